"""This module checks the answers to the exercises of notebook 9."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.costs.conditioning import rescaled_budget
from tutorial_lib.course.checks.checker import try_answer
from tutorial_lib.course.tabular import budget_optimum, random_cmdp


def check_rescaled_budget(answer: Callable) -> None:
    """Checks an exercise of notebook 9: `answer(limit, spent, t, horizon)` returns the value of eq. 23."""
    hints = {
        (30.0, 0.0, 0, 200): "at the start: the limit itself",
        (30.0, 15.0, 100, 200): "half spent at half time: on schedule, the limit itself",
        (30.0, 0.0, 100, 200): "all of the budget for half of the steps counts double",
        (30.0, 40.0, 150, 200): "overspent: negative; what to make of that, the nearest threshold settles",
        (30.0, 5.0, 199, 200): "one step is left for all of the 25",
        (np.inf, 50.0, 10, 200): "no limit stays none",
    }
    try_answer(answer, [(case, float(rescaled_budget(*case)), hint) for case, hint in hints.items()])


def check_budget_backup(answer: Callable) -> None:
    """Checks an exercise of notebook 9.

    `answer(cmdp, then)` computes one backward step of the budget recursion. `then` and the result have the
    shape (b+1, S), where b is the budget and S is the number of states.
    """
    rng = np.random.default_rng(0)
    cases = []
    for states, budget, hint in (
        (3, 0, "without a budget only actions that cost nothing are to be had"),
        (3, 2, "after an action with cost c the value of the next state is then[b - c]"),
        (4, 3, "where no action is affordable the episode is stopped, at the value 0"),
    ):
        cmdp = random_cmdp(rng, states)
        values, _ = budget_optimum(cmdp, 6, budget)
        cases.append(((_Shown(cmdp), values[3]), values[2], hint))
    try_answer(answer, cases)


class _Shown:
    """This is a CMDP whose text in a message is only the word `cmdp`."""

    def __init__(self, cmdp):
        self.transitions, self.rewards, self.costs = cmdp.transitions, cmdp.rewards, cmdp.costs

    def __str__(self):
        return "cmdp"
