"""Behaviour cloning (BC), the two baselines that any offline method should beat: copy everyone, or the safe
ones.

Sources: Open Safe RL (OSRL), as DSRL's benchmark has it: a deterministic policy, squared error, Adam at 1e-3,
    and for
BC-Safe only the episodes that kept the limit.

Departures:

1. The learning rate decays to zero along a half cosine, as every policy's here; OSRL's stays as it is.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor, nn

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.seeds import Rates
from tutorial_lib.config import NOT_NEGATIVE, Config
from tutorial_lib.data.dataset import Dataset, DatasetError
from tutorial_lib.networks import mlp


@dataclass(frozen=True)
class BCConfig(Config):
    """The options of behaviour cloning."""

    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate (OSRL's)."""


class DeterministicPolicy(nn.Module):
    """a = pi(s): a tanh action (B, act), and None in the place of a spread, which cloning does not use."""

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, act_dim)

    def forward(self, observations: Tensor) -> tuple[Tensor, None]:
        return torch.tanh(self.net(observations)), None


class BCAll(Agent):
    """Clones every episode, whatever it cost: it takes no limit and cannot know of one."""

    name = "BC-All"
    Config = BCConfig
    scalars = {"policy_loss": "mean squared error of the actions"}
    config: BCConfig

    def build(self):
        policy = DeterministicPolicy(self.task.obs_dim, self.task.act_dim, self.config)
        return super().build() | {"policy": policy}

    def optimiser(self, name):
        return Rates(self.config.policy_lr, cosine=True)

    def losses(self, net, batch):
        action, _ = net.policy(self.network_input(net, batch.observations, batch.limit))
        return {"policy": (action - batch.actions).square().mean()}, {}


class BCSafe(BCAll):
    """Clones the episodes whose undiscounted cost is at most the limit: one run per limit.

    A recording's unfinished tail would count there as an episode that cost nothing; `read_dataset` drops it.
    """

    name = "BC-Safe"
    needs_limit = True

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        """The safe episodes. Raises DatasetError where there are none."""
        safe = dataset.episode_costs <= limit
        if not safe.any():
            least = f"the cheapest of {dataset.num_episodes} costs {dataset.episode_costs.min():g}"
            raise DatasetError(f"{self.name}: no episode costs at most {limit:g}: {least}")
        return super().select(dataset.select(safe), limit)
