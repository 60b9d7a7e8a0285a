"""Trains S runs of one algorithm together: it holds, updates and saves their tensors.

An algorithm's `build`, `losses` and `step` are written for one run. Here the tensors of S runs are stacked
along a first axis, and the functions are lifted over the stack (see `lift`). Runs share no parameter, so the
gradient of the sum of their losses gives each run its own gradient.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tutorial_lib.agents import lift
from tutorial_lib.config import Config

Networks = SimpleNamespace
"""The networks of one run that `losses` and `step` get, by name. They are the networks and variables of
`build`, the target networks as `target_NAME`, and the networks listed in `frozen` as `frozen_NAME`, whose
parameters get no gradient."""
Fields = SimpleNamespace
"""The batch of one run that `losses` and `step` get: everything that `draw` returned, by name."""


class Rates(NamedTuple):
    """How Adam trains one network."""

    lr: float
    """The learning rate."""
    weight_decay: float = 0.0
    """The weight decay, decoupled from the gradient as in AdamW."""
    clip: float | None = None
    """The largest norm that one run's gradient of this network may have. With None there is no bound."""
    cosine: bool = False
    """If true, the learning rate decays to zero along a half cosine."""
    warm_up: int = 0
    """The number of updates over which the learning rate rises linearly from zero."""

    def at(self, update: int, updates: int) -> float:
        """Returns the learning rate at an update, counted from zero, of a run of `updates` updates."""
        cosine = 0.5 * (1 + np.cos(np.pi * min(update / updates, 1))) if self.cosine else 1.0
        return self.lr * cosine * min((update + 1) / self.warm_up, 1.0) if self.warm_up else self.lr * cosine


class Runs:
    """The tensors of S runs. `agent.Agent` says what an algorithm must define."""

    config: Config
    """The options, which are the same in all runs."""
    seeds: tuple[int, ...]
    """The seed of each run, (S,)."""
    device: torch.device
    """The device of all tensors."""
    targets: ClassVar[tuple[str, ...]] = ()
    """The networks that have a target network, a copy that follows them with Polyak step `tau`."""
    frozen: ClassVar[tuple[str, ...]] = ()
    """The networks through which a loss needs a gradient although it does not train them."""
    fixed: ClassVar[tuple[str, ...]] = ()
    """The networks that no update changes. `Agent.prepare` may train them before the first update."""
    steps_variables: bool
    """True if the algorithm defines `step`."""

    def build(self) -> dict[str, nn.Module | Tensor]:
        """Returns the networks and variables of one run (see `Agent.build`)."""
        raise NotImplementedError

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Returns one run's losses and scalars (see `Agent.losses`)."""
        raise NotImplementedError

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns new values of one run's variables (see `Agent.step`)."""
        raise NotImplementedError

    def optimiser(self, name: str) -> Rates:
        """Returns how Adam trains a network (see `Agent.optimiser`)."""
        raise NotImplementedError

    def tau(self, name: str) -> float:
        """Returns the Polyak step of a target network (see `Agent.tau`)."""
        raise NotImplementedError

    def build_runs(self) -> None:
        """Makes the tensors of all runs, each with the random numbers of its seed, and their optimiser.

        Raises ValueError for a network that cannot be lifted (see `lift.refuse_hidden_state`).
        """
        runs = [self._build_seeded(seed) for seed in self.seeds]
        networks: dict[str, Any] = {}
        variables: dict[str, Any] = {}
        for name, part in runs[0].items():
            (networks if isinstance(part, nn.Module) else variables)[name] = [run[name] for run in runs]

        def on_device(x: Tensor) -> Tensor:
            return x.to(self.device)

        def trained(x: Tensor) -> Tensor:
            return on_device(x).requires_grad_()

        self.modules = {name: nets[0] for name, nets in networks.items()}
        self._borrowers = self._make_borrowers()  # refuses layers that cannot be lifted
        stacks = {kind: {n: lift.stacked(nets, kind) for n, nets in networks.items()} for kind in lift.KINDS}
        self.parameters = {
            name: lift.map_tensors(stack, on_device if name in self.fixed else trained)
            for name, stack in stacks["parameters"].items()
        }
        self.buffers = lift.map_tensors(stacks["buffers"], on_device)
        self.target_parameters = lift.map_tensors(
            {name: self.parameters[name] for name in self.targets}, lambda x: x.detach().clone()
        )
        stack = {name: torch.stack(values) for name, values in variables.items()}
        self.variables = lift.map_tensors(stack, on_device)
        self.rates = {name: self.optimiser(name) for name in networks if name not in self.fixed}
        groups = [
            {
                "params": list(self.parameters[name].values()),
                "lr": rates.lr,
                "weight_decay": rates.weight_decay,
            }
            for name, rates in self.rates.items()
        ]
        self.adam = torch.optim.AdamW(groups, fused=True)
        self._lifted = lift.over_runs(self._total, len(self.seeds))
        self._acting: dict[int, Networks] = {}
        self.updates = 0

    def update(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Makes one gradient step of every run on what `draw_all` returned, and returns scalars (S,).

        All losses are computed from the same parameters, and then all networks step at once. So the policy
        and the targets of Q see V from before this step. (IQL's code updates V first. At these learning rates
        the difference is one step, and one joint step is faster.)
        """
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            loss, scalars = self._lifted(self._tensors(), batch)
        self.adam.zero_grad()
        loss.sum().backward()
        for group, (name, rates) in zip(self.adam.param_groups, self.rates.items(), strict=True):
            group["lr"] = rates.at(self.updates, self.config.updates)
            if rates.clip is not None:
                lift.clip_gradients(self.parameters[name].values(), rates.clip)
        self.adam.step()
        with torch.no_grad():  # otherwise each target keeps the autograd graph of every earlier update
            for name, averages in self.target_parameters.items():
                online = list(self.parameters[name].values())
                torch._foreach_lerp_(list(averages.values()), online, self.tau(name))
            self._step_variables(batch, scalars)
        self.updates += 1
        return scalars

    def networks(self, run: int = 0) -> Networks:
        """Returns the networks and variables of one run, as `losses` sees them, for use without gradients."""
        if run not in self._acting:
            own = lift.map_tensors(self._tensors(), lambda x: x[run].detach())
            self._acting[run] = self._net(own, self._make_borrowers())
        return self._acting[run]

    def fill_last_bias(self, names: Sequence[str], values: Sequence[float]) -> None:
        """Sets the output bias of these networks and of their target networks to one value per run, (S,).

        The output bias is the last parameter of a network.
        """
        with torch.no_grad():
            for parameters in (self.parameters, self.target_parameters):
                for name in set(names) & set(parameters):
                    for bias, value in zip(list(parameters[name].values())[-1], values, strict=True):
                        bias.fill_(value)

    def fill_network(self, name: str, run: int, network: nn.Module) -> None:
        """Gives one run's network the parameters and buffers of a network with the same layers."""
        with torch.no_grad():
            for own, given in (
                (self.parameters, network.named_parameters),
                (self.buffers, network.named_buffers),
            ):
                for key, value in given():
                    own[name][key][run].copy_(value)

    def state(self) -> dict[str, Tensor]:
        """Returns all tensors by flat names: online.*, buffer.*, target.*, variable.*, adam.* and updates."""
        parts = {"online": self.parameters, "buffer": self.buffers, "target": self.target_parameters}
        tensors = {
            name: tensor.detach()
            for kind, part in parts.items()
            for name, tensor in lift.flat_names(part, kind)
        }
        tensors |= {f"variable.{name}": value for name, value in self.variables.items()}
        for index, moments in self.adam.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{key}": value for key, value in moments.items()}
        return tensors | {"updates": torch.tensor(self.updates)}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Sets all tensors to those that `state` returned.

        If adam.* and target.* are missing, the agent can act, but it cannot continue its training. Raises
        KeyError for a missing tensor, and ValueError for a tensor of another shape.
        """
        with torch.no_grad():
            for name, place in self.state().items():
                if name.startswith(("adam.", "updates")):
                    continue
                online = name.replace("target.", "online.", 1)  # files of `save_agent` have no target.*
                value = tensors[name if name in tensors or name == online else online]
                if value.shape != place.shape:  # otherwise copy_ would copy one run to all
                    raise ValueError(f"{name} has shape {tuple(value.shape)}, not {tuple(place.shape)}")
                place.copy_(value)
        state = self.adam.state_dict() | {"state": {}}
        for key, value in tensors.items():
            if key.startswith("adam."):
                _, index, moment = key.split(".")
                state["state"].setdefault(int(index), {})[moment] = value
        self.adam.load_state_dict(state)
        self.updates = int(tensors["updates"])

    def __getstate__(self) -> dict[str, Any]:
        """Returns what a worker process needs to act: everything but the optimiser and the lent networks."""
        left = ("adam", "_borrowers", "_lifted", "_acting")
        return {key: value for key, value in vars(self).items() if key not in left} | {"_acting": {}}

    def _build_seeded(self, seed: int) -> dict[str, nn.Module | Tensor]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return self.build()

    def _make_borrowers(self) -> dict[str, lift.Borrower]:
        of = {name: name for name in self.modules}
        of |= {f"target_{name}": name for name in self.targets}
        of |= {f"frozen_{name}": name for name in self.frozen}
        return {name: lift.Borrower(self.modules[network]) for name, network in of.items()}

    def _tensors(self) -> dict[str, dict]:
        """Returns all tensors of all runs, (S, ...), as nested dicts."""
        return {
            "online": self.parameters,
            "target": self.target_parameters,
            "buffer": self.buffers,
            "variable": self.variables,
        }

    def _net(self, own: dict[str, dict], borrowers: dict[str, lift.Borrower]) -> Networks:
        """Returns what `losses` sees of one run, from that run's tensors."""
        online, buffers = own["online"], own["buffer"]
        lent = {name: params | buffers[name] for name, params in online.items()}
        lent |= {f"target_{name}": params | buffers[name] for name, params in own["target"].items()}
        for name in self.frozen:
            lent[f"frozen_{name}"] = lift.map_tensors(online[name], Tensor.detach) | buffers[name]
        nets = {name: borrowers[name].lend(tensors) for name, tensors in lent.items()}
        return Networks(**nets, **own["variable"])

    def _total(self, own: dict[str, dict], batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the sum of one run's losses, and its scalars, from its tensors and its batch."""
        losses, scalars = self.losses(self._net(own, self._borrowers), Fields(**batch))
        scalars = {f"{name}_loss": loss for name, loss in losses.items()} | scalars
        total: Any = sum(losses.values())
        return total, {name: value.detach() for name, value in scalars.items()}

    def _step_variables(self, batch: dict[str, Tensor], scalars: dict[str, Tensor]) -> None:
        """Gives the variables of every run the values that `step` returns."""
        if not self.steps_variables:
            return

        def stepped(own: dict, batch: dict, scalars: dict) -> dict[str, Tensor]:
            return self.step(self._net(own, self._borrowers), Fields(**batch), scalars)

        new = lift.over_runs(stepped, len(self.seeds))(self._tensors(), batch, scalars)
        for name, value in new.items():
            self.variables[name].copy_(value)
