"""What every algorithm shares: networks for several seeds, one optimiser step, acting, saving.

An algorithm is written for one run. `Agent` holds the parameters of S seeds, stacked along a leading
axis, and lifts the algorithm's `losses` over that axis with torch.func, so several seeds train
together and the code that is taught is the code that runs.
"""

import copy
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from tutorial_lib import losses as L
from tutorial_lib.config import Config
from tutorial_lib.costs.conditioning import check_threshold
from tutorial_lib.data.dataset import Batch, Dataset, returns_to_go
from tutorial_lib.networks import Borrower
from tutorial_lib.tasks import Task

MEASURED = ("observation_mean", "observation_std", "reward_scale")
"""What an agent measures on its dataset before the first update, and saves with its networks."""


class Agent:
    """S runs of one algorithm on one task.

    A subclass names its networks in `build`, its target networks in `targets`, and writes `losses`.
    `threshold` is the fixed cost limit of algorithms that are trained for one; the conditioned ones
    (`conditioned = True`) take a limit when they act. Raises ValueError where the two do not fit.
    """

    name: str
    conditioned = False  # does the policy take the limit as an input?
    constrained = True  # does training know a limit at all?
    can_price = False  # does it read `unsafe_price`?
    targets: tuple[str, ...] = ()  # networks with a Polyak-averaged copy
    frozen: tuple[str, ...] = ()  # networks that a loss looks through without training them

    def __init__(
        self,
        task: Task,
        config: Config,
        seeds: Sequence[int] = (0,),
        threshold: float | None = None,
        device="cpu",
    ):
        needs_threshold = self.constrained and not self.conditioned
        if needs_threshold != (threshold is not None):
            verb = (
                "is trained for one threshold: give it one"
                if needs_threshold
                else "takes no threshold to train"
            )
            raise ValueError(f"{self.name} {verb}")
        self.task, self.config, self.seeds, self.device = task, config, tuple(seeds), torch.device(device)
        if not self.seeds or min(self.seeds) < 0 or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds {list(self.seeds)}: at least one, each 0 or more and there once")
        self.threshold = None if threshold is None else check_threshold(threshold)

        self.observation_mean = torch.zeros(task.obs_dim, device=self.device)
        self.observation_std = torch.ones(task.obs_dim, device=self.device)
        self.reward_scale = torch.tensor(reward_guess(task, config), device=self.device)
        runs = [self._build_seeded(seed) for seed in self.seeds]
        self.modules = {name: copy.deepcopy(net).to("meta") for name, net in runs[0].items()}
        self.parameters = {name: stack_module_state([run[name] for run in runs])[0] for name in self.modules}
        self.parameters = _map(self.parameters, lambda p: p.detach().to(self.device).requires_grad_())
        self.target_parameters = _map(
            {n: self.parameters[n] for n in self.targets}, lambda p: p.detach().clone()
        )
        self.optimiser = torch.optim.Adam(
            [
                {
                    "params": list(params.values()),
                    "lr": self.learning_rate(name),
                    "base_lr": self.learning_rate(name),
                }
                for name, params in self.parameters.items()
            ],
            fused=True,
        )
        self.borrowers = {name: Borrower(net) for name, net in self.modules.items()}
        self.borrowers |= {f"target_{name}": Borrower(self.modules[name]) for name in self.targets}
        self.borrowers |= {f"frozen_{name}": Borrower(self.modules[name]) for name in self.frozen}
        self.updates = 0
        self.data_checksum: str | None = None  # of the dataset that it was trained on

    # What a subclass writes -------------------------------------------------------------------------

    def build(self) -> dict[str, nn.Module]:
        """The networks of one run, by name."""
        raise NotImplementedError

    def losses(
        self, net: SimpleNamespace, batch: Batch, limit: Tensor, *noise: Tensor
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """One run's losses and other scalars on a batch of B transitions.

        `net` holds the networks by name, the target networks as `target_<name>` and those named in
        `frozen` as `frozen_<name>`: the online network, whose parameters get no gradient. `limit` is the
        cost limit of each transition (B,), `noise` is what `draw_noise` drew. Every loss must reach only
        the network that it trains.
        """
        raise NotImplementedError

    def select_episodes(self, dataset: Dataset) -> Dataset:
        """The part of the dataset that this algorithm learns from; `prepare` and training see no other."""
        return dataset

    def prepare(self, dataset: Dataset, progress: bool = True) -> None:
        """Whatever must be learned from the whole dataset before the first update."""
        if self.config.normalise_observations:
            self.observation_mean = self._tensor(dataset.observations.mean(0))
            self.observation_std = self._tensor(dataset.observations.std(0)) + 1e-3
        self.reward_scale = self._tensor(abs(returns_to_go(dataset, self.config.gamma).mean()))

    def draw_limits(self, generator: torch.Generator, batch_size: int) -> Tensor:
        """The cost limits of one run's batch, (B,)."""
        return torch.full((batch_size,), torch.inf if self.threshold is None else self.threshold)

    def draw_noise(self, generator: torch.Generator, batch_size: int) -> tuple[Tensor, ...]:
        """The random numbers that one run's losses need for a batch, drawn as its limits are; none here."""
        return ()

    def learning_rate(self, name: str) -> float:
        """The learning rate of the network called `name` (Table 4)."""
        if name == "policy":
            return self.config.policy_lr
        return self.config.critic_lr if "critic" in name else self.config.value_lr

    def network_input(self, observations: Tensor, limit: Tensor) -> Tensor:
        """What every network sees: the observation, for conditioned agents with the encoded limit."""
        return (observations - self.observation_mean) / self.observation_std

    def reward_mask(self, batch: Batch) -> Tensor:
        """1 where Q_r bootstraps, 0 where nothing follows, (B,)."""
        return _goes_on(batch, self.config.reward_time_limits)

    def cost_mask(self, batch: Batch) -> Tensor:
        """1 where Q_c bootstraps, 0 where nothing follows, (B,)."""
        return _goes_on(batch, self.config.time_limits)

    def guess_costs(self, dataset: Dataset) -> None:
        """All cost heads start at the dataset's own cost rate.

        The closer the first guess, the less they disagree while they converge, and a reconstruction lives on
        their differences.
        """
        guess = float(dataset.costs.mean()) * self.task.horizon / self.task.thresholds[1]
        self.fill_last_bias(("cost_value", "cost_critics"), guess - 1)

    def penalised_q(self, q_reward: Tensor, cost: Tensor, value_cost: Tensor, limit: Tensor) -> Tensor:
        """Eq. 11, or our variant with a price: Q_r, episode cost and limit (B,), and V_c's heads (B, m)."""
        if self.config.unsafe_price is None:
            return L.penalised_q(q_reward, cost, limit)
        price = self.config.unsafe_price * self.reward_scale / self.task.cost_range
        return L.priced_q(q_reward, cost, self.episode_cost(value_cost.detach()), limit, price)

    # What they all share ----------------------------------------------------------------------------

    def update(self, batch: Batch, generators: Sequence[torch.Generator]) -> dict[str, Tensor]:
        """One gradient step of every run; batch fields are (S, B, ...). Returns named scalars, each (S,).

        All losses look at the same, old parameters, then all networks step at once: the policy and
        the targets of Q see V from before this step. (IQL's code updates V first; at these learning
        rates the difference is one step's worth, and one joint step is faster.)
        """
        size = batch.rewards.shape[1]
        limits = torch.stack([self.draw_limits(g, size) for g in generators])
        limits = limits.to(self.device, non_blocking=True)  # a GPU is fed, not waited for
        noise = zip(*[self.draw_noise(g, size) for g in generators], strict=True)  # by kind, not by run
        noise = [torch.stack(runs).to(self.device, non_blocking=True) for runs in noise]
        rounded = self.config.precision == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=rounded):
            loss, scalars = self._lifted(batch, limits, *noise)
        self.optimiser.zero_grad()
        loss.sum().backward()  # runs share no parameter, so each gets its own gradient
        for group in self.optimiser.param_groups:
            group["lr"] = group["base_lr"]
        self.optimiser.param_groups[list(self.parameters).index("policy")]["lr"] *= self._cosine()
        self.optimiser.step()
        with torch.no_grad():  # or the targets would remember how they came about, for ever
            for name, averages in self.target_parameters.items():
                torch._foreach_lerp_(
                    list(averages.values()), list(self.parameters[name].values()), self.config.target_tau
                )
        self.updates += 1
        return scalars

    def act(self, observations, limit, run: int = 0) -> np.ndarray:
        """Mean actions (E, act) of run number `run` at observations (E, obs) under cost limits (E,)."""
        with torch.no_grad():
            x = self._tensor(observations), self._tensor(limit)
            mean, _ = self.network("policy", run)(self.network_input(*x))
            return mean.cpu().numpy()

    def predicted_cost(self, observations, limit, run: int = 0) -> np.ndarray:
        """The episode cost that the critics expect of the policy's action, (E,); NaN from all but C2IQL."""
        return np.full(len(observations), np.nan)

    def fill_last_bias(self, names: Sequence[str], value: float) -> None:
        """Set the output bias of these networks, and of their target networks, in every run."""
        with torch.no_grad():
            for parameters in (self.parameters, self.target_parameters):
                for name in set(names) & set(parameters):
                    list(parameters[name].values())[-1].fill_(value)

    def network(self, name: str, run: int = 0) -> Callable[..., Tensor]:
        """One network of one run, to be called."""
        own = {key: value[run].detach() for key, value in self.parameters[name].items()}
        return lambda *inputs: functional_call(self.modules[name], own, inputs)

    def state(self) -> dict[str, Tensor]:
        """Every tensor of the agent by a flat name: online.*, target.*, adam.* and the number of updates."""
        tensors = {f"online.{n}.{k}": v.detach() for n, p in self.parameters.items() for k, v in p.items()}
        tensors |= {f"target.{n}.{k}": v for n, p in self.target_parameters.items() for k, v in p.items()}
        for index, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{key}": value for key, value in moments.items()}
        for name in MEASURED:
            tensors[name] = getattr(self, name)
        return tensors | {"updates": torch.tensor(self.updates)}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """The inverse of `state`. Without adam.* and target.* the agent can act, and train on only afresh.

        Raises KeyError for a missing tensor, ValueError for one of another shape.
        """

        def put(place: Tensor, value: Tensor) -> None:
            if value.shape != place.shape:  # copy_ would repeat one run for all
                raise ValueError(f"a tensor of shape {tuple(value.shape)} where {tuple(place.shape)} belongs")
            place.copy_(value)

        with torch.no_grad():
            for name, params in self.parameters.items():
                for key, value in params.items():
                    put(value, tensors[f"online.{name}.{key}"])
            for name, params in self.target_parameters.items():
                for key, value in params.items():
                    put(value, tensors.get(f"target.{name}.{key}", self.parameters[name][key]))
        state = self.optimiser.state_dict() | {"state": {}}
        for key, value in tensors.items():
            if key.startswith("adam."):
                _, index, moment = key.split(".")
                state["state"].setdefault(int(index), {})[moment] = value
        self.optimiser.load_state_dict(state)
        for name in MEASURED:
            getattr(self, name).copy_(tensors[name])
        self.updates = int(tensors["updates"])

    def __getstate__(self):
        """What a worker process needs to act: without the optimiser and the lent networks."""
        return {key: value for key, value in vars(self).items() if key not in ("optimiser", "borrowers")}

    def _build_seeded(self, seed: int) -> dict[str, nn.Module]:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return self.build()

    def _lifted(self, batch: Batch, limits: Tensor, *noise: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """`_total` of every run: losses (S,), and scalars, each (S,)."""
        lent = self.parameters, self.target_parameters
        if len(self.seeds) > 1:
            return vmap(self._total)(*lent, batch, limits, *noise)
        # Without the lift, which is not free.
        squeezed = (_map(p, lambda x: x.squeeze(0)) for p in lent)  # x[0] would have its gradient copied
        own = Batch(*(x[0] for x in batch)), limits[0], *(x[0] for x in noise)
        loss, scalars = self._total(*squeezed, *own)
        return loss, {name: value[None] for name, value in scalars.items()}

    def _total(
        self, parameters, target_parameters, batch: Batch, limit: Tensor, *noise: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """One run's losses, summed, and its scalars, as a function of its parameters."""
        target = {f"target_{name}": p for name, p in target_parameters.items()}
        frozen = {f"frozen_{name}": _detached(parameters[name]) for name in self.frozen}
        lent = parameters | target | frozen
        net = SimpleNamespace(**{name: self.borrowers[name].lend(p) for name, p in lent.items()})
        losses, scalars = self.losses(net, batch, limit, *noise)
        scalars = {f"{name}_loss": loss for name, loss in losses.items()} | scalars
        return sum(losses.values()), {name: value.detach() for name, value in scalars.items()}

    def _cosine(self) -> float:
        return 0.5 * (1 + np.cos(np.pi * min(self.updates / self.config.steps, 1)))

    def _tensor(self, x) -> Tensor:
        return torch.as_tensor(np.asarray(x, np.float32), device=self.device)


def _goes_on(batch: Batch, time_limits: str) -> Tensor:
    return 1 - (torch.maximum(batch.terminals, batch.timeouts) if time_limits == "mask" else batch.terminals)


def reward_guess(task: Task, config: Config) -> float:
    """A first guess of Q_r and V_r: half of DSRL's best mean reward per step, for ever."""
    return 0.5 * task.max_return / task.horizon / (1 - config.gamma)


def cost_guess(task: Task, gammas: Sequence[float]) -> tuple[float, ...]:
    """A first guess of the m heads of Q_c and V_c: the cost rate of the middle threshold, for ever."""
    rate = task.thresholds[1] / task.horizon
    return tuple(rate / (1 - gamma) for gamma in gammas)


def _detached(parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    return {key: value.detach() for key, value in parameters.items()}


def _map(parameters, function):
    return {
        name: {key: function(value) for key, value in params.items()} for name, params in parameters.items()
    }
