"""This module checks the answers to the exercises of notebook 8."""

from collections.abc import Callable

import numpy as np
import torch

from tutorial_lib.course.checks.checker import try_answer


class _Slope:
    """This is the derivative f'(u) of a convex loss, whose name is its text in a message."""

    def __init__(self, name: str, function: Callable):
        self.name, self.function = name, function

    def __call__(self, u):
        return self.function(np.asarray(u, float))

    def __str__(self):
        return self.name


def check_implicit_policy(answer: Callable) -> None:
    """Checks an exercise of notebook 8.

    `answer(mu, q, v, slope)` returns the implicit policy of Theorem 1. `mu`, `q` and the result have the
    shape (..., A), where A is the number of actions. `v` has the shape (..., 1), or is a number.
    """
    square = _Slope("2u", lambda u: 2 * u)
    expectile = _Slope("0.7-expectile", lambda u: 2 * np.where(u < 0, 0.3, 0.7) * u)
    linex = _Slope("linex", np.expm1)
    mu, q = np.array([0.5, 0.3, 0.2]), np.array([1.0, 4.0, -2.0])
    weighted = mu * np.array([0.3, 0.7, 0.3])
    u = q - 2.0
    exact, touching = mu * np.expm1(u) / u, mu * np.array([-np.expm1(-3.0) / 3, 1.0, -np.expm1(-6.0) / 6])
    states, values = np.array([mu, mu]), np.array([[2.0], [2.0]])
    try_answer(
        answer,
        [
            ((mu, q, 0.5, square), mu, "a square weighs all alike, so pi_imp is mu: divide by the sum"),
            ((mu, q, 2.0, expectile), weighted / weighted.sum(), "mu times |f'(u)| / |u| with u = q - v"),
            ((mu, q, 2.0, linex), exact / exact.sum(), "mu times |f'(u)| / |u| with u = q - v"),
            ((mu, q, 4.0, linex), touching / touching.sum(), "one action is worth just v: take the limit 1"),
            (
                (states, np.array([q, q]), values, expectile),
                np.array([weighted, weighted]) / weighted.sum(),
                "two states: each has a sum of its own, over the last axis",
            ),
        ],
    )


def check_batched_loss(answer: Callable) -> None:
    """Checks an exercise of notebook 8.

    `answer(weight, q_cost, value)` returns the loss of eq. 17. The tensors have the shapes (B,), (B, 1) and
    (B,), where B is the number of transitions.
    """
    rng = np.random.default_rng(0)
    weight, q_cost, value = rng.random(5).round(1), rng.random((5, 1)).round(1), rng.random(5).round(1)
    loop = [w * (q[0] - v) ** 2 for w, q, v in zip(weight, q_cost, value, strict=True)]
    cases = [
        (([1.0], [[3.0]], [1.0]), 4.0, "one transition: its weight times its squared error"),
        (([1.0, 1.0], [[0.0], [10.0]], [0.0, 10.0]), 0.0, "both values are right: two errors, not four"),
        (([1.0, 1.0], [[2.0], [0.0]], [0.0, 0.0]), 2.0, "a mean over the two transitions"),
        (([1.0, 0.0], [[4.0], [0.0]], [0.0, 0.0]), 8.0, "each error has its own weight: print both shapes"),
        ((weight, q_cost, value), float(np.mean(loop)), "compare with a loop over the transitions"),
    ]
    tensors = [(tuple(torch.tensor(np.array(part)) for part in x), *rest) for x, *rest in cases]
    try_answer(answer, tensors)
