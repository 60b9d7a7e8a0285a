"""Implicit Q-learning (IQL). It maximises the reward only, and CIQL and C2IQL are built on it.

Sources: Kostrikov, Nair and Levine 2022; equations 6, 7 and 8 of the C2IQL paper.

Departures:

1. All networks step at once, on losses of the same parameters. IQL's code updates V first, then the policy,
   then Q. At these learning rates the difference is one step.
2. The target of Q ends at a time limit (`reward_time_limits`), as in OSRL's code. IQL's code bootstraps
   through it.
"""

from dataclasses import dataclass
from typing import Annotated

from torch import Tensor, nn

from tutorial_lib import losses
from tutorial_lib.agents.critic import reward_guess
from tutorial_lib.agents.implicit import ImplicitAgent, ImplicitConfig
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import NOT_NEGATIVE
from tutorial_lib.networks import Critics, Policy, Value, gaussian_log_prob


@dataclass(frozen=True)
class IQLConfig(ImplicitConfig):
    """The options of IQL."""

    awr_alpha: Annotated[float, NOT_NEGATIVE] = 3.0
    """The factor alpha of the policy extraction (eq. 8), for rewards that are scaled so that returns have a
    range of 1000. Both numbers are those of IQL's code."""


class IQL(ImplicitAgent):
    """IQL, equations 6, 7 and 8. It takes no limit, because it ignores the cost."""

    name = "IQL"
    Config = IQLConfig
    in_table1 = False
    scalars = {
        "value_loss": "expectile loss of V_r (eq. 6)",
        "critic_loss": "squared error of the Q_r, summed over the ensemble (eq. 7)",
        "policy_loss": "minus the weighted log-likelihood of the recorded actions (eq. 8)",
        "value_mean": "mean of V_r, in discounted reward",
    }
    config: IQLConfig

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        scale = reward_guess(task, config)
        return super().build() | {
            "value": Value(task.obs_dim, config, scale),
            "critics": Critics(task.obs_dim, task.act_dim, config, scale),
            "policy": Policy(task.obs_dim, task.act_dim, config),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, a = self.config, batch.actions
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)

        # Eq. 6: value function.
        q = net.target_critics(s, a).amin(0)
        v = net.value(s)
        value_loss = losses.expectile_loss(q, v, config.kappa_1)

        # Eq. 7: Q-value function.
        target = losses.td_target(batch.rewards, config.gamma, net.value(s_next), self.reward_mask(batch))
        critic_loss = losses.td_loss(target, net.critics(s, a))

        # Eq. 8: policy extraction.
        advantage = (q - v) * 1000 / (self.task.max_return - self.task.min_return)
        weight = losses.awr_weight(advantage, config.awr_alpha)
        policy_loss = losses.policy_loss(weight, gaussian_log_prob(a, *net.policy(s)))

        return {"value": value_loss, "critic": critic_loss, "policy": policy_loss}, {"value_mean": v.mean()}
