"""This module checks the answers to the exercises of notebook 11."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.checks.checker import try_answer


def check_implicit_cost_value(answer: Callable) -> None:
    """Checks an exercise of notebook 11.

    `answer(q, v, q_cost, kappa)` returns V_c of one state, which is the cost under the implicit policy.
    """
    cost = np.array([0.0, 10.0, 20.0])
    try_answer(
        answer,
        [
            (
                (np.array([1.0, 1.0, 1.0]), 0.0, cost, 0.7),
                10.0,
                "equal weights give the plain mean: divide by the sum of M",
            ),
            (
                (np.array([-1.0, -1.0, -1.0]), 0.0, cost, 0.7),
                10.0,
                "below V all weigh the same: divide by the sum of M",
            ),
            ((np.array([1.0, -1.0, -1.0]), 0.0, cost, 0.5), 10.0, "at kappa = 0.5 all weigh the same"),
            (
                (np.array([5.0, 2.0, 3.0]), 4.0, cost, 0.7),
                90 / 13,
                "M is kappa where Q >= V, and 1 - kappa elsewhere",
            ),
            (
                (np.array([1.0, 0.0, -1.0]), 0.0, cost, 0.9),
                110 / 19,
                "an action just as good as V counts as better",
            ),
        ],
    )


def check_condition(answer: Callable) -> None:
    """Checks an exercise of notebook 11.

    `answer(limit, spent, t, horizon, thresholds)` returns the threshold that eq. 23 selects at step t.
    """
    choices, cases = (30.0, 50.0, 70.0), []
    for limit, spent, t, expected, hint in (
        (30.0, 0.0, 0, 30.0, "at the start nothing is spent: the limit itself"),
        (34.0, 0.0, 100, 70.0, "half the time is left and all of the budget: it counts double, 68"),
        (
            50.0,
            40.0,
            100,
            30.0,
            "10 left for half of the time is a rate of 20 per episode: the nearest is 30",
        ),
        (
            30.0,
            45.0,
            150,
            30.0,
            "overspent: the budget is negative, and the smallest threshold is the nearest",
        ),
        (70.0, 0.0, 199, 70.0, "near the end eq. 23 grows without bound: the largest is the nearest"),
        (45.0, 5.0, 50, 50.0, "40 left for three quarters of the time is 53 per episode"),
    ):
        cases.append(((limit, spent, t, 200, choices), expected, hint))
    try_answer(answer, cases)
