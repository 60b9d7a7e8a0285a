"""Checks that follow a notebook's claims, and checkers for its exercises, one file per notebook.

A check prints a line without the value that it found, so that a notebook's outputs compare across
machines; where the claim fails, it raises AssertionError with the value. An exercise's checker never
raises: it prints what is wrong, or OK.
"""

from tutorial_lib.course.checks.c2iql import *
from tutorial_lib.course.checks.checker import *
from tutorial_lib.course.checks.cmdp import *
from tutorial_lib.course.checks.conditioning import *
from tutorial_lib.course.checks.discounting import *
from tutorial_lib.course.checks.iql import *
from tutorial_lib.course.checks.penalty import *
from tutorial_lib.course.checks.reconstruction import *
from tutorial_lib.course.checks.recordings import *
from tutorial_lib.course.checks.start import *
from tutorial_lib.course.checks.studies import *
