"""What BCQ-Lag and BEAR-Lag share: critics of a policy's own actions, a VAE, and a Lagrange multiplier.

Both maximise Q_r of the policy's actions while Q_c stays below L~ (eq. 2). The multiplier lambda of this
constraint comes from a PID controller (Stooke, Achiam and Abbeel 2020): it is a weighted sum of the error, of
the sum of all errors and of the error's last increase, where the error is the mean of Q_c - L~. As in OSRL,
the targets contain a mixture of the smaller and the larger critic, and the largest Q of ten actions, for the
cost, too. Q_c continues at time limits, while L~ counts T steps. So the costs are judged too high, and most
so in short episodes: where every step costs the same, by 1 / (1 - gamma^T), which is 1.58 for T = 100.

Departures from OSRL:

1. The target of the cost critics ends where the robot fell, as in CIQL. In OSRL it never ends. (Ball and Car
   never fall.)
2. The cost after a step is clamped to [0, 1 / (1 - gamma)] times the largest cost of a step, as in CPQ.
   Without this, BCQ-Lag's Q_c of recorded actions on BallCircle was between -71 and 3,068 after 12,000
   updates, where 100 is the most (profile `small`, seed 0 only, a sample of 4,000 actions).
3. The first guess of Q_c is the recorded cost, in the unit of L~, and that of Q_r is half of the best. In
   OSRL they are zero. From there the targets need some 1 / (target_tau (1 - gamma)) updates, 2,500 here.
4. The targets of Q_r and Q_c contain the same actions, which are then computed once. In OSRL each draws its
   own.
5. There are two critics of each kind, as in BCQ and BEAR. OSRL's settings have two pairs, and the smaller Q
   of a pair counts.
6. All networks step at once (see `Runs.update`). In OSRL the VAE steps first, then Q_r, Q_c and the policy.
7. In profile `small`, target_tau is 0.04. In OSRL it is 0.005 for 100,000 updates. With 12,000 updates, the
   product is about the same, and so is the share of their way that the targets have gone at the end.
8. Observations are normalised and recorded actions are clamped, as for all algorithms here.

With these points undone, losses and multipliers are those of OSRL's code (`benchmarks/osrl_lagrangian.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, cost_guess, reward_guess
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import COUNT, NOT_NEGATIVE, SHARE
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.data.dataset import Batch, Dataset
from tutorial_lib.networks import ActionDecoder, ActionEncoder, Critics, vae_loss

LARGEST_LATENT = 0.5
"""Latents of the prior are clamped to this absolute value, so that decoded actions are likely ones."""


@dataclass(frozen=True)
class LagrangianConfig(CriticConfig):
    """The options that BCQ-Lag and BEAR-Lag have."""

    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate for the policy, as in OSRL."""
    samples: Annotated[int, COUNT] = 10
    """The number of the target policy's actions at s'. The targets contain the largest Q of them."""
    smallest_weight: Annotated[float, SHARE] = 0.75
    """The weight of the smaller of two target critics in the targets. The larger one has the rest."""
    reward_weight: Annotated[float, NOT_NEGATIVE] = 0.1
    """The weight of Q_r in the policy's loss, per unit of discounted reward. OSRL multiplies all rewards by
    0.1, which is the same. It is the unit of the multiplier: lambda times Q_c, in discounted cost, is
    subtracted from reward_weight times Q_r."""
    proportional_gain: Annotated[float, NOT_NEGATIVE] = 0.1
    """The multiplier per unit of the error, in discounted cost."""
    integral_gain: Annotated[float, NOT_NEGATIVE] = 0.003
    """The multiplier per unit of the sum of the errors of all updates."""
    derivative_gain: Annotated[float, NOT_NEGATIVE] = 0.001
    """The multiplier per unit of the error's increase since the last update."""
    kl_weight: Annotated[float, NOT_NEGATIVE] = 0.5
    """The weight of the VAE's KL divergence. Its mean squared error has the weight one."""
    vae_width: Annotated[float, NOT_NEGATIVE] = 400 / 256
    """The width of the VAE's two hidden layers, in units of `hidden_width`."""

    # Departure 7: 12,000 times 0.04 is about 100,000 times 0.005.
    profiles = {"small": {"target_tau": 0.04}}


def soft_clipped_max(q: Tensor, smallest_weight: float) -> Tensor:
    """Returns max_n (w min_k Q + (1 - w) max_k Q), (B,), of k critics' values of n actions, (k, n, B)."""
    return (smallest_weight * q.amin(0) + (1 - smallest_weight) * q.amax(0)).amax(0)


class LagrangianAgent(CriticAgent):
    """What BCQ-Lag and BEAR-Lag share, for one finite limit L. Raises ValueError for an infinite limit.

    Its variables `error_sum` and `last_error` are the memory of the PID controller, in discounted cost.
    """

    config: LagrangianConfig
    needs_limit = True
    targets = ("critics", "cost_critics", "policy")
    frozen = ("critics", "cost_critics")
    scalars = {
        "critic_loss": "squared error of the Q_r, summed over both critics",
        "cost_critic_loss": "squared error of the Q_c, summed over both critics",
        "vae_loss": "squared error and KL divergence of the conditional VAE",
        "policy_loss": "minus the weighted Q_r of the policy's actions, and the price of their cost",
        "error": "mean of Q_c - L~ of the policy's actions, in discounted cost",
        "multiplier": "lambda, the price of a unit of discounted cost, in units of 1 / reward_weight",
    }

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if float("inf") in (self.limits or ()):
            raise ValueError(f"{self.name} needs a finite limit: under an infinite one no cost has a price")

    def prepare(self, datasets: Sequence[Dataset], progress: bool = True) -> None:
        """Measures each run's variables, and lets Q_c start at the recorded cost, in the unit of L~ (eq. 2).

        The first errors then compare the recorded cost of T steps with the limit. The errors of a worse guess
        would stay in the sum of errors.
        """
        super().prepare(datasets, progress)
        gamma, horizon = self.config.gamma, self.task.horizon
        costs = [float(dataset.costs.mean()) * horizon for dataset in datasets]
        scale = cost_guess(self.task, (gamma,))[0]  # the critics' output is scale (1 + bias)
        self.fill_last_bias(
            ("cost_critics",), [average_threshold(cost, gamma, horizon) / scale - 1 for cost in costs]
        )

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        sizes = task.obs_dim, task.act_dim
        width = round(config.vae_width * config.hidden_width)
        return super().build() | {
            "critics": Critics(*sizes, config, reward_guess(task, config)),
            "cost_critics": Critics(*sizes, config, cost_guess(task, (config.gamma,))[0]),
            "encoder": ActionEncoder(*sizes, width, 2),
            "decoder": ActionDecoder(*sizes, width, 2),
            "error_sum": torch.zeros(()),
            "last_error": torch.zeros(()),
        }

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also noise for the latents of the recorded actions, (B, 2 act)."""
        shape = self.config.batch_size, 2 * self.task.act_dim
        noise = torch.randn(shape, generator=generator)
        return super().draw(data, generator, limit) | {"latent_noise": noise}

    def draw_latents(self, generator: torch.Generator, *shape: int) -> Tensor:
        """Returns latents of the prior, (*shape, 2 act), clamped to +-0.5, which the decoder turns into
        actions."""
        latents = torch.randn(*shape, 2 * self.task.act_dim, generator=generator)
        return latents.clamp(-LARGEST_LATENT, LARGEST_LATENT)

    def critic_losses(
        self, net: Networks, batch: Fields, s: Tensor, s_next: Tensor, a_next: Tensor
    ) -> dict[str, Tensor]:
        """Returns the losses of Q_r, of Q_c and of the VAE, by name.

        The network inputs s and s_next are (B, inputs). `a_next` are n actions of the target policy at
        s_next, (n, B, act), which both critics share.
        """
        config, a = self.config, batch.actions
        inputs = s_next.repeat(len(a_next), 1), a_next.flatten(0, 1)  # (n B, ...)

        def q_next(critics: nn.Module) -> Tensor:
            with torch.no_grad():
                q = critics(*inputs).unflatten(1, a_next.shape[:2])  # (2, n, B)
                return soft_clipped_max(q, config.smallest_weight)

        mask = self.reward_mask(batch)
        target = losses.td_target(batch.rewards, config.gamma, q_next(net.target_critics), mask)
        most = self.task.max_step_cost / (1 - config.gamma)  # the largest cost at every step
        cost_next, mask = q_next(net.target_cost_critics).clamp(0, most), 1 - batch.terminals
        cost_target = losses.td_target(batch.costs, config.gamma, cost_next, mask)
        return {
            "critic": losses.td_loss(target, net.critics(s, a)),
            "cost_critic": losses.td_loss(cost_target, net.cost_critics(s, a)),
            "vae": vae_loss(net.encoder, net.decoder, s, a, batch.latent_noise, config.kl_weight),
        }

    def lagrangian(
        self, net: Networks, s: Tensor, a: Tensor, limit: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns minus the weighted Q_r plus lambda (Q_c - L~), both means, and the scalars for the log.

        s (B, inputs) and a (B, act) are the policy's actions, which get the gradient. `limit` is (B,).
        """
        config = self.config
        q_reward = net.frozen_critics(s, a).amin(0)
        limit = average_threshold(limit, config.gamma, self.task.horizon)
        error = (net.frozen_cost_critics(s, a).amin(0) - limit).mean()
        multiplier = self.multiplier(net, error.detach())
        loss = -config.reward_weight * q_reward.mean() + multiplier * error
        return loss, {"error": error, "multiplier": multiplier}

    def multiplier(self, net: Networks, error: Tensor) -> Tensor:
        """Returns lambda, 0 or more, by the PID controller. `error` is (), in discounted cost."""
        config = self.config
        proportional = config.proportional_gain * F.relu(error)
        integral = config.integral_gain * F.relu(net.error_sum + error)
        return proportional + integral + config.derivative_gain * F.relu(error - net.last_error)

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns the memory of the PID controller. The sum of errors never falls below zero."""
        error = scalars["error"]
        return {"error_sum": F.relu(net.error_sum + error), "last_error": error}
