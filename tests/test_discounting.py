"""Discounted sums and Fig. 1's counts against loops, enumerations and exact probabilities."""

import itertools
from math import comb

import numpy as np
import pytest
from scipy import stats

from tutorial_lib.costs.discounting import (
    average_threshold,
    cost_sequences,
    discounted_sums,
    misjudged,
    random_cost_sequences,
    settled_share,
)
from tutorial_lib.data.dataset import Dataset

KINDS = ("uniform", "block", "beta")


def sequences(kind, n, horizon, largest=None, seed=0):
    return random_cost_sequences(kind, n, horizon, np.random.default_rng(seed), largest)


# --- Sums and thresholds ---


def test_discounted_sums_are_their_loops():
    rng = np.random.default_rng(0)
    costs, gammas = rng.random((2, 4, 30)).astype(np.float32), (0.9, 0.99, 1.0)
    sums = discounted_sums(costs, gammas)
    assert sums.shape == (2, 4, 3)
    for i, j in np.ndindex(2, 4):
        for k, gamma in enumerate(gammas):
            expected = 0.0
            for t in range(30):
                expected += gamma**t * float(costs[i, j, t])
            assert sums[i, j, k] == pytest.approx(expected, rel=1e-6)


def test_one_discounted_sum_by_hand():
    # The first step counts in full: 1 + 0.25 = 1.25 for gamma 1/2.
    np.testing.assert_array_equal(discounted_sums(np.array([1.0, 0.0, 1.0]), (0.5, 0.1)), [1.25, 1.01])


@pytest.mark.parametrize(
    ("limit", "gamma", "horizon"), [(50, 0.99, 301), (10, 0.5, 4), (0, 0.9, 10), (30, 0.9999, 7)]
)
def test_average_threshold_is_the_discounted_sum_of_a_steady_cost(limit, gamma, horizon):
    steady = sum(gamma**t * limit / horizon for t in range(horizon))
    assert average_threshold(limit, gamma, horizon) == pytest.approx(steady)


def test_average_threshold_of_several_limits_and_of_none():
    np.testing.assert_allclose(average_threshold(np.array([4.0, 8.0]), 0.5, 4), [1.875, 3.75])
    assert average_threshold(np.inf, 0.99, 100) == np.inf


@pytest.mark.parametrize("gamma", [0, 1, 1.01, -0.5, float("nan")])
def test_average_threshold_refuses_a_gamma_that_discounts_nothing(gamma):
    with pytest.raises(ValueError, match="gamma"):
        average_threshold(50, gamma, 100)


def test_misjudged_is_its_loop():
    rng = np.random.default_rng(0)
    cost, estimate = rng.integers(0, 9, 500), rng.integers(0, 9, 500)  # many of them on the limit itself
    positives = negatives = 0
    for c, e in zip(cost, estimate, strict=True):
        if c <= 5 and e > 3:
            positives += 1
        if c > 5 and e <= 3:
            negatives += 1
    shares = misjudged(cost, estimate, 5, 3)
    assert shares.false_positives == positives / 500 and shares.false_negatives == negatives / 500
    assert positives != negatives


def test_an_episode_cut_short_costs_nothing_more():
    costs = np.array([1, 0, 1, 1, 0, 2.5, 1], np.float32)  # episodes of 3, 1 and 3 steps
    ends = np.isin(np.arange(7), (2, 3, 6))
    zeros = np.zeros((7, 1), np.float32)
    fell = ends & (np.arange(7) == 3)
    dataset = Dataset(zeros, zeros, zeros, zeros[:, 0], costs, fell, ends & ~fell)
    np.testing.assert_array_equal(cost_sequences(dataset, 4), [[1, 0, 1, 0], [1, 0, 0, 0], [0, 2.5, 1, 0]])


@pytest.mark.parametrize(("gamma", "tau"), [(0.9, 0.1), (0.99, 0.005), (0.5, 1.0)])
def test_settled_share_is_a_critic_that_always_meets_its_targets(gamma, tau):
    """Ten states in a ring that all cost 1; the critic is set to its targets, and its copy follows."""
    copy = np.zeros(10)
    for update in range(1, 301):
        critic = 1 + gamma * np.roll(copy, -1)
        copy = (1 - tau) * copy + tau * critic
        assert settled_share(gamma, update, tau) == pytest.approx(copy.mean() * (1 - gamma))


def test_nothing_is_settled_before_the_first_update():
    np.testing.assert_array_equal(settled_share(np.array([0.5, 0.9]), [[0], [1]], 0.1)[0], [0, 0])
    assert settled_share(0.9, 1, 0.1) == pytest.approx(0.01)  # tau of a value of 10 is 1: the first cost


# --- Random sequences ---


@pytest.mark.parametrize("kind", KINDS)
def test_sequences_hold_zeros_and_ones_whose_totals_are_uniform(kind):
    costs = sequences(kind, 6000, 40, largest=20)
    assert costs.shape == (6000, 40) and costs.dtype == np.float32
    assert set(np.unique(costs)) == {0, 1}
    counts = np.bincount(costs.sum(1).astype(int), minlength=21)
    assert len(counts) == 21  # none above the largest
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_largest_total_every_step_may_be_unsafe(kind):
    counts = np.bincount(sequences(kind, 3000, 5).sum(1).astype(int), minlength=6)
    assert len(counts) == 6 and stats.chisquare(counts).pvalue > 1e-3


def enumerated(kind, horizon):
    """The probability of every 0/1 sequence, for the kinds where it is plain."""
    for costs in itertools.product((0, 1), repeat=horizon):
        total = sum(costs)
        if kind == "uniform":
            yield costs, 1 / (horizon + 1) / comb(horizon, total)
        elif "1" * total in "".join(map(str, costs)):  # one stretch, which starts anywhere that it fits
            yield costs, 1 / (horizon + 1) / (horizon - total + 1 if total else 1)


@pytest.mark.parametrize("kind", ["uniform", "block"])
def test_every_short_sequence_is_as_frequent_as_it_should_be(kind):
    probability = dict(enumerated(kind, 5))
    assert sum(probability.values()) == pytest.approx(1)
    drawn = [tuple(row) for row in sequences(kind, 20_000, 5).astype(int)]
    assert set(drawn) <= set(probability)
    counts = [drawn.count(costs) for costs in probability]
    assert stats.chisquare(counts, 20_000 * np.array(list(probability.values()))).pvalue > 1e-3


def test_a_block_is_one_contiguous_stretch():
    costs = sequences("block", 300, 50)
    for row in costs.tolist():
        rises = sum(1 for before, now in zip([0.0] + row, row, strict=False) if now > before)
        assert rises == (1 if sum(row) else 0)


def test_beta_times_are_drawn_one_after_the_other_with_a_beta_densitys_odds():
    horizon, n = 4, 40_000
    midpoints = (np.arange(horizon) + 0.5) / horizon
    grid = np.exp(np.log(0.5) + np.log(16) * (np.arange(60) + 0.5) / 60)  # a and b: log-uniform on [0.5, 8]
    pair = dict.fromkeys(itertools.combinations(range(horizon), 2), 0.0)
    single = np.zeros(horizon)
    for a, b in itertools.product(grid, grid):
        p = stats.beta.pdf(midpoints, a, b)
        p = p / p.sum() / len(grid) ** 2
        single += p
        for i, j in pair:
            pair[i, j] += p[i] * p[j] / (1 / 3600 - p[i]) + p[j] * p[i] / (1 / 3600 - p[j])
    expected = {(i,): x for i, x in enumerate(single)} | pair
    drawn = [tuple(np.flatnonzero(row)) for row in sequences("beta", n, horizon, largest=2)]
    counts = np.array([drawn.count(times) for times in expected])
    probabilities = np.array(list(expected.values())) / 3  # totals 0, 1 and 2 alike
    assert stats.chisquare(counts, counts.sum() * probabilities / probabilities.sum()).pvalue > 1e-3
    assert counts.sum() == n - drawn.count(())


def test_the_kinds_differ_in_when_the_cost_falls():
    """Spread of the mean time of the unsafe steps, at totals of 20 in 100, and stretches per sequence."""
    spread, stretches = {}, {}
    for kind in KINDS:
        costs = sequences(kind, 6000, 100)
        costs = costs[np.abs(costs.sum(1) - 20) < 5]
        times = [np.flatnonzero(row) for row in costs]
        spread[kind] = np.std([t.mean() for t in times])
        stretches[kind] = np.mean([1 + (np.diff(t) > 1).sum() for t in times])
    assert spread["uniform"] < 8 < 15 < spread["beta"]
    assert 15 < spread["block"]
    assert stretches["block"] == 1 and 5 < stretches["beta"] < stretches["uniform"]
    assert stretches["uniform"] > 12


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_names_the_sequences(kind):
    np.testing.assert_array_equal(sequences(kind, 20, 30, seed=1), sequences(kind, 20, 30, seed=1))
    assert (sequences(kind, 20, 30, seed=1) != sequences(kind, 20, 30, seed=2)).any()


def test_an_unknown_kind_is_an_error_that_names_those_there_are():
    with pytest.raises(ValueError, match="'early'.*'uniform', 'block' or 'beta'"):
        sequences("early", 3, 10)


# --- Figure 1: T = 301 steps, gamma = 0.99, L = 50, totals up to 100 ---

T, GAMMA, LIMIT, LARGEST, N = 301, 0.99, 50, 100, 10_000


def discounting_misjudges(kind):
    costs = sequences(kind, N, T, LARGEST)
    return misjudged(
        costs.sum(1), discounted_sums(costs, [GAMMA])[:, 0], LIMIT, average_threshold(LIMIT, GAMMA, T)
    )


def assert_share(share, expected, known_to=0.0):
    """Equal within 4 standard errors of N draws, and within the error of `expected` itself."""
    assert abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / N) + known_to


def test_figure_1_for_one_block_against_all_blocks_that_there_are():
    positives = negatives = 0.0
    limit = LIMIT / T * sum(GAMMA**t for t in range(T))
    for total in range(LARGEST + 1):
        starts = range(T - total + 1)
        accepted = [GAMMA**s * (1 - GAMMA**total) / (1 - GAMMA) <= limit for s in starts]
        share = sum(accepted) / len(starts) / (LARGEST + 1)
        if total <= LIMIT:
            positives += 1 / (LARGEST + 1) - share
        else:
            negatives += share
    assert (positives, negatives) == pytest.approx((0.0701, 0.2311), abs=1e-4)
    shares = discounting_misjudges("block")
    assert_share(shares.false_positives, positives)
    assert_share(shares.false_negatives, negatives)


def test_figure_1_for_uniform_times_against_a_normal_approximation():
    """Drawing k of T steps without replacement: mean and variance of the discounted sum are exact."""
    powers = GAMMA ** np.arange(T)
    limit = LIMIT * powers.mean()
    positives = negatives = 0.0
    for total in range(LARGEST + 1):
        std = np.sqrt(total * (T - total) / (T - 1) * powers.var())
        accepted = stats.norm.cdf((limit - total * powers.mean()) / std) if total else 1.0
        if total <= LIMIT:
            positives += (1 - accepted) / (LARGEST + 1)
        else:
            negatives += accepted / (LARGEST + 1)
    assert (positives, negatives) == pytest.approx((0.0223, 0.0195), abs=1e-4)
    shares = discounting_misjudges("uniform")
    assert_share(shares.false_positives, positives, known_to=0.001)
    assert_share(shares.false_negatives, negatives, known_to=0.001)


def test_figure_1_for_beta_times_against_numpys_own_draws_without_replacement():
    rng = np.random.default_rng(1)
    midpoints = (np.arange(T) + 0.5) / T
    costs = np.zeros((N // 4, T))
    for row in costs:
        a, b = np.exp(rng.uniform(np.log(0.5), np.log(8), 2))
        density = stats.beta.pdf(midpoints, a, b)
        row[rng.choice(T, rng.integers(LARGEST + 1), replace=False, p=density / density.sum())] = 1
    discounted = [sum(GAMMA**t for t in np.flatnonzero(row)) for row in costs]
    limit = LIMIT / T * sum(GAMMA**t for t in range(T))
    total = costs.sum(1)
    slow = [
        np.mean([c <= LIMIT and d > limit for c, d in zip(total, discounted, strict=True)]),
        np.mean([c > LIMIT and d <= limit for c, d in zip(total, discounted, strict=True)]),
    ]
    for share, expected in zip(discounting_misjudges("beta"), slow, strict=True):
        assert_share(share, expected, known_to=2.5 * np.sqrt(expected * (1 - expected) / len(costs)))


@pytest.mark.parametrize("kind", KINDS)
def test_the_undiscounted_sum_misjudges_nobody(kind):
    costs = sequences(kind, 500, 100)
    assert misjudged(costs.sum(1), discounted_sums(costs, [1.0])[:, 0], 50, 50) == (0, 0)
