"""Constraints penalized Q-learning (CPQ), as the benchmark OSRL trains it and as it was published.

Sources: Xu, Zhan and Zhu 2022; equations 3 and 4 of the C2IQL paper; the file `cpq.py` of OSRL, whose
settings are used here.

The targets of CPQ's critics contain actions of the policy, recorded or not. As published, a conditional VAE
of the recorded actions finds those that are outside the data, and a *push* trains the cost critics to predict
a high cost for them. In OSRL's code, with whose results papers compare, the push is inside `no_grad` and uses
the target networks, so it trains nothing. `CPQ` is what that code trains. `PushedCPQ` is what was published.

As in OSRL, the *smaller* of two cost critics counts, and their first guess is zero, so that all actions look
safe at first. The multiplier takes a plain gradient step. The policy's learning rate is constant (the cosine
belongs to IQL).

Departures: points 1 and 2 hold for both classes, and points 3 to 6 for the push.

1. The target of the cost critics ends where the robot fell, as in CIQL. In OSRL it never ends. (Ball and Car
   never fall.)
2. The cost after a step is clamped to [0, 1 / (1 - gamma)], from no cost to a cost of one at every step.
3. The cost of the actions outside is that of the *online* cost critics, and its gradient reaches them.
4. This cost is a mean over the actions outside, which is the paper's expectation. In OSRL it is a mean over
   all samples, with zeros for the actions inside, and so a quarter as large.
5. The actions outside are squashed by tanh, like those that act. In OSRL they are taken before the tanh.
6. The push is zero as soon as the actions outside cost enough. With only the multiplier, which falls late,
   and without departure 2, the cost critics' predictions reached from -1,617 to 1,265, where 33 was enough.

Measured: on BallCircle at a limit of 50 (profile `small`, target_tau=0.01, one trial with seed 0 only), `CPQ`
had a normalised reward and cost of 0.57 / 0.96, and `PushedCPQ` of 0.02 / 0.97. So the tables have `CPQ`.
With target_tau=0.1, like the other algorithms, `CPQ` had 0.26 / 0.49 (seed 0 only).
"""

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor, nn

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, cost_guess, reward_guess
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import COUNT, NOT_NEGATIVE, SHARE
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.data.dataset import Batch
from tutorial_lib.networks import ActionDecoder, ActionEncoder, Critics, SquashedPolicy, latent_kl, vae_loss


@dataclass(frozen=True)
class CPQConfig(CriticConfig):
    """The options of CPQ."""

    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Adam's learning rate for the policy, as in OSRL."""
    cost_critics: Annotated[int, COUNT] = 2
    """The number of cost critics, of which the lowest cost counts, as in OSRL."""

    # The targets are slower than those of other algorithms, because they contain the policy's own actions.
    profiles = {"small": {"policy_lr": 1e-3 * (1 / 3), "target_tau": 0.01}}


@dataclass(frozen=True)
class PushedCPQConfig(CPQConfig):
    """The options of CPQ as it was published, with the push."""

    samples: Annotated[int, COUNT] = 10
    """The number of the policy's actions per state among which those outside the data are sought."""
    outside_share: Annotated[float, SHARE] = 0.25
    """The share of these samples that count as outside: those with the largest KL divergence in the batch."""
    outside_cost: Annotated[float, NOT_NEGATIVE] = 1.5
    """The lowest cost that the cost critics should predict for actions outside, in units of L~ (eq. 2)."""
    kl_weight: Annotated[float, NOT_NEGATIVE] = 0.5
    """The weight of the VAE's KL divergence. Its mean squared error has the weight one."""
    vae_width: Annotated[float, NOT_NEGATIVE] = 400 / 256
    """The width of the VAE's two hidden layers, in units of `hidden_width`."""
    multiplier_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """The learning rate of the multiplier alpha. An update adds multiplier_lr * alpha * shortfall to log
    alpha, where the shortfall is in discounted cost."""
    largest_log_multiplier: Annotated[float, NOT_NEGATIVE] = 5.0
    """The largest absolute value of log alpha."""


class CPQ(CriticAgent):
    """CPQ, equations 3 and 4, as OSRL's code trains it, for one finite limit L.

    Discounted costs are compared with L~ (eq. 2). Raises ValueError for an infinite limit.
    """

    name = "CPQ"
    Config = CPQConfig
    config: CPQConfig
    needs_limit = True
    scalars = {
        "critic_loss": "squared error of the Q_r, summed over the ensemble (eq. 3)",
        "cost_critic_loss": "squared error of the Q_c, summed over the ensemble, and the push",
        "policy_loss": "minus the penalised Q_r of the policy's own actions (eq. 4)",
        "safe_fraction": "share of the policy's actions whose expected cost keeps L~",
        "negative_q": "share of the policy's actions with Q_r < 0, where a penalty of zero is a reward",
    }
    targets = ("critics", "cost_critics")
    frozen = ("critics", "cost_critics")

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if float("inf") in (self.limits or ()):
            raise ValueError(f"{self.name} needs a finite limit: under an infinite one nothing is unsafe")
        # If all actions look unsafe, the policy has no gradient (eq. 4). So all look safe at first.
        self.fill_last_bias(("cost_critics",), [-1.0] * len(self.seeds))

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        sizes = task.obs_dim, task.act_dim
        cost_scale = cost_guess(task, (config.gamma,))[0]
        return super().build() | {
            "critics": Critics(*sizes, config, reward_guess(task, config)),
            "cost_critics": Critics(*sizes, config, cost_scale, k=config.cost_critics),
            "policy": SquashedPolicy(*sizes, config),
        }

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also noise for the policy's actions at s' and at s, both (B, act)."""
        shape = self.config.batch_size, self.task.act_dim
        return super().draw(data, generator, limit) | {
            "next_noise": torch.randn(shape, generator=generator),
            "noise": torch.randn(shape, generator=generator),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, a = self.config, batch.actions
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)
        limit = average_threshold(batch.limit, config.gamma, self.task.horizon)

        # Eq. 3: the next Q counts where the policy's action at s', which may be outside the data, looks safe.
        a_next = net.policy(s_next, batch.next_noise)[0].detach()
        q_cost_next = net.target_cost_critics(s_next, a_next).amin(0)  # (B,)
        q_next = losses.penalised_q(net.target_critics(s_next, a_next).amin(0), q_cost_next, limit)
        target = losses.td_target(batch.rewards, config.gamma, q_next, self.reward_mask(batch))
        critic_loss = losses.td_loss(target, net.critics(s, a))

        q_cost_next = q_cost_next.clamp(0, 1 / (1 - config.gamma))
        target = losses.td_target(batch.costs, config.gamma, q_cost_next, 1 - batch.terminals)
        cost_critic_loss = losses.td_loss(target, net.cost_critics(s, a))

        # Eq. 4: the policy maximises the penalised Q of its own actions. The critics do not learn from it.
        a = net.policy(s, batch.noise)[0]
        q_cost = net.frozen_cost_critics(s, a).amin(0)
        q_reward = net.frozen_critics(s, a).amin(0)
        policy_loss = -losses.penalised_q(q_reward, q_cost, limit).mean()

        return {"critic": critic_loss, "cost_critic": cost_critic_loss, "policy": policy_loss}, {
            "safe_fraction": (q_cost <= limit).float().mean(),
            "negative_q": (q_reward < 0).float().mean(),
        }


class PushedCPQ(CPQ):
    """CPQ as it was published. The cost critics learn that actions outside the data cost at least 1.5 L~."""

    name = "CPQ w/ push"
    in_table1 = False
    Config = PushedCPQConfig
    scalars = CPQ.scalars | {
        "vae_loss": "squared error and KL divergence of the conditional VAE",
        "outside_cost": "mean expected cost of the policy's actions outside the data, in discounted cost",
        "shortfall": "how much less this is than 1.5 L~, in discounted cost",
        "alpha": "the multiplier of the shortfall",
    }
    config: PushedCPQConfig

    def build(self) -> dict[str, nn.Module | Tensor]:
        width = round(self.config.vae_width * self.config.hidden_width)
        sizes = self.task.obs_dim, self.task.act_dim, width, 2
        vae = {"encoder": ActionEncoder(*sizes), "decoder": ActionDecoder(*sizes)}
        return super().build() | vae | {"log_multiplier": torch.zeros(())}

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also noise for the policy's samples at s, (10, B, act), and for the latent, (B, 2 act)."""
        batch_size, act = self.config.batch_size, self.task.act_dim
        return super().draw(data, generator, limit) | {
            "sample_noise": torch.randn(self.config.samples, batch_size, act, generator=generator),
            "latent_noise": torch.randn(batch_size, 2 * act, generator=generator),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        of_networks, scalars = super().losses(net, batch)
        config = self.config
        s = self.network_input(net, batch.observations, batch.limit)

        # The conditional VAE of the recorded actions.
        vae = vae_loss(net.encoder, net.decoder, s, batch.actions, batch.latent_noise, config.kl_weight)

        # The push: alpha max(0, 1.5 L~ - Q_c), with the mean Q_c of the actions outside.
        samples = net.policy(s, batch.sample_noise)[0].detach()  # (10, B, act)
        outside_cost = net.cost_critics(*self._outside(net, s, samples)).amin(0).mean()
        enough = config.outside_cost * average_threshold(batch.limit[0], config.gamma, self.task.horizon)
        shortfall = enough - outside_cost
        alpha = net.log_multiplier.exp()
        pushed = of_networks["cost_critic"] + alpha * shortfall.clamp(min=0)
        scalars |= {"outside_cost": outside_cost, "shortfall": shortfall, "alpha": alpha}
        return of_networks | {"cost_critic": pushed, "vae": vae}, scalars

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns a larger log alpha if the actions outside cost too little, and a smaller one otherwise."""
        log, bound = net.log_multiplier, self.config.largest_log_multiplier
        log = log + self.config.multiplier_lr * log.exp() * scalars["shortfall"]
        return {"log_multiplier": log.clamp(-bound, bound)}

    def _outside(self, net, s: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the samples least like the recorded actions: states (n, obs) and actions (n, act)."""
        states = s.repeat(len(samples), 1)  # (10 B, obs)
        actions = samples.flatten(0, 1)
        with torch.no_grad():
            kl = latent_kl(*net.encoder(states, actions))  # (10 B,)
        rows = kl.topk(round(self.config.outside_share * len(kl))).indices
        return states[rows], actions[rows]
