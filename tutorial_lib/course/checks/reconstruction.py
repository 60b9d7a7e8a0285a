"""This module checks the answers to the exercises of notebook 6."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.checks.checker import try_answer
from tutorial_lib.tasks import TASKS


def check_flat_weights(answer: Callable) -> None:
    """Checks an exercise of notebook 6.

    `answer(gammas, horizon)` returns the weights w that minimise the sum over steps t of
    (sum over heads i of w_i gamma_i^t - 1)^2.
    """
    hints = {
        ((0.5,), 1): "one step and one head: a weight of 1",
        ((0.9, 0.5), 2): "two heads for two steps: exact, w_1 + w_2 = 1 and 0.9 w_1 + 0.5 w_2 = 1",
        ((0.9,), 10): "one head: (sum of gamma^t) / (sum of gamma^2t)",
    }
    hints |= {
        (TASKS[name].gammas, TASKS[name].horizon): f"{name}: minimise the sum over all steps"
        for name in ("CarCircle", "BallRun")
    }
    cases = []
    for (gammas, horizon), hint in hints.items():
        # These are the normal equations. Their sums over steps are geometric series.
        products = np.multiply.outer(gammas, gammas)
        gram = (1 - products**horizon) / (1 - products)
        sums = (1 - np.array(gammas) ** horizon) / (1 - np.array(gammas))
        cases.append(((np.array(gammas), horizon), np.linalg.solve(gram, sums), hint))
    try_answer(answer, cases)


def check_error_in_cost(answer: Callable) -> None:
    """Checks an exercise of notebook 6.

    `answer(weights, error)` returns three errors of the reconstructed cost, where every head has an error of
    size `error`: for independent errors, for errors with the worst signs, and for a common error.
    """
    small, large = np.array([3.0, -4.0]), np.array([8.3, -21.1, 13.9])
    three_ways = (np.sqrt(707.31) / 10, 4.33, 0.11)  # because 8.3^2 + 21.1^2 + 13.9^2 = 707.31
    cases = [
        ((small, 1.0), (5.0, 7.0, 1.0), "independent 5, worst 7, common 1: add squares, sizes, values"),
        ((np.array([2.0]), 0.5), (1.0, 1.0, 1.0), "with one head, all three are the same"),
        ((large, 0.1), three_ways, "variances of independent errors add up"),
        ((-large, 0.1), three_ways, "a size has no sign"),
    ]
    try_answer(answer, cases)
