"""The figures of the course, one file for each topic.

Each function draws one figure, closes it and returns it. A notebook therefore shows it once, where it is the
last value of a cell.
"""

from tutorial_lib.course.figures.cmdp import *
from tutorial_lib.course.figures.conditioning import *
from tutorial_lib.course.figures.discounting import *
from tutorial_lib.course.figures.episodes import *
from tutorial_lib.course.figures.failures import *
from tutorial_lib.course.figures.from_scratch import *
from tutorial_lib.course.figures.keeping import *
from tutorial_lib.course.figures.luck import *
from tutorial_lib.course.figures.maximisation_bias import *
from tutorial_lib.course.figures.method_map import *
from tutorial_lib.course.figures.penalty import *
from tutorial_lib.course.figures.reconstruction import *
from tutorial_lib.course.figures.recordings import *
from tutorial_lib.course.figures.results import *
from tutorial_lib.course.figures.safety import *
from tutorial_lib.course.figures.shortcut import *
from tutorial_lib.course.figures.whole import *
from tutorial_lib.studies.figures import *
from tutorial_lib.style import *
