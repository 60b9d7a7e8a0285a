"""What algorithms with critics of reward share: options, first guesses, and what a time limit means to
Q_r."""

import warnings
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.seeds import Fields, Rates
from tutorial_lib.config import NOT_NEGATIVE, SHARE, STEP, Config
from tutorial_lib.data.dataset import Dataset, returns_to_go
from tutorial_lib.tasks import Task


@dataclass(frozen=True)
class CriticConfig(Config):
    """The options of algorithms with critics."""

    gamma: Annotated[float, SHARE] = 0.99
    """Discount factor of the reward, and of the cost where there is no reconstruction (Table 4)."""
    critic_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate for Q_r and Q_c (Table 4)."""
    target_tau: Annotated[float, STEP] = 0.005
    """Polyak step of the target critics."""
    reward_time_limits: Literal["bootstrap", "mask"] = "mask"
    """What a time limit means to V_r and Q_r. 'bootstrap' is IQL's code, 'mask' is OSRL's. The paper does not
    say.
    States at time limits are never trained on, and in the Run tasks nothing like them is: bootstrapping
    extrapolates."""
    shift_rewards: bool = False
    """Train on rewards minus their smallest value in the dataset. The zero penalty of eq. 11 punishes only
    where Q_r > 0."""

    # So few updates need faster targets.
    profiles = {"small": {"target_tau": 0.1}}


class CriticAgent(Agent):
    """An agent with critics Q_r. Its variable `reward_scale` is the dataset's mean discounted
    return-to-go."""

    config: CriticConfig

    def build(self):
        return super().build() | {"reward_scale": torch.tensor(reward_guess(self.task, self.config))}

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        if self.config.shift_rewards:
            dataset = replace(dataset, rewards=dataset.rewards - dataset.rewards.min())
        return super().select(dataset, limit)

    def measure(self, dataset: Dataset) -> dict[str, Tensor]:
        scale = abs(returns_to_go(dataset, self.config.gamma).mean())
        return super().measure(dataset) | {"reward_scale": torch.tensor(scale, dtype=torch.float32)}

    def optimiser(self, name: str) -> Rates:
        return Rates(self.config.policy_lr if name == "policy" else self.config.critic_lr)

    def tau(self, name: str) -> float:
        return self.config.target_tau

    def reward_mask(self, batch: Fields) -> Tensor:
        """1 where Q_r bootstraps, 0 where nothing follows, (B,)."""
        return goes_on(batch, self.config.reward_time_limits)

    def check(self, log: list[dict[str, Any]]) -> None:
        share = max((row.get("negative_q", 0.0) for row in log[-len(self.seeds) :]), default=0.0)
        if share > 0.01 and self.penalty_is_zero and not self.config.shift_rewards:
            warnings.warn(
                f"{share:.0%} of Q_r are negative: the zero penalty rewards unsafe actions there; "
                f"{self.remedy}",
                stacklevel=3,
            )

    @property
    def penalty_is_zero(self) -> bool:
        """Is an unsafe action worth zero (eq. 11)?"""
        return True

    remedy = "try shift_rewards=True"


def goes_on(batch: Fields, time_limits: str) -> Tensor:
    """1 where an episode goes on after the transition, 0 where nothing follows, (B,).

    After a terminal nothing follows. After a time limit nothing follows where `time_limits` is 'mask'.
    """
    return 1 - (torch.maximum(batch.terminals, batch.timeouts) if time_limits == "mask" else batch.terminals)


def reward_guess(task: Task, config: CriticConfig) -> float:
    """A first guess of Q_r and V_r: half of DSRL's best mean reward per step, for ever."""
    return 0.5 * task.max_return / task.horizon / (1 - config.gamma)


def cost_guess(task: Task, gammas: tuple[float, ...]) -> tuple[float, ...]:
    """A first guess of the m heads of Q_c and V_c: the cost rate of the task's typical limit, for ever."""
    rate = task.typical_limit / task.horizon
    return tuple(rate / (1 - gamma) for gamma in gammas)
