"""The interface of an algorithm, and what every algorithm shares: one update, acting, saving.

An algorithm is written for one run. `Agent` holds S runs, which may differ in their seed and in their limit,
and computes the algorithm's `draw`, `losses` and `step` for all of them (see `seeds`). The code that is
taught is the code that runs.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from tutorial_lib.agents import lift
from tutorial_lib.agents.player import Player
from tutorial_lib.agents.seeds import Fields, Networks, Rates, Runs
from tutorial_lib.config import Config as AnyConfig
from tutorial_lib.costs.conditioning import check_limit
from tutorial_lib.data.dataset import Batch, Dataset, sample_batch
from tutorial_lib.tasks import Task


class Agent(Runs):
    """S runs of one algorithm on one task.

    Args:
        task: the task whose data the runs learn from.
        config: the options, an instance of the class's own `Config`. `configure` makes one.
        seeds: the seed of each run.
        limits: the limit on the cost of an episode that each run is trained for: one number, or one per run.
            Only for algorithms with `needs_limit`.
        device: where the runs are computed.

    Raises ValueError where seeds, limits or config do not fit.
    """

    name: ClassVar[str]
    Config: ClassVar[type[AnyConfig]] = AnyConfig
    """The class of its options."""
    needs_limit: ClassVar[bool] = False
    """Is a run trained for one limit? If not, it knows no limit, or is told one when it plays."""
    scalars: ClassVar[dict[str, str]] = {}
    """What the log says at each of its updates, by name: every loss as NAME_loss, and what `losses` adds."""
    in_table1: ClassVar[bool] = True
    """Is it a row of Table 1? Ablations and building blocks are not."""
    at_test: ClassVar[tuple[str, ...]] = ()
    """Options that only `player` reads: agents that differ in nothing else are trained alike."""

    def __init__(
        self,
        task: Task,
        config: AnyConfig,
        seeds: Sequence[int] = (0,),
        limits: float | Sequence[float] | None = None,
        device: torch.device | str = "cpu",
    ):
        if type(config) is not self.Config:
            raise ValueError(
                f"{self.name} takes a {self.Config.__name__}, not a {type(config).__name__}: "
                f"make one with {type(self).__name__}.configure()"
            )
        self.task, self.config, self.device = task, config, torch.device(device)
        self.seeds = tuple(seeds)
        self.limits = self._check_limits(limits)
        runs = list(zip(self.seeds, self.limits or self.seeds, strict=True))
        if not runs or min(self.seeds) < 0 or len(set(runs)) < len(runs):
            raise ValueError(
                f"seeds {list(self.seeds)}: at least one, each 0 or more and there once per limit"
            )
        self.steps_variables = type(self).step is not Agent.step
        self.build_runs()
        self.data_checksum: str | None = None  # of the dataset that the runs were trained on

    # What an algorithm writes ------------------------------------------------------------------------

    def build(self) -> dict[str, nn.Module | Tensor]:
        """The networks of one run, and its variables, by name.

        A variable is a plain tensor that no optimiser changes: a multiplier, say, or a statistic of the
        A variable is a plain tensor that no optimiser changes: a multiplier, say, or a statistic of the
        dataset. It is saved with the networks. `measure` may set it before the first update, `step` after
        every update.
        """
        zeros = torch.zeros(self.task.obs_dim)
        return {"observation_mean": zeros, "observation_std": torch.ones_like(zeros)}

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        """The data that a run with this limit learns from, (a part of) the dataset; the run sees no other.

        Actions are kept a hair inside their bounds, as in IQL's code: a Gaussian policy with a tanh mean
        cannot reach an action of exactly one.
        """
        return dataclasses.replace(dataset, actions=np.clip(dataset.actions, -1 + 1e-5, 1 - 1e-5))

    def measure(self, dataset: Dataset) -> dict[str, Tensor]:
        """Variables of one run that depend on the data it learns from, by name."""
        if not self.config.normalise_observations:
            return {}
        mean, std = dataset.observations.mean(0), dataset.observations.std(0)
        return {"observation_mean": torch.tensor(mean), "observation_std": torch.tensor(std) + 1e-3}

    def prepare(self, datasets: Sequence[Dataset], progress: bool = True) -> None:
        """What must be learned before the first update, from the selected dataset of each run."""
        measured = {id(dataset): self.measure(dataset) for dataset in datasets}
        for run, dataset in enumerate(datasets):
            for name, value in measured[id(dataset)].items():
                self.variables[name][run] = value.to(self.device)

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Everything random that one run's update sees, by name: by default a batch of transitions and its
        limit.

        `data` are all transitions that the run learns from, on the agent's device. All draws come from
        `generator`, which is on the CPU, so that they are the same on every device. Each value has the same
        shape in every run.
        """
        batch = sample_batch(data, self.config.batch_size, generator)._asdict()
        return batch | {"limit": torch.full((self.config.batch_size,), limit)}

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """One run's losses and other scalars to be logged, by name, on what `draw` returned.

        Every loss must reach only the network that it trains.
        """
        raise NotImplementedError

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """New values of variables of one run, by name, after an update of its networks."""
        return {}

    def optimiser(self, name: str) -> Rates:
        """How Adam changes the network called `name`."""
        raise NotImplementedError

    def tau(self, name: str) -> float:
        """The Polyak step of the target network of the network called `name`."""
        raise NotImplementedError

    def network_input(self, net: Networks, observations: Tensor, limit: Tensor) -> Tensor:
        """What the networks see of observations (..., obs) and limits (...): the normalised observations."""
        return (observations - net.observation_mean) / net.observation_std

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        """Plays E episodes of one run at once, under limits (E,); its chances come from seeds (E,)."""
        return Player(self, limits, run)

    def predicted_cost(self, observations: np.ndarray, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """The cost of an episode that the run expects of its action now, (E,); NaN: it cannot tell."""
        return np.full(len(observations), np.nan)

    def diagnose(self, dataset: Dataset) -> dict[str, float]:
        """Numbers that describe the trained agent on its dataset, by name, for studies that ask for them."""
        return {}

    def check(self, log: list[dict[str, Any]]) -> None:
        """Warns of what went wrong in a finished training, whose log this is."""

    # What they all share -----------------------------------------------------------------------------

    @classmethod
    def configure(cls, profile: str = "small", task: Task | None = None, **changes: Any) -> AnyConfig:
        """The options of a profile, with the task's own where one is given, and with `changes` made last.

        Raises ValueError for an unknown profile, an option that the algorithm does not read, or a value out
        of its bounds.
        """
        return cls.Config.make(profile, None if task is None else task.name).changed(**changes)

    def draw_all(self, data: Sequence[Batch], generators: Sequence[torch.Generator]) -> dict[str, Tensor]:
        """What `draw` returns for each run, from its own data and generator, stacked: (S, ...)."""
        limits = self.limits or (float("inf"),) * len(self.seeds)
        runs = [self.draw(*run) for run in zip(data, generators, limits, strict=True)]
        stack = {name: torch.stack([run[name] for run in runs]) for name in runs[0]}
        return lift.map_tensors(stack, lambda x: x.to(self.device, non_blocking=True))

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """Mean actions (E, act) of one run at observations (E, obs) under limits (E,), by network
        `policy`."""
        with torch.no_grad():
            net, x = self.networks(run), (self._tensor(observations), self._tensor(limits))
            mean, _ = net.policy(self.network_input(net, *x))
            return mean.cpu().numpy()

    def playing_with(self, **changes: Any) -> Self:
        """The same trained agent with other values of options that only its player reads (`at_test`)."""
        if unread := set(changes) - set(self.at_test):
            raise ValueError(
                f"{self.name}: {', '.join(sorted(unread))}: training reads this, not only playing"
            )
        other = type(self).__new__(type(self))
        vars(other).update(vars(self) | {"config": self.config.changed(**changes)})
        return other

    def _check_limits(self, limits: float | Sequence[float] | None) -> tuple[float, ...] | None:
        """One limit per run, or None for algorithms that are trained for none."""
        if self.needs_limit != (limits is not None):
            verb = "is trained for one limit: give it one" if self.needs_limit else "takes no limit to train"
            raise ValueError(f"{self.name} {verb}")
        if limits is None:
            return None
        limits = [limits] * len(self.seeds) if isinstance(limits, int | float) else list(limits)
        if len(limits) != len(self.seeds):
            raise ValueError(
                f"{len(limits)} limits for {len(self.seeds)} seeds: give one limit, or one per seed"
            )
        return tuple(check_limit(limit) for limit in limits)

    def _tensor(self, x: Any) -> Tensor:
        return torch.as_tensor(np.asarray(x, np.float32), device=self.device)
