"""The fixed points of IQL and CIQL, in the limit of infinite data from the behaviour policy mu."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.tabular.cmdp import CMDP


def expectile(behaviour: np.ndarray, q: np.ndarray, kappa: float) -> np.ndarray:
    """The exact solution of eq. 6: the kappa-expectile of Q over the actions of each state, (S,).

    `behaviour` is mu and `q` is Q, both (S, A). The expectile is a weighted mean of Q. With the actions in
    order of Q, the weights are 1 - kappa up to some action and kappa from there on. The right place is the
    one with the largest weighted mean (for kappa < 1/2 the smallest), because an expectile is a coherent risk
    measure.
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
    """The weight M = |kappa - 1(u < 0)| of Theorem 1 for advantages u, in the shape of u."""
    return np.where(advantage < 0, 1 - kappa, kappa)


def implicit_policy(behaviour: np.ndarray, q: np.ndarray, v: np.ndarray, weight: Callable) -> np.ndarray:
    """The implicit policy of Theorem 1, pi_imp = mu M / E_mu[M], (S, A).

    `behaviour` is mu (S, A), `q` is (S, A), `v` is (S,). `weight` maps the advantages q - v, (S, A), to M,
    (S, A).
    """
    weighted = behaviour * weight(q - v[:, None])
    return weighted / weighted.sum(1, keepdims=True)


def iql_fixed_point(
    cmdp: CMDP, behaviour: np.ndarray, kappa: float, gamma: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Q (S, A) and V (S,) of eqs. 6 and 7 in the limit of infinite data, by iteration.

    The iteration ends when no V changes by more than 1e-12 max(1, max |V|). The default of `gamma` is the
    CMDP's.
    """
    gamma = cmdp.gamma if gamma is None else gamma
    v, moved = np.zeros(len(cmdp.initial)), np.inf
    while moved > 1e-12 * max(1, np.abs(v).max()):
        before, q = v, cmdp.rewards + gamma * cmdp.transitions @ v
        v = expectile(behaviour, q, kappa)
        moved = np.abs(v - before).max()
    return q, v


def ciql_fixed_point(
    cmdp: CMDP,
    behaviour: np.ndarray,
    kappa: float,
    limit: float,
    gamma: float | None = None,
    steps: int = 5000,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Q_r (S, A), V_r (S,), Q_c (S, A) and V_c (S,) of eqs. 11 to 17 in the limit of infinite data.

    They are found by iteration. The penalty is zero, as in eq. 11. `limit` is the limit L~ on the discounted
    Q_c (eq. 2). All four are updated together and begin at zero. Raises ArithmeticError if they have not
    converged after `steps` iterations. There may be no fixed point: the indicator of eq. 11 depends on Q_c
    and changes Q_c, so that it can alternate between 0 and 1.
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
    raise ArithmeticError(
        f"no fixed point after {steps} steps: the indicator of eq. 11 flips between 0 and 1"
    )
