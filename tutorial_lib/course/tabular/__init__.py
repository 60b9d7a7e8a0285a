"""Constrained Markov decision processes small enough to solve exactly: the ground truth of the course.

S states, A actions, float64 throughout. A policy is an (S, A) array of probabilities. Values and limits here
are discounted sums (eq. 2) unless a horizon is given; then they are the plain sums of eq. 1.
"""

from tutorial_lib.course.tabular.budgets import *
from tutorial_lib.course.tabular.cmdp import *
from tutorial_lib.course.tabular.examples import *
from tutorial_lib.course.tabular.general import *
from tutorial_lib.course.tabular.implicit import *
from tutorial_lib.course.tabular.optimal import *
