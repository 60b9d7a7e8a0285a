"""The course's figures: each function draws one and returns it, closed, so that a notebook shows it once,
where it is the last value of a cell. One file per idea of the course.
"""

from tutorial_lib.plotting.cmdp import *
from tutorial_lib.plotting.conditioning import *
from tutorial_lib.plotting.discounting import *
from tutorial_lib.plotting.episodes import *
from tutorial_lib.plotting.logs import *
from tutorial_lib.plotting.luck import *
from tutorial_lib.plotting.ood import *
from tutorial_lib.plotting.penalty import *
from tutorial_lib.plotting.reconstruction import *
from tutorial_lib.plotting.results import *
from tutorial_lib.plotting.speed import *
from tutorial_lib.plotting.studies import *
from tutorial_lib.plotting.style import *
