"""Constraint conditioning (Section 3.4): the threshold set, its encoding, and the budget rule, eq. 23."""

import math

import numpy as np
import torch
from torch import Tensor

from tutorial_lib.tasks import Task

INFINITE_CODE = 1.5
"""Paper silent: an infinite threshold enters the networks as 1.5 cost ranges, above every finite one."""


def threshold_set(task: Task, with_zero: bool = False) -> np.ndarray:
    """The set {small, middle, high, infinity} of Appendix B.2, (4,), or with a zero before them, (5,)."""
    return np.array([*([0.0] if with_zero else []), *task.thresholds, math.inf])


def encode(threshold, task: Task) -> Tensor:
    """Thresholds as network inputs: in units of the task's cost range, so that they are of order one."""
    threshold = torch.as_tensor(threshold, dtype=torch.float32)
    return torch.where(threshold.isinf(), INFINITE_CODE, threshold / task.cost_range)


def check_threshold(threshold: float) -> float:
    """The threshold itself, or ValueError: a limit on a cost is a number of at least zero."""
    if not threshold >= 0:
        raise ValueError(f"a cost threshold must be zero or more, not {threshold}")
    return float(threshold)


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
