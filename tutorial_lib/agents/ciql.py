"""Constrained implicit Q-learning (CIQL): IQL with a penalty on cost, and cost critics of its policy.

Sources: Section 3.1 of the C2IQL paper, equations 11 to 18.

Departures:

1. The departures of IQL.
2. In profile `small`, the value of an unsafe action is Q_r minus a price of its cost beyond the limit, in
   units of the advantages' spread (`price_unit`). In eq. 11 and in profile `paper` it is zero
   (`unsafe_price`).
3. In profile `small`, the cost critics learn the cost of a policy with the expectile of the one that acts
   (`cost_kappa`), and V_c learns from their mean (`evaluated_critic`).
4. The cost critics bootstrap through time limits (`time_limits`). The paper does not say what a time limit
   means.
5. There are two cost critics, and the higher cost counts (`cost_critics`). The paper does not say how many it
   has.

The consequences of departures 2, 4 and 5 were measured on C2IQL: see `data/README.md`.
"""

import torch
from torch import Tensor

from tutorial_lib import losses
from tutorial_lib.agents.implicit import ConstrainedAgent, ConstrainedConfig
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.networks import gaussian_log_prob


class CIQL(ConstrainedAgent):
    """CIQL, equations 11 to 18, for one limit L. The discounted cost is compared with L~ (eq. 2)."""

    name = "CIQL"
    Config = ConstrainedConfig
    needs_limit = True
    in_table1 = False

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, a, limit = self.config, batch.actions, batch.limit
        s = self.network_input(net, batch.observations, limit)
        s_next = self.network_input(net, batch.next_observations, limit)

        # The cost of an action: the highest of the cost critics, and at least the recorded step (eq. 16).
        q_cost = net.target_cost_critics(s, a)  # (k, B, 1)
        costs = self.episode_cost(net, q_cost)  # (k, B)
        cost, q_cost = costs.amax(0), self.evaluated_heads(q_cost, costs)  # (B,) and (B, 1)
        mask = self.cost_mask(batch)[:, None]
        cost_target = losses.td_target(batch.costs[:, None], config.gamma, net.cost_value(s_next), mask)
        if config.recorded_step:
            cost = torch.maximum(cost, self.episode_cost(net, cost_target.detach()))

        # Eq. 11: constraint penalisation.
        q_reward = net.target_critics(s, a).amin(0)
        v_cost = net.cost_value(s)  # (B, 1)
        state_cost = self.state_cost(net, v_cost)
        q = self.penalised_q(net, q_reward, cost, state_cost, limit)

        # Eq. 12: value function.
        v = net.value(s)
        value_loss = losses.expectile_loss(q, v, config.kappa_1)

        # Eq. 17: cost value function of the implicit policy that V_r above defines (Theorem 1).
        weight = losses.expectile_weight(q - v, config.evaluated_kappa)
        cost_value_loss = losses.cost_value_loss(weight, q_cost, v_cost)

        # Q-value function, and cost Q-value function.
        target = losses.td_target(batch.rewards, config.gamma, net.value(s_next), self.reward_mask(batch))
        critic_loss = losses.td_loss(target, net.critics(s, a))
        cost_critic_loss = losses.td_loss(cost_target, net.cost_critics(s, a))

        # Eq. 18: policy extraction.
        weight = losses.expectile_weight(q - v, config.kappa_2)
        policy_loss = losses.policy_loss(weight, gaussian_log_prob(a, *net.policy(s)))

        of_networks = {"value": value_loss, "cost_value": cost_value_loss, "critic": critic_loss}
        of_networks |= {"cost_critic": cost_critic_loss, "policy": policy_loss}
        return of_networks, self.logged(cost, limit, v, q_reward, state_cost)
