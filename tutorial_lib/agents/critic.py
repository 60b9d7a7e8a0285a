"""The options, first guesses and time limits that all algorithms with reward critics share."""

import warnings
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import torch
from torch import Tensor, nn

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.seeds import Fields, Rates
from tutorial_lib.config import NOT_NEGATIVE, SHARE, STEP, Config
from tutorial_lib.data.dataset import Dataset, returns_to_go
from tutorial_lib.tasks import Task


@dataclass(frozen=True)
class CriticConfig(Config):
    """The options of every algorithm with critics."""

    gamma: Annotated[float, SHARE] = 0.99
    """The discount factor of the reward, and of the cost where there is no reconstruction (Table 4)."""
    critic_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate for Q_r and Q_c (Table 4)."""
    target_tau: Annotated[float, STEP] = 0.005
    """The Polyak step of the target critics."""
    reward_time_limits: Literal["bootstrap", "mask"] = "mask"
    """What a time limit means to V_r and Q_r. With 'bootstrap', as in IQL's code, the target of Q_r contains
    the value after the time limit. With 'mask', as in OSRL's code, nothing follows a time limit. The paper
    does not say. No network is trained on the states at time limits, and in the Run tasks no other state is
    like them, so bootstrapping extrapolates."""
    shift_rewards: bool = False
    """If true, the dataset's smallest reward is subtracted from all rewards, so that none is negative. The
    zero of eq. 11 is a penalty only where Q_r > 0."""

    # With so few updates, the targets must be faster. IQL's code bootstraps through time limits.
    profiles = {
        "small": {"target_tau": 0.1},
        "printed": {"target_tau": 0.1, "reward_time_limits": "bootstrap"},
    }


class CriticAgent(Agent):
    """An agent with reward critics Q_r.

    Its variable `reward_scale`, in discounted reward, is the absolute value of the dataset's mean discounted
    return-to-go.
    """

    config: CriticConfig

    def build(self) -> dict[str, nn.Module | Tensor]:
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
        """Returns 1 where Q_r bootstraps and 0 where nothing follows, (B,)."""
        return goes_on(batch, self.config.reward_time_limits)

    def check(self, log: list[dict[str, Any]]) -> None:
        """Warns if more than 1% of Q_r are negative where eq. 11 applies, because zero is a reward there."""
        share = max((row.get("negative_q", 0.0) for row in log[-len(self.seeds) :]), default=0.0)
        if share > 0.01 and self.penalty_is_zero and not self.config.shift_rewards:
            warnings.warn(
                f"{share:.0%} of Q_r are negative: there, the zero penalty rewards unsafe actions; "
                f"{self.remedy}",
                stacklevel=3,
            )

    @property
    def penalty_is_zero(self) -> bool:
        """True if an unsafe action has the value zero (eq. 11)."""
        return True

    remedy = "try shift_rewards=True"
    """What the warning of `check` suggests."""


def goes_on(batch: Fields, time_limits: str) -> Tensor:
    """Returns 1 where an episode goes on after the transition and 0 where nothing follows, (B,).

    Nothing follows a terminal. Nothing follows a time limit if `time_limits` is 'mask'.
    """
    return 1 - (torch.maximum(batch.terminals, batch.timeouts) if time_limits == "mask" else batch.terminals)


def reward_guess(task: Task, config: CriticConfig) -> float:
    """Returns a first guess of Q_r and V_r, in discounted reward: 0.5 max_return / T / (1 - gamma).

    This is the value of half of DSRL's best mean reward at every step.
    """
    return 0.5 * task.max_return / task.horizon / (1 - config.gamma)


def cost_guess(task: Task, gammas: tuple[float, ...]) -> tuple[float, ...]:
    """Returns a first guess of the m heads of Q_c and V_c, in discounted cost: (L / T) / (1 - gamma_i).

    This is the discounted cost if every step costs L / T, where L is the task's typical limit.
    """
    rate = task.typical_limit / task.horizon
    return tuple(rate / (1 - gamma) for gamma in gammas)
