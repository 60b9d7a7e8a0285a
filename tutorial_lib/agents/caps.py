"""CAPS: constraint-adaptive policy switching. Several policies of one IQL learner, and a rule that picks one.

Sources: Chemingui et al. 2025 (CAPS, AAAI), in the variant that is built on IQL; its public code, whose
settings are used in profile `paper`.

Training takes no limit. IQL learns V_r and Q_r from the rewards, and V_c and Q_c from the costs as if a cost
were a negative reward. The policies are heads of one network. All of them clone the recorded actions. The
first head gives more weight to actions that earn more than V_r, the last one to actions that cost less than
V_c, and the heads between mix the two weights.

While it plays, CAPS is told a limit. At every step, what is left of the limit is turned into discounted cost,
as if it were spent evenly over the remaining steps. Of the heads whose action has a Q_c of at most this, the
one whose action has the highest Q_r acts. If there is none, the one with the least Q_c acts.

Q_c is not the cost of the policy that acts. It is the cost of the action if cheap recorded actions follow it.
CAPS may take a dear action as long as it can become cheap afterwards. Q_c does not know the time, but the
discounted budget of the same cost per step falls towards the end of an episode. So the cheapest action is
played more often there, and a part of the limit can be left.

Departures:

1. A head between the two ends has the weight (1 - m) w_r + m w_c, with m = i / (heads - 1) for head i. In
   CAPS's code it is w_r + 2 m w_c, which for three heads is twice as much.
2. The heads' standard deviations are trained, as in IQL. In CAPS's code they are in a list that the optimiser
   does not see. They stay at one, and so the heads minimise a weighted squared error.
3. The policy's learning rate decays to zero over the run. In CAPS's code the cosine is ten times as long as
   the run.
4. Costs are not negated here. The expectile of V_c is 1 - kappa_1, and of two critics the one with the higher
   cost counts. This is the same as an expectile of kappa_1 and the lower value for negative rewards.
5. The rewards stay as they are, and the advantage in reward is multiplied by 0.1. In CAPS's code all rewards
   are. The weights are the same.
6. Q_c may be equal to the budget. In CAPS's code it must be less.
7. The width of the networks and the number of updates are those of the profile. CAPS's code has 512 and
   100,000.

Measured: on BallCircle (profile `small`, one trial with seed 0 only, 10 episodes) CAPS had a normalised
reward and cost of 0.77 / 0.82, 0.86 / 0.90 and 0.87 / 0.66 under limits of 30, 50 and 70. Played alone in
four episodes, the reward head cost 60 and the cost head 54. So neither keeps a limit of 30 or 50, and the
switching does. Under a limit of 50 the reward head acted in 79% of all steps and in 20% of the last ten. With
no limit it acted in 82%, because in the other states the action of the cost head has the higher Q_r. On
CarCircle (3,300 of the 12,000 updates) it had 0.70 / 0.74, 0.73 / 0.84 and 0.74 / 0.90.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor, nn

from tutorial_lib import losses
from tutorial_lib.agents.critic import cost_guess, goes_on, reward_guess
from tutorial_lib.agents.implicit import ImplicitAgent, ImplicitConfig
from tutorial_lib.agents.player import CountingPlayer, Player
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import NOT_NEGATIVE, PAIR
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.networks import Critics, Policy, Value, gaussian_log_prob, mlp


@dataclass(frozen=True)
class CAPSConfig(ImplicitConfig):
    """The options of CAPS."""

    critic_lr: Annotated[float, NOT_NEGATIVE] = 3e-4
    """Adam's learning rate for Q_r and Q_c, as in CAPS's code."""
    value_lr: Annotated[float, NOT_NEGATIVE] = 3e-4
    """Adam's learning rate for V_r and V_c, as in CAPS's code."""
    heads: Annotated[int, PAIR] = 2
    """The number of policies. CAPS's code has two, one for the reward and one for the cost."""
    awr_alpha: Annotated[float, NOT_NEGATIVE] = 3.0
    """The factor of both advantages in the weights of the recorded actions, as in CAPS's code."""
    reward_factor: Annotated[float, NOT_NEGATIVE] = 0.1
    """The factor of the reward in its weights, as in CAPS's code. The factor of the cost is one."""

    profiles = {"small": {"critic_lr": 1e-3, "value_lr": 1e-3, "kappa_1": 0.7}}  # CAPS's code has 0.7, too


class PolicyHeads(nn.Module):
    """Several policies with shared hidden layers. Each is a Gaussian like `networks.Policy`."""

    def __init__(self, obs_dim: int, act_dim: int, config: CAPSConfig):
        super().__init__()
        self.shape = config.heads, act_dim
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, config.heads * act_dim)
        self.log_std = nn.Parameter(torch.zeros(self.shape))

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean actions (B, heads, act) of all heads, and their log-stds (heads, act)."""
        mean = torch.tanh(self.net(observations)).unflatten(-1, self.shape)
        return mean, self.log_std.clamp(*Policy.LOG_STD)


def head_weights(reward_weight: Tensor, cost_weight: Tensor, heads: int) -> Tensor:
    """Returns the weight of each recorded action for each head, (B, heads), from its two weights, (B,).

    Head i has (1 - m) reward_weight + m cost_weight with m = i / (heads - 1).
    """
    mix = torch.linspace(0, 1, heads, device=reward_weight.device)
    return (1 - mix) * reward_weight.unsqueeze(-1) + mix * cost_weight.unsqueeze(-1)


def choose_heads(q_reward: Tensor, q_cost: Tensor, threshold: Tensor) -> Tensor:
    """Returns the number of the head that acts, (E,), from the values (E, heads) of the heads' own actions.

    Among the heads with Q_c <= threshold it is the one with the highest Q_r. If there is none, it is the one
    with the least Q_c. `q_cost` and `threshold` (E,) are in discounted cost.
    """
    fits = q_cost <= threshold.unsqueeze(-1)
    best = torch.where(fits, q_reward, -torch.inf).argmax(-1)
    return torch.where(fits.any(-1), best, q_cost.argmin(-1))


class SwitchingPlayer(CountingPlayer):
    """A player that lets the agent choose a head at every step, by what is left of the limit and the time."""

    def predicted_cost(self, observations: np.ndarray) -> np.ndarray:
        """Returns the cost so far plus the cost of the remaining steps that the agent predicts, (E,)."""
        return self.spent + self.agent.predicted_cost(observations, self.told, self.run, self.t)


class CAPS(ImplicitAgent):
    """CAPS. A run takes no limit to train, and is told one while it plays."""

    name = "CAPS"
    Config = CAPSConfig
    config: CAPSConfig
    targets = ("critics", "cost_critics")
    scalars = {
        "value_loss": "expectile loss of V_r",
        "critic_loss": "squared error of the Q_r, summed over the ensemble",
        "cost_value_loss": "expectile loss of V_c",
        "cost_critic_loss": "squared error of the Q_c, summed over the ensemble",
        "policy_loss": "minus the weighted log-likelihood of the recorded actions, averaged over the heads",
        "value_mean": "mean of V_r, in discounted reward",
        "cost_value_mean": "mean of V_c, in discounted cost",
    }

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        sizes, scale = (task.obs_dim, task.act_dim), reward_guess(task, config)
        (cost_scale,) = cost_guess(task, (config.gamma,))
        return super().build() | {
            "value": Value(task.obs_dim, config, scale),
            "cost_value": Value(task.obs_dim, config, cost_scale),
            "critics": Critics(*sizes, config, scale),
            "cost_critics": Critics(*sizes, config, cost_scale),
            "policy": PolicyHeads(*sizes, config),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, a = self.config, batch.actions
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)

        # IQL for the reward. Of two critics the lower value counts.
        q, v = net.target_critics(s, a).amin(0), net.value(s)  # (B,)
        value_loss = losses.expectile_loss(q, v, config.kappa_1)
        target = losses.td_target(batch.rewards, config.gamma, net.value(s_next), self.reward_mask(batch))
        critic_loss = losses.td_loss(target, net.critics(s, a))

        # IQL for the cost: low is good, so of two critics the higher cost counts ("Departures", point 4).
        q_cost, v_cost = net.target_cost_critics(s, a).amax(0), net.cost_value(s)
        cost_value_loss = losses.expectile_loss(q_cost, v_cost, 1 - config.kappa_1)
        mask = goes_on(batch, "mask")  # in CAPS's code nothing follows a time limit, as in OSRL
        target = losses.td_target(batch.costs, config.gamma, net.cost_value(s_next), mask)
        cost_critic_loss = losses.td_loss(target, net.cost_critics(s, a))

        # The heads clone the recorded actions, each with its own weights.
        reward_weight = losses.awr_weight(config.reward_factor * (q - v), config.awr_alpha)
        cost_weight = losses.awr_weight(v_cost - q_cost, config.awr_alpha)
        weights = head_weights(reward_weight, cost_weight, config.heads)
        log_prob = gaussian_log_prob(a.unsqueeze(-2), *net.policy(s))  # (B, heads)
        policy_loss = losses.policy_loss(weights, log_prob)

        of_networks = {"value": value_loss, "critic": critic_loss, "policy": policy_loss}
        of_networks |= {"cost_value": cost_value_loss, "cost_critic": cost_critic_loss}
        return of_networks, {"value_mean": v.mean(), "cost_value_mean": v_cost.mean()}

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0, t: int = 0) -> np.ndarray:
        """Returns the actions (E, act) at observations (E, obs) of step t. `limits` (E,) are what is left."""
        return self._switch(observations, limits, run, t)[0].cpu().numpy()

    def predicted_cost(
        self, observations: np.ndarray, limits: np.ndarray, run: int = 0, t: int = 0
    ) -> np.ndarray:
        """Returns the cost of the steps from t on that Q_c predicts for the action of the acting head, (E,).

        It is Q_c in the unit in which it is compared with the limit. `limits` (E,) are what is left.
        """
        q_cost = self._switch(observations, limits, run, t)[1]
        return (q_cost / average_threshold(1.0, self.config.gamma, self.task.horizon - t)).cpu().numpy()

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        return SwitchingPlayer(self, limits, run)

    def _switch(self, observations: np.ndarray, left: np.ndarray, run: int, t: int) -> tuple[Tensor, Tensor]:
        """Returns the actions (E, act) of the heads that act, and their Q_c (E,), in discounted cost."""
        with torch.no_grad():
            net, budget, heads = self.networks(run), self._tensor(left), self.config.heads
            s = self.network_input(net, self._tensor(observations), budget)
            actions, _ = net.policy(s)  # (E, heads, act)
            pairs = s.repeat_interleave(heads, 0), actions.flatten(0, 1)  # (E heads, obs), (E heads, act)
            q_reward = net.critics(*pairs).amin(0).view(-1, heads)
            q_cost = net.cost_critics(*pairs).amax(0).view(-1, heads)
            threshold = average_threshold(budget, self.config.gamma, self.task.horizon - t)
            chosen = choose_heads(q_reward, q_cost, threshold).unsqueeze(-1)  # (E, 1)
            return (
                actions.take_along_dim(chosen.unsqueeze(-1), 1).squeeze(1),
                q_cost.take_along_dim(chosen, 1).squeeze(1),
            )
