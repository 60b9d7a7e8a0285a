"""What m discounted sums of one cost signal can tell of its undiscounted sum, and what misleads them.

A weighted sum of the heads counts a cost at step t with sum_i w_i gamma_i^t. Where that curve is 1, the
discounts are undone.
"""

import numpy as np
import torch
from scipy.optimize import linprog

from tutorial_lib.costs.reconstruction import CostReconstruction
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import Task


def flat_weights(gammas, horizon: int) -> np.ndarray:
    """Weights (m,) whose curve is 1 on steps 0 to horizon - 1, by least squares; exact where m = horizon.

    The linear reconstruction before it has seen any data: every step's cost matters alike.
    """
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))  # (m, T)
    return np.linalg.lstsq(powers.T, np.ones(horizon))[0]


def weight_curve(weights, gammas, steps: int) -> np.ndarray:
    """sum_i w_i gamma_i^t, (steps,): what a cost at step t counts in the weighted sum of the heads."""
    return weights @ np.power.outer(np.asarray(gammas, float), np.arange(steps))


def linear_weights(model: CostReconstruction) -> np.ndarray:
    """The weights (m,) that a linear reconstruction model gives to its heads, in plain units."""
    if not isinstance(model.net, torch.nn.Linear):
        raise ValueError("only a linear model has weights for its heads: train one with crm='linear'")
    return (model.whiten @ model.net.weight[0]).detach().double().cpu().numpy() * model.horizon


def steady_heads(task: Task, cost: float, time_limits: str = "rate", step: int = 0) -> np.ndarray:
    """What critics of a steady cost, `cost` per episode, have to give the reconstruction, (m,).

    `time_limits` as in `config.Config`: 'bootstrap' looks ahead for ever; 'rate' keeps the first T steps'
    share of that, which is exact here; 'mask' sees only the steps that are left at `step`. ValueError for
    another word.
    """
    gammas = np.asarray(task.gammas)
    for_ever = cost / task.horizon / (1 - gammas)
    steps_seen = {"bootstrap": np.inf, "rate": task.horizon, "mask": task.horizon - step}
    if time_limits not in steps_seen:
        raise ValueError(f"unknown treatment {time_limits!r}: {', '.join(steps_seen)}")
    return for_ever * (1 - gammas ** steps_seen[time_limits])


def critic_heads(agent, dataset: Dataset, n: int, seed: int = 0) -> np.ndarray:
    """What a trained agent's first cost critic gives the reconstruction for n recorded actions, (n, m).

    Under the task's typical limit, on rows drawn at random, and scaled as option `time_limits` says.
    """
    rows = np.random.default_rng(seed).choice(len(dataset), n, replace=False)
    limits = torch.full((n,), float(agent.task.typical_limit))
    net = agent.networks()
    s = agent.network_input(net, torch.tensor(dataset.observations[rows]), limits)
    q = net.cost_critics(s, torch.tensor(dataset.actions[rows]))[0].detach().double().numpy()
    gammas = np.asarray(agent.task.gammas)
    return q * (1 - gammas**agent.task.horizon) if agent.config.time_limits == "rate" else q


def cost_bounds(heads, gammas, horizon: int) -> tuple[float, float]:
    """The least and the largest undiscounted sum of any costs in [0, 1] with these discounted sums, (m,).

    The feasible set of eq. 19, as two linear programmes. (nan, nan) where no sequence has these heads.
    """
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))
    return _extremes(np.ones(horizon), powers, heads)


def head_bounds(heads, head: int, gammas, horizon: int) -> tuple[float, float]:
    """The least and the largest that `heads[head]` can be, given the others; (nan, nan) as `cost_bounds`."""
    powers = np.power.outer(np.asarray(gammas, float), np.arange(horizon))
    others = np.arange(len(powers)) != head
    return _extremes(powers[head], powers[others], np.asarray(heads)[others])


def _extremes(objective, powers, heads) -> tuple[float, float]:
    # Divided by their largest possible value, all heads are as precise as each other.
    scale = powers.sum(1)
    equal = {"A_eq": powers / scale[:, None], "b_eq": np.asarray(heads) / scale, "bounds": (0, 1)}
    least, most = (linprog(sign * objective, **equal, method="highs") for sign in (1, -1))
    if least.status or most.status:
        return np.nan, np.nan
    return least.fun, -most.fun
