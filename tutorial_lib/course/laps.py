"""Notebook 07's agents: the shortcut in laps, a policy for each threshold, and the budget rule over them.

Everything here is exact: chances are followed through all steps, budgets and cells; nothing is sampled.
"""

import dataclasses

import numpy as np

from tutorial_lib.costs.conditioning import ConditioningConfig, told_limit
from tutorial_lib.course import tabular
from tutorial_lib.tasks import get_task

TASK = dataclasses.replace(
    get_task("BallCircle"), name="Laps", horizon=100, thresholds=(10, 25, 40), cost_range=60
)
"""What the budget rule must know of a task: its horizon, its thresholds and its cost range."""

LEAST = 0.1
"""No policy is cheaper than 0.04 per episode, because moves slip: the threshold 0 stands for this cost."""


def policies(thresholds, bias: float = 1.0) -> dict[float, np.ndarray]:
    """For each threshold the best policy, (S, A), that costs as much, times `bias`, per episode.

    A bias below one makes a thrifty agent, one above a spendthrift: it is told one limit and keeps another.
    """
    cmdp = tabular.laps()
    costs = {float(limit): max(bias * limit, LEAST) for limit in thresholds}
    return {limit: tabular.rate_policy(cmdp, cost, TASK.horizon) for limit, cost in costs.items()}


def told(config: ConditioningConfig, limit: float) -> np.ndarray:
    """The limit told at each step after each sum spent, (T, T+1), by `conditioning.told_limit`."""
    spent = np.arange(TASK.horizon + 1.0)
    limits = np.full(len(spent), float(limit))
    return np.stack([told_limit(TASK, config, limits, spent, t) for t in range(TASK.horizon)])


def follow_rule(config: ConditioningConfig, agent: dict[float, np.ndarray], limit: float) -> tabular.Spending:
    """What an agent, a policy per threshold, earns and pays as the budget rule tells it what is left."""
    thresholds = told(config, limit)
    choices, where = np.unique(thresholds, return_inverse=True)
    table = np.stack([agent[choice] for choice in choices])
    where = where.reshape(thresholds.shape)
    return tabular.follow(tabular.laps(), TASK.horizon, lambda t: table[where[t]])


def follow_one(policy: np.ndarray) -> tabular.Spending:
    """The same for one policy, (S, A), that is never told anything."""
    return tabular.follow(tabular.laps(), TASK.horizon, lambda t: policy[None])
