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

from tutorial_lib.agents import C2IQL
from tutorial_lib.costs.reconstruction import CostReconstruction
from tutorial_lib.data.dataset import Dataset
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


def critic_heads(agent: C2IQL, dataset: Dataset, n: int, seed: int = 0) -> np.ndarray:
    """The heads (n, m) that an agent's first cost critic gives to the reconstruction, for n transitions.

    The transitions are drawn at random from the dataset. The limit is the task's typical one, and the heads
    are scaled as option `time_limits` says.
    """
    rows = np.random.default_rng(seed).choice(len(dataset), n, replace=False)
    limits = torch.full((n,), float(agent.task.typical_limit))
    net = agent.networks()
    s = agent.network_input(net, torch.tensor(dataset.observations[rows]), limits)
    q = net.cost_critics(s, torch.tensor(dataset.actions[rows]))[0].detach().double().numpy()
    gammas = np.asarray(agent.task.gammas)
    return q * (1 - gammas**agent.task.horizon) if agent.config.time_limits == "rate" else q


def cost_bounds(heads: ArrayLike, gammas: ArrayLike, horizon: int) -> tuple[float, float]:
    """The least and the largest undiscounted sum of T costs in [0, 1] that have these heads, (m,).

    Two linear programmes over the feasible set of eq. 19. The result is (nan, nan) where no sequence has
    these heads.
    """
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))
    return _extremes(np.ones(horizon), powers, heads)


def head_bounds(heads: ArrayLike, head: int, gammas: ArrayLike, horizon: int) -> tuple[float, float]:
    """The least and the largest value that `heads[head]` can have, given the other heads.

    `heads` are (m,). The result is (nan, nan) where no sequence of costs in [0, 1] has the other heads.
    """
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))
    others = np.arange(len(powers)) != head
    return _extremes(powers[head], powers[others], np.asarray(heads)[others])


def _extremes(objective: np.ndarray, powers: np.ndarray, heads: ArrayLike) -> tuple[float, float]:
    """The least and the largest objective @ costs, over costs (T,) in [0, 1] with powers @ costs = heads."""
    # Each head is divided by its largest possible value, so that the solver's tolerance is the same for all.
    scale = powers.sum(1)
    equal = {"A_eq": powers / scale[:, None], "b_eq": np.asarray(heads) / scale, "bounds": (0, 1)}
    least, most = (linprog(sign * objective, **equal, method="highs") for sign in (1, -1))
    if least.status or most.status:
        return np.nan, np.nan
    return least.fun, -most.fun
