"""This module checks the answers to the exercises of notebook 8."""

from collections.abc import Callable

import numpy as np
import torch

from tutorial_lib.course.checks.checker import text, try_answer
from tutorial_lib.course.tabular import expectile, expectile_weight, implicit_policy


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


def check_priced_q(answer: Callable) -> None:
    """Checks an exercise of notebook 8.

    `answer(q_reward, q_cost, v_cost, limit, price)` returns the priced values, (S, A). Q_r and Q_c are
    (S, A), and V_c is (S,).
    """
    q_r, q_c = np.array([[5.0, -5.0, -9.0]]), np.array([[10.0, 40.0, 90.0]])
    rng = np.random.default_rng(0)
    rewards, costs, state = 10 * rng.normal(size=(4, 3)), 60 * rng.random((4, 3)), 60 * rng.random(4)
    excess = [[max(0.0, x - 30) - max(0.0, v - 30) for x in row] for row, v in zip(costs, state, strict=True)]
    cases = [
        ((q_r, q_c, np.array([20.0]), 100.0, 2.0), q_r, "all costs keep the limit: nothing is paid"),
        (
            (q_r, q_c, np.array([20.0]), 30.0, 2.0),
            np.array([[5.0, -25.0, -129.0]]),
            "an action pays for its cost beyond the limit: 2 (40 - 30) and 2 (90 - 30), and it keeps its Q_r",
        ),
        (
            (q_r, q_c, np.array([50.0]), 30.0, 2.0),
            np.array([[45.0, 15.0, -89.0]]),
            "what the state pays in any case, 2 (50 - 30), is given back to each of its actions",
        ),
        ((q_r, q_c, np.array([50.0]), np.inf, 2.0), q_r, "under an infinite limit nothing is paid"),
        (
            (rewards, costs, state, 30.0, 0.5),
            rewards - 0.5 * np.array(excess),
            "V_c is (S,): v_cost[:, None] stands beside each of the actions of its own state",
        ),
    ]
    try_answer(answer, cases)


def check_sign_trap(q_reward, q_cost, limit) -> None:
    """Checks an exercise of notebook 8: a state in which the zero of eq. 11 prefers an unsafe action.

    The unsafe action must earn less than a safe one. Q_r and Q_c (A,) belong to the same actions.
    """
    mistake = _sign_trap_mistake(q_reward, q_cost, limit)
    if mistake:
        print(f"NOT YET  {mistake}")
        return
    q_r, q_c = np.asarray(q_reward, float), np.asarray(q_cost, float)
    even = np.full((1, len(q_r)), 1 / len(q_r))
    penalised = np.where(q_c <= float(limit), q_r, 0.0)[None]
    value = expectile(even, penalised, 0.9)
    policy = implicit_policy(even, penalised, value, lambda u: expectile_weight(u, 0.9))[0]
    print(f"OK  eq. 11 prefers an unsafe action: Q_(r|c) = {text(penalised[0])}")
    print(f"    cost with mu even: {text(q_c.mean())}; cost of pi_imp with kappa 0.9: {text(policy @ q_c)}")


def _sign_trap_mistake(q_reward, q_cost, limit) -> str:
    """Returns what keeps an answer of `check_sign_trap` from being a trap, or an empty text."""
    if any(part is ... for part in (q_reward, q_cost, limit)):
        return "write numbers in place of the `...`"
    try:
        q_r, q_c, limit = np.asarray(q_reward, float), np.asarray(q_cost, float), float(limit)
    except (TypeError, ValueError):
        return "q_reward and q_cost are lists of numbers, and limit is a number"
    if q_r.ndim != 1 or q_r.shape != q_c.shape or len(q_r) < 2:
        return f"Q_r and Q_c need a number per action, for two actions or more: {q_r.shape}, {q_c.shape}"
    if not np.isfinite([*q_r, *q_c]).all() or (q_c < 0).any():
        return "all Q must be finite, and a cost is not negative"
    safe = q_c <= limit
    if safe.all():
        return "all actions are safe, so nothing is penalised: one must cost more than the limit"
    if not safe.any():
        return "no action is safe, so all are worth 0 and pi_imp is mu: that is another trap. Keep one safe"
    if q_r[~safe].max() >= q_r[safe].max():
        return (
            "an unsafe action earns most even without a penalty: the best safe one must have the higher Q_r"
        )
    if q_r[safe].max() > 0:
        return "the best safe action has Q_r > 0 and zero is below it: a punishment. When is zero a reward?"
    if q_r[safe].max() == 0:
        return "the best safe action has Q_r = 0, a draw with the unsafe one: which sign of Q_r breaks it?"
    return ""
