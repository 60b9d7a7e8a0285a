"""Constrained implicit Q-learning (CIQL): IQL with a penalty, and costs under the same implicit policy.

Sources: Section 3.1 of the C2IQL paper, equations 11 to 18.

Departures: those of IQL, and the options of `ConstrainedConfig` where profile `small` changes them: a price
    in the
place of eq. 11's zero (`unsafe_price`), and the recorded step (`recorded_step`). Profile `paper` has neither.
"""

import torch

from tutorial_lib import losses
from tutorial_lib.agents.implicit import ConstrainedAgent, ConstrainedConfig
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.networks import gaussian_log_prob


class CIQL(ConstrainedAgent):
    """Equations 11 to 18 for one limit L: costs are discounted once and compared with L~ (eq. 2)."""

    name = "CIQL"
    Config = ConstrainedConfig
    needs_limit = True
    in_table1 = False

    def episode_cost(self, q_cost):
        """Discounted costs (..., 1) over L~ / L (eq. 2), (...,): comparing them with L is Q_c against L~."""
        gamma, horizon = self.config.gamma, self.task.horizon
        if self.config.time_limits == "rate":  # bootstrapped for ever: keep the first T steps' share
            q_cost = q_cost * (1 - gamma**horizon)
        return q_cost.squeeze(-1) / average_threshold(1.0, gamma, horizon)

    def losses(self, net, batch):
        config, a, limit = self.config, batch.actions, batch.limit
        s = self.network_input(net, batch.observations, limit)
        s_next = self.network_input(net, batch.next_observations, limit)

        # What an action costs: the highest of the cost critics, and no less than the recorded step (eq. 16).
        q_cost = net.target_cost_critics(s, a).amax(0)  # (B, 1)
        cost = self.episode_cost(q_cost)
        mask = self.cost_mask(batch)[:, None]
        cost_target = losses.td_target(batch.costs[:, None], config.gamma, net.cost_value(s_next), mask)
        if config.recorded_step:
            cost = torch.maximum(cost, self.episode_cost(cost_target.detach()))

        # Eq. 11: constraint penalisation.
        q_reward = net.target_critics(s, a).amin(0)
        v_cost = net.cost_value(s)  # (B, 1)
        q = self.penalised_q(net, q_reward, cost, v_cost, limit)

        # Eq. 12: value function.
        v = net.value(s)
        value_loss = losses.expectile_loss(q, v, config.kappa_1)

        # Eq. 17: cost value function, under the implicit policy of the line above (Theorem 1).
        weight = losses.expectile_weight(q - v, config.evaluated_kappa)
        cost_value_loss = losses.cost_value_loss(weight, q_cost, v_cost)

        # Q-value function, and cost Q-value function.
        target = losses.td_target(batch.rewards, config.gamma, net.value(s_next), self.reward_mask(batch))
        critic_loss = losses.td_loss(target, net.critics(s, a))
        cost_critic_loss = losses.td_loss(cost_target, net.cost_critics(s, a))

        # Eq. 18: policy extraction.
        weight = losses.expectile_weight(q - v, config.kappa_2)
        policy_loss = losses.policy_loss(weight, gaussian_log_prob(a, *net.policy(s)))

        return {
            "value": value_loss,
            "cost_value": cost_value_loss,
            "critic": critic_loss,
            "cost_critic": cost_critic_loss,
            "policy": policy_loss,
        }, {
            "safe_fraction": (cost <= limit).float().mean(),
            "value_mean": v.mean(),
            "negative_q": (q_reward < 0).float().mean(),
        }
