"""BCQ-Lag: batch-constrained deep Q-learning with a Lagrange multiplier.

Sources: Fujimoto, Meger and Precup 2019 (BCQ); Stooke, Achiam and Abbeel 2020 (the PID controller of the
multiplier); the file `bcql.py` of OSRL, whose settings are used here.

A conditional VAE learns the recorded actions. The policy only perturbs an action that the VAE decodes, by at
most `phi`, so it stays near the data. It plays one random decoded action, perturbed.

Departures:

1. The departures that the file `lagrangian.py` lists.
2. The hidden units of the policy are ReLU, as in BCQ. In OSRL they are tanh.

Measured: on BallCircle at a limit of 50 (profile `small`, one trial with seed 0 only, and without departure 2
of `lagrangian.py`), the normalised reward and cost of 10 episodes were 0.87 / 1.10 after 6,000 updates and
0.89 / 1.02 after 12,000. Lambda stayed below 0.001 for 3,500 updates, and then was between 0.1 and 0.6.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor, nn

from tutorial_lib.agents.lagrangian import LARGEST_LATENT, LagrangianAgent, LagrangianConfig
from tutorial_lib.agents.player import Player
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import NOT_NEGATIVE, Config
from tutorial_lib.data.dataset import Batch
from tutorial_lib.networks import mlp


@dataclass(frozen=True)
class BCQConfig(LagrangianConfig):
    """The options of BCQ-Lag."""

    phi: Annotated[float, NOT_NEGATIVE] = 0.05
    """The largest change of a decoded action, in each dimension. Actions are within -1 and 1."""


class Perturbation(nn.Module):
    """pi(s, a'): the decoded action a' changed by phi tanh of a network's output, and clamped to [-1, 1]."""

    def __init__(self, obs_dim: int, act_dim: int, config: Config, phi: float):
        super().__init__()
        self.phi = phi
        self.net = mlp(obs_dim + act_dim, config.hidden_width, config.hidden_layers, act_dim)

    def forward(self, observations: Tensor, decoded: Tensor) -> Tensor:
        """Returns actions (B, act) of observations (B, obs) and decoded actions (B, act)."""
        change = torch.tanh(self.net(torch.cat([observations, decoded], -1)))
        return (decoded + self.phi * change).clamp(-1, 1)


class DecodingPlayer(Player):
    """A player that decodes one random latent per step. Each episode draws its own from its seed."""

    agent: "BCQLag"

    def __init__(
        self, agent: "BCQLag", limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0
    ):
        super().__init__(agent, limits, run)
        self.generators = [np.random.default_rng(seed) for seed in seeds]

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Returns actions (E, act) at observations (E, obs), from a new latent in every episode."""
        size = 2 * self.agent.task.act_dim
        latents = np.stack([generator.normal(size=size) for generator in self.generators])
        latents = latents.clip(-LARGEST_LATENT, LARGEST_LATENT)
        return self.agent.decode(observations, latents, self.limits, self.run)


class BCQLag(LagrangianAgent):
    """BCQ with a Lagrange multiplier, for one finite limit L. Discounted costs are compared with L~ (eq. 2).

    Raises ValueError for an infinite limit.
    """

    name = "BCQ-Lag"
    Config = BCQConfig
    config: BCQConfig

    def build(self) -> dict[str, nn.Module | Tensor]:
        policy = Perturbation(self.task.obs_dim, self.task.act_dim, self.config, self.config.phi)
        return super().build() | {"policy": policy}

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also latents of the prior at s', (n, B, 2 act), and at s, (B, 2 act)."""
        size, samples = self.config.batch_size, self.config.samples
        return super().draw(data, generator, limit) | {
            "next_latents": self.draw_latents(generator, samples, size),
            "latents": self.draw_latents(generator, size),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)

        with torch.no_grad():
            states = s_next.expand(self.config.samples, -1, -1)  # (n, B, inputs)
            a_next = net.target_policy(states, net.decoder(states, batch.next_latents))  # (n, B, act)
            decoded = net.decoder(s, batch.latents)  # (B, act)
        of_networks = self.critic_losses(net, batch, s, s_next, a_next)

        # The policy maximises Q_r - lambda Q_c of its perturbed actions. The VAE does not learn from it.
        policy_loss, scalars = self.lagrangian(net, s, net.policy(s, decoded), batch.limit)
        return of_networks | {"policy": policy_loss}, scalars

    def decode(
        self, observations: np.ndarray, latents: np.ndarray, limits: np.ndarray, run: int = 0
    ) -> np.ndarray:
        """Returns the perturbed actions (E, act) of latents (E, 2 act) at observations (E, obs)."""
        with torch.no_grad():
            net = self.networks(run)
            s = self.network_input(net, self._tensor(observations), self._tensor(limits))
            return net.policy(s, net.decoder(s, self._tensor(latents))).cpu().numpy()

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """Returns the actions (E, act) of the latent zero, the prior's mean. The player draws latents."""
        return self.decode(observations, np.zeros((len(observations), 2 * self.task.act_dim)), limits, run)

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        """Returns a player that draws the latents of each episode from the episode's seed."""
        return DecodingPlayer(self, limits, seeds, run)
