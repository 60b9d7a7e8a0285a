"""This module checks the answers to the exercises of notebook 1."""

import functools
from collections.abc import Callable

import numpy as np

from tutorial_lib.course.checks.checker import try_answer
from tutorial_lib.course.tabular import CMDP, least_cost, shortcut, solve_priced

_CLOSE = 1e-3
"""A result that differs by at most this from the true value is right, because iterations stop somewhere."""


def _small_world(moves, costs, initial, gamma: float) -> CMDP:
    """Returns a CMDP of two states without rewards. `moves` has the matrix (2, 2) of each action."""
    return CMDP(np.stack(moves, 1), np.zeros((2, 2)), np.array(costs), np.array(initial), gamma)


_STAY, _SWAP = np.eye(2), np.eye(2)[::-1]
_ONE_STATE = CMDP(np.ones((1, 2, 1)), np.zeros((1, 2)), np.array([[1.0, 0.25]]), np.ones(1), 0.9)
# In state 0, the action "stay" costs 0.5 at every step, and the action "swap" costs 1 once.
_PATIENCE = _small_world((_STAY, _SWAP), [[0.5, 1.0], [0.0, 0.0]], [1.0, 0.0], 0.9)
_SPREAD = _small_world((_STAY, _STAY), [[1.0, 1.0], [0.0, 0.0]], [0.75, 0.25], 0.5)


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
    hints = (
        (_ONE_STATE, "0.25 at every step, discounted: 0.25 / (1 - gamma). Nearly right? Iterate longer"),
        (_SPREAD, "the start is drawn from `cmdp.initial`: average V over it"),
        (
            _PATIENCE,
            "the cheapest action now may lead to a costly future: look ahead, min over a of c + gamma P V",
        ),
        (shortcut(), "the shortcut's: iterate until nothing moves any more, some 200 times"),
        (shortcut(slip=0.4), "the shortcut's, with more slips"),
    )
    cases = [((cmdp,), least_cost(cmdp), hint) for cmdp, hint in hints]
    try_answer(_one_number(answer, least_cost), cases)


def check_best_for_price(answer: Callable) -> None:
    """Checks an exercise of notebook 1.

    `answer(cmdp, price)` returns the largest R - price * C of all policies, in discounted sums.
    """
    earns = CMDP(np.ones((1, 2, 1)), np.array([[1.0, 2.0]]), np.array([[0.0, 1.0]]), np.ones(1), 0.9)
    hints = (
        ((earns, 0.0), "at the price 0 only the reward counts: 2 at every step, discounted"),
        ((earns, 0.5), "the second action is worth 2 - 0.5 * 1 at every step"),
        ((earns, 3.0), "at the price 3 the first action is better, which earns 1 and costs nothing"),
        ((_PATIENCE, 1.0), "look ahead: max over a of r - price * c + gamma P V. Values can be negative"),
        ((_SPREAD, 2.0), "the start is drawn from `cmdp.initial`: average V over it"),
        ((shortcut(), 0.733), "the shortcut's: iterate until nothing moves any more, some 200 times"),
        ((shortcut(), 5.0), "the shortcut's, where a unit of cost is expensive"),
    )
    cases = [(arguments, _lagrangian(*arguments), hint) for arguments, hint in hints]
    try_answer(_one_number(answer, _lagrangian), cases)


def _lagrangian(cmdp: CMDP, price: float) -> float:
    """Returns the largest R - price * C, by the linear programme."""
    found = solve_priced(cmdp, price)
    return found.reward - price * found.cost


def _one_number(answer: Callable, truth: Callable) -> Callable:
    """Returns `answer`, where a number that is close to `truth` is equal to it.

    A result of several numbers, such as one value for each state, is an error that says so. What is no number
    stays as it is.
    """

    @functools.wraps(answer)
    def number(*arguments):
        got = answer(*arguments)
        count = int(np.prod(np.shape(got)))
        if count > 1:
            raise ValueError(f"it returns {count} numbers: average V over the start, cmdp.initial @ V")
        try:
            value = float(np.squeeze(got))
        except (TypeError, ValueError):
            return got
        true = truth(*arguments)
        return true if abs(value - true) <= _CLOSE else value

    return number
