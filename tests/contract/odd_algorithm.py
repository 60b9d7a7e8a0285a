"""An algorithm that uses everything that the interface allows. It is of no use but for tests.

Sources: none.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import nn

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.player import Player
from tutorial_lib.agents.seeds import Rates
from tutorial_lib.config import NOT_NEGATIVE, SHARE, Config
from tutorial_lib.networks import Output, Value

WIDTH = 8
KINDS = 5
"""Limits come in so many kinds, from zero to the cost range and beyond."""


@dataclass(frozen=True)
class OddConfig(Config):
    """The options of this algorithm."""

    chance: Annotated[float, NOT_NEGATIVE] = 0.3
    """Standard deviation of the noise on the actions that are played."""
    kept: Annotated[float, SHARE] = 0.8
    """Share of the features that an update keeps."""


class Actor(nn.Module):
    """Attention over the numbers of an observation, given a kind of limit."""

    def __init__(self, task):
        super().__init__()
        self.register_buffer("frequencies", torch.randn(WIDTH))
        self.kinds = nn.Embedding(KINDS, WIDTH)
        self.spread = nn.Linear(1, WIDTH, bias=False)
        self.norm = nn.LayerNorm(WIDTH)
        self.attention = nn.MultiheadAttention(WIDTH, 2, bias=False, batch_first=True)
        self.head = Output(WIDTH, task.act_dim)

    def forward(self, observations, kinds, mask=1.0):
        """Actions (B, act) at observations (B, obs) and kinds of limits (B,); mask (B, WIDTH)."""
        tokens = self.spread(observations.unsqueeze(-1)) + self.kinds(kinds).unsqueeze(-2)  # (B, obs, WIDTH)
        tokens = self.norm(tokens * torch.cos(self.frequencies))
        mixed, _ = self.attention(tokens, tokens, tokens)
        return torch.tanh(self.head((tokens + mixed).mean(-2) * mask))


class DicePlayer(Player):
    """Adds noise from a generator of each episode's own to the actions, and tells the policy what is left."""

    def __init__(self, agent, limits, seeds, run):
        super().__init__(agent, limits, run)
        self.dice = [np.random.default_rng(seed) for seed in seeds]
        self.spent = np.zeros(len(self.limits))

    @property
    def told(self):
        return np.maximum(self.limits - self.spent, 0)

    def act(self, observations):
        mean, config = super().act(observations), self.agent.config
        noise = np.stack([dice.normal(size=mean.shape[1]) for dice in self.dice])
        return np.clip(mean + config.chance * noise, -1, 1).astype(np.float32)

    def see(self, rewards, costs):
        self.spent = self.spent + costs


class Odd(Agent):
    """Clones actions, and pays a price for what a critic expects them to cost, under one limit."""

    name = "Odd one"
    Config = OddConfig
    needs_limit = True
    targets = ("actor", "critic")
    frozen = ("critic",)
    at_test = ("chance",)
    scalars = {
        "actor_loss": "squared error of the actions, weighted, and the price of what they cost",
        "critic_loss": "squared error of V_c",
        "price_mean": "the price",
    }
    config: OddConfig

    def build(self):
        critic = Value(self.task.obs_dim + self.task.act_dim, self.config, (1.0, 2.0))
        variables = {"log_price": torch.zeros(()), "seen": torch.zeros(2)}
        return super().build() | {"actor": Actor(self.task), "critic": critic} | variables

    def draw(self, data, generator, limit):
        """Besides, noise (B, act), and a mask of features (B, WIDTH), 0 or 1 over the share kept."""
        size, kept = self.config.batch_size, self.config.kept
        mask = (torch.rand(size, WIDTH, generator=generator) < kept) / kept
        noise = torch.randn(size, self.task.act_dim, generator=generator)
        return super().draw(data, generator, limit) | {"mask": mask, "noise": noise}

    def optimiser(self, name):
        if name == "actor":
            return Rates(5e-3, weight_decay=0.1, clip=0.05, warm_up=4)
        return Rates(2e-3, cosine=True)

    def tau(self, name):
        return 0.2 if name == "actor" else 0.03

    def kinds(self, limit):
        """Limits (...) as whole numbers below KINDS, (...)."""
        return (limit / self.task.cost_range * (KINDS - 1)).clamp(0, KINDS - 1).long()

    def losses(self, net, batch):
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)
        kinds = self.kinds(batch.limit)

        a_next = net.target_actor(s_next, kinds) + 0.1 * batch.noise
        following = net.target_critic(torch.cat([s_next, a_next], -1)).detach()  # (B, 2)
        target = batch.costs[:, None] + 0.8 * (1 - batch.terminals)[:, None] * following
        critic_loss = (net.critic(torch.cat([s, batch.actions], -1)) - target).square().mean()

        a = net.actor(s, kinds, batch.mask)
        cost = net.frozen_critic(torch.cat([s, a], -1)).mean(-1)  # (B,)
        price = net.log_price.exp()
        actor_loss = (a - batch.actions).square().mean() + 0.1 * price * cost.mean()
        return {"actor": actor_loss, "critic": critic_loss}, {"price_mean": price}

    def step(self, net, batch, scalars):
        """The price follows the critic's loss, and the actor's buffer takes part in what is seen."""
        log = net.log_price + 0.01 * (scalars["critic_loss"] - 1).clamp(-1, 1) * net.actor.frequencies.mean()
        return {"log_price": log, "seen": net.seen + torch.stack([batch.costs.sum(), batch.mask.mean()])}

    def act(self, observations, limits, run=0):
        with torch.no_grad():
            net, limit = self.networks(run), self._tensor(limits)
            s = self.network_input(net, self._tensor(observations), limit)
            return net.actor(s, self.kinds(limit)).cpu().numpy()

    def player(self, limits, seeds, run=0):
        return DicePlayer(self, limits, seeds, run)
