"""Behaviour cloning, the two baselines that any offline method should beat: copy everyone, or the safe ones.

Recipe: Open Safe RL's (OSRL), as DSRL's benchmark has it: a deterministic policy, squared error, Adam at
1e-3, and, for the safe one, only the episodes that kept the limit.
"""

import torch
from torch import nn

from tutorial_lib.agents.agent import Agent
from tutorial_lib.data.dataset import DatasetError
from tutorial_lib.networks import mlp


class DeterministicPolicy(nn.Module):
    """a = pi(s): a tanh action (B, act), and None in the place of a spread, which cloning has no use for."""

    def __init__(self, obs_dim: int, act_dim: int, config):
        super().__init__()
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, act_dim)

    def forward(self, observations):
        return torch.tanh(self.net(observations)), None


class BCAll(Agent):
    """Clones every episode, whatever it cost: it takes no limit and cannot know of one."""

    name = "BC-All"
    constrained = False

    def build(self):
        return {"policy": DeterministicPolicy(self.task.obs_dim, self.task.act_dim, self.config)}

    def learning_rate(self, name):
        return 1e-3  # OSRL's; here it decays along the half cosine that every policy has

    def losses(self, net, batch, limit):
        action, _ = net.policy(self.network_input(batch.observations, limit))
        return {"policy": (action - batch.actions).square().mean()}, {}


class BCSafe(BCAll):
    """Clones the episodes whose undiscounted cost is at most the threshold: one agent per threshold.

    A recording's unfinished tail would count there as an episode that cost nothing; `read_dataset` drops it.
    """

    name = "BC-Safe"
    constrained = True

    def select_episodes(self, dataset):
        """The safe episodes. Raises DatasetError where there are none."""
        safe = dataset.episode_costs <= self.threshold
        if not safe.any():
            least = f"the cheapest of {dataset.num_episodes} costs {dataset.episode_costs.min():g}"
            raise DatasetError(f"{self.name}: no episode costs at most {self.threshold:g}: {least}")
        return dataset.select(safe)
