"""This module checks the answers to the exercises of notebook 10."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import torch

from tutorial_lib.course.checks.checker import given, name_of, text, try_answer


def mended_batch(seed: int = 0, size: int = 48, heads: int = 3) -> SimpleNamespace:
    """Returns random numbers for the exercise with a wrong cost loss, as float64 tensors.

    `cost` and `weight` (the M of eq. 17) are (B,). The heads `q_c`, `q_c_target`, `v_c` and `v_c_next` are
    (B, m), in discounted cost.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    x = SimpleNamespace(cost=draw(size).round(), weight=torch.where(draw(size) < 0.5, 0.3, 0.7).double())
    for name in ("q_c", "q_c_target", "v_c", "v_c_next"):
        setattr(x, name, 30 * draw(size, heads))
    return x


_MISTAKES = (
    ({"here": True, "weighted": True}, "this is still the wrong loss. It has two mistakes"),
    ({"here": True}, "V_c is still taken at s: line 18 of Algorithm 2 has the next state, s'"),
    ({"one_gamma": True}, "each head has a discount factor of its own: gammas, (m,), not one number"),
    ({"target": True}, "line 18 trains Q_c itself: its target network stands in line 14"),
    ({"weighted": True}, "the weight M belongs to line 14: what follows an action does not depend on M"),
    ({"undiscounted": True}, "the discount factors are missing: a head is a discounted sum"),
)


def _cost_loss_by_loop(x: SimpleNamespace, gammas, **mistake) -> float:
    """Returns the loss of line 18, summed over heads, in a loop. A `mistake` makes one of the likely ones."""
    total = 0.0
    for i in range(len(x.cost)):
        for j, own in enumerate(gammas):
            factor = gammas[1] if mistake.get("one_gamma") else 1.0 if mistake.get("undiscounted") else own
            follows = x.v_c[i, j] if mistake.get("here") else x.v_c_next[i, j]
            predicted = x.q_c_target[i, j] if mistake.get("target") else x.q_c[i, j]
            weight = float(x.weight[i]) if mistake.get("weighted") else 1.0
            total += weight * (float(x.cost[i]) + factor * float(follows) - float(predicted)) ** 2
    return total / len(x.cost)


def check_mended_loss(answer: Callable) -> None:
    """Checks an exercise of notebook 10: `answer(x, gammas)` returns the loss of Q_c (line 18).

    `x` is a batch as in `mended_batch`. The loss of m heads may be their sum or their mean.
    """
    x, gammas = mended_batch(), (0.9, 0.95, 0.97)
    name = name_of(answer)
    arguments = x, torch.tensor(gammas, dtype=torch.float64)
    found = given(answer, arguments, read=lambda got: np.asarray(got, float))
    if found is None:
        return
    if found.ndim:
        print(f"NOT YET  {name} returns the shape {found.shape}: a loss is one number, a mean over the batch")
        return
    right = _cost_loss_by_loop(x, gammas)
    if _sum_or_mean(found, right):
        print(f"OK  {name} is the loss of line 18")
        return
    for mistake, hint in _MISTAKES:
        if _sum_or_mean(found, _cost_loss_by_loop(x, gammas, **mistake)):
            print(f"NOT YET  {name} = {text(found)}, expected {text(right)}: {hint}")
            return
    print(f"NOT YET  {name} = {text(found)}, expected {text(right)}: it is not c + gamma_i V_c(s') - Q_c yet")


def _sum_or_mean(found, sum_of_heads: float, heads: int = 3) -> bool:
    return bool(np.isclose(found, [sum_of_heads, sum_of_heads / heads], rtol=1e-6).any())


def check_policy_weights(answer: Callable) -> None:
    """Checks an exercise of notebook 10.

    `answer(q_r, cost, limit, v_r, kappa)` returns the weights of eq. 18 for the actions of one state, (A,).
    `q_r` and `cost` are (A,), and an action beyond the limit is worth zero, as in eq. 11.
    """
    q_r, cost = np.array([5.0, 9.0, 2.0]), np.array([10.0, 40.0, 30.0])
    rng = np.random.default_rng(0)
    many = rng.normal(size=8).round(2), (60 * rng.random(8)).round()
    loop = [0.1 if (q if c <= 30 else 0.0) - 0.25 < 0 else 0.9 for q, c in zip(*many, strict=True)]
    try_answer(
        answer,
        [
            (
                (q_r, cost, np.inf, 4.0, 0.9),
                np.array([0.9, 0.9, 0.1]),
                "kappa at and above V_r, else 1 - kappa",
            ),
            (
                (q_r, cost, 30.0, 4.0, 0.9),
                np.array([0.9, 0.1, 0.1]),
                "the second action costs 40: it is worth 0, which is below V_r",
            ),
            (
                (q_r, cost, 30.0, 1.0, 0.8),
                np.array([0.8, 0.2, 0.8]),
                "a cost of exactly the limit keeps it; the weights need not sum to one",
            ),
            (
                (-q_r, cost, 30.0, -3.0, 0.9),
                np.array([0.1, 0.9, 0.9]),
                "zero is above a negative V_r: there the unsafe action gets kappa",
            ),
            ((q_r, cost, 0.0, 0.0, 0.7), np.array([0.7, 0.7, 0.7]), "u = 0 counts as not below"),
            ((*many, 30.0, 0.25, 0.9), np.array(loop), "compare with a loop over the actions"),
        ],
    )
