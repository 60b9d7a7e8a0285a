"""This module checks the answers to the exercises of notebook 2."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.checks.checker import try_answer


def check_episode_sums(answer: Callable) -> None:
    """Checks an exercise of notebook 2.

    `answer(values, terminals, timeouts)` returns the undiscounted sum of each complete episode.
    """
    off = np.zeros(5, bool)
    values = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    ends = [np.isin(np.arange(5), rows) for rows in ([1, 4], [4], [1], [3])]
    try_answer(
        answer,
        [
            ((values, off, ends[0]), np.array([3.0, 28.0]), "an episode ends with the row that is flagged"),
            ((values, ends[0], off), np.array([3.0, 28.0]), "a terminal ends an episode too"),
            ((values, ends[2], ends[1]), np.array([3.0, 28.0]), "either flag ends an episode"),
            ((values, off, ends[3]), np.array([15.0]), "an unfinished tail belongs to no episode"),
        ],
    )


def check_backup_target(answer: Callable) -> None:
    """Checks an exercise of notebook 2.

    `answer(reward, gamma, next_value, terminal, timeout, bootstrap)` returns the target of a backup.
    """
    try_answer(
        answer,
        [
            ((1.0, 0.9, 10.0, False, False, True), 10.0, "in mid-episode the target is r + gamma V(s')"),
            ((1.0, 0.9, 10.0, True, False, True), 1.0, "after a terminal nothing follows"),
            ((1.0, 0.9, 10.0, False, True, True), 10.0, "bootstrap=True looks through a time limit"),
            ((1.0, 0.9, 10.0, False, True, False), 1.0, "bootstrap=False stops at a time limit"),
            ((1.0, 0.9, 10.0, True, True, True), 1.0, "a fall in the last step is still a fall"),
            ((1.0, 0.9, 10.0, False, False, False), 10.0, "bootstrap=False stops at time limits only"),
            ((1.0, 0.9, 10.0, True, False, False), 1.0, "after a terminal nothing follows, either way"),
        ],
    )
