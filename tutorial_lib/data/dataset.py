"""Datasets as arrays, and batches to train on.

A dataset is seven arrays with one row per transition, in the layout of DSRL (Liu et al. 2024). The rows of
one episode stand together and in order. Both `terminals` (the robot fell) and `timeouts` (the horizon was
reached) end an episode. They are never merged: after a terminal nothing follows, but a time limit only ends
the recording.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.signal import lfilter  # computes the recursion y_t = x_t + gamma y_(t+1) in compiled code

KEYS = ("observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts")
"""The names of the seven arrays."""


class DatasetError(ValueError):
    """Is raised for a dataset that cannot be used.

    The message is one line: the file, the key, what is wrong, and what to do.
    """


class Batch(NamedTuple):
    """B transitions as float32 tensors.

    observations and next_observations are (B, obs), actions (B, act), all others (B,). The flags terminals
    and timeouts are 0 or 1. The last three describe a transition's place in its episode.
    """

    observations: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    costs: torch.Tensor
    next_observations: torch.Tensor
    terminals: torch.Tensor
    timeouts: torch.Tensor
    timesteps: torch.Tensor
    """The number of steps that the episode has before the transition."""
    returns_to_go: torch.Tensor
    """The undiscounted sum of the rewards from the transition to the end of the episode."""
    costs_to_go: torch.Tensor
    """The undiscounted sum of the costs from the transition to the end of the episode."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """N transitions that make up whole episodes, in order.

    observations and next_observations (N, obs), actions (N, act), rewards and costs (N,) are float32.
    terminals and timeouts (N,) are bool. `attributes` says where the data come from. Raises DatasetError
    where the last row does not end an episode.
    """

    observations: np.ndarray
    next_observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    terminals: np.ndarray
    timeouts: np.ndarray
    attributes: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not len(self) or not (self.terminals[-1] or self.timeouts[-1]):
            raise DatasetError("a dataset needs whole episodes: its last row must be a terminal or a timeout")

    def __len__(self) -> int:
        return len(self.rewards)

    @cached_property
    def ends(self) -> np.ndarray:
        """(num_episodes,): one past the last row of each episode. The rows of an episode are [start, end)."""
        return np.flatnonzero(self.terminals | self.timeouts) + 1

    @cached_property
    def starts(self) -> np.ndarray:
        """(num_episodes,): the first row of each episode."""
        return np.concatenate(([0], self.ends[:-1]))

    @property
    def num_episodes(self) -> int:
        """The number of episodes."""
        return len(self.ends)

    @property
    def episode_lengths(self) -> np.ndarray:
        """(num_episodes,): the number of steps of each episode."""
        return self.ends - self.starts

    @cached_property
    def episode_returns(self) -> np.ndarray:
        """(num_episodes,) float64: the undiscounted sum of the rewards of each episode."""
        return np.add.reduceat(self.rewards, self.starts, dtype=np.float64)

    @cached_property
    def episode_costs(self) -> np.ndarray:
        """(num_episodes,) float64: the undiscounted sum of the costs of each episode. Limits apply to it."""
        return np.add.reduceat(self.costs, self.starts, dtype=np.float64)

    @cached_property
    def episode_index(self) -> np.ndarray:
        """(N,): the number of each row's episode, counted from 0."""
        return np.repeat(np.arange(self.num_episodes), self.episode_lengths)

    @property
    def timesteps(self) -> np.ndarray:
        """(N,): the number of steps that each row's episode has before it."""
        return np.arange(len(self)) - self.starts[self.episode_index]

    @property
    def returns_to_go(self) -> np.ndarray:
        """(N,) float64: the undiscounted sum of the rewards from each row to the end of its episode."""
        return self._to_go(self.rewards)

    @property
    def costs_to_go(self) -> np.ndarray:
        """(N,) float64: the undiscounted sum of the costs from each row to the end of its episode."""
        return self._to_go(self.costs)

    def _to_go(self, values: np.ndarray) -> np.ndarray:
        sums = np.concatenate(([0.0], np.cumsum(values, dtype=np.float64)))
        return sums[self.ends][self.episode_index] - sums[:-1]

    @cached_property
    def checksum(self) -> str:
        """The SHA-256 of all values, in hexadecimal.

        Equal data have equal checksums, whatever the compression of their files.
        """
        digest = hashlib.sha256()
        for key in KEYS:
            digest.update(np.ascontiguousarray(getattr(self, key)).data)
        return digest.hexdigest()

    def select(self, episodes: np.ndarray | Sequence[int]) -> "Dataset":
        """A dataset of some of the episodes, for example `d.select(d.episode_costs < 30)`.

        `episodes` is a mask (num_episodes,), or the episodes' numbers in the wanted order. Raises
        DatasetError where no episode is chosen.
        """
        chosen = np.arange(self.num_episodes)[episodes]
        if not len(chosen):
            raise DatasetError(
                f"select: none of {self.num_episodes} episodes is chosen: a dataset needs at least one"
            )
        rows = np.concatenate([np.arange(self.starts[i], self.ends[i]) for i in chosen])
        return Dataset(**{key: getattr(self, key)[rows] for key in KEYS}, attributes=self.attributes)

    def tensors(self, device: torch.device | str = "cpu") -> Batch:
        """A copy of all N transitions as one Batch on `device`. Training draws its batches from it."""
        options: dict[str, Any] = {"dtype": torch.float32, "device": device}
        return Batch(**{key: torch.tensor(getattr(self, key), **options) for key in Batch._fields})


def sample_batch(data: Batch, batch_size: int, generator: torch.Generator) -> Batch:
    """B = `batch_size` transitions of `data`, drawn uniformly with replacement.

    `generator` is on the CPU. So the drawn rows do not depend on the device of the data.
    """
    rows = torch.randint(len(data.rewards), (batch_size,), generator=generator)
    rows = rows.to(data.rewards.device, non_blocking=True)
    return Batch(*(values.index_select(0, rows) for values in data))


def returns_to_go(dataset: Dataset, gamma: float, after_timeout: ArrayLike = 0.0) -> np.ndarray:
    """The discounted sum of the rewards from each row to the end of its episode, (N,) float64.

    Nothing follows a terminal. What follows a time limit was not recorded: `after_timeout`, which is one
    number or one per episode, (num_episodes,), is taken as the value of the state after it.
    """
    tails = np.broadcast_to(after_timeout, dataset.num_episodes)
    totals = np.empty(len(dataset))
    for start, end, tail in zip(dataset.starts, dataset.ends, tails, strict=True):
        following = 0.0 if dataset.terminals[end - 1] else float(tail)
        backwards = np.asarray(dataset.rewards[start:end][::-1], np.float64)
        totals[start:end][::-1] = lfilter([1.0], [1.0, -gamma], backwards, zi=[gamma * following])[0]
    return totals
