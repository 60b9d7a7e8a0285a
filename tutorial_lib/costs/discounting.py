"""Discounted against undiscounted cost: sums, the average threshold, and who is misjudged (Section 3.2)."""

from typing import NamedTuple

import numpy as np

from tutorial_lib.data.dataset import Dataset


def discounted_sums(costs: np.ndarray, gammas) -> np.ndarray:
    """sum_t gamma^t c_t of each sequence for each gamma: costs (..., T) and m gammas give (..., m)."""
    powers = np.power.outer(np.asarray(gammas, float), np.arange(costs.shape[-1]))  # (m, T)
    return costs @ powers.T


def average_threshold(limit, gamma: float, horizon: int):
    """Eq. 2's L~ = (L / T) (1 - gamma^T) / (1 - gamma): the discounted sum of a steady L / T per step."""
    if not 0 < gamma < 1:
        raise ValueError(f"gamma must lie in (0, 1), not {gamma}")
    return limit / horizon * (1 - gamma**horizon) / (1 - gamma)


def cost_sequences(dataset: Dataset, horizon: int) -> np.ndarray:
    """The costs of a dataset's episodes, (episodes, horizon) float32: one cut short costs nothing more."""
    costs = np.zeros((dataset.num_episodes, horizon), np.float32)
    for row, start, end in zip(costs, dataset.starts, dataset.ends, strict=True):
        row[: end - start] = dataset.costs[start:end]
    return costs


def settled_share(gamma, updates, tau: float):
    """The share of a steady cost's value that a critic can have learned after so many updates, from zero.

    Its targets come from a copy that follows with Polyak step `tau`. Each update, the best that a critic
    can do is to meet its target c + gamma q; then the copy's error shrinks by 1 - tau (1 - gamma), and
    real critics are slower. With arrays: broadcast.
    """
    return 1 - (1 - tau * (1 - np.asarray(gamma))) ** np.asarray(updates)


class Misjudged(NamedTuple):
    """Shares of all sequences (Fig. 1): safe but rejected, and unsafe but accepted."""

    false_positives: float
    false_negatives: float


def misjudged(cost: np.ndarray, estimate: np.ndarray, limit: float, estimate_limit: float) -> Misjudged:
    """Compare cost <= limit, the truth, with estimate <= estimate_limit, its stand-in; both (n,)."""
    safe, accepted = cost <= limit, estimate <= estimate_limit
    return Misjudged(float(np.mean(safe & ~accepted)), float(np.mean(~safe & accepted)))


def random_cost_sequences(
    kind: str, n: int, horizon: int, rng: np.random.Generator, largest=None
) -> np.ndarray:
    """n sequences of 0/1 costs, (n, horizon) float32; totals are uniform on 0..largest (default: horizon).

    The paper's generator is unstated and decides how much discounting misjudges, so there are three:
    'uniform' costs fall at any time; 'block' in one contiguous stretch; 'beta' early, late or in the
    middle, at times drawn from a random Beta distribution.
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
        raise ValueError(f"unknown kind {kind!r}: 'uniform', 'block' or 'beta'")
    rank = score.argsort(axis=1).argsort(axis=1)
    return (rank < totals).astype(np.float32)
