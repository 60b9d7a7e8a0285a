"""Datasets as arrays, and batches to train on.

A dataset is seven arrays with one row per transition, episode after episode (DSRL: Liu et al. 2024).
`terminals` (the robot fell) and `timeouts` (the horizon was reached) both end an episode and are never
merged: after a terminal nothing follows, whereas a time limit only ends the recording.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.signal import lfilter  # the recursion y_t = x_t + gamma y_(t+1), compiled

KEYS = ("observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts")


class DatasetError(ValueError):
    """A dataset that cannot be used. One line: the file, the key, what is wrong, what to do."""


class Batch(NamedTuple):
    """B transitions as float32: observations (B, obs), actions (B, act), the others (B,), flags 0 or 1."""

    observations: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    costs: torch.Tensor
    next_observations: torch.Tensor
    terminals: torch.Tensor
    timeouts: torch.Tensor


@dataclass(frozen=True, eq=False)
class Dataset:
    """N transitions that make up whole episodes, in order.

    observations, next_observations (N, obs), actions (N, act), rewards, costs (N,) are float32;
    terminals, timeouts (N,) are bool. `attributes` tells where the data come from. The last row must
    end an episode: DatasetError if not.
    """

    observations: np.ndarray
    next_observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    terminals: np.ndarray
    timeouts: np.ndarray
    attributes: dict = field(default_factory=dict)

    def __post_init__(self):
        if not len(self) or not (self.terminals[-1] or self.timeouts[-1]):
            raise DatasetError("a dataset needs whole episodes: its last row must be a terminal or a timeout")

    def __len__(self) -> int:
        return len(self.rewards)

    @cached_property
    def ends(self) -> np.ndarray:
        """(num_episodes,): one past the last row of each episode, so that rows are [start, end)."""
        return np.flatnonzero(self.terminals | self.timeouts) + 1

    @cached_property
    def starts(self) -> np.ndarray:
        """(num_episodes,): the first row of each episode."""
        return np.concatenate(([0], self.ends[:-1]))

    @property
    def num_episodes(self) -> int:
        return len(self.ends)

    @property
    def episode_lengths(self) -> np.ndarray:
        """(num_episodes,): steps."""
        return self.ends - self.starts

    @cached_property
    def episode_returns(self) -> np.ndarray:
        """(num_episodes,) float64: undiscounted sums of rewards."""
        return np.add.reduceat(self.rewards, self.starts, dtype=np.float64)

    @cached_property
    def episode_costs(self) -> np.ndarray:
        """(num_episodes,) float64: undiscounted sums of costs, which a threshold bounds."""
        return np.add.reduceat(self.costs, self.starts, dtype=np.float64)

    @cached_property
    def episode_index(self) -> np.ndarray:
        """(N,): the episode of each row."""
        return np.repeat(np.arange(self.num_episodes), self.episode_lengths)

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of all values, in hexadecimal: the same for the same data, however a file packs them."""
        digest = hashlib.sha256()
        for key in KEYS:
            digest.update(np.ascontiguousarray(getattr(self, key)).data)
        return digest.hexdigest()

    def select(self, episodes) -> "Dataset":
        """These episodes alone, a mask or indices in the order wanted: `d.select(d.episode_costs < 30)`."""
        chosen = np.arange(self.num_episodes)[episodes]
        if not len(chosen):
            raise DatasetError(f"select: none of {self.num_episodes} episodes chosen: a dataset needs one")
        rows = np.concatenate([np.arange(self.starts[i], self.ends[i]) for i in chosen])
        return Dataset(**{key: getattr(self, key)[rows] for key in KEYS}, attributes=self.attributes)

    def tensors(self, device="cpu") -> Batch:
        """All N transitions as one Batch on `device`, a copy, so that training samples by indexing it."""
        options = {"dtype": torch.float32, "device": device}
        return Batch(**{key: torch.tensor(getattr(self, key), **options) for key in KEYS})


def sample_batch(data: Batch, batch_size: int, generator: torch.Generator) -> Batch:
    """`batch_size` rows of `data`, uniform, with replacement: observations (batch_size, obs) and so on.

    The generator is on the CPU, so that the rows do not depend on the device of the data.
    """
    rows = torch.randint(len(data.rewards), (batch_size,), generator=generator)
    rows = rows.to(data.rewards.device, non_blocking=True)
    return Batch(*(values.index_select(0, rows) for values in data))


def returns_to_go(dataset: Dataset, gamma: float, after_timeout=0.0) -> np.ndarray:
    """Discounted sum of the rewards from each row to the end of its episode, (N,) float64.

    Nothing follows a terminal. What follows a time limit was not recorded: `after_timeout`, a number or one
    per episode, is put in its place.
    """
    tails = np.broadcast_to(after_timeout, dataset.num_episodes)
    totals = np.empty(len(dataset))
    for start, end, tail in zip(dataset.starts, dataset.ends, tails, strict=True):
        following = 0.0 if dataset.terminals[end - 1] else float(tail)
        backwards = np.asarray(dataset.rewards[start:end][::-1], np.float64)
        totals[start:end][::-1] = lfilter([1.0], [1.0, -gamma], backwards, zi=[gamma * following])[0]
    return totals
