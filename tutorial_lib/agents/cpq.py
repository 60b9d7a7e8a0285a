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

import torch
from torch import Tensor, nn

from tutorial_lib import losses as L
from tutorial_lib.agents.agent import Agent, cost_guess, reward_guess
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.networks import ActionDecoder, ActionEncoder, Critics, SquashedPolicy, latent_kl

SAMPLES = 10
"""Actions of the policy per state, of which those outside the data are sought."""
OUTSIDE_SHARE = 0.25
"""Share of these samples, those with the largest KL divergence in the whole batch, that count as outside."""
OUTSIDE_COST = 1.5
"""What the cost critics should say of actions outside at least, in units of the limit."""
KL_WEIGHT = 0.5
"""Of the VAE's KL divergence against its mean squared error."""
VAE_WIDTH = 400 / 256
"""Width of the VAE's two hidden layers, relative to the other networks'."""
POLICY_LR = 1 / 3
"""Learning rate of the policy, relative to the profile's: 1e-4 in profile `paper`."""
MULTIPLIER_LR = 1e-4
"""Step of the multiplier's logarithm, for a multiplier of one, per unit of missing cost."""
LOG_MULTIPLIER = 5.0
"""Bound on that logarithm, on either side of zero."""


class Multiplier(nn.Module):
    """A positive number by its logarithm, which no loss trains: it is stepped in `PushedCPQ.update`."""

    def __init__(self):
        super().__init__()
        self.log = nn.Parameter(torch.zeros(()))

    def forward(self) -> Tensor:
        return self.log.exp()


class CPQ(Agent):
    """Equations 3 and 4 for one finite threshold L, compared with discounted costs as L~ (eq. 2)."""

    name = "CPQ"
    targets = ("critics", "cost_critics")
    frozen = ("critics", "cost_critics")

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        if self.threshold == float("inf"):
            raise ValueError(f"{self.name} needs a finite threshold: without one nothing is unsafe")
        # Where all actions look unsafe the policy has no gradient (eq. 4), so let all look safe at first.
        self.fill_last_bias(("cost_critics",), -1.0)

    def build(self):
        task, config = self.task, self.config
        sizes = task.obs_dim, task.act_dim
        cost_scale = cost_guess(task, (config.gamma,))[0]
        return {
            "critics": Critics(*sizes, config, reward_guess(task, config)),
            "cost_critics": Critics(*sizes, config, cost_scale, k=config.cost_critics),
            "policy": SquashedPolicy(*sizes, config),
        }

    def learning_rate(self, name):
        return super().learning_rate(name) * (POLICY_LR if name == "policy" else 1)

    def draw_noise(self, generator, batch_size):
        """For the policy's actions at s' and at s, (B, act) each."""
        shape = batch_size, self.task.act_dim
        return torch.randn(shape, generator=generator), torch.randn(shape, generator=generator)

    def losses(self, net, batch, limit, next_noise, noise):
        config, a = self.config, batch.actions
        s, s_next = (self.network_input(x, limit) for x in (batch.observations, batch.next_observations))
        limit = average_threshold(limit, config.gamma, self.task.horizon)

        # Eq. 3: what follows counts where the policy's action at s' looks safe. It may be outside the data.
        a_next = net.policy(s_next, next_noise)[0].detach()
        q_cost_next = net.target_cost_critics(s_next, a_next).amin(0)  # (B,)
        q_next = L.penalised_q(net.target_critics(s_next, a_next).amin(0), q_cost_next, limit)
        target = L.td_target(batch.rewards, config.gamma, q_next, self.reward_mask(batch))
        critic_loss = L.td_loss(target, net.critics(s, a))

        q_cost_next = q_cost_next.clamp(0, 1 / (1 - config.gamma))
        target = L.td_target(batch.costs, config.gamma, q_cost_next, 1 - batch.terminals)
        cost_critic_loss = L.td_loss(target, net.cost_critics(s, a))

        # Eq. 4: the policy, through critics that do not learn from it.
        a = net.policy(s, noise)[0]
        q_cost = net.frozen_cost_critics(s, a).amin(0)
        q_reward = net.frozen_critics(s, a).amin(0)
        policy_loss = -L.penalised_q(q_reward, q_cost, limit).mean()

        losses = {"critic": critic_loss, "cost_critic": cost_critic_loss, "policy": policy_loss}
        return losses, {
            "safe_fraction": (q_cost <= limit).float().mean(),
            "negative_q": (q_reward < 0).float().mean(),
        }

    def _cosine(self):
        return 1.0


class PushedCPQ(CPQ):
    """CPQ as published: the policy's actions outside the data are trained to cost 1.5 L~."""

    name = "CPQ w/ push"

    def build(self):
        sizes = self.task.obs_dim, self.task.act_dim, round(VAE_WIDTH * self.config.hidden_width), 2
        vae = {"encoder": ActionEncoder(*sizes), "decoder": ActionDecoder(*sizes)}
        return super().build() | vae | {"multiplier": Multiplier()}

    def draw_noise(self, generator, batch_size):
        """Besides, for the policy's samples at s (10, B, act) and the latent (B, 2 act)."""
        act = self.task.act_dim
        shapes = (SAMPLES, batch_size, act), (batch_size, 2 * act)
        own = tuple(torch.randn(shape, generator=generator) for shape in shapes)
        return super().draw_noise(generator, batch_size) + own

    def update(self, batch, generators):
        """All networks, then the multiplier: it grows while the actions outside look too cheap."""
        scalars = super().update(batch, generators)
        log = self.parameters["multiplier"]["log"]
        with torch.no_grad():
            step = MULTIPLIER_LR * log.exp() * scalars["shortfall"]
            log.add_(step).clamp_(-LOG_MULTIPLIER, LOG_MULTIPLIER)
        return scalars

    def losses(self, net, batch, limit, next_noise, noise, sample_noise, latent_noise):
        losses, scalars = super().losses(net, batch, limit, next_noise, noise)
        s = self.network_input(batch.observations, limit)

        # The conditional VAE of the recorded actions.
        losses["vae"] = _vae_loss(net.encoder, net.decoder, s, batch.actions, latent_noise)

        # The push, with a price on every unit that the actions outside miss: alpha (1.5 L~ - Q_c).
        samples = net.policy(s, sample_noise)[0].detach()  # (10, B, act)
        outside_cost = net.cost_critics(*self._outside(net, s, samples)).amin(0).mean()
        enough = OUTSIDE_COST * average_threshold(limit[0], self.config.gamma, self.task.horizon)
        shortfall = enough - outside_cost
        alpha = net.multiplier().detach()
        losses["cost_critic"] = losses["cost_critic"] + alpha * shortfall.clamp(min=0)
        return losses, scalars | {"outside_cost": outside_cost, "shortfall": shortfall, "alpha": alpha}

    def _outside(self, net, s: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """States (n, obs) and actions (n, act): of samples (10, B, act) the least like the recorded ones."""
        states = s.repeat(len(samples), 1)  # (10 B, obs)
        actions = samples.flatten(0, 1)
        with torch.no_grad():
            kl = latent_kl(*net.encoder(states, actions))  # (10 B,)
        rows = kl.topk(round(OUTSIDE_SHARE * len(kl))).indices
        return states[rows], actions[rows]


def _vae_loss(encoder, decoder, s: Tensor, a: Tensor, noise: Tensor) -> Tensor:
    """Mean squared error of the decoded actions and KL divergence of the latent, both means over (B, ...)."""
    mean, log_std = encoder(s, a)
    decoded = decoder(s, mean + log_std.exp() * noise)
    return (decoded - a).square().mean() + KL_WEIGHT * latent_kl(mean, log_std).mean()
