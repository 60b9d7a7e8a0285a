"""The agents of notebook 9 on the repeated shortcut: those that are told a rate, and one that plans.

The first have one policy per threshold, chosen by the budget rule (eq. 23). The last sees what is left of the
budget, and the step.

All results are exact. The probabilities of all states and spent costs are computed for every step, and
nothing is sampled.
"""

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np

from tutorial_lib.costs.conditioning import ConditioningConfig, rescaled_budget, told_limit
from tutorial_lib.course import tabular
from tutorial_lib.tasks import get_task

TASK = dataclasses.replace(
    get_task("BallCircle"), name="Laps", horizon=100, thresholds=(10, 25, 40), cost_range=60
)
"""The task of the laps. The budget rule reads its horizon (100 steps), its thresholds and its cost range."""

LEAST = 0.1
"""The cost of an episode that stands for the threshold 0. Moves slip, so no policy costs less than 0.04."""


def policies(thresholds: Iterable[float], bias: float = 1.0) -> dict[float, np.ndarray]:
    """The best policy, (S, A), for each threshold L among those that cost `bias` L per episode.

    With a bias below one the agent spends less than the threshold that it is given, with a bias above one it
    spends more.
    """
    cmdp = tabular.laps()
    costs = {float(limit): max(bias * limit, LEAST) for limit in thresholds}
    return {limit: tabular.rate_policy(cmdp, cost, TASK.horizon) for limit, cost in costs.items()}


def told(config: ConditioningConfig, limit: float) -> np.ndarray:
    """The limit given to the policy at each step after each cost spent so far, (T, T+1): eq. 23."""
    spent = np.arange(TASK.horizon + 1.0)
    limits = np.full(len(spent), float(limit))
    return np.stack([told_limit(TASK, config, limits, spent, t) for t in range(TASK.horizon)])


def follow_rule(config: ConditioningConfig, agent: dict[float, np.ndarray], limit: float) -> tabular.Spending:
    """What an agent earns and spends under a limit when the budget rule chooses its threshold at every step.

    `agent` has a policy (S, A) for each threshold that can occur.
    """
    thresholds = told(config, limit)
    choices, where = np.unique(thresholds, return_inverse=True)
    table = np.stack([agent[choice] for choice in choices])
    where = where.reshape(thresholds.shape)
    return tabular.follow(tabular.laps(), TASK.horizon, lambda t: table[where[t]])


def follow_one(policy: np.ndarray) -> tabular.Spending:
    """What a single policy (S, A), which does not depend on the budget, earns and spends."""
    return tabular.follow(tabular.laps(), TASK.horizon, lambda t: policy[None])


def follow_any_rate(limit: float) -> tabular.Spending:
    """What an agent with a policy for every rate earns and spends under eq. 23.

    It is told the rescaled budget itself, in whole unsafe steps per episode from 0 to the cost range.
    """
    horizon, largest = TASK.horizon, int(TASK.cost_range)
    table = np.stack(list(_every_rate().values()))  # (largest+1, S, A)
    left = limit - np.arange(horizon + 1.0)
    told = [rescaled_budget(left, 0, t, horizon).round().clip(0, largest) for t in range(horizon)]
    return tabular.follow(tabular.laps(), horizon, lambda t: table[told[t].astype(int)])


@functools.cache
def _every_rate() -> dict[float, np.ndarray]:
    return policies(range(int(TASK.cost_range) + 1))


def follow_plan(limit: int, price: float = 1.0, clock: bool = True) -> tabular.Spending:
    """What an agent that plans with a shrinking budget earns and spends under a limit.

    It plans with `tabular.plan_budget`: every unsafe step beyond the limit costs it `price` (in reward). With
    a `clock`, it sees the step and what is left. Without one, it sees the rescaled budget of eq. 23 only, and
    acts as if the episode began with this limit.
    """
    cmdp, horizon, largest = tabular.laps(), TASK.horizon, int(TASK.cost_range)
    _, actions = tabular.plan_budget(cmdp, horizon, largest, price)
    certain = np.eye(cmdp.rewards.shape[1])
    left = (limit - np.arange(horizon + 1.0)).clip(max=largest)
    if clock:
        seen = left.clip(0).astype(int)
        return tabular.follow(cmdp, horizon, lambda t: certain[actions[t, seen]])
    told = [rescaled_budget(left, 0, t, horizon).round().clip(0, largest) for t in range(horizon)]
    return tabular.follow(cmdp, horizon, lambda t: certain[actions[0, told[t].astype(int)]])
