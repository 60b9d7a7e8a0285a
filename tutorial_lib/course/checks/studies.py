"""This module checks the answers to the exercises of notebooks 13 and 14."""

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy import stats

from tutorial_lib.course.checks.checker import try_answer


def check_paired_interval(answer: Callable) -> None:
    """Checks an exercise of notebook 13.

    `answer(first, second)` returns the 95% interval (low, high) of the mean paired difference.
    """
    cases = []
    for first, second, hint in (
        ([0.7, 0.8], [0.6, 0.6], "two seeds: t is 12.71 with one degree of freedom, not 1.96"),
        ([0.5, 0.7, 0.9], [0.4, 0.6, 0.8], "every pair differs by 0.1: the interval is a point"),
        ([0.5, 0.9, 0.7], [0.6, 0.6, 0.6], "take the differences seed by seed, and divide by n - 1"),
        ([0.1, 0.2, 0.4, 0.3, 0.3], [0.3, 0.2, 0.1, 0.1, 0.5], "five seeds have four degrees of freedom"),
    ):
        pair = np.array(first), np.array(second)
        differences = pair[0] - pair[1]
        if np.ptp(differences) < 1e-9:
            expected = np.repeat(differences.mean(), 2)
        else:
            expected = np.array(stats.ttest_rel(*pair).confidence_interval(0.95))
        cases.append((pair, expected, hint))
    try_answer(answer, cases)


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
