"""Episodes with random actions, for the tests of tasks: played, kept and compared."""

import functools
from typing import NamedTuple

import numpy as np
import pytest

from tutorial_lib.tasks import make_env, simulator_of


class Episode(NamedTuple):
    """An episode of n steps, or its first n steps. Row 0 is its start, row t what step t led to."""

    observations: np.ndarray
    """(n + 1, obs_dim)"""
    rewards: np.ndarray
    """(n + 1,), the first is 0"""
    costs: np.ndarray
    """(n + 1,), the first is 0"""
    positions: np.ndarray
    """(n + 1, 2), or (n + 1, 0) where the task has no scene"""
    terminated: np.ndarray
    """(n + 1,) bool"""
    truncated: np.ndarray
    """(n + 1,) bool"""

    def __len__(self):
        return len(self.rewards) - 1

    def first(self, steps: int) -> "Episode":
        """Its first steps."""
        return Episode(*(part[: steps + 1] for part in self))


def needs_simulator(task):
    """The mark of a test that plays a task: it skips, and says why, where the simulator is not installed."""
    simulator = simulator_of(task)
    reason = f"{simulator.package} is not installed: {simulator.remedy}"
    return pytest.mark.skipif(bool(simulator.missing()), reason=reason)


@functools.cache
def shared_env(name: str):
    """One environment per task, used by all tests: what a test leaves behind must not matter to the next."""
    return make_env(name)


def play(env, seed: int, steps: int | None = None, actions_seed: int = 0, hold: int = 5) -> Episode:
    """An episode, or its first steps, with random actions that are held for `hold` steps each."""
    rng = np.random.default_rng(actions_seed)
    observation, _ = env.reset(seed=seed)
    rows = [(observation, 0.0, 0.0, _position(env), False, False)]
    while len(rows) - 1 != steps:
        if (len(rows) - 1) % hold == 0:
            action = rng.uniform(-1, 1, env.task.act_dim)
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append((observation, reward, info["cost"], _position(env), terminated, truncated))
        if terminated or truncated:
            break
    return Episode(*map(np.array, zip(*rows, strict=True)))


def _position(env):
    return np.array(env.position if env.task.scene is not None else [])


@functools.cache
def reference(name: str) -> Episode:
    """The episode of seed 3, in an environment that has played nothing before."""
    return play(make_env(name), seed=3)


def assert_same(one: Episode, other: Episode) -> None:
    """Fails where any number of the two differs, by however little."""
    for field, left, right in zip(Episode._fields, one, other, strict=True):
        np.testing.assert_array_equal(left, right, err_msg=field)
