"""The options, the networks and the penalisation that IQL, CIQL and C2IQL share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, cost_guess, goes_on, reward_guess
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import COUNT, NOT_NEGATIVE, SHARE
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.networks import Critics, Policy, Value

EXCHANGE_STEP = 0.01
"""How far the exchange rate moves towards the ratio of the spreads in each update."""


@dataclass(frozen=True)
class ImplicitConfig(CriticConfig):
    """The options that IQL, CIQL and C2IQL have."""

    kappa_1: Annotated[float, SHARE] = 0.7
    """The expectile of the value functions V_r and V_c (Table 4)."""
    value_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate for V_r and V_c (Table 4)."""

    profiles = {"small": {"kappa_1": 0.8}}  # higher than the paper's 0.7


@dataclass(frozen=True)
class ConstrainedConfig(ImplicitConfig):
    """The options that CIQL and C2IQL have."""

    kappa_2: Annotated[float, SHARE] = 0.9
    """The expectile of the policy extraction (Table 4), a temperature between cloning and maximising."""
    time_limits: Literal["rate", "bootstrap", "mask"] = "rate"
    """What a time limit means to the cost critics. The paper does not say. With 'rate', their targets
    bootstrap through it, and head i is multiplied by 1 - gamma_i^T before the reconstruction. With
    'bootstrap', or without a reconstruction, there is no such factor. With 'mask', nothing follows a time
    limit. The critics then predict the remaining cost, which is compared with the remaining budget without
    rescaling."""
    cost_kappa: Annotated[float | None, SHARE] = None
    """The expectile of the implicit policy whose cost the cost critics learn. None means kappa_1, as in
    Algorithm 2. The policy that acts is extracted with kappa_2, so with the value of kappa_2 here the cost
    critics learn (nearly) the cost of the policy that acts."""
    cost_critics: Annotated[int, COUNT] = 2
    """The number of cost critics, of which the highest cost counts. The paper does not give it."""
    evaluated_critic: Literal["highest", "mean"] = "highest"
    """What V_c learns from, if there are several cost critics: the one that predicts the highest cost, or the
    mean of all. With 'highest', every backup takes a maximum again, so errors only add up."""
    unsafe_price: Annotated[float | None, NOT_NEGATIVE] = None
    """The price of cost beyond the limit, in units of `price_unit`. None means that an unsafe action has the
    value zero, as in eq. 11. With a number, its value is Q_r minus the price of every unit of cost beyond the
    limit."""
    price_unit: Literal["return", "advantage"] = "return"
    """The unit of `unsafe_price`. With 'return', it is `reward_scale` (discounted reward) per cost range.
    With 'advantage', it is the spread of the advantages of reward over the spread of those of cost, both over
    actions for which nothing is paid: those under an infinite limit where the algorithm has one, and those
    that the limit does not touch elsewhere. A price in this unit says how much of what an action can earn
    may be given up for what it can cost, and does not change when rewards or costs are scaled or shifted."""
    first_guess: Literal["data", "zero"] = "data"
    """Where the value functions start. With 'data', those of cost start at the dataset's mean cost, and those
    of reward at half of the best mean reward of the task. With 'zero', all start at zero. The paper does not
    say, and with the penalty of eq. 11 it can decide what is learned: where all actions look too expensive at
    first, no value tells them apart."""
    recorded_step: bool = False
    """If true, the cost of a recorded action is at least that of its recorded step, c + gamma V_c(s'). The
    critics are smooth, and the recorded step is exact where cost begins (at a speed or at a wall). Of two
    noisy estimates, the higher one also leaves a margin."""

    profiles = {
        "small": {
            "cost_kappa": 0.9,
            "evaluated_critic": "mean",
            "unsafe_price": 3.0,
            "price_unit": "advantage",
        },
        "printed": {"time_limits": "bootstrap", "cost_critics": 1, "first_guess": "zero"},
    }

    @property
    def evaluated_kappa(self) -> float:
        """The expectile of the implicit policy whose cost V_c learns."""
        return self.kappa_1 if self.cost_kappa is None else self.cost_kappa


class ImplicitAgent(CriticAgent):
    """What IQL, CIQL and C2IQL share: value functions, critics, and a policy that is extracted from them."""

    config: ImplicitConfig
    targets: ClassVar[tuple[str, ...]] = ("critics",)

    def optimiser(self, name: str) -> Rates:
        if name == "policy":
            return Rates(self.config.policy_lr, cosine=True)  # as in IQL's code
        return Rates(self.config.critic_lr if name in ("critics", "cost_critics") else self.config.value_lr)


class ConstrainedAgent(ImplicitAgent):
    """What CIQL and C2IQL share: cost critics of the implicit policy, and a penalised reward value.

    Costs are in unsafe steps, discounted in the heads of Q_c and V_c, and of a whole episode in
    `episode_cost`.
    """

    config: ConstrainedConfig
    targets = ("critics", "cost_critics")
    scalars = {
        "value_loss": "expectile loss of V_r (eq. 12)",
        "cost_value_loss": "weighted squared error of V_c (eq. 17)",
        "critic_loss": "squared error of the Q_r, summed over the ensemble (line 16)",
        "cost_critic_loss": "squared error of the Q_c, summed over the ensemble (eq. 16, line 18)",
        "policy_loss": "minus the weighted log-likelihood of the recorded actions (eq. 18)",
        "safe_fraction": "share of recorded actions whose expected cost keeps the limit",
        "value_mean": "mean of V_r, in discounted reward",
        "negative_q": "share of recorded actions with Q_r < 0, where a penalty of zero is a reward",
        "reward_spread": "standard deviation of Q_r - V_r where nothing is paid, in discounted reward",
        "cost_spread": "standard deviation of an action's cost minus its state's there, in unsafe steps",
    }

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.steps_variables = self.prices_advantages

    @property
    def extra_inputs(self) -> int:
        """The number of inputs of every network besides the observation."""
        return 0

    @property
    def cost_gammas(self) -> tuple[float, ...]:
        """The discount factors of the m cost heads."""
        return (self.config.gamma,)

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        inputs = task.obs_dim + self.extra_inputs
        scale, cost_scale = reward_guess(task, config), cost_guess(task, self.cost_gammas)
        built = super().build() | {
            "value": Value(inputs, config, scale),
            "cost_value": Value(inputs, config, cost_scale),
            "critics": Critics(inputs, task.act_dim, config, scale),
            "cost_critics": Critics(inputs, task.act_dim, config, cost_scale, k=config.cost_critics),
            "policy": Policy(inputs, task.act_dim, config),
        }
        if self.prices_advantages:
            built["exchange_rate"] = torch.tensor(scale / task.cost_range)
        return built

    def measure(self, dataset: Dataset) -> dict[str, Tensor]:
        measured = super().measure(dataset)
        if self.prices_advantages:  # a first guess
            measured["exchange_rate"] = measured["reward_scale"] / self.task.cost_range
        return measured

    def prepare(self, datasets: Sequence[Dataset], progress: bool = True) -> None:
        """Measures each run's variables, and lets all values start where `first_guess` says.

        With a closer first guess the cost heads disagree less while they converge, and a reconstruction
        depends on their differences.
        """
        super().prepare(datasets, progress)
        if self.config.first_guess == "zero":  # a network's output o gives the value scale (1 + o)
            valued = ("value", "critics", "cost_value", "cost_critics")
            return self.fill_last_bias(valued, [-1.0] * len(self.seeds))
        horizon, limit = self.task.horizon, self.task.typical_limit
        guesses = [float(dataset.costs.mean()) * horizon / limit - 1 for dataset in datasets]
        self.fill_last_bias(("cost_value", "cost_critics"), guesses)

    def episode_cost(self, net: Networks, q_cost: Tensor, timesteps: Tensor | float = 0.0) -> Tensor:
        """Returns the cost of an episode after its first `timesteps` (...), for discounted costs (..., m).

        It is (...,), in unsafe steps per episode, like the limit L with which it is compared. By default, it
        is the only head divided by L~ / L (eq. 2), where the horizon is what is left of it: to compare this
        with L is to compare Q_c with L~.
        """
        return q_cost.squeeze(-1) / average_threshold(1.0, self.config.gamma, self.task.horizon - timesteps)

    def state_cost(self, net: Networks, v_cost: Tensor, timesteps: Tensor | float = 0.0) -> Tensor | None:
        """Returns the cost of an episode from a state on, (B,), for the heads of V_c, (B, m).

        It is None where there is no `unsafe_price`, because eq. 11 does not ask for it.
        """
        if self.penalty_is_zero:
            return None
        return self.episode_cost(net, v_cost.detach(), timesteps)

    def evaluated_heads(self, q_cost: Tensor, costs: Tensor) -> Tensor:
        """Returns the heads that V_c learns, (B, m), from those of k critics, (k, B, m).

        `costs` (k, B) are the critics' costs of an episode (see `evaluated_critic`).
        """
        if self.config.evaluated_critic == "mean":
            return q_cost.mean(0)
        return q_cost.take_along_dim(costs.argmax(0)[None, :, None], 0).squeeze(0)

    def cost_mask(self, batch: Fields) -> Tensor:
        """Returns 1 where Q_c bootstraps and 0 where nothing follows, (B,)."""
        return goes_on(batch, self.config.time_limits)

    def logged(
        self, cost: Tensor, limit: Tensor, v: Tensor, q_reward: Tensor, state_cost: Tensor | None
    ) -> dict[str, Tensor]:
        """Returns what the log says besides the losses. All arguments are (B,)."""
        spreads = {}
        if self.prices_advantages and state_cost is not None:
            spreads = self.spreads(q_reward, v, cost, state_cost, limit)
        return spreads | {
            "safe_fraction": (cost <= limit).float().mean(),
            "value_mean": v.mean(),
            "negative_q": (q_reward < 0).float().mean(),
        }

    def penalised_q(
        self, net: Networks, q_reward: Tensor, cost: Tensor, state_cost: Tensor | None, limit: Tensor
    ) -> Tensor:
        """Returns the penalised Q_r, (B,), by eq. 11, or by `losses.priced_q` if there is an `unsafe_price`.

        `q_reward` is in discounted reward. `cost` of the action, `state_cost` (see there) and `limit` are in
        unsafe steps per episode. All four are (B,).
        """
        if self.config.unsafe_price is None or state_cost is None:
            return losses.penalised_q(q_reward, cost, limit)
        unit = net.reward_scale / self.task.cost_range
        if self.prices_advantages:
            unit = net.exchange_rate
        return losses.priced_q(q_reward, cost, state_cost, limit, self.config.unsafe_price * unit)

    def spreads(
        self, q_reward: Tensor, v: Tensor, cost: Tensor, state_cost: Tensor, limit: Tensor
    ) -> dict[str, Tensor]:
        """Returns the standard deviations of both advantages over the actions for which nothing is paid.

        All arguments are (B,). Where there are fewer than two such actions, both are zero.
        """
        untouched = self.untouched(cost, state_cost, limit).float()
        return {
            "reward_spread": losses.spread(q_reward - v, untouched).detach(),
            "cost_spread": losses.spread(cost - state_cost, untouched).detach(),
        }

    def untouched(self, cost: Tensor, state_cost: Tensor, limit: Tensor) -> Tensor:
        """Returns true where the limit does not touch an action: its cost and its state's cost keep it, (B,).

        Under one finite limit V_r contains the payments of later steps, and they spread the advantages of
        such actions, too. A high price under a tight limit can therefore raise itself.
        """
        return torch.maximum(cost, state_cost) <= limit

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns the exchange rate, which follows the ratio of the two spreads slowly."""
        if not self.prices_advantages:
            return {}
        reward, cost = scalars["reward_spread"], scalars["cost_spread"]
        ratio = torch.where(cost > 0, reward / cost.clamp(min=1e-6), net.exchange_rate)
        return {"exchange_rate": net.exchange_rate + EXCHANGE_STEP * (ratio - net.exchange_rate)}

    @property
    def prices_advantages(self) -> bool:
        """True if the price is in units of the advantages' spreads."""
        return self.config.unsafe_price is not None and self.config.price_unit == "advantage"

    @property
    def penalty_is_zero(self) -> bool:
        return self.config.unsafe_price is None

    remedy = "try shift_rewards=True, or an unsafe_price"
