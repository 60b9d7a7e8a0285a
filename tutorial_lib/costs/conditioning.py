"""Constraint conditioning (Section 3.4): the threshold set, its encoding and the budget rule (eq. 23).

Limits, budgets and costs are in unsafe steps per episode.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from tutorial_lib.config import RESERVE, SHARE, Config
from tutorial_lib.tasks import Task


@dataclass(frozen=True)
class ConditioningConfig(Config):
    """The options of constraint conditioning."""

    thresholds: Literal["set", "range"] = "set"
    """Where the thresholds of training come from. With 'set', they are the paper's: small, middle, high and
    infinity (Appendix B.2). With 'range', any limit can be told: they are infinite, zero, what the own
    episode still costs, or uniform between zero and the task's cost range, in the shares below."""
    infinite_share: Annotated[float, SHARE] = 0.15
    """The share of infinite thresholds, with thresholds='range'."""
    zero_share: Annotated[float, SHARE] = 0.1
    """The share of zero thresholds, with thresholds='range'."""
    episode_share: Annotated[float, SHARE] = 0.5
    """Of the other thresholds with thresholds='range', the share that is the cost that the transition's own
    episode still has (rescaled to a whole episode where there is no `clock`). Such pairs of state and
    threshold occur, and uniform ones mostly do not. But an episode can cost little by luck, so that all
    thresholds of this kind would promise too much."""
    policy_thresholds: Literal["all", "own"] = "all"
    """The thresholds under which the policy is extracted. With 'own', the policy learns only from transitions
    whose threshold is what their own episode still costs, or infinite. Then the recorded action is known to
    fit the threshold. With 'all', it learns from the actions of many plans at once, and the mean of a
    Gaussian policy lies between them. Needs thresholds='range' and a `clock`."""
    clock: bool = False
    """If true, the networks also see the share of the episode that is over, and a threshold shrinks by every
    recorded cost: after a step of cost c, a threshold L has become max(L - c, 0). A threshold is then a limit
    on the remaining cost, so `time_limits` must be 'mask'."""
    thresholds_per: Literal["sample", "batch"] = "sample"
    """Whether one threshold is drawn per transition ('sample') or per batch ('batch'). Line 5 of Algorithm 2
    can be read as one per batch. One per transition has the lower variance."""
    zero_threshold: bool = False
    """If true, the threshold set {small, middle, high, infinity} also contains zero, and an agent is told
    zero when its budget is spent. Without zero, the budget rule (eq. 23) cannot ask for a lower cost rate
    than that of the small threshold."""
    infinite_at_test: Literal["covered", "nearest", "never"] = "covered"
    """When the budget rule tells the policy an infinite threshold. With 'covered', this is when the budget
    covers the largest cost of every remaining step, because nothing can then break the limit. With 'nearest',
    it is when the code of infinity (1.5 cost ranges) is the closest to the rescaled budget. With 'never', the
    paper's "closest value" is always finite."""

    margin: Annotated[float, RESERVE] = 0.0
    """The share of a limit that the budget rule keeps in reserve: it plays for (1 - margin) times the limit.
    An agent that pays what it is told pays more than that in half of its runs."""

    profiles = {
        "small": {"clock": True, "thresholds": "range", "episode_share": 0.7, "policy_thresholds": "own"},
        "printed": {"thresholds_per": "batch", "infinite_at_test": "never"},
    }

    def __post_init__(self):
        super().__post_init__()
        if self.policy_thresholds == "own" and not (self.clock and self.thresholds == "range"):
            raise ValueError("policy_thresholds='own' needs thresholds='range' and clock=True")


INFINITE_CODE = 1.5
"""The code of an infinite threshold, in cost ranges, above every finite one. The paper does not give it."""


def threshold_set(task: Task, with_zero: bool = False) -> np.ndarray:
    """Returns {small, middle, high, infinity} (Appendix B.2), (4,), or with a zero before them, (5,)."""
    return np.array([*([0.0] if with_zero else []), *task.thresholds, math.inf])


def encode(threshold: Tensor | np.ndarray | float, task: Task) -> Tensor:
    """Returns thresholds of any shape as network inputs, in units of the task's cost range.

    So they are of order one. Infinity becomes `INFINITE_CODE`.
    """
    threshold = torch.as_tensor(threshold, dtype=torch.float32)
    return torch.where(threshold.isinf(), INFINITE_CODE, threshold / task.cost_range)


def draw_thresholds(
    task: Task,
    config: ConditioningConfig,
    generator: torch.Generator,
    batch: Mapping[str, Tensor] | None = None,
) -> Tensor:
    """Returns thresholds for one run's batch of transitions, (batch_size,) (line 5).

    With `thresholds='set'`, they are drawn uniformly from the threshold set. The paper does not say whether
    it draws one per batch or one per transition. One per transition has the lower variance. With 'range',
    `batch` says what each episode still costs, and `ConditioningConfig` has the shares.
    """
    if config.thresholds == "set":
        choices = torch.as_tensor(threshold_set(task, with_zero=config.zero_threshold), dtype=torch.float32)
        draws = config.batch_size if config.thresholds_per == "sample" else 1
        return choices[torch.randint(len(choices), (draws,), generator=generator)].expand(config.batch_size)
    if batch is None:
        raise ValueError("thresholds='range' needs the batch: it says what each episode still costs")
    own = batch["costs_to_go"]
    if not config.clock:
        own = own * task.horizon / (task.horizon - batch["timesteps"])
    kind, which, place = torch.rand(3, config.batch_size, generator=generator).to(
        own.device, non_blocking=True
    )
    finite = torch.where(which < config.episode_share, own, place * task.cost_range)
    finite = torch.where(kind < config.infinite_share + config.zero_share, 0.0, finite)
    return torch.where(kind < config.infinite_share, torch.inf, finite)


def policy_weight(config: Config, batch: Any) -> Tensor | float:
    """Returns the weights of transitions in the policy's loss, (B,), with a mean of 1, or 1 for all.

    With `policy_thresholds='own'`, they are zero except for a transition's own thresholds. A `limit` (B,) of
    the batch is the transition's own if it is equal to its `costs_to_go` (B,), or infinite.
    """
    if not isinstance(config, ConditioningConfig) or config.policy_thresholds == "all":
        return 1.0
    own = ((batch.limit == batch.costs_to_go) | batch.limit.isinf()).float()
    return own / own.mean().clamp(min=1e-6)


def after_step(threshold: Tensor, cost: Tensor) -> Tensor:
    """Returns max(L - c, 0), (B,): what is left of thresholds L (B,) after a step of cost c (B,)."""
    return (threshold - cost).clamp(min=0)


def check_limit(limit: float) -> float:
    """Returns the limit as a float. Raises ValueError if it is negative or NaN."""
    if not limit >= 0:
        raise ValueError(f"a limit on the cost must be zero or more, not {limit}")
    return float(limit)


def rescaled_budget(limit: ArrayLike, spent: np.ndarray | float, t: int, horizon: int) -> np.ndarray:
    """Returns (limit - spent) T / (T - t) (eq. 23), with the shape to which `limit` and `spent` broadcast.

    This is the limit on a whole episode that has the same cost rate as the budget has over the remaining
    steps. It grows without bound as t -> T, and it is negative if more was spent than the limit.
    `nearest_threshold` clamps both. Raises ValueError if t is not a step of the episode.
    """
    if not 0 <= t < horizon:
        raise ValueError(f"step {t} is not in an episode of {horizon} steps")
    return (np.asarray(limit, float) - spent) * horizon / (horizon - t)


def nearest_threshold(
    budget: np.ndarray, task: Task, with_infinite: bool = False, with_zero: bool = False
) -> np.ndarray:
    """Returns the element of the threshold set that is closest to each budget, with the shape of `budget`.

    A budget below the smallest threshold gets the smallest one, and a budget above the largest threshold gets
    the largest one. With `with_infinite`, infinity is in the set, and its distance is measured from its code,
    1.5 cost ranges. With `with_zero`, zero is in the set.
    """
    choices = threshold_set(task, with_zero)[: None if with_infinite else -1]
    places = np.where(np.isinf(choices), INFINITE_CODE * task.cost_range, choices)
    # Without the clip, an infinite budget would be equally far from all places.
    budget = np.clip(np.asarray(budget, float), places[0], places[-1])
    distance = np.abs(budget[..., None] - places)
    return choices[distance.argmin(axis=-1)]


def told_limit(
    task: Task,
    config: ConditioningConfig,
    limits: np.ndarray,
    spent: np.ndarray,
    t: int,
    remaining: bool = False,
) -> np.ndarray:
    """Returns the limit that a conditioned policy is told at step t, (E,).

    It is the element of the threshold set that is nearest to the rescaled budget of eq. 23. Where thresholds
    do not come from the set, it is the budget itself, between zero and the task's cost range. `limits` (E,)
    are the limits of E episodes, and `spent` (E,) is what each has cost so far. With `remaining`, the critics
    predict the remaining cost and not that of a whole episode, so the budget is not rescaled.
    """
    aims = (1 - config.margin) * limits
    budget = aims - spent if remaining else rescaled_budget(aims, spent, t, task.horizon)
    if config.thresholds == "set" and config.infinite_at_test == "nearest":
        chosen = nearest_threshold(budget, task, with_infinite=True, with_zero=config.zero_threshold)
    else:
        chosen = _finite_limit(task, config, budget)
    if config.infinite_at_test == "covered":
        covered = limits - spent >= (task.horizon - t) * task.max_step_cost
        chosen = np.where(covered, np.inf, chosen)
    return chosen


def trained_limit(task: Task, config: ConditioningConfig, limits: np.ndarray) -> np.ndarray:
    """Returns the limits that the networks were trained with and that are closest to `limits` (E,), (E,).

    An infinite limit stays infinite.
    """
    return np.where(np.isinf(limits), np.inf, _finite_limit(task, config, limits))


def _finite_limit(task: Task, config: ConditioningConfig, limits: np.ndarray) -> np.ndarray:
    """Returns the closest finite limit that is trained with, (E,), to each of `limits` (E,)."""
    if config.thresholds == "set":
        return nearest_threshold(limits, task, with_zero=config.zero_threshold)
    return np.clip(limits, 0.0, task.cost_range)  # every limit between was trained with
