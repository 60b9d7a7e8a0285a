"""This module checks the answers to the exercises of notebook 1."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.checks.checker import try_answer
from tutorial_lib.course.tabular import CMDP, least_cost, shortcut


def check_run_cost(answer: Callable) -> None:
    """Checks an exercise of notebook 1.

    `answer(y, speed, speed_limit)` returns the cost of a step in a Run task.
    """
    try_answer(
        answer,
        [
            ((0.0, 1.0, 2.5), 0.0, "between the walls and slow: safe"),
            ((2.1, 1.0, 2.5), 1.0, "beyond the wall at y = 2"),
            ((-2.1, 1.0, 2.5), 1.0, "there are two walls: y = -2 is the other"),
            ((0.5, 2.6, 2.5), 1.0, "between the walls, but too fast"),
            ((0.5, 2.6, 3.0), 0.0, "the limit is this robot's `speed_limit`"),
            ((3.0, 9.0, 2.5), 1.0, "twice unsafe is unsafe: a step costs 1 at most"),
            ((2.0, 2.5, 2.5), 0.0, "on the line and at the limit is still safe"),
        ],
    )


def check_least_cost(answer: Callable) -> None:
    """Checks an exercise of notebook 1: `answer(cmdp)` returns the least discounted cost of all policies."""
    stay, swap = np.eye(2), np.eye(2)[::-1]
    zeros, first = np.zeros((2, 2)), np.array([1.0, 0.0])
    one_state = CMDP(np.ones((1, 2, 1)), zeros[:1], np.array([[1.0, 0.25]]), np.ones(1), 0.9)
    # In state 0, the action "stay" costs 0.5 at every step, and the action "swap" costs 1 once.
    patience = CMDP(np.stack([stay, swap], 1), zeros, np.array([[0.5, 1.0], [0.0, 0.0]]), first, 0.9)
    spread = CMDP(np.stack([stay, stay], 1), zeros, np.array([[1.0, 1.0], [0.0, 0.0]]), first / 2 + 0.25, 0.5)
    hints = (
        (one_state, "0.25 at every step, discounted: 0.25 / (1 - gamma)"),
        (
            patience,
            "the cheapest action now may lead to a dear future: look ahead, min over a of c + gamma P V",
        ),
        (spread, "the start is drawn from `cmdp.initial`: average V over it"),
        (shortcut(), "the shortcut's: iterate until nothing moves any more"),
        (shortcut(slip=0.4), "the shortcut's, with more slips"),
    )
    try_answer(answer, [((cmdp,), least_cost(cmdp), hint) for cmdp, hint in hints])
