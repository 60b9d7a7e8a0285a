"""How a sum of costs can be recovered from m discounted sums, and what errors in these do to it.

The m discounted sums are called heads, as the m outputs of a cost critic. In a weighted sum of the heads, a
cost at step t has the weight sum_i w_i gamma_i^t. If this weight is 1 at every step, the weighted sum is the
undiscounted sum.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.optimize import linprog

from tutorial_lib.costs.reconstruction import CostReconstruction
from tutorial_lib.tasks import Task


def flat_weights(gammas: ArrayLike, horizon: int) -> np.ndarray:
    """Weights (m,) for which sum_i w_i gamma_i^t is nearest to 1 on steps 0 to horizon - 1, by least squares.

    They are exact where m = horizon. They are a linear reconstruction without any data, in which the costs of
    all steps are equally important.
    """
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))  # (m, T)
    return np.linalg.lstsq(powers.T, np.ones(horizon))[0]


def weight_curve(weights: np.ndarray | Sequence[float], gammas: ArrayLike, steps: int) -> np.ndarray:
    """sum_i w_i gamma_i^t, (steps,): the weight of a cost at step t in the weighted sum of the heads."""
    return weights @ np.power.outer(np.asarray(gammas, float), np.arange(steps))


def linear_weights(model: CostReconstruction) -> np.ndarray:
    """The weights (m,) of a linear reconstruction model: unsafe steps per unit of discounted cost.

    Raises ValueError for a model that is not linear.
    """
    if not isinstance(model.net, torch.nn.Linear):
        raise ValueError("only a linear model has weights for its heads: train one with crm='linear'")
    return (model.whiten @ model.net.weight[0]).detach().double().cpu().numpy() * model.horizon


def steady_heads(task: Task, cost: float, time_limits: str = "rate", step: int = 0) -> np.ndarray:
    """The heads (m,) that exact critics give to the reconstruction when every step has the same cost.

    `cost` is the cost of an episode. `time_limits` is the option of C2IQL: with 'bootstrap' the critics sum
    over an endless future; with 'rate' that sum is multiplied by 1 - gamma_i^T, the share of the first T
    steps, which is exact here; with 'mask' they sum over the steps that are left at `step`. Raises ValueError
    for another word.
    """
    gammas = np.asarray(task.gammas)
    for_ever = cost / task.horizon / (1 - gammas)
    steps_seen = {"bootstrap": np.inf, "rate": task.horizon, "mask": task.horizon - step}
    if time_limits not in steps_seen:
        raise ValueError(f"unknown time_limits {time_limits!r}: must be one of {', '.join(steps_seen)}")
    return for_ever * (1 - gammas ** steps_seen[time_limits])


def extremal_costs(heads: ArrayLike, gammas: ArrayLike, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """The sequences of costs in [0, 1], (T,), with the least and the largest sum that have these heads, (m,).

    They solve two linear programmes over the feasible set of eq. 19. All their costs are NaN where no
    sequence has these heads.
    """
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))
    return _extremal(np.ones(horizon), powers, heads)


def cost_bounds(heads: ArrayLike, gammas: ArrayLike, horizon: int) -> tuple[float, float]:
    """The least and the largest undiscounted sum of T costs in [0, 1] that have these heads, (m,).

    The result is (nan, nan) where no sequence has these heads.
    """
    least, most = extremal_costs(heads, gammas, horizon)
    return least.sum(), most.sum()


def head_bounds(heads: ArrayLike, head: int, gammas: ArrayLike, horizon: int) -> tuple[float, float]:
    """The least and the largest value that `heads[head]` can have, given the other heads.

    `heads` are (m,). The result is (nan, nan) where no sequence of costs in [0, 1] has the other heads.
    """
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))
    others = np.arange(len(powers)) != head
    least, most = _extremal(powers[head], powers[others], np.asarray(heads)[others])
    return powers[head] @ least, powers[head] @ most


def _extremal(objective: np.ndarray, powers: np.ndarray, heads: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Costs (T,) in [0, 1] with powers @ costs = heads: with the least and the largest objective @ costs."""
    # Each head is divided by its largest possible value, so that the solver's tolerance is the same for all.
    scale = powers.sum(1)
    equal = {"A_eq": powers / scale[:, None], "b_eq": np.asarray(heads) / scale, "bounds": (0, 1)}
    least, most = (linprog(sign * objective, **equal, method="highs") for sign in (1, -1))
    if least.status or most.status:
        nothing = np.full(powers.shape[1], np.nan)
        return nothing, nothing
    return least.x, most.x
