"""This module checks the answers to the exercises of notebook 3."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.checks.checker import try_answer


def check_expectile(answer: Callable) -> None:
    """Checks an exercise of notebook 3.

    `answer(values, kappa)` returns the expectile of equally frequent values.
    """
    try_answer(
        answer,
        [
            ((np.array([1.0, 2.0, 6.0]), 0.5), 3.0, "at kappa = 0.5 all weigh the same: the mean"),
            ((np.array([4.0, 4.0]), 0.9), 4.0, "equal values have one expectile"),
            ((np.array([0.0, 1.0]), 0.9), 0.9, "V = (0.1 * 0 + 0.9 * 1) / (0.1 + 0.9)"),
            ((np.array([0.0, 0.0, 0.0, 10.0]), 0.9), 7.5, "V = 9 / (3 * 0.1 + 0.9): divide by the weights"),
            ((np.array([0.0, 4.0, 10.0]), 0.9), 9.4 / 1.1, "V moves, and so does who is better than V"),
            ((np.arange(10.0), 0.97), 17.33 / 2.18, "repeat until V stops moving: one round is not enough"),
            ((np.array([0.0, 4.0, 10.0]), 0.1), 1.4 / 1.1, "below 0.5 it leans to the worst"),
        ],
    )


def check_linex_weight(answer: Callable) -> None:
    """Checks an exercise of notebook 3.

    `answer(u, a)` returns the weight |f'(u)| / |u| of f(u) = exp(a u) - a u. At u = 0 it returns the value
    that this ratio approaches.
    """
    try_answer(
        answer,
        [
            ((np.array([2.0]), 1.0), np.array([(np.exp(2.0) - 1) / 2]), "f'(u) = a exp(a u) - a, over |u|"),
            ((np.array([1.0]), 2.0), np.array([2 * (np.exp(2.0) - 1)]), "f'(u) = a exp(a u) - a, a twice"),
            (
                (np.array([-1.0]), 1.0),
                np.array([1 - np.exp(-1.0)]),
                "a weight is positive: take |f'| and |u|",
            ),
            (
                (np.array([0.0, 1.0]), 1.0),
                np.array([1.0, np.exp(1.0) - 1]),
                "at u = 0 the ratio has a limit: f''(0)",
            ),
            ((np.array([0.0]), 3.0), np.array([9.0]), "at u = 0 the limit is f''(0) = a^2"),
        ],
    )
