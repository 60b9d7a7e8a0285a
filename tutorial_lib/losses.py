"""The losses of IQL, CIQL and C2IQL. They are pure functions of tensors, one for each line of Algorithm 2.

B is the batch size and m is the number of cost discount factors. Every loss is a mean over the batch. Its
gradient flows only into its *last* argument, because the arguments before it are targets or weights. A loss
raises AssertionError where the shapes of its arguments do not fit.
"""

import torch
from torch import Tensor


def expectile_weight(advantage: Tensor, kappa: float) -> Tensor:
    """Returns |kappa - 1(u < 0)| for the advantage u, with the shape of u.

    This is the weight M of the implicit policy for f = L_2^kappa (Theorem 1).
    """
    return torch.where(advantage < 0, 1 - kappa, kappa)


def awr_weight(advantage: Tensor, alpha: float) -> Tensor:
    """Returns min(exp(alpha u), 100) for the advantage u, with the shape of u (eq. 8).

    The bound of 100 is that of IQL's code.
    """
    return torch.exp(alpha * advantage).clamp(max=100.0)


def expectile_loss(target: Tensor, value: Tensor, kappa: float) -> Tensor:
    """Returns the mean of |kappa - 1(u < 0)| u^2 with u = target - value, both (B,) (eqs. 6 and 12)."""
    assert target.shape == value.shape, (target.shape, value.shape)  # otherwise they would broadcast
    advantage = target.detach() - value
    return (expectile_weight(advantage, kappa).detach() * advantage.square()).mean()


def penalised_q(q_reward: Tensor, cost: Tensor, limit: Tensor) -> Tensor:
    """Returns Q_{r|c} = 1(cost <= limit) Q_r, (B,), for arguments of shape (B,) (eq. 11).

    `cost` and `limit` have the same unit. An infinite limit penalises no action.
    """
    return torch.where(cost <= limit, q_reward, 0.0)


def priced_q(
    q_reward: Tensor, cost: Tensor, state_cost: Tensor, limit: Tensor, price: Tensor | float
) -> Tensor:
    """Returns Q_r - price (max(0, cost - limit) - max(0, state_cost - limit)), (B,). It is not in the paper.

    All arguments are (B,). `cost` is the expected cost of the action and `state_cost` is that of its state.
    They have the unit of `limit`. `price` is in discounted reward per unit of cost.

    Under eq. 11 all unsafe actions have the same value, zero. With a price they are ranked, as by a Lagrange
    multiplier that acts only beyond the limit. The state's excess does not change the order of the actions.
    Without it, V_r would sum payments along the episode that no action can avoid.
    """
    return q_reward - price * ((cost - limit).clamp(min=0.0) - (state_cost - limit).clamp(min=0.0))


def spread(values: Tensor, weight: Tensor) -> Tensor:
    """Returns the standard deviation of values (B,) with weights (B,) that are not negative, ().

    It is zero where all weights are.
    """
    weight = weight / weight.sum().clamp(min=1e-6)
    mean = (weight * values).sum()
    return (weight * (values - mean).square()).sum().sqrt()


def td_target(reward: Tensor, gamma: Tensor | float, next_value: Tensor, mask: Tensor) -> Tensor:
    """Returns r + gamma mask V(s') (eqs. 7 and 16). `mask` is 0 where nothing follows, and 1 elsewhere.

    For rewards, r, mask and V are (B,). For m cost heads, r and mask are (B, 1), gamma is (m,) and V is
    (B, m).
    """
    return reward + gamma * mask * next_value


def td_loss(target: Tensor, q: Tensor) -> Tensor:
    """Returns the mean squared error of each of k critics, summed over the critics (lines 16 and 18).

    `target` is (B, ...) and `q` is (k, B, ...).
    """
    assert target.shape == q.shape[1:], (target.shape, q.shape)
    return (target.detach() - q).square().mean(dim=tuple(range(1, q.ndim))).sum()


def cost_value_loss(weight: Tensor, q_cost: Tensor, value_cost: Tensor) -> Tensor:
    """Returns the mean of M (Q_c - V_c)^2 (eq. 17).

    `weight` (B,) is the weight M of the implicit policy. Q_c and V_c are (B, m).
    """
    assert q_cost.shape == value_cost.shape == (*weight.shape, q_cost.shape[-1])
    return (weight.detach().unsqueeze(-1) * (q_cost.detach() - value_cost).square()).mean()


def policy_loss(weight: Tensor, log_prob: Tensor) -> Tensor:
    """Returns minus the mean of weight log pi(a | s), both (B,) (eqs. 8 and 18).

    The sign is that of line 20 of Algorithm 2.
    """
    assert weight.shape == log_prob.shape, (weight.shape, log_prob.shape)
    return -(weight.detach() * log_prob).mean()
