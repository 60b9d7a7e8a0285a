"""The losses of IQL, CIQL and C2IQL: pure functions of tensors, one per line of Algorithm 2.

B is the batch and m the number of cost discount factors. Every loss is a mean over its batch, and
gradients flow only into its *last* argument: what comes before it is a target.
"""

import torch
from torch import Tensor


def expectile_weight(advantage: Tensor, kappa: float) -> Tensor:
    """|kappa - 1(u < 0)|: the weight M of the implicit policy for f = L_2^kappa (Theorem 1), shape of u."""
    return torch.where(advantage < 0, 1 - kappa, kappa)


def awr_weight(advantage: Tensor, alpha: float) -> Tensor:
    """Eq. 8: exp(alpha u), at most 100 as in IQL's code, shape of u."""
    return torch.exp(alpha * advantage).clamp(max=100.0)


def expectile_loss(target: Tensor, value: Tensor, kappa: float) -> Tensor:
    """Eqs. 6 and 12: mean of |kappa - 1(u < 0)| u^2 with u = target - value; both (B,)."""
    assert target.shape == value.shape, (target.shape, value.shape)  # else they broadcast, in silence
    advantage = target.detach() - value
    return (expectile_weight(advantage, kappa).detach() * advantage.square()).mean()


def penalised_q(q_reward: Tensor, cost: Tensor, limit: Tensor) -> Tensor:
    """Eq. 11: Q_{r|c} = 1(cost <= limit) Q_r; all (B,). An infinite limit penalises nothing."""
    return torch.where(cost <= limit, q_reward, 0.0)


def priced_q(
    q_reward: Tensor, cost: Tensor, state_cost: Tensor, limit: Tensor, price: Tensor | float
) -> Tensor:
    """Ours: Q_r - price (excess of the action - excess of its state) over the limit; all (B,).

    Under eq. 11 all unsafe actions are worth the same, nothing. Here they are ranked, as by a Lagrange
    multiplier that acts beyond the limit only. The state's excess ranks nothing, but without it V_r would add
    up payments along the episode that no action can avoid.
    """
    return q_reward - price * ((cost - limit).clamp(min=0.0) - (state_cost - limit).clamp(min=0.0))


def td_target(reward: Tensor, gamma: Tensor | float, next_value: Tensor, mask: Tensor) -> Tensor:
    """Eqs. 7 and 16: r + gamma mask V(s'). For m cost heads: r, mask (B, 1), gamma (m,), V (B, m)."""
    return reward + gamma * mask * next_value


def td_loss(target: Tensor, q: Tensor) -> Tensor:
    """Lines 16 and 18: mean squared error of an ensemble, summed over it: target (B, ...), q (k, B, ...)."""
    assert target.shape == q.shape[1:], (target.shape, q.shape)
    return (target.detach() - q).square().mean(dim=tuple(range(1, q.ndim))).sum()


def cost_value_loss(weight: Tensor, q_cost: Tensor, value_cost: Tensor) -> Tensor:
    """Eq. 17: mean of M (Q_c - V_c)^2 with M the weight (B,) of the implicit policy; Q_c and V_c (B, m)."""
    assert q_cost.shape == value_cost.shape == (*weight.shape, q_cost.shape[-1])
    return (weight.detach().unsqueeze(-1) * (q_cost.detach() - value_cost).square()).mean()


def policy_loss(weight: Tensor, log_prob: Tensor) -> Tensor:
    """Eqs. 8 and 18 with the sign of Algorithm 2's line 20: -mean of weight log pi(a | s); both (B,)."""
    assert weight.shape == log_prob.shape, (weight.shape, log_prob.shape)
    return -(weight.detach() * log_prob).mean()
