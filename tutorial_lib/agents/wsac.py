"""WSAC-style: an actor against two critics that are trained to judge it badly, and a cloned reference.

Sources: Wei, Peng, Ghosh and Liu 2024 (WSAC), through its abstract and summaries by others; Cheng, Xie, Jiang
and Agarwal 2022 (ATAC), whose public code is the model for what is not known.

This is not WSAC's own code, which we did not find, and so its name is 'WSAC-style'. What is certain is this.
With L(f) = mean f(s, pi) - f(s, a), which compares the policy's actions with the recorded ones, the reward
critic minimises L(f_r) + beta E(f_r), where E is a Bellman error with importance weights of 0 or C. The cost
critic minimises -lambda L(f_c) + beta E(f_c). The policy maximises f_r - lambda max(0, f_c - f_c(s, pi_ref)),
where pi_ref is a reference policy. It is cloned from the data if there is none. The critics learn faster than
the policy ('two time scales').

Everything else is ours:

- The policy must cost no more than the reference *and* no more than L~ (eq. 2): f_c is compared with the
  smaller of f_c(s, pi_ref) and L~. As published, it is as safe as the reference, and no limit enters. How
  WSAC's experiments use their limits is not known to us.
- beta, lambda, the sizes and the learning rates. The rewards are divided by half of the task's best mean
  reward, so that one beta and one lambda fit all tasks.
- E is ATAC's: half of the squared error is that of a target from target networks, and half is that of the
  critic's own next value, with the gradient of both values. Of squared errors, the weights 0 or C with the
  largest sum are all C. So C is a factor of beta. We do not know whether WSAC's errors are squared.
- The smaller target critic counts for the reward, as in ATAC, and the mean of both for the cost.

Departures from ATAC:

1. The policy is IQL's Gaussian with a tanh mean. ATAC's is squashed, and its entropy is held at a target.
2. The policy clones the recorded actions during the first 15% of the updates, while the critics already
   judge it. ATAC clones for 100,000 of a million updates, and its critics learn the data's values.
3. The policy's learning rate is 0.3 of the critics'. In ATAC it is 5e-7, for 900,000 updates. With this rate,
   Adam could move a parameter by 0.006 at most in 12,000 updates.
4. The norm of the critics' weights has no bound. ATAC's is 100 per layer, and with a width of 128 they start
   near 6.5.
5. The next value of the cost is clamped to what is possible, and costs end only where the robot fell, as in
   CPQ.
6. All networks step at once. In ATAC the critics step first.

Measured: on BallCircle at a limit of 50 (6,000 updates with a width of 64 and batches of 128, one trial with
seed 0 only), the normalised reward and cost of 5 episodes were 0.47 / 0.00. With beta = 20 and the larger
target critic for the cost, 3,000 updates gave 0.16 / 0.13: Q_c of the policy's actions was 0.28 above that of
the recorded ones, this added up over the steps, and the excess rose to 26, where L~ is 21.7. A whole run was
not measured.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor, nn

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import COUNT, NOT_NEGATIVE, SHARE
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.data.dataset import Batch
from tutorial_lib.networks import Critics, Policy, gaussian_log_prob


@dataclass(frozen=True)
class WSACConfig(CriticConfig):
    """The options of WSAC-style."""

    updates: Annotated[int, COUNT] = 30_000
    """The number of gradient updates of a run (Table 7)."""
    policy_lr: Annotated[float, NOT_NEGATIVE] = 1.5e-4
    """Adam's learning rate for the policy, 0.3 of `critic_lr`."""
    critic_lr: Annotated[float, NOT_NEGATIVE] = 5e-4
    """Adam's learning rate for Q_r, Q_c and the reference, as in ATAC."""
    beta: Annotated[float, NOT_NEGATIVE] = 100.0
    """The weight of the Bellman errors, per unit of reward or cost. The smaller it is, the worse the critics
    judge the policy's actions."""
    penalty: Annotated[float, NOT_NEGATIVE] = 10.0
    """Lambda: the price of a cost that is above that of the reference or above L~, in units of half of the
    task's best mean reward of a step."""
    cloning_share: Annotated[float, SHARE] = 0.15
    """The share of the updates in which the policy clones the recorded actions. Then it improves on them."""

    # The targets are slower than those of IQL, because they contain the policy's own actions.
    profiles = {
        "small": {"updates": 12_000, "critic_lr": 1e-3, "policy_lr": 3e-4, "target_tau": 0.04},
    }


def bellman_error(target: Tensor, own_target: Tensor, q: Tensor) -> Tensor:
    """Returns half the mean of (target - q)^2 plus half the mean of (own_target - q)^2, of k critics, (k,).

    `q` is (k, B). `target` (B,) comes from target networks and gets no gradient. `own_target` (k, B) contains
    each critic's own next value, and gets the gradient as q does.
    """
    assert target.shape == q.shape[1:] and own_target.shape == q.shape
    return 0.5 * (target.detach() - q).square().mean(1) + 0.5 * (own_target - q).square().mean(1)


class WSAC(CriticAgent):
    """WSAC-style, for one finite limit L. Discounted costs are compared with L~ (eq. 2).

    Its variable `updates_made` counts the updates. Raises ValueError for an infinite limit.
    """

    name = "WSAC-style"
    Config = WSACConfig
    config: WSACConfig
    needs_limit = True
    targets = ("critics", "cost_critics")
    frozen = ("critics", "cost_critics")
    scalars = {
        "critic_loss": "L(Q_r) and beta times its Bellman error, summed over both critics",
        "cost_critic_loss": "-lambda L(Q_c) and beta times its Bellman error, summed over both critics",
        "reference_loss": "minus the log-likelihood of the recorded actions under the reference",
        "policy_loss": "the same of the policy, while it clones; then minus Q_r, and lambda times the excess",
        "reward_gap": "L(Q_r): mean Q_r of the policy's actions minus that of the recorded ones",
        "cost_gap": "L(Q_c): the same for Q_c, in discounted cost",
        "excess": "mean of how far Q_c is above the reference's or above L~, in discounted cost",
    }

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if float("inf") in (self.limits or ()):
            raise ValueError(f"{self.name} needs a finite limit: an infinite one is compared with nothing")

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        sizes = task.obs_dim, task.act_dim
        reward = average_threshold(task.horizon, config.gamma, task.horizon)  # one unit at each of T steps
        cost = average_threshold(task.typical_limit, config.gamma, task.horizon)
        return super().build() | {
            "critics": Critics(*sizes, config, reward),
            "cost_critics": Critics(*sizes, config, cost),
            "reference": Policy(*sizes, config),
            "policy": Policy(*sizes, config),
            "updates_made": torch.zeros(()),
        }

    @property
    def reward_unit(self) -> float:
        """Half of DSRL's best mean reward of a step. The critics count reward in this unit."""
        return 0.5 * self.task.max_return / self.task.horizon

    def optimiser(self, name: str) -> Rates:
        return Rates(self.config.policy_lr if name == "policy" else self.config.critic_lr)

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also noise for the policy's actions at s' and at s, both (B, act)."""
        shape = self.config.batch_size, self.task.act_dim
        return super().draw(data, generator, limit) | {
            "next_noise": torch.randn(shape, generator=generator),
            "noise": torch.randn(shape, generator=generator),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, horizon = self.config, self.task.horizon
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)
        a, a_next = self.sample(net, s, batch.noise), self.sample(net, s_next, batch.next_noise).detach()

        # The critics judge the policy's actions as badly as the recorded rewards and costs allow.
        states, actions = torch.cat([s, s, s_next]), torch.cat([batch.actions, a.detach(), a_next])

        def judge(name: str, reward: Tensor, mask: Tensor, target_value: Tensor) -> tuple[Tensor, Tensor]:
            q, q_policy, q_next = getattr(net, name)(states, actions).chunk(3, -1)  # (2, B)
            target = losses.td_target(reward, config.gamma, target_value, mask)
            own_target = losses.td_target(reward, config.gamma, q_next, mask)
            return (q_policy - q).mean(1), bellman_error(target, own_target, q)

        q_next = net.target_critics(s_next, a_next).amin(0)
        reward, mask = batch.rewards / self.reward_unit, self.reward_mask(batch)
        gap, error = judge("critics", reward, mask, q_next)
        critic_loss = (gap + config.beta * error).sum()

        most = self.task.max_step_cost / (1 - config.gamma)  # the largest cost at every step
        cost_next = net.target_cost_critics(s_next, a_next).mean(0).clamp(0, most)
        cost_gap, cost_error = judge("cost_critics", batch.costs, 1 - batch.terminals, cost_next)
        cost_critic_loss = (config.beta * cost_error - config.penalty * cost_gap).sum()

        # The reference clones. The policy does so first, and then improves on it by the first critic of each.
        mean, log_std = net.reference(s)
        reference_loss = -gaussian_log_prob(batch.actions, mean, log_std).mean()
        allowed = net.frozen_cost_critics(s, mean.detach())[0].detach()  # (B,)
        allowed = torch.minimum(allowed, average_threshold(batch.limit, config.gamma, horizon))
        excess = (net.frozen_cost_critics(s, a)[0] - allowed).clamp(min=0).mean()
        improving_loss = config.penalty * excess - net.frozen_critics(s, a)[0].mean()
        cloning_loss = -gaussian_log_prob(batch.actions, *net.policy(s)).mean()
        clones = net.updates_made < config.cloning_share * config.updates
        policy_loss = torch.where(clones, cloning_loss, improving_loss)

        of_networks = {"critic": critic_loss, "cost_critic": cost_critic_loss}
        of_networks |= {"reference": reference_loss, "policy": policy_loss}
        return of_networks, {"reward_gap": gap.mean(), "cost_gap": cost_gap.mean(), "excess": excess}

    def sample(self, net: Networks, s: Tensor, noise: Tensor) -> Tensor:
        """Returns the policy's actions at s for standard normal noise, (B, act), within [-1, 1]."""
        mean, log_std = net.policy(s)
        return (mean + log_std.exp() * noise).clamp(-1, 1)

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Returns the number of updates made."""
        return {"updates_made": net.updates_made + 1}
