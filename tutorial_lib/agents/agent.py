"""The interface of an algorithm, and the code that every algorithm shares.

An algorithm is written for one run. `Agent` holds S runs, which may differ in their seed and in their limit,
and computes the algorithm's `draw`, `losses` and `step` for all of them (see `seeds`). The code that the
course explains is the code that runs.
"""

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

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
        seeds: the seed of each run, 0 or more.
        limits: the limit that each run is trained for, in cost per episode: one number, or one per run.
            Algorithms with `needs_limit` need it, and all others must not have it.
        device: the device on which the runs are computed.

    Raises ValueError if seeds, limits or config do not fit.
    """

    name: ClassVar[str]
    """The name that the command line and the results files use."""
    Config: ClassVar[type[AnyConfig]] = AnyConfig
    """The class of the algorithm's options."""
    needs_limit: ClassVar[bool] = False
    """True if a run is trained for one limit. If False, it takes no limit, or is told one while it plays."""
    scalars: ClassVar[dict[str, str]] = {}
    """The meaning of each scalar in the log, by name: of NAME_loss, and of what `losses` adds."""
    in_table1: ClassVar[bool] = True
    """True if the algorithm is a row of Table 1. Ablations and building blocks are not."""
    at_test: ClassVar[tuple[str, ...]] = ()
    """The options that only `player` reads. Agents that differ only in these are trained in the same way."""

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

    # What an algorithm defines ------------------------------------------------------------------------

    def build(self) -> dict[str, nn.Module | Tensor]:
        """Returns the networks and the variables of one run, by name.

        A variable is a tensor that no optimiser changes, for example a multiplier or a statistic of the
        dataset. It is saved with the networks. `measure` may set it before the first update, and `step` after
        every update. The variables here are `observation_mean` and `observation_std`, both (obs,).
        """
        zeros = torch.zeros(self.task.obs_dim)
        return {"observation_mean": zeros, "observation_std": torch.ones_like(zeros)}

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        """Returns the data that a run with this limit learns from. The run sees no other data.

        Actions are clamped to [-1 + 1e-5, 1 - 1e-5], as in IQL's code, because a Gaussian policy with a tanh
        mean cannot reach an action of exactly one.
        """
        return dataclasses.replace(dataset, actions=np.clip(dataset.actions, -1 + 1e-5, 1 - 1e-5))

    def measure(self, dataset: Dataset) -> dict[str, Tensor]:
        """Returns the variables of one run that depend on the data that it learns from, by name."""
        if not self.config.normalise_observations:
            return {}
        mean, std = dataset.observations.mean(0), dataset.observations.std(0)
        return {"observation_mean": torch.tensor(mean), "observation_std": torch.tensor(std) + 1e-3}

    def prepare(self, datasets: Sequence[Dataset], progress: bool = True) -> None:
        """Does what must be done before the first update: it measures each run's variables.

        `datasets` has the selected dataset of each run. `progress` shows a progress bar where this takes
        long.
        """
        measured = {id(dataset): self.measure(dataset) for dataset in datasets}
        for run, dataset in enumerate(datasets):
            for name, value in measured[id(dataset)].items():
                self.variables[name][run] = value.to(self.device)

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns everything random that one update of one run sees, by name.

        By default this is a batch of transitions (B, ...) and `limit`, the run's limit, (B,). `data` are all
        transitions that the run learns from, on the agent's device. All random numbers come from `generator`,
        which is on the CPU, so that they are the same on every device. Each value has the same shape in every
        run.
        """
        batch = sample_batch(data, self.config.batch_size, generator)._asdict()
        return batch | {"limit": torch.full((self.config.batch_size,), limit)}

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Returns one run's losses, and other scalars for the log, both by name.

        The gradient of a loss must reach only the networks that it trains. `batch` holds what `draw`
        returned.
        """
        raise NotImplementedError

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns new values of one run's variables, by name, after each update of its networks."""
        return {}

    def optimiser(self, name: str) -> Rates:
        """Returns how Adam trains the network called `name`."""
        raise NotImplementedError

    def tau(self, name: str) -> float:
        """Returns the Polyak step of the target network of the network called `name`."""
        raise NotImplementedError

    def network_input(self, net: Networks, observations: Tensor, limit: Tensor) -> Tensor:
        """Returns the networks' input for observations (..., obs) and limits (...). It is (..., inputs).

        By default this is the normalised observations."""
        return (observations - net.observation_mean) / net.observation_std

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        """Returns a player of one run for E episodes, each with its own limit and seed, (E,).

        A player that draws random numbers takes them from these seeds.
        """
        return Player(self, limits, run)

    def predicted_cost(self, observations: np.ndarray, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """Returns the cost of an episode that the run predicts for its action at observations (E, obs), (E,).

        It is NaN if the algorithm predicts no cost. The limits are (E,).
        """
        return np.full(len(observations), np.nan)

    def diagnose(self, dataset: Dataset, run: int = 0) -> dict[str, float]:
        """Returns numbers that describe a trained run on its dataset, by name. Studies ask for them."""
        return {}

    def check(self, log: list[dict[str, Any]]) -> None:
        """Warns if the log of a finished training shows a problem."""

    # What all algorithms share -----------------------------------------------------------------------------

    @classmethod
    def row_name(cls, profile: str) -> str:
        """Returns the algorithm's name in results. An algorithm as it is printed has a row of its own."""
        return f"{cls.name} (printed)" if profile == "printed" else cls.name

    @property
    def label(self) -> str:
        """The agent's name in results."""
        return self.row_name(self.config.profile)

    @classmethod
    def configure(cls, profile: str = "small", **changes: Any) -> AnyConfig:
        """Returns the options of a profile, changed by `changes`.

        Raises ValueError for an unknown profile, an option that the algorithm does not have, or a value that
        is out of its bound.
        """
        return cls.Config.make(profile).changed(**changes)

    @classmethod
    def count_parameters(
        cls,
        task: Task,
        config: AnyConfig,
        seeds: Sequence[int],
        limits: Sequence[float] | None,
        most: float = math.inf,
    ) -> int:
        """Returns the number of parameters of the first of these runs, without taking memory for them.

        The run is built on the device `meta`, which has shapes but no memory, and its parameters are counted
        as they are made. If they are more than `most`, the rest is not built, and the count so far is
        returned.
        """
        made = 0

        class Enough(Exception):
            """There are more than `most` parameters."""

        def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
            nonlocal made
            made += 0 if parameter is None else parameter.numel()
            if made > most:
                raise Enough

        def build_one(agent: Agent) -> None:
            agent.build()
            agent.parameters, agent.target_parameters = {}, {}

        outline = type("Outline", (cls,), {"build_runs": build_one})
        handle = register_module_parameter_registration_hook(count)
        try:
            with contextlib.suppress(Enough), torch.device("meta"):
                outline(task, config, seeds[:1], limits and limits[:1], "meta")
        finally:
            handle.remove()
        return made

    def draw_all(self, data: Sequence[Batch], generators: Sequence[torch.Generator]) -> dict[str, Tensor]:
        """Returns what `draw` returns for each run, from its own data and generator, stacked: (S, ...)."""
        limits = self.limits or (float("inf"),) * len(self.seeds)
        runs = [self.draw(*run) for run in zip(data, generators, limits, strict=True)]
        stack = {name: torch.stack([run[name] for run in runs]) for name in runs[0]}
        return lift.map_tensors(stack, lambda x: x.to(self.device, non_blocking=True))

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """Returns the mean actions (E, act) of one run's network `policy`.

        The observations are (E, obs) and the limits are (E,).
        """
        with torch.no_grad():
            net, x = self.networks(run), (self._tensor(observations), self._tensor(limits))
            mean, _ = net.policy(self.network_input(net, *x))
            return mean.cpu().numpy()

    def playing_with(self, **changes: Any) -> Self:
        """Returns the same trained agent with other values of options that only its player reads (`at_test`).

        Raises ValueError for an option that training reads.
        """
        if unread := set(changes) - set(self.at_test):
            raise ValueError(
                f"{self.name}: {', '.join(sorted(unread))} cannot change: training reads it, too"
            )
        other = type(self).__new__(type(self))
        vars(other).update(vars(self) | {"config": self.config.changed(**changes)})
        return other

    def _check_limits(self, limits: float | Sequence[float] | None) -> tuple[float, ...] | None:
        """Returns one limit per run, or None for algorithms that are trained for no limit."""
        if self.needs_limit != (limits is not None):
            verb = "is trained for one limit: give it one" if self.needs_limit else "takes no limit to train"
            raise ValueError(f"{self.name} {verb}")
        if limits is None:
            return None
        given = np.asarray(limits, float)
        given = np.full(len(self.seeds), given) if given.ndim == 0 else given
        if given.shape != (len(self.seeds),):
            count = f"{given.size} limits for {len(self.seeds)} seeds"
            raise ValueError(f"{count}: give one limit, or one per seed")
        return tuple(check_limit(limit) for limit in given.tolist())

    def _tensor(self, x: Any) -> Tensor:
        return torch.as_tensor(np.asarray(x, np.float32), device=self.device)
