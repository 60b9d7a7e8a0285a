"""Constrained implicit Q-learning (Section 3.1): IQL with a penalty, and costs under the same policy."""

import torch

from tutorial_lib import losses as L
from tutorial_lib.agents.agent import Agent, cost_guess, reward_guess
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.networks import Critics, Policy, Value, gaussian_log_prob


class CIQL(Agent):
    """Equations 11 to 18 for one threshold L: costs are discounted once and compared with L~ (eq. 2)."""

    name = "CIQL"
    can_price = True
    targets = ("critics", "cost_critics")

    def build(self):
        task, config = self.task, self.config
        scale = reward_guess(task, config)
        cost_scale = cost_guess(task, (config.gamma,))
        return {
            "value": Value(task.obs_dim, config, scale),
            "cost_value": Value(task.obs_dim, config, cost_scale),
            "critics": Critics(task.obs_dim, task.act_dim, config, scale),
            "cost_critics": Critics(task.obs_dim, task.act_dim, config, cost_scale, k=config.cost_critics),
            "policy": Policy(task.obs_dim, task.act_dim, config),
        }

    def prepare(self, dataset, progress=True):
        super().prepare(dataset, progress)
        self.guess_costs(dataset)

    def episode_cost(self, q_cost):
        """Discounted costs (..., 1) over L~ / L (eq. 2), (...,): comparing them with L is Q_c against L~."""
        gamma, horizon = self.config.gamma, self.task.horizon
        if self.config.time_limits == "rate":  # bootstrapped for ever: keep the first T steps' share
            q_cost = q_cost * (1 - gamma**horizon)
        return q_cost.squeeze(-1) / average_threshold(1.0, gamma, horizon)

    def losses(self, net, batch, limit):
        config, a = self.config, batch.actions
        s, s_next = (self.network_input(x, limit) for x in (batch.observations, batch.next_observations))

        q_cost = net.target_cost_critics(s, a).amax(0)  # (B, 1)
        cost = self.episode_cost(q_cost)
        cost_target = L.td_target(
            batch.costs[:, None], config.gamma, net.cost_value(s_next), self.cost_mask(batch)[:, None]
        )  # eq. 16
        if config.recorded_step:
            cost = torch.maximum(cost, self.episode_cost(cost_target.detach()))
        q_reward = net.target_critics(s, a).amin(0)
        v_cost = net.cost_value(s)  # (B, 1)
        q = self.penalised_q(q_reward, cost, v_cost, limit)  # eq. 11
        v = net.value(s)
        value_loss = L.expectile_loss(q, v, config.kappa_1)  # eq. 12

        weight = L.expectile_weight(q - v, config.evaluated_kappa)  # Theorem 1
        cost_value_loss = L.cost_value_loss(weight, q_cost, v_cost)  # eq. 17

        target = L.td_target(batch.rewards, config.gamma, net.value(s_next), self.reward_mask(batch))
        critic_loss = L.td_loss(target, net.critics(s, a))

        cost_critic_loss = L.td_loss(cost_target, net.cost_critics(s, a))

        weight = L.expectile_weight(q - v, config.kappa_2)
        policy_loss = L.policy_loss(weight, gaussian_log_prob(a, *net.policy(s)))  # eq. 18
        losses = {
            "value": value_loss,
            "cost_value": cost_value_loss,
            "critic": critic_loss,
            "cost_critic": cost_critic_loss,
            "policy": policy_loss,
        }
        return losses, {
            "safe_fraction": (cost <= limit).float().mean(),
            "value_mean": v.mean(),
            "negative_q": (q_reward < 0).float().mean(),
        }
