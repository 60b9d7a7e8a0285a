"""BEAR-Lag: bootstrapping error accumulation reduction with a Lagrange multiplier for the cost.

Sources: Kumar, Fu, Tucker and Levine 2019 (BEAR); Stooke, Achiam and Abbeel 2020 (the PID controller of the
multiplier); the file `bearl.py` of OSRL, whose settings are used here.

A conditional VAE learns the recorded actions. The policy is a Gaussian of its own, and a second multiplier,
alpha, keeps its actions near those that the VAE decodes: their maximum mean discrepancy (MMD) should be at
most 0.05. It is taken before the tanh of both.

Departures:

1. The departures that the file `lagrangian.py` lists.
2. In profile `small`, alpha's rate is ten times OSRL's, where 300,000 updates follow. On BallCircle (seed 0
   only), after 2,500 updates alpha was 2.3 and the MMD 0.06. With OSRL's rate they were 1.1 and 0.09.

Measured: on BallCircle at a limit of 50 (profile `small`, one trial with seed 0 only), the normalised reward
and cost of 10 episodes were 0.72 / 0.91 after 3,000 of 12,000 updates. With OSRL's rate of alpha they were
0.82 / 1.19. A whole run was not measured.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor, nn

from tutorial_lib.agents.lagrangian import LagrangianAgent, LagrangianConfig
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import COUNT, NOT_NEGATIVE, POSITIVE
from tutorial_lib.data.dataset import Batch
from tutorial_lib.networks import SquashedPolicy


@dataclass(frozen=True)
class BEARConfig(LagrangianConfig):
    """The options of BEAR-Lag."""

    matched_samples: Annotated[int, COUNT] = 10
    """The number of the policy's actions at s, and of the VAE's, whose distributions are compared."""
    sigma: Annotated[float, POSITIVE] = 50.0
    """The width of the Gaussian kernel exp(-|x - y|^2 / (2 sigma)). Before the tanh, actions have no unit."""
    largest_mmd: Annotated[float, NOT_NEGATIVE] = 0.05
    """The MMD that alpha aims at."""
    alpha_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """The learning rate of alpha. An update adds alpha_lr * alpha * (MMD - largest_mmd) to log alpha."""
    largest_log_alpha: Annotated[float, NOT_NEGATIVE] = 5.0
    """The largest absolute value of log alpha."""

    profiles = {"small": {"alpha_lr": 0.01}}  # departure 2


def mmd(x: Tensor, y: Tensor, sigma: float) -> Tensor:
    """Returns the maximum mean discrepancy of n samples x (n, B, act) and m samples y (m, B, act), (B,).

    It is the square root of mean k(x, x') + mean k(y, y') - 2 mean k(x, y) + 1e-6, with the kernel
    k(x, y) = exp(-|x - y|^2 / (2 sigma)).
    """

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        squares = (a.unsqueeze(1) - b.unsqueeze(0)).square().sum(-1)  # (n, m, B)
        return torch.expm1(-squares / (2 * sigma)).mean((0, 1))  # k - 1: the ones cancel, with their rounding

    return (kernel(x, x) + kernel(y, y) - 2 * kernel(x, y) + 1e-6).sqrt()


class BEARLag(LagrangianAgent):
    """BEAR with a Lagrange multiplier, for one finite limit L. Discounted costs are compared with L~ (eq. 2).

    Raises ValueError for an infinite limit.
    """

    name = "BEAR-Lag"
    Config = BEARConfig
    config: BEARConfig
    scalars = LagrangianAgent.scalars | {
        "policy_loss": LagrangianAgent.scalars["policy_loss"] + ", and alpha (MMD - 0.05)",
        "mmd": "mean MMD between the policy's actions and the VAE's, before the tanh",
        "alpha": "the multiplier of the MMD, in units of 1 / reward_weight",
    }

    def build(self) -> dict[str, nn.Module | Tensor]:
        policy = SquashedPolicy(self.task.obs_dim, self.task.act_dim, self.config)
        return super().build() | {"policy": policy, "log_alpha": torch.zeros(())}

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also noise for the policy's actions at s' and at s, and latents of the prior at s.

        They are (samples, B, act), (matched_samples, B, act) and (matched_samples, B, 2 act).
        """
        config, act = self.config, self.task.act_dim
        next_noise, noise = (
            torch.randn(count, config.batch_size, act, generator=generator)
            for count in (config.samples, config.matched_samples)
        )
        latents = self.draw_latents(generator, config.matched_samples, config.batch_size)
        drawn = {"next_noise": next_noise, "noise": noise, "latents": latents}
        return super().draw(data, generator, limit) | drawn

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config = self.config
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)

        with torch.no_grad():
            a_next = net.target_policy(s_next, batch.next_noise)[0]  # (n, B, act)
            states = s.expand(config.matched_samples, -1, -1)  # (n, B, inputs)
            decoded = net.decoder.net(torch.cat([states, batch.latents], -1))  # before the tanh
        of_networks = self.critic_losses(net, batch, s, s_next, a_next)

        # The policy maximises Q_r - lambda Q_c of its first sample, and stays near the decoded actions.
        mean, log_std = net.policy.net(s).chunk(2, -1)
        std = log_std.clamp(*SquashedPolicy.LOG_STD).exp()
        samples = mean + std * batch.noise  # (n, B, act), before the tanh
        distance = mmd(decoded, samples, config.sigma).mean()
        alpha = net.log_alpha.exp()
        policy_loss, scalars = self.lagrangian(net, s, torch.tanh(samples[0]), batch.limit)
        policy_loss = policy_loss + alpha * (distance - config.largest_mmd)
        return of_networks | {"policy": policy_loss}, scalars | {"mmd": distance, "alpha": alpha}

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns also a larger log alpha if the MMD is too large, and a smaller one otherwise."""
        config, log = self.config, net.log_alpha
        log = log + config.alpha_lr * log.exp() * (scalars["mmd"] - config.largest_mmd)
        bound = config.largest_log_alpha
        return super().step(net, batch, scalars) | {"log_alpha": log.clamp(-bound, bound)}
