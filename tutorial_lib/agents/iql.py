"""Implicit Q-learning (Kostrikov et al. 2022), for rewards only: what CIQL and C2IQL start from."""

from tutorial_lib import losses as L
from tutorial_lib.agents.agent import Agent, reward_guess
from tutorial_lib.networks import Critics, Policy, Value, gaussian_log_prob


class IQL(Agent):
    """Equations 6, 7 and 8. It takes no cost limit: it is the family's unconstrained member."""

    name = "IQL"
    constrained = False
    targets = ("critics",)

    def build(self):
        task, config = self.task, self.config
        scale = reward_guess(task, config)
        return {
            "value": Value(task.obs_dim, config, scale),
            "critics": Critics(task.obs_dim, task.act_dim, config, scale),
            "policy": Policy(task.obs_dim, task.act_dim, config),
        }

    def losses(self, net, batch, limit):
        a = batch.actions
        s, s_next = (self.network_input(x, limit) for x in (batch.observations, batch.next_observations))

        q = net.target_critics(s, a).amin(0)
        v = net.value(s)
        value_loss = L.expectile_loss(q, v, self.config.kappa_1)  # eq. 6

        mask = self.reward_mask(batch)
        target = L.td_target(batch.rewards, self.config.gamma, net.value(s_next), mask)  # eq. 7
        critic_loss = L.td_loss(target, net.critics(s, a))

        weight = L.awr_weight(
            (q - v) * 1000 / (self.task.max_return - self.task.min_return), self.config.awr_alpha
        )
        policy_loss = L.policy_loss(weight, gaussian_log_prob(a, *net.policy(s)))  # eq. 8

        losses = {"value": value_loss, "critic": critic_loss, "policy": policy_loss}
        return losses, {"value_mean": v.mean()}
