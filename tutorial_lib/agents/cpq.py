"""Constraints penalized Q-learning (CPQ; Xu, Zhan and Zhu 2022; eqs. 3 and 4 of the C2IQL paper), twice.

The backup of CPQ asks the critics about actions of the policy, recorded or not. As published, a conditional
VAE of the recorded actions tells which of them lie outside the data, and the cost critics are pushed to find
these too costly. In the benchmark's code (OSRL, `cpq.py`), whose results papers compare with, that push sits
inside `no_grad`, on the target networks: it trains nothing. `CPQ` is what that code trains, `PushedCPQ` what
was published. On BallCircle at a limit of 50 (`small`, target_tau=0.01, a trial of seed 0 alone) they had a
normalised reward and cost of 0.57 / 0.96 and 0.02 / 0.97, so the tables have the first.

Settings are OSRL's. Where we depart, or settle what is open:

1. The cost backup stops where the robot fell, as in CIQL; OSRL's never stops. (Ball and Car never fall.)
2. What follows costs between nothing and every step, 1 / (1 - gamma).

And for the push:

3. The cost of the actions outside is what the *online* cost critics say, and its gradient reaches them.
4. That cost is a mean over the actions outside, the paper's expectation. OSRL's is a mean over all samples,
   with zeros for those inside, and so a quarter of it.
5. Actions outside are squashed by tanh like those that run; OSRL's are taken before the tanh.
6. It ends where the actions outside cost enough. With the multiplier alone, which lets go late, and without
   bound 2 the cost critics came to expect between -1,617 and 1,265 where 33 was enough.

As in OSRL: of two cost critics the *smaller* counts, and its first guess is zero, so that all looks safe; the
multiplier takes a plain gradient step; the policy's learning rate stays as it is (the cosine belongs to IQL).
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, cost_guess, reward_guess
from tutorial_lib.config import COUNT, NOT_NEGATIVE, SHARE
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.networks import ActionDecoder, ActionEncoder, Critics, SquashedPolicy, latent_kl, vae_loss


@dataclass(frozen=True)
class CPQConfig(CriticConfig):
    """The options of CPQ."""

    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Adam's learning rate for the policy (OSRL's)."""
    cost_critics: Annotated[int, COUNT] = 2
    """Number of cost critics; the lowest cost counts, as in OSRL."""

    # Slower targets than the other algorithms': an actor asks about its own actions. On BallCircle at a limit
    # of 50, CPQ had a normalised reward and cost of 0.57 / 0.96 with 0.01, and of 0.26 / 0.49 with 0.1 (seed
    # 0 alone).
    profiles = {"small": {"policy_lr": 1e-3 * (1 / 3), "target_tau": 0.01}}


@dataclass(frozen=True)
class PushedCPQConfig(CPQConfig):
    """The options of CPQ as published, with the push."""

    samples: Annotated[int, COUNT] = 10
    """Actions of the policy per state, of which those outside the data are sought."""
    outside_share: Annotated[float, SHARE] = 0.25
    """Share of these samples, those with the largest KL divergence in the whole batch, that count as
    outside."""
    outside_cost: Annotated[float, NOT_NEGATIVE] = 1.5
    """What the cost critics should say of actions outside at least, in units of the limit."""
    kl_weight: Annotated[float, NOT_NEGATIVE] = 0.5
    """Weight of the VAE's KL divergence against its mean squared error."""
    vae_width: Annotated[float, NOT_NEGATIVE] = 400 / 256
    """Units of the VAE's two hidden layers, in units of the other networks' width."""
    multiplier_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Step of the multiplier's logarithm, for a multiplier of one, per unit of missing cost."""
    largest_log_multiplier: Annotated[float, NOT_NEGATIVE] = 5.0
    """Bound on that logarithm, on either side of zero."""


class CPQ(CriticAgent):
    """Equations 3 and 4 for one finite limit L, compared with discounted costs as L~ (eq. 2)."""

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

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        if float("inf") in (self.limits or ()):
            raise ValueError(f"{self.name} needs a finite limit: without one nothing is unsafe")
        # Where all actions look unsafe the policy has no gradient (eq. 4), so let all look safe at first.
        self.fill_last_bias(("cost_critics",), [-1.0] * len(self.seeds))

    def build(self):
        task, config = self.task, self.config
        sizes = task.obs_dim, task.act_dim
        cost_scale = cost_guess(task, (config.gamma,))[0]
        return super().build() | {
            "critics": Critics(*sizes, config, reward_guess(task, config)),
            "cost_critics": Critics(*sizes, config, cost_scale, k=config.cost_critics),
            "policy": SquashedPolicy(*sizes, config),
        }

    def draw(self, data, generator, limit):
        """Besides, noise for the policy's actions at s' and at s, (B, act) each."""
        shape = self.config.batch_size, self.task.act_dim
        return super().draw(data, generator, limit) | {
            "next_noise": torch.randn(shape, generator=generator),
            "noise": torch.randn(shape, generator=generator),
        }

    def losses(self, net, batch):
        config, a = self.config, batch.actions
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)
        limit = average_threshold(batch.limit, config.gamma, self.task.horizon)

        # Eq. 3: what follows counts where the policy's action at s' looks safe. It may be outside the data.
        a_next = net.policy(s_next, batch.next_noise)[0].detach()
        q_cost_next = net.target_cost_critics(s_next, a_next).amin(0)  # (B,)
        q_next = losses.penalised_q(net.target_critics(s_next, a_next).amin(0), q_cost_next, limit)
        target = losses.td_target(batch.rewards, config.gamma, q_next, self.reward_mask(batch))
        critic_loss = losses.td_loss(target, net.critics(s, a))

        q_cost_next = q_cost_next.clamp(0, 1 / (1 - config.gamma))
        target = losses.td_target(batch.costs, config.gamma, q_cost_next, 1 - batch.terminals)
        cost_critic_loss = losses.td_loss(target, net.cost_critics(s, a))

        # Eq. 4: the policy, through critics that do not learn from it.
        a = net.policy(s, batch.noise)[0]
        q_cost = net.frozen_cost_critics(s, a).amin(0)
        q_reward = net.frozen_critics(s, a).amin(0)
        policy_loss = -losses.penalised_q(q_reward, q_cost, limit).mean()

        return {"critic": critic_loss, "cost_critic": cost_critic_loss, "policy": policy_loss}, {
            "safe_fraction": (q_cost <= limit).float().mean(),
            "negative_q": (q_reward < 0).float().mean(),
        }


class PushedCPQ(CPQ):
    """CPQ as published: the policy's actions outside the data are trained to cost 1.5 L~."""

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

    def build(self):
        width = round(self.config.vae_width * self.config.hidden_width)
        sizes = self.task.obs_dim, self.task.act_dim, width, 2
        vae = {"encoder": ActionEncoder(*sizes), "decoder": ActionDecoder(*sizes)}
        return super().build() | vae | {"log_multiplier": torch.zeros(())}

    def draw(self, data, generator, limit):
        """Besides, noise for the policy's samples at s (10, B, act) and for the latent (B, 2 act)."""
        batch_size, act = self.config.batch_size, self.task.act_dim
        return super().draw(data, generator, limit) | {
            "sample_noise": torch.randn(self.config.samples, batch_size, act, generator=generator),
            "latent_noise": torch.randn(batch_size, 2 * act, generator=generator),
        }

    def losses(self, net, batch):
        of_networks, scalars = super().losses(net, batch)
        config = self.config
        s = self.network_input(net, batch.observations, batch.limit)

        # The conditional VAE of the recorded actions.
        vae = vae_loss(net.encoder, net.decoder, s, batch.actions, batch.latent_noise, config.kl_weight)

        # The push, with a price on every unit that the actions outside miss: alpha (1.5 L~ - Q_c).
        samples = net.policy(s, batch.sample_noise)[0].detach()  # (10, B, act)
        outside_cost = net.cost_critics(*self._outside(net, s, samples)).amin(0).mean()
        enough = config.outside_cost * average_threshold(batch.limit[0], config.gamma, self.task.horizon)
        shortfall = enough - outside_cost
        alpha = net.log_multiplier.exp()
        pushed = of_networks["cost_critic"] + alpha * shortfall.clamp(min=0)
        scalars |= {"outside_cost": outside_cost, "shortfall": shortfall, "alpha": alpha}
        return of_networks | {"cost_critic": pushed, "vae": vae}, scalars

    def step(self, net, batch, scalars):
        """The multiplier grows while the actions outside look too cheap."""
        log, bound = net.log_multiplier, self.config.largest_log_multiplier
        log = log + self.config.multiplier_lr * log.exp() * scalars["shortfall"]
        return {"log_multiplier": log.clamp(-bound, bound)}

    def _outside(self, net, s: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """States (n, obs) and actions (n, act): of samples (10, B, act) the least like the recorded ones."""
        states = s.repeat(len(samples), 1)  # (10 B, obs)
        actions = samples.flatten(0, 1)
        with torch.no_grad():
            kl = latent_kl(*net.encoder(states, actions))  # (10 B,)
        rows = kl.topk(round(self.config.outside_share * len(kl))).indices
        return states[rows], actions[rows]
