"""Discounted and undiscounted cost: sums, the average threshold, and misjudged episodes (Section 3.2).

Undiscounted costs and limits are in unsafe steps per episode.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tutorial_lib.data.dataset import Dataset


def discounted_sums(costs: np.ndarray, gammas: ArrayLike) -> np.ndarray:
    """Returns sum_t gamma^t c_t, (..., m), of sequences of costs (..., T) for m discount factors gammas."""
    powers = np.power.outer(np.asarray(gammas, float), np.arange(costs.shape[-1]))  # (m, T)
    return costs @ powers.T


def average_threshold(limit: Any, gamma: float, horizon: Any) -> Any:
    """Returns L~ = (L / T) (1 - gamma^T) / (1 - gamma) (eq. 2), in discounted cost.

    This is the discounted sum of a constant cost of L / T per step. `limit` and `horizon` are numbers, arrays
    or tensors, and the result has the shape to which they broadcast. Raises ValueError if gamma is not in
    (0, 1).
    """
    if not 0 < gamma < 1:
        raise ValueError(f"gamma must lie in (0, 1), not {gamma}")
    return limit / horizon * (1 - gamma**horizon) / (1 - gamma)


def cost_sequences(dataset: Dataset, horizon: int) -> np.ndarray:
    """Returns the costs of a dataset's episodes, (episodes, horizon) float32.

    After the end of an episode that is shorter than the horizon, its costs are zero.
    """
    costs = np.zeros((dataset.num_episodes, horizon), np.float32)
    for row, start, end in zip(costs, dataset.starts, dataset.ends, strict=True):
        row[: end - start] = dataset.costs[start:end]
    return costs


def settled_share(gamma: ArrayLike, updates: ArrayLike, tau: float) -> np.ndarray:
    """Returns 1 - (1 - tau (1 - gamma))^updates, the largest share of its value that a critic can have.

    The critic starts at zero, the cost per step is constant, and the target network has the Polyak step
    `tau`. At best, the critic meets its target c + gamma q at each update. Then the error of the target
    network is multiplied by 1 - tau (1 - gamma). Real critics are slower. `gamma` and `updates` broadcast.
    """
    return 1 - (1 - tau * (1 - np.asarray(gamma))) ** np.asarray(updates)


class Misjudged(NamedTuple):
    """The shares of all sequences that an estimate of the cost misjudges (Fig. 1)."""

    false_positives: float
    """The share of sequences that are safe and rejected."""
    false_negatives: float
    """The share of sequences that are unsafe and accepted."""


def misjudged(cost: np.ndarray, estimate: np.ndarray, limit: float, estimate_limit: float) -> Misjudged:
    """Returns how often estimate <= estimate_limit differs from cost <= limit, the truth.

    `cost` and `estimate` are (n,), one number per sequence.
    """
    safe, accepted = cost <= limit, estimate <= estimate_limit
    return Misjudged(float(np.mean(safe & ~accepted)), float(np.mean(~safe & accepted)))


def random_cost_sequences(
    kind: str, n: int, horizon: int, rng: np.random.Generator, largest: int | None = None
) -> np.ndarray:
    """Returns n random sequences of 0/1 costs, (n, horizon) float32.

    Their sums are uniform on 0..largest (default: horizon). The paper does not describe its generator, and
    the share of misjudged sequences depends on it, so there are three kinds. With 'uniform', costs are at any
    time. With 'block', they are in one contiguous block. With 'beta', they are early, late or in the middle,
    at times from a random Beta distribution. Raises ValueError for another kind.
    """
    totals = rng.integers(0, (horizon if largest is None else largest) + 1, size=(n, 1))
    time = np.arange(horizon)
    if kind == "block":
        start = (rng.random((n, 1)) * (horizon - totals + 1)).astype(int)
        return ((time >= start) & (time < start + totals)).astype(np.float32)
    if kind == "uniform":
        score = rng.random((n, horizon), dtype=np.float32)
    elif kind == "beta":
        # Gumbel top-k draws `totals` distinct times with probabilities proportional to a Beta density.
        a, b = np.exp(rng.uniform(np.log(0.5), np.log(8), (2, n, 1)))
        x = (time + 0.5) / horizon
        log_density = (a - 1) * np.log(x) + (b - 1) * np.log1p(-x)
        score = -(log_density + rng.gumbel(size=(n, horizon)))
    else:
        raise ValueError(f"unknown kind {kind!r}: it must be 'uniform', 'block' or 'beta'")
    rank = score.argsort(axis=1).argsort(axis=1)
    return (rank < totals).astype(np.float32)
