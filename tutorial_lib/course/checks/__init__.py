"""This package holds the checks of the notebooks' claims and the checkers of their exercises.

There is one file for each notebook; notebooks 13 and 14 share `studies.py`, and all share `checker.py`.

A check prints one line where the claim is true: what was found, rounded, and what was expected. The
comparison of a notebook's outputs passes over what was found, because it differs a little between machines.
A check raises AssertionError where the claim is false. The checker of an exercise does not raise errors. It
prints OK or the first mistake.
"""

from tutorial_lib.course.checks.c2iql import *
from tutorial_lib.course.checks.checker import *
from tutorial_lib.course.checks.cmdp import *
from tutorial_lib.course.checks.conditioning import *
from tutorial_lib.course.checks.discounting import *
from tutorial_lib.course.checks.failures import *
from tutorial_lib.course.checks.from_scratch import *
from tutorial_lib.course.checks.iql import *
from tutorial_lib.course.checks.keeping import *
from tutorial_lib.course.checks.penalty import *
from tutorial_lib.course.checks.reconstruction import *
from tutorial_lib.course.checks.recordings import *
from tutorial_lib.course.checks.safety import *
from tutorial_lib.course.checks.start import *
from tutorial_lib.course.checks.studies import *
