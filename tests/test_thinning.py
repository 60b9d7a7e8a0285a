"""Which episodes a dataset keeps: counted one by one."""

from collections import Counter

import numpy as np
import pytest

from tutorial_lib.data.thinning import evenly, thin

LIMITS = (10, 30, 60)


def plane(seed, count=3_000):
    """Episodes crowded at low cost, as training leaves them, some of them out of bounds, of three sources."""
    rng = np.random.default_rng(seed)
    costs = np.minimum(rng.exponential(25, count), 100).round()
    sources = rng.choice(["priced-0", "priced-1", "lagrangian-0"], count, p=[0.7, 0.28, 0.02])
    return costs, rng.normal(500, 250, count) + 4 * costs, sources


def count_bins(costs, returns, kept):
    """How many of some episodes lie in each (column, row) of the grid, counted one by one."""
    low, high, counts = min(returns), max(returns), Counter()
    for i in kept:
        counts[min(int(costs[i] / 80 * 20), 19), min(int((returns[i] - low) / (high - low) * 20), 19)] += 1
    return counts


@pytest.mark.parametrize("n", [1, 50, 500, 1_000, 100_000])
@pytest.mark.parametrize("seed", range(3))
def test_it_is_even_over_cost_and_within_a_cost_over_return(seed, n):
    costs, returns, _ = plane(seed)
    costs, returns = costs[costs <= 80], returns[costs <= 80]
    kept = evenly(costs, returns, n, max_cost=80)
    assert len(set(kept)) == len(kept) == min(n, len(costs)) and list(kept) == sorted(kept)
    there, taken = count_bins(costs, returns, range(len(costs))), count_bins(costs, returns, kept)
    columns, of_column = Counter(), Counter()
    for (column, _), count in there.items():
        columns[column] += count
    for (column, _), count in taken.items():
        of_column[column] += count
    k = max(of_column.values())
    for column, count in columns.items():  # the last turn reaches only some of the columns
        assert of_column[column] in (min(k, count), min(k - 1, count))
        rows = [row for c, row in there if c == column]
        most = max(taken[column, row] for row in rows)
        for row in rows:  # a bin gives fewer than another only where it has no more, or at the last turn
            assert taken[column, row] in (there[column, row], most, most - 1)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_near_the_best_under_each_limit_is_not_rare(seed):
    costs, returns, sources = plane(seed)
    kept = thin(costs, returns, sources, 500, LIMITS, 80, 1_000)
    assert len(kept) == 500
    for limit in LIMITS:
        allowed = [i for i in range(len(costs)) if costs[i] <= limit and returns[i] <= 1_000]
        best = max(returns[i] for i in allowed)
        near = [i for i in allowed if returns[i] >= 0.9 * best]
        within = [i for i in kept if costs[i] <= limit]
        assert len(near) > 30 and len(within) > 30
        assert len(set(near) & set(kept)) >= 30 >= 0.05 * len(within)


@pytest.mark.parametrize("seed", range(3))
def test_the_frontier_is_kept(seed):
    rng = np.random.default_rng(seed)
    costs = rng.integers(0, 81, 600)
    returns = 5 * costs + rng.uniform(0, 100, 600)  # costs earn, so nearly every cost has a frontier episode
    kept = set(thin(costs, returns, np.zeros(600), 200, LIMITS, 80, 1_000).tolist())
    for limit in LIMITS:
        near = [i for i in range(600) if costs[i] <= limit]
        best = max(near, key=lambda i: returns[i])
        frontier = [
            i
            for i in near
            if returns[i] >= 0.9 * returns[best]
            and not any(costs[j] <= costs[i] and returns[j] > returns[i] for j in range(600))
        ]
        assert 1 <= len(frontier) <= 12 and set(frontier) <= kept


def test_every_source_gives_an_equal_part_or_all_that_it_has():
    costs, returns, sources = plane(0)
    kept = thin(costs, returns, sources, 500, (), 80, 1_000)
    counts = Counter(sources[kept])
    allowed = Counter(sources[(costs <= 80) & (returns <= 1_000)])
    assert counts["lagrangian-0"] == allowed["lagrangian-0"] < 100
    assert sorted([counts["priced-0"], counts["priced-1"]])[0] == (500 - counts["lagrangian-0"]) // 2
    assert sum(counts.values()) == 500


def test_draws_are_random_and_the_same_every_time():
    costs, returns, sources = np.zeros(1_000), np.full(1_000, 7.0), np.zeros(1_000)  # all in one bin
    draw = lambda seed: thin(costs, returns, sources, 100, LIMITS, 80, 1_000, seed=seed)  # noqa: E731
    assert len(draw(1)) == 100 and 300 < draw(1).mean() < 700
    assert draw(1).tolist() == draw(1).tolist() != draw(2).tolist()


def test_to_keep_no_episode_is_refused():
    with pytest.raises(ValueError, match="at least one episode, not 0"):
        thin(np.zeros(5), np.zeros(5), np.zeros(5), 0, LIMITS, 10, 10)


def test_that_no_episode_is_left_is_refused_in_one_line():
    with pytest.raises(
        ValueError, match="^none of 2 episodes has a cost of at most 10 and .* 7: collect more$"
    ):
        thin(np.array([11.0, 5.0]), np.array([0.0, 8.0]), np.zeros(2), 1, LIMITS, 10, 7)


def test_the_highest_cost_and_return_themselves_are_kept():
    costs, returns = np.array([80.0, 80.5, 10.0]), np.array([5.0, 5.0, 1_000.0])
    assert thin(costs, returns, np.zeros(3), 9, LIMITS, 80, 1_000).tolist() == [0, 2]
