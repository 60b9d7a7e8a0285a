"""Constraint conditioning (Section 3.4): the threshold set, its encoding, and the budget rule, eq. 23."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tutorial_lib.config import Config
from tutorial_lib.tasks import Task


@dataclass(frozen=True)
class ConditioningConfig(Config):
    """The options of constraint conditioning."""

    thresholds_per: Literal["sample", "batch"] = "sample"
    """One threshold per transition (lower variance), or one per batch, as Algorithm 2's line 5 reads."""
    zero_threshold: bool = False
    """Does the threshold set {small, middle, high, infinity} hold a zero, too? It is what an agent is told
    whose budget is spent. Without it the budget rule, eq. 23, can ask for no less than the small threshold's
    rate."""
    infinite_at_test: Literal["covered", "nearest", "never"] = "covered"
    """When the budget rule tells the policy an infinite threshold. 'covered': once the budget left covers the
    largest cost of every step left, since nothing can then break the limit; 'nearest': where its code is
    closest to the rescaled budget; 'never': 'the closest value' is finite."""

    profiles = {"small": {"zero_threshold": True}}


INFINITE_CODE = 1.5
"""Paper silent: an infinite threshold enters the networks as 1.5 cost ranges, above every finite one."""


def threshold_set(task: Task, with_zero: bool = False) -> np.ndarray:
    """The set {small, middle, high, infinity} of Appendix B.2, (4,), or with a zero before them, (5,)."""
    return np.array([*([0.0] if with_zero else []), *task.thresholds, math.inf])


def encode(threshold, task: Task) -> Tensor:
    """Thresholds as network inputs: in units of the task's cost range, so that they are of order one."""
    threshold = torch.as_tensor(threshold, dtype=torch.float32)
    return torch.where(threshold.isinf(), INFINITE_CODE, threshold / task.cost_range)


def draw_thresholds(task: Task, config: ConditioningConfig, generator: torch.Generator) -> Tensor:
    """Thresholds for one run's batch, drawn uniformly from the threshold set, (batch_size,).

    The paper does not say whether line 5 draws one per batch or one per sample; per sample has the lower
    variance.
    """
    choices = torch.as_tensor(threshold_set(task, with_zero=config.zero_threshold), dtype=torch.float32)
    draws = config.batch_size if config.thresholds_per == "sample" else 1
    return choices[torch.randint(len(choices), (draws,), generator=generator)].expand(config.batch_size)


def check_limit(limit: float) -> float:
    """The limit itself, or ValueError: a limit on a cost is a number of at least zero."""
    if not limit >= 0:
        raise ValueError(f"a limit on the cost must be zero or more, not {limit}")
    return float(limit)


def rescaled_budget(limit, spent, t: int, horizon: int) -> np.ndarray:
    """Eq. 23: what is left of the limit, spread over the steps left, as a limit on a whole episode.

    It grows without bound as t -> T and is negative once overspent: `nearest_threshold` clamps both ends.
    """
    if not 0 <= t < horizon:
        raise ValueError(f"step {t} is not in an episode of {horizon} steps")
    return (np.asarray(limit, float) - spent) * horizon / (horizon - t)


def nearest_threshold(budget, task: Task, with_infinite: bool = False, with_zero: bool = False) -> np.ndarray:
    """The element of the threshold set closest to each budget.

    A budget below the smallest threshold, or negative, gets the smallest; one above the largest, the
    largest. With `with_infinite`, infinity stands where its code does, at 1.5 cost ranges; with `with_zero`,
    0 is the smallest.
    """
    choices = threshold_set(task, with_zero)[: None if with_infinite else -1]
    places = np.where(np.isinf(choices), INFINITE_CODE * task.cost_range, choices)
    budget = np.clip(np.asarray(budget, float), places[0], places[-1])  # infinity is as far from all
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
    """What a conditioned policy is told at step t, (E,): eq. 23, then the nearest element of the threshold
    set.

    `limits` (E,) are the limits of E episodes, `spent` (E,) what each has cost so far. `remaining`: the
    critics speak of the cost that remains, not of a whole episode's, so the budget is not rescaled.
    """
    budget = limits - spent if remaining else rescaled_budget(limits, spent, t, task.horizon)
    chosen = nearest_threshold(
        budget, task, with_infinite=config.infinite_at_test == "nearest", with_zero=config.zero_threshold
    )
    if config.infinite_at_test == "covered":
        covered = limits - spent >= (task.horizon - t) * task.max_step_cost
        chosen = np.where(covered, np.inf, chosen)
    return chosen
