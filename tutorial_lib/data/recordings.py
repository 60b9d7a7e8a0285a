"""What recordings can teach, before anything is trained: frontiers, filters, coverage, time limits."""

import numpy as np

from tutorial_lib.data.dataset import Dataset


def best_left(dataset: Dataset, limits) -> tuple[np.ndarray, np.ndarray]:
    """BC-Safe's filter at each limit: the share of episodes that cost at most so much, and their best return.

    Both have the shape of `limits`; where no episode is left, the share is 0 and the return NaN.
    """
    order = np.argsort(dataset.episode_costs, kind="stable")
    best = np.maximum.accumulate(dataset.episode_returns[order])
    left = np.searchsorted(dataset.episode_costs[order], limits, side="right")
    return left / dataset.num_episodes, np.where(left > 0, best[np.maximum(left, 1) - 1], np.nan)


def best_mixture(dataset: Dataset, limits) -> np.ndarray:
    """The best mean return of whole episodes mixed so that their *mean* cost keeps each limit (eq. 1).

    It is the upper concave envelope of the cost-return plane, of the shape of `limits`; NaN below the
    cheapest episode.
    """
    limits = np.asarray(limits, float)
    order = np.lexsort((-dataset.episode_returns, dataset.episode_costs))
    costs, returns = dataset.episode_costs[order], dataset.episode_returns[order]
    rises = returns > np.concatenate([[-np.inf], np.maximum.accumulate(returns)[:-1]])
    corners: list[tuple[float, float]] = []
    for c, r in zip(costs[rises], returns[rises], strict=True):  # both strictly rise
        while len(corners) > 1 and _slope(corners[-2], corners[-1]) <= _slope(corners[-1], (c, r)):
            corners.pop()
        corners.append((c, r))
    x, y = np.array(corners).T
    return np.where(limits < x[0], np.nan, np.interp(limits, x, y))


def _slope(left, right) -> float:
    return (right[1] - left[1]) / (right[0] - left[0])


def near_best(dataset: Dataset, limit: float, share: float = 0.9) -> int:
    """Episodes that keep the limit and earn at least this share of the best return that keeps it."""
    kept = dataset.episode_returns[dataset.episode_costs <= limit]
    return int(np.sum(kept >= share * kept.max(initial=0.0)))


def within(dataset: Dataset, steps: int) -> np.ndarray:
    """Does each row's episode pay a cost in this step or the `steps` - 1 after it? (N,) bool."""
    paid = np.concatenate([[0.0], np.cumsum(dataset.costs, dtype=np.float64)])
    rows = np.arange(len(dataset))
    last = np.minimum(rows + steps, dataset.ends[dataset.episode_index])
    return paid[last] > paid[rows]
