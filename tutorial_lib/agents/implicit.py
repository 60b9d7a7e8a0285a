"""What IQL, CIQL and C2IQL share: options, networks, and how a constraint enters the reward value."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from torch import Tensor

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, cost_guess, goes_on, reward_guess
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import COUNT, NOT_NEGATIVE, SHARE
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.networks import Critics, Policy, Value


@dataclass(frozen=True)
class ImplicitConfig(CriticConfig):
    """The options of IQL, which CIQL and C2IQL have, too."""

    kappa_1: Annotated[float, SHARE] = 0.7
    """Expectile of the value functions V_r and V_c (Table 4)."""
    value_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate for V_r and V_c (Table 4)."""

    profiles = {"small": {"kappa_1": 0.8}}  # sharper than the paper's 0.7


@dataclass(frozen=True)
class ConstrainedConfig(ImplicitConfig):
    """The options of CIQL, which C2IQL has, too."""

    kappa_2: Annotated[float, SHARE] = 0.9
    """Expectile of the policy extraction (Table 4): the temperature between cloning and maximising."""
    time_limits: Literal["rate", "bootstrap", "mask"] = "rate"
    """What a time limit means to the cost critics; the paper does not say. 'rate' bootstraps through it and
    scales head i by 1 - gamma_i^T before the cost is compared; 'bootstrap' leaves out the factor; 'mask'
    stops there, so that the estimate is the remaining cost, which is compared with the unscaled remaining
    budget."""
    cost_kappa: Annotated[float | None, SHARE] = None
    """Expectile whose implicit policy the cost critics evaluate. None: kappa_1, as in Algorithm 2. The policy
    that runs is extracted with kappa_2, so kappa_2 here evaluates (nearly) the policy that runs."""
    cost_critics: Annotated[int, COUNT] = 2
    """Number of cost critics; the highest cost counts. The paper does not say; 1: a single critic."""
    unsafe_price: Annotated[float | None, NOT_NEGATIVE] = None
    """What an unsafe action is worth. None: zero, as in eq. 11. A number: Q_r minus a price per unit of cost
    beyond the limit; the price is this number times the dataset's mean Q_r per cost range."""
    recorded_step: bool = False
    """Does an action cost no less than its recorded step, c + gamma V_c(s')? The critics are smooth; the step
    is exact about where cost sets in (a speed, a wall), and of two noisy estimates the higher one leaves a
    margin."""

    profiles = {"small": {"kappa_2": 0.97, "unsafe_price": 6.0, "recorded_step": True}}

    @property
    def evaluated_kappa(self) -> float:
        """The expectile of the implicit policy whose cost V_c learns."""
        return self.kappa_1 if self.cost_kappa is None else self.cost_kappa


class ImplicitAgent(CriticAgent):
    """IQL, CIQL and C2IQL: value functions and critics, and a policy that is extracted from them."""

    config: ImplicitConfig
    targets: ClassVar[tuple[str, ...]] = ("critics",)

    def optimiser(self, name: str) -> Rates:
        if name == "policy":
            return Rates(self.config.policy_lr, cosine=True)  # as in IQL's code
        return Rates(self.config.critic_lr if name in ("critics", "cost_critics") else self.config.value_lr)


class ConstrainedAgent(ImplicitAgent):
    """CIQL and C2IQL: the cost of the implicit policy, and a reward value that a limit on it penalises."""

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
    }

    @property
    def extra_inputs(self) -> int:
        """Inputs of every network besides the observation."""
        return 0

    @property
    def cost_gammas(self) -> tuple[float, ...]:
        """The discount factors of the m cost heads."""
        return (self.config.gamma,)

    def build(self):
        task, config = self.task, self.config
        inputs = task.obs_dim + self.extra_inputs
        scale, cost_scale = reward_guess(task, config), cost_guess(task, self.cost_gammas)
        return super().build() | {
            "value": Value(inputs, config, scale),
            "cost_value": Value(inputs, config, cost_scale),
            "critics": Critics(inputs, task.act_dim, config, scale),
            "cost_critics": Critics(inputs, task.act_dim, config, cost_scale, k=config.cost_critics),
            "policy": Policy(inputs, task.act_dim, config),
        }

    def prepare(self, datasets: Sequence[Dataset], progress: bool = True) -> None:
        """Besides, all cost heads start at the dataset's own cost rate.

        The closer the first guess, the less the heads disagree while they converge, and a reconstruction
        looks at their differences.
        """
        super().prepare(datasets, progress)
        horizon, limit = self.task.horizon, self.task.typical_limit
        guesses = [float(dataset.costs.mean()) * horizon / limit - 1 for dataset in datasets]
        self.fill_last_bias(("cost_value", "cost_critics"), guesses)

    def episode_cost(self, q_cost: Tensor) -> Tensor:
        """Discounted costs (..., m) as the cost of a whole episode, (...,), to be compared with a limit."""
        raise NotImplementedError

    def cost_mask(self, batch: Fields) -> Tensor:
        """1 where Q_c bootstraps, 0 where nothing follows, (B,)."""
        return goes_on(batch, self.config.time_limits)

    def penalised_q(
        self, net: Networks, q_reward: Tensor, cost: Tensor, value_cost: Tensor, limit: Tensor
    ) -> Tensor:
        """Eq. 11, or the course's variant with a price: Q_r, episode cost and limit (B,), V_c's heads (B,
        m)."""
        if self.config.unsafe_price is None:
            return losses.penalised_q(q_reward, cost, limit)
        price = self.config.unsafe_price * net.reward_scale / self.task.cost_range
        return losses.priced_q(q_reward, cost, self.episode_cost(value_cost.detach()), limit, price)

    @property
    def penalty_is_zero(self) -> bool:
        return self.config.unsafe_price is None

    remedy = "try shift_rewards=True, or an unsafe_price"
