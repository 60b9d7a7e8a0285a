"""What implicit Q-learning converges to, with all of the behaviour policy's data."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.tabular.cmdp import CMDP


def expectile(behaviour: np.ndarray, q: np.ndarray, kappa: float) -> np.ndarray:
    """Eq. 6 solved exactly: the kappa-expectile of Q over the actions of each state, (S, A) -> (S,).

    The weights kappa and 1 - kappa split the sorted actions somewhere; the true split is the one with the
    largest weighted mean (the smallest, for kappa < 1/2), because an expectile is a coherent risk measure.
    """
    order = q.argsort(axis=1)
    q, mu = np.take_along_axis(q, order, 1), np.take_along_axis(behaviour, order, 1)
    split = np.arange(q.shape[1])
    weights = np.where(split[None, :] < split[:, None], 1 - kappa, kappa)  # (splits, A)
    mass = mu @ weights.T
    means = (mu * q) @ weights.T / np.where(mass > 0, mass, 1)
    means = np.where(mass > 0, means, means[:, :1])
    return means.max(1) if kappa >= 0.5 else means.min(1)


def expectile_weight(advantage: np.ndarray, kappa: float) -> np.ndarray:
    """M = |kappa - 1(u < 0)| of Theorem 1, in the shape of u."""
    return np.where(advantage < 0, 1 - kappa, kappa)


def implicit_policy(behaviour: np.ndarray, q: np.ndarray, v: np.ndarray, weight: Callable) -> np.ndarray:
    """Theorem 1: pi_imp = mu M / E_mu[M], (S, A). `weight` maps the advantages q - v to M, both (S, A)."""
    weighted = behaviour * weight(q - v[:, None])
    return weighted / weighted.sum(1, keepdims=True)


def iql_fixed_point(cmdp: CMDP, behaviour: np.ndarray, kappa: float, gamma=None):
    """Eqs. 6 and 7 with all of mu's data: Q (S, A) and V (S,), by iteration until nothing moves by 1e-12."""
    gamma = cmdp.gamma if gamma is None else gamma
    v, moved = np.zeros(len(cmdp.initial)), np.inf
    while moved > 1e-12 * max(1, np.abs(v).max()):
        before, q = v, cmdp.rewards + gamma * cmdp.transitions @ v
        v = expectile(behaviour, q, kappa)
        moved = np.abs(v - before).max()
    return q, v


def ciql_fixed_point(
    cmdp: CMDP, behaviour: np.ndarray, kappa: float, limit: float, gamma=None, steps: int = 5000
):
    """Eqs. 11 to 17 with all of mu's data and the zero penalty: Q_r (S, A), V_r (S,), Q_c (S, A), V_c (S,).

    `limit` bounds the discounted Q_c (the L~ of eq. 2). All four are updated together, from zero. Raises
    ArithmeticError if something still moves after `steps`: where the indicator of eq. 11 flips to and fro,
    because it decides about the very cost that it looks at, there need not be a fixed point.
    """
    gamma = cmdp.gamma if gamma is None else gamma
    v_r = v_c = np.zeros(len(cmdp.initial))
    for _ in range(steps):
        q_r = cmdp.rewards + gamma * cmdp.transitions @ v_r
        q_c = cmdp.costs + gamma * cmdp.transitions @ v_c
        penalised = np.where(q_c <= limit, q_r, 0.0)
        new_r = expectile(behaviour, penalised, kappa)
        policy = implicit_policy(behaviour, penalised, new_r, lambda u: expectile_weight(u, kappa))
        new_c = (policy * q_c).sum(1)
        moved = max(np.abs(new_r - v_r).max(), np.abs(new_c - v_c).max())
        if moved <= 1e-12 * max(1, np.abs(q_r).max(), np.abs(q_c).max()):
            return q_r, new_r, q_c, new_c
        v_r, v_c = new_r, new_c
    raise ArithmeticError(f"no fixed point after {steps} steps: the indicator of eq. 11 flips to and fro")
