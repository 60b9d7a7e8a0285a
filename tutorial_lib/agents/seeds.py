"""Many seeds as one: the tensors of S runs of one algorithm, one update of all of them, and their state.

An algorithm's `build`, `losses` and `step` speak of one run. Here their tensors are stacked along a first
axis, and the functions are lifted over the stack (see `lift`). Runs share no parameter, so the gradient of
the sum of their losses gives each run its own gradient.
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
"""What `losses` and `step` see of one run, by name: the networks and variables of `build`, the target
networks as `target_NAME`, and the networks listed in `frozen` as `frozen_NAME`, whose parameters get no
gradient there."""
Fields = SimpleNamespace
"""What `losses` and `step` see of one run's batch: everything that `draw` returned, by name."""


class Rates(NamedTuple):
    """How Adam changes one network."""

    lr: float
    """The learning rate."""
    weight_decay: float = 0.0
    """Decoupled, as in AdamW."""
    clip: float | None = None
    """The largest norm of one run's gradient of this network; None: any."""
    cosine: bool = False
    """Does the learning rate decay to zero along a half cosine?"""
    warm_up: int = 0
    """Updates over which the learning rate rises linearly from zero."""

    def at(self, update: int, updates: int) -> float:
        """The learning rate at an update, counted from zero, of so many."""
        cosine = 0.5 * (1 + np.cos(np.pi * min(update / updates, 1))) if self.cosine else 1.0
        return self.lr * cosine * min((update + 1) / self.warm_up, 1.0) if self.warm_up else self.lr * cosine


class Runs:
    """The tensors of S runs. `agent.Agent` says what an algorithm writes."""

    config: Config
    seeds: tuple[int, ...]
    device: torch.device
    targets: ClassVar[tuple[str, ...]] = ()
    """Networks that have a copy which follows them slowly (`tau`)."""
    frozen: ClassVar[tuple[str, ...]] = ()
    """Networks that some loss looks through without training them."""
    steps_variables: bool
    """Does the algorithm write `step`?"""

    def build(self) -> dict[str, nn.Module | Tensor]:
        raise NotImplementedError

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        raise NotImplementedError

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        raise NotImplementedError

    def optimiser(self, name: str) -> Rates:
        raise NotImplementedError

    def tau(self, name: str) -> float:
        raise NotImplementedError

    def build_runs(self) -> None:
        """Make the tensors of all runs, each drawn with its seed, and Adam for those that are trained."""
        runs = [self._build_seeded(seed) for seed in self.seeds]
        networks: dict[str, Any] = {}
        variables: dict[str, Any] = {}
        for name, part in runs[0].items():
            (networks if isinstance(part, nn.Module) else variables)[name] = [run[name] for run in runs]

        def on_device(x: Tensor) -> Tensor:
            return x.to(self.device)

        def trained(x: Tensor) -> Tensor:
            return x.to(self.device).requires_grad_()

        self.modules = {name: nets[0] for name, nets in networks.items()}
        self._borrowers = self._make_borrowers()  # refuses layers that cannot be lifted
        stacks = {kind: {n: lift.stacked(nets, kind) for n, nets in networks.items()} for kind in lift.KINDS}
        self.parameters = lift.map_tensors(stacks["parameters"], trained)
        self.buffers = lift.map_tensors(stacks["buffers"], on_device)
        self.target_parameters = lift.map_tensors(
            {name: self.parameters[name] for name in self.targets}, lambda x: x.detach().clone()
        )
        stack = {name: torch.stack(values) for name, values in variables.items()}
        self.variables = lift.map_tensors(stack, on_device)
        self.rates = {name: self.optimiser(name) for name in networks}
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
        """One gradient step of every run on what `draw` returned, stacked: (S, ...). Returns scalars (S,).

        All losses look at the same, old parameters, then all networks step at once: the policy and the
        All losses look at the same, old parameters, then all networks step at once: the policy and the
        targets of Q see V from before this step. (IQL's code updates V first. At these learning rates the
        difference is one step's worth, and one joint step is faster.)
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
        """The networks and variables of one run, as `losses` sees them, for use without gradients."""
        if run not in self._acting:
            own = lift.map_tensors(self._tensors(), lambda x: x[run].detach())
            self._acting[run] = self._net(own, self._make_borrowers())
        return self._acting[run]

    def fill_last_bias(self, names: Sequence[str], values: Sequence[float]) -> None:
        """Set the output bias, the last parameter, of these networks and of their targets: one value per
        run."""
        with torch.no_grad():
            for parameters in (self.parameters, self.target_parameters):
                for name in set(names) & set(parameters):
                    for bias, value in zip(list(parameters[name].values())[-1], values, strict=True):
                        bias.fill_(value)

    def state(self) -> dict[str, Tensor]:
        """Every tensor by a flat name: online.*, buffer.*, target.*, variable.*, adam.* and updates."""
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
        """The inverse of `state`. Without adam.* and target.* the agent can act, but not continue its
        training.

        Raises KeyError for a missing tensor, ValueError for one of another shape.
        """
        with torch.no_grad():
            for name, place in self.state().items():
                if name.startswith(("adam.", "updates")):
                    continue
                online = name.replace("target.", "online.", 1)  # a file to act from has no target networks
                value = tensors[name if name in tensors or name == online else online]
                if value.shape != place.shape:  # copy_ would repeat one run for all
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
        """What a worker process needs to act: everything but the optimiser and the lent networks."""
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
        """All tensors of all runs, (S, ...), as nested dicts."""
        return {
            "online": self.parameters,
            "target": self.target_parameters,
            "buffer": self.buffers,
            "variable": self.variables,
        }

    def _net(self, own: dict[str, dict], borrowers: dict[str, lift.Borrower]) -> Networks:
        """What `losses` sees of one run, from that run's tensors."""
        online, buffers = own["online"], own["buffer"]
        lent = {name: params | buffers[name] for name, params in online.items()}
        lent |= {f"target_{name}": params | buffers[name] for name, params in own["target"].items()}
        for name in self.frozen:
            lent[f"frozen_{name}"] = lift.map_tensors(online[name], Tensor.detach) | buffers[name]
        nets = {name: borrowers[name].lend(tensors) for name, tensors in lent.items()}
        return Networks(**nets, **own["variable"])

    def _total(self, own: dict[str, dict], batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """One run's losses, summed, and its scalars, as a function of its tensors."""
        losses, scalars = self.losses(self._net(own, self._borrowers), Fields(**batch))
        scalars = {f"{name}_loss": loss for name, loss in losses.items()} | scalars
        total: Any = sum(losses.values())
        return total, {name: value.detach() for name, value in scalars.items()}

    def _step_variables(self, batch: dict[str, Tensor], scalars: dict[str, Tensor]) -> None:
        """Give every run the new values of its variables."""
        if not self.steps_variables:
            return

        def stepped(own: dict, batch: dict, scalars: dict) -> dict[str, Tensor]:
            return self.step(self._net(own, self._borrowers), Fields(**batch), scalars)

        new = lift.over_runs(stepped, len(self.seeds))(self._tensors(), batch, scalars)
        for name, value in new.items():
            self.variables[name].copy_(value)
