"""Cloning weighted by advantage: a template. Copy this file to tutorial_lib/agents/, and change it.

Sources: Wang et al. 2018 (MARWIL), equations 1 to 3; Peng et al. 2019 (AWR).

Departures:

1. The value function learns from r + gamma V(s'), not from whole returns. It has less variance, and it is
   biased while V is wrong. What this changes in the results was not measured.
"""

from dataclasses import dataclass
from typing import Annotated

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, reward_guess
from tutorial_lib.agents.seeds import Rates
from tutorial_lib.config import NOT_NEGATIVE
from tutorial_lib.networks import Policy, Value, gaussian_log_prob


@dataclass(frozen=True)
class WeightedCloningConfig(CriticConfig):
    """The options of weighted cloning."""

    greed: Annotated[float, NOT_NEGATIVE] = 10.0
    """Factor of the advantage in the weight's exponent, where advantages are in mean returns-to-go. 0 clones
    every action alike."""


class WeightedCloning(CriticAgent):
    """Clones the recorded actions, and those more that did better than expected. It takes no limit."""

    name = "Weighted cloning"
    Config = WeightedCloningConfig
    targets = ("value",)
    scalars = {
        "value_loss": "half the mean squared error of V_r",
        "policy_loss": "minus the weighted log-likelihood of the recorded actions",
        "weight_mean": "mean weight of the recorded actions",
    }
    config: WeightedCloningConfig

    def build(self):
        task, config = self.task, self.config
        return super().build() | {
            "value": Value(task.obs_dim, config, reward_guess(task, config)),
            "policy": Policy(task.obs_dim, task.act_dim, config),
        }

    def optimiser(self, name):
        return Rates(self.config.policy_lr, cosine=True) if name == "policy" else Rates(self.config.critic_lr)

    def losses(self, net, batch):
        config = self.config
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)

        following, mask = net.target_value(s_next), self.reward_mask(batch)
        target = losses.td_target(batch.rewards, config.gamma, following, mask)
        v = net.value(s)  # (B,)
        value_loss = losses.expectile_loss(target, v, kappa=0.5)

        weight = losses.awr_weight((target - v) / net.reward_scale, config.greed)
        policy_loss = losses.policy_loss(weight, gaussian_log_prob(batch.actions, *net.policy(s)))
        return {"value": value_loss, "policy": policy_loss}, {"weight_mean": weight.mean()}
