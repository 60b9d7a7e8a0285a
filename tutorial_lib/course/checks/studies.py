"""This module checks the answers to the exercises of notebooks 13 and 14."""

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy import stats

from tutorial_lib.course.checks.checker import try_answer

Case = tuple[tuple, object, str]
"""The arguments of a call, its right value, and a hint for values that no known mistake gives."""
Mistake = tuple[Callable, str]
"""A function that makes a mistake, and the words that name it."""


def check_paired_interval(answer: Callable) -> None:
    """Checks an exercise of notebook 13.

    `answer(first, second)` returns the 95% interval (low, high) of the mean paired difference.
    """

    def interval(d, half):
        return [d.mean() - half, d.mean() + half]

    def unpaired(x, y):
        found = stats.ttest_ind(x, y).confidence_interval(0.95)
        return [found.low, found.high]

    def student(d, ddof=1, chance=0.975, root=True):
        spread = d.std(ddof=ddof) / (len(d) ** 0.5 if root else 1)
        return interval(d, stats.t.ppf(chance, len(d) - 1) * spread)

    mistakes: list[Mistake] = [
        (
            lambda x, y: interval(x - y, 1.959964 * (x - y).std(ddof=1) / len(x) ** 0.5),
            "1.96 is for many seeds: n seeds have n - 1 degrees of freedom, so take t, which is larger",
        ),
        (lambda x, y: student(x - y, ddof=0), "the standard deviation of a sample divides by n - 1"),
        (lambda x, y: student(x - y, chance=0.95), "95% in the middle leave 2.5% on each side: ppf(0.975)"),
        (lambda x, y: student(x - y, root=False), "the mean of n values varies less: divide by sqrt(n)"),
        (lambda x, y: student(y - x), "first - second, in this order"),
        (unpaired, "the runs share their seeds: take the differences seed by seed, then their interval"),
    ]
    cases: list[Case] = []
    for first, second in (
        ([0.5, 0.9, 0.7], [0.6, 0.6, 0.5]),
        ([0.1, 0.2, 0.4, 0.3, 0.3], [0.3, 0.2, 0.1, 0.1, 0.5]),
        ([0.7, 0.8], [0.6, 0.65]),
    ):
        pair = np.array(first), np.array(second)
        expected = np.array(stats.ttest_rel(*pair).confidence_interval(0.95))
        cases.append((pair, expected, "return the pair (mean - half, mean + half) of the differences"))
    try_answer(answer, cases, mistakes)


def check_at_equal_cost(answer: Callable) -> None:
    """Checks an exercise of notebook 13.

    `answer(cost, earned, costs, earnings)` returns what a run earned more than another run at the same paid
    cost. The other run's costs and earnings (n,) are interpolated linearly. Outside of its costs it is NaN.
    """

    def clamped(cost, earned, costs, earnings):
        order = np.argsort(costs)
        return earned - np.interp(cost, costs[order], earnings[order])

    mistakes: list[Mistake] = [
        (clamped, "the other run never paid this cost: say nan, and do not extend its line"),
        (
            lambda cost, earned, costs, earnings: earned - np.interp(cost, costs, earnings),
            "np.interp needs rising costs: sort the other run's points by their costs first",
        ),
        (lambda *x: -clamped(*x), "what this run earned minus what the other one earned"),
        (
            lambda cost, earned, costs, earnings: earned - earnings[np.abs(costs - cost).argmin()],
            "the nearest point has another cost: interpolate between the two points around the cost",
        ),
    ]
    up, down = np.array([10.0, 20.0, 40.0]), np.array([40.0, 10.0, 20.0])
    cases: list[Case] = [
        ((15.0, 0.6, up, np.array([0.4, 0.6, 0.7])), 0.1, "halfway between 0.4 and 0.6 lies 0.5"),
        ((25.0, 0.6, down, np.array([0.8, 0.4, 0.6])), -0.05, "at a cost of 25 the other run earns 0.65"),
        ((20.0, 0.6, up, np.array([0.4, 0.6, 0.7])), 0.0, "at one of its own costs the other run is known"),
    ]
    for cost in (50.0, 5.0):
        cases.append(((cost, 0.9, up, np.array([0.4, 0.6, 0.7])), np.nan, mistakes[0][1]))
    try_answer(answer, cases, mistakes)


def check_hidden_by_the_mean(differences) -> None:
    """Checks an exercise of notebook 13.

    `differences` (seeds, limits) are a claim's differences. Over the mean of the limits the claim must agree,
    and under one limit it must be contradicted, each with a 95% interval over at least three seeds.
    """
    try:
        table = np.asarray(differences, float)
    except (TypeError, ValueError):
        table = np.zeros(0)
    if table.ndim != 2 or table.shape[0] < 3 or table.shape[1] < 2 or not np.isfinite(table).all():
        print("NOT YET  write a table of numbers: a row for each of three seeds or more, a column per limit")
        return
    (low, high), columns = _interval(table.mean(1)), [_interval(column) for column in table.T]
    if low <= 0:
        side = "contradicts" if high < 0 else "is undecided"
        print(f"NOT YET  the mean over limits {side}: its interval is {low:.3f} to {high:.3f}")
    elif all(end >= 0 for _, end in columns):
        words = ", ".join(f"{start:.3f} to {end:.3f}" for start, end in columns)
        print(f"NOT YET  no limit contradicts: the intervals are {words}, and one must lie below zero")
    else:
        worst = min(range(len(columns)), key=lambda n: columns[n][1])
        found = f"{columns[worst][0]:.3f} to {columns[worst][1]:.3f}"
        print(f"OK  the mean agrees ({low:.3f} to {high:.3f}), and limit {worst + 1} contradicts ({found})")


def _interval(values: np.ndarray) -> tuple[float, float]:
    """Returns the 95% interval of the mean of values (seeds,), which is a point where they are equal."""
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return values.mean() - half, values.mean() + half


def check_best_safe(answer: Callable) -> None:
    """Checks an exercise of notebook 13.

    `answer(rewards, costs)` returns the index of the setting that has the highest reward among those with a
    cost of at most 1. It returns -1 where no setting has such a cost.
    """
    cases = []
    for rewards, costs, expected, hint in (
        ([0.5, 0.9, 0.7], [0.4, 0.8, 0.9], 1, "all are safe: the one that earns the most"),
        ([0.5, 0.9, 0.7], [0.4, 1.2, 0.9], 2, "the best earner is unsafe and does not count"),
        ([0.5, 0.9], [0.4, 1.0], 1, "a cost of exactly 1 keeps the limit"),
        ([-0.2, 0.9], [0.7, 2.0], 0, "returns can be negative: what is unsafe is no candidate, not a zero"),
        ([0.5, 0.9, 0.7], [1.4, 1.2, 1.9], -1, "none is safe: say -1, do not pick the least bad silently"),
    ):
        cases.append(((np.array(rewards), np.array(costs)), expected, hint))
    try_answer(answer, cases)


def check_seed_spread(answer: Callable) -> None:
    """Checks an exercise of notebook 14.

    `answer(scores)` returns the standard deviation over seeds. The score of a seed is the mean over its
    episodes at each limit, then the mean over the limits.
    """
    cases = []
    for values, expected, hint in (
        ({(0, 30): [1, 1], (1, 30): [3, 3]}, 2**0.5, "two seeds with means 1 and 3: divide by n - 1"),
        ({(0, 30): [0, 2], (1, 30): [2, 0]}, 0.0, "episodes differ, but the seeds' means are equal"),
        (
            {(0, 30): [1], (0, 50): [3], (1, 30): [3], (1, 50): [1]},
            0.0,
            "limits differ, but the seeds' means over limits are equal",
        ),
        (
            {(0, 30): [1, 1, 1], (0, 50): [3], (1, 30): [2], (1, 50): [2]},
            0.0,
            "a limit with more episodes counts no more than another: first over episodes, then over limits",
        ),
        (
            {(0, 30): [0], (0, 50): [2], (1, 30): [3], (1, 50): [5], (2, 30): [6], (2, 50): [8]},
            3.0,
            "the seeds' means are 1, 4 and 7",
        ),
    ):
        rows = [(s, limit, v) for (s, limit), column in values.items() for v in column]
        cases.append(((pd.DataFrame(rows, columns=["seed", "threshold", "score"]),), expected, hint))
    try_answer(answer, cases)


def check_share_kept(answer: Callable) -> None:
    """Checks an exercise of notebook 14.

    `answer(costs, limits)` returns the share of mean costs that are at most their limit. `costs` has one row
    for each agent and one column for each limit.
    """
    limits = np.array([30.0, 50.0, 70.0])
    cases = []
    for costs, expected, hint in (
        ([[45, 40, 42]], 2 / 3, "the normalised mean is below 1, and yet the limit 30 is broken"),
        ([[30, 50, 70]], 1.0, "the limit itself is kept"),
        ([[10, 10, 10], [40, 60, 80]], 0.5, "one agent keeps all three, the other none"),
    ):
        cases.append(((np.array(costs, float), limits), expected, hint))
    try_answer(answer, cases)


def check_iqm(answer: Callable) -> None:
    """Checks an exercise of notebook 14.

    `answer(scores)` returns the interquartile mean of all numbers of `scores` (tasks, seeds): the mean of the
    middle half. Every case has a multiple of four numbers.
    """

    def middle(scores, axis=None):
        return stats.trim_mean(scores, 0.25, axis=axis)

    mistakes: list[Mistake] = [
        (lambda x: np.median(x), "this is the median, which keeps one or two numbers: keep the middle half"),
        (lambda x: np.mean(x), "this is the mean: one outlier moves it. Drop a quarter at each end first"),
        (
            lambda x: np.mean(middle(x, axis=-1)),
            "sort the numbers of all tasks together, not task by task: tasks compete for the middle half",
        ),
        (lambda x: np.sort(x, axis=None)[np.size(x) // 4 :].mean(), "drop a quarter at the upper end, too"),
        (lambda x: stats.trim_mean(x, 0.1, axis=None), "a quarter at each end, not a tenth"),
        (
            lambda x: np.ravel(x)[np.size(x) // 4 : np.size(x) - np.size(x) // 4].mean(),
            "the middle half of the *sorted* scores",
        ),
    ]
    cases: list[Case] = []
    for scores, hint in (
        ([[0.9, 0.1, 0.4, 0.7]], "of 0.1, 0.4, 0.7 and 0.9 the middle two are 0.4 and 0.7"),
        ([[0.9, 0.8, 0.7, 0.1], [0.5, 0.6, 0.3, -2.0]], "the middle four of the eight sorted scores"),
        (np.arange(12.0).reshape(4, 3) ** 2, "the middle six of the twelve sorted scores"),
    ):
        array = np.array(scores)
        cases.append(((array,), float(middle(array)), hint))
    try_answer(answer, cases, mistakes)


def check_undominated(answer: Callable) -> None:
    """Checks an exercise of notebook 14.

    `answer(earned, paid)` returns for each system (n,) whether no other system earns at least as much and
    pays at most as much, with one of the two strictly better.
    """

    def best_safe(earned, paid):
        return (paid <= 1) & (earned == earned[paid <= 1].max(initial=-np.inf))

    def neither(earned, paid):
        better = (earned[:, None] > earned) & (paid[:, None] < paid)
        return ~better.any(0)

    def ties_lose(earned, paid):
        better = (earned[:, None] >= earned) & (paid[:, None] <= paid) & ~np.eye(len(paid), dtype=bool)
        return ~better.any(0)

    mistakes: list[Mistake] = [
        (ties_lose, "two systems that are equal in both do not drop each other"),
        (best_safe, "this picks the best earner among the safe: who pays less may earn less and stay"),
        (neither, "as good in one of the two and better in the other is already a reason to drop a system"),
    ]
    cases: list[Case] = []
    for earned, paid, expected, hint in (
        (
            [0.9, 0.7, 0.6],
            [0.8, 0.5, 0.6],
            [True, True, False],
            "the second earns more than the third for less",
        ),
        (
            [0.9, 0.9, 0.5],
            [0.8, 0.9, 0.8],
            [True, False, False],
            "ties in one number are decided by the other",
        ),
        ([0.5, 0.5], [1.4, 1.4], [True, True], "equal systems stay, also beyond the limit"),
        ([1.0, 0.8, 0.3], [2.0, 0.9, 0.0], [True, True, True], "more return for more cost is another choice"),
    ):
        cases.append(((np.array(earned), np.array(paid)), np.array(expected), hint))
    try_answer(answer, cases, mistakes)
