"""Chooses the episodes of a dataset among all that were collected.

A dataset should show every cost and every skill, so episodes are taken evenly over cost and, at similar cost,
over return. It should also show for every limit what a good policy does there, often enough to be learned, so
a share of the episodes is taken near the best return under each limit. And it should not be the record of one
agent, so every source gives its part.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd

COST_BINS = 20
"""The number of bins of cost in which episodes are counted."""
NEAR_BEST = 0.9
"""An episode is near the best under a limit if it keeps the limit and has this share of the best return."""
NEAR_BEST_SHARE = 0.06
"""The share of the dataset that is drawn, for each limit, from the episodes near the best under it."""


def thin(
    costs: np.ndarray,
    returns: np.ndarray,
    sources: np.ndarray,
    n: int,
    limits: Sequence[float],
    max_cost: float,
    max_return: float,
    return_bins: int = 20,
    seed: int = 0,
) -> np.ndarray:
    """The rising indices of n episodes, or of all if there are fewer.

    `costs` and `returns` (episodes,) are undiscounted sums over an episode, and `sources` (episodes,) names
    the run that each comes from. Episodes above `max_cost` or `max_return` are left out. `collect` takes both
    from DSRL, so that normalised scores mean the same on our data as on DSRL's.

    First, for each limit, `NEAR_BEST_SHARE` of n episodes are drawn near the best return under it, those on
    the frontier before others. An episode is on the frontier where no other one earns as much at the same or
    a lower cost. Then the sources, in turn, give equal numbers of the rest, each evenly over cost and return
    (see `evenly`). Where a source has too few, the others give more. All draws come from `seed`.

    Raises ValueError for n < 1, and where no episode is left.
    """
    if n < 1:
        raise ValueError(f"a dataset keeps at least one episode, not {n}")
    allowed = (costs <= max_cost) & (returns <= max_return)
    if not allowed.any():
        raise ValueError(
            f"none of {len(costs)} episodes has a cost of at most {max_cost:g} and a return of at most "
            f"{max_return:g}: collect more"
        )
    rng = np.random.default_rng(seed)
    order = rng.permutation(np.flatnonzero(allowed))
    on_frontier = _on_frontier(costs[order], returns[order])
    order = order[np.argsort(~on_frontier, kind="stable")]
    near = [_near_best(costs, returns, order, limit)[: round(NEAR_BEST_SHARE * n)] for limit in limits]
    chosen = np.unique(np.concatenate([np.empty(0, int), *near]))[:n]
    rest = order[~np.isin(order, chosen)]
    parts = [rest[sources[rest] == source] for source in pd.unique(sources)]
    takes = _shares(n - len(chosen), [len(part) for part in parts])
    for part, take in zip(parts, takes, strict=True):
        chosen = np.append(chosen, part[evenly(costs[part], returns[part], take, max_cost, return_bins)])
    return np.sort(chosen)


def evenly(
    costs: np.ndarray, returns: np.ndarray, n: int, max_cost: float, return_bins: int = 20
) -> np.ndarray:
    """The rising indices of n episodes, spread evenly over cost and, at similar cost, over return.

    The costs from 0 to `max_cost` are cut into `COST_BINS` equal bins, and the range of the returns into
    `return_bins`. A bin of cost keeps at most k episodes, and takes them from its bins of return in turn, so
    that no cost and no skill outnumbers the others. k is the smallest number with which all bins together
    keep n episodes. Within one bin of cost and of return the first episodes are kept, and of the bins that
    have a k-th episode the cheapest.
    """
    if not n:
        return np.empty(0, int)
    cost_bin = _bin(costs, 0, max_cost, COST_BINS)
    return_bin = _bin(returns, returns.min(), returns.max(), return_bins)
    turn = pd.DataFrame({"cost": cost_bin, "return": return_bin}).groupby(["cost", "return"]).cumcount()
    place = turn.groupby(cost_bin).rank(method="first").to_numpy()  # 1, 2, 3 ... in each bin of cost
    return np.sort(np.lexsort((cost_bin, place))[:n])


def _near_best(costs: np.ndarray, returns: np.ndarray, order: np.ndarray, limit: float) -> np.ndarray:
    """The episodes of `order`, in its order, that keep the limit and are near the best that do."""
    kept = order[costs[order] <= limit]
    return kept[returns[kept] >= NEAR_BEST * returns[kept].max(initial=0.0)]


def _shares(n: int, available: list[int]) -> list[int]:
    """How many of n each part gives: equally many, and where a part has too few, the others give more."""
    takes = [0] * len(available)
    while n > 0 and (open_ := [i for i, count in enumerate(available) if takes[i] < count]):
        for place, i in enumerate(open_):
            more = min(-(-n // (len(open_) - place)), available[i] - takes[i])
            takes[i] += more
            n -= more
    return takes


def _bin(values: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
    """The index of the bin that each value lies in, of `count` equal bins from low to high."""
    return np.minimum((values - low) / max(high - low, 1e-9) * count, count - 1).astype(int)


def _on_frontier(costs: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Which episodes (n,) earn more than all others that cost as much or less. Of equal ones, the first."""
    order = np.lexsort((-returns, costs))
    best_before = np.maximum.accumulate(np.append(-np.inf, returns[order][:-1]))
    on = np.empty(len(costs), bool)
    on[order] = returns[order] > best_before
    return on
