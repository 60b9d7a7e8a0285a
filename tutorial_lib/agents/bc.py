"""Behaviour cloning (BC) of all episodes or of the safe ones: two baselines that offline methods should beat.

Sources: Open Safe RL (OSRL), as used in DSRL's benchmark: a deterministic policy, the mean squared error of
the actions, Adam with a learning rate of 1e-3, and for BC-Safe only the episodes that keep the limit.

Departures:

1. The learning rate decays to zero along a half cosine, as for the policies of IQL, CIQL and C2IQL. In OSRL
   it stays constant.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor, nn

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import NOT_NEGATIVE, Config
from tutorial_lib.data.dataset import Dataset, DatasetError
from tutorial_lib.networks import mlp


@dataclass(frozen=True)
class BCConfig(Config):
    """The options of behaviour cloning."""

    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate for the policy, as in OSRL."""


class DeterministicPolicy(nn.Module):
    """a = pi(s): a network whose output is a tanh."""

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, act_dim)

    def forward(self, observations: Tensor) -> tuple[Tensor, None]:
        """Returns the action (B, act) at observations (B, obs), and None, because it has no log-std."""
        return torch.tanh(self.net(observations)), None


class BCAll(Agent):
    """Clones every episode, whatever its cost. It takes no limit."""

    name = "BC-All"
    Config = BCConfig
    scalars = {"policy_loss": "mean squared error of the actions"}
    config: BCConfig

    def build(self) -> dict[str, nn.Module | Tensor]:
        policy = DeterministicPolicy(self.task.obs_dim, self.task.act_dim, self.config)
        return super().build() | {"policy": policy}

    def optimiser(self, name: str) -> Rates:
        return Rates(self.config.policy_lr, cosine=True)

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        action, _ = net.policy(self.network_input(net, batch.observations, batch.limit))
        return {"policy": (action - batch.actions).square().mean()}, {}


class BCSafe(BCAll):
    """Clones the episodes whose undiscounted cost is at most the limit. A run is trained for one limit.

    A recording may end within an episode, which would then seem cheaper than it was. `read_dataset` drops it.
    """

    name = "BC-Safe"
    needs_limit = True

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        """Returns the safe episodes. Raises DatasetError if there are none."""
        safe = dataset.episode_costs <= limit
        if not safe.any():
            least = f"the cheapest of {dataset.num_episodes} costs {dataset.episode_costs.min():g}"
            raise DatasetError(f"{self.name}: no episode costs at most {limit:g}: {least}")
        return super().select(dataset.select(safe), limit)
