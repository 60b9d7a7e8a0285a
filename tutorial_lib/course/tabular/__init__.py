"""Constrained Markov decision processes (CMDPs) that are small enough to be solved exactly.

They give the course its true values. There are S states and A actions, and all numbers are float64. A policy
is an (S, A) array of probabilities. Values and limits are discounted sums (eq. 2), except in functions with a
horizon: there they are the undiscounted sums of eq. 1.
"""

from tutorial_lib.course.tabular.budgets import *
from tutorial_lib.course.tabular.cmdp import *
from tutorial_lib.course.tabular.examples import *
from tutorial_lib.course.tabular.general import *
from tutorial_lib.course.tabular.implicit import *
from tutorial_lib.course.tabular.optimal import *
