"""Values for a convex f with f'(0) = 0: V minimises E_mu f(Q - V) (eq. 9; IDQL, Hansen-Estruch et al. 2023).

An f with a kink at 0 will do, too, if 0 lies between its slopes on both sides: that of quantiles.
"""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.tabular.cmdp import CMDP

AT_ZERO = 1e-12
"""The smallest |u| in |f'(u)| / |u|, which is 0 / 0 at u = 0. A u nearer to 0 is replaced by this number."""


def expectile_slope(u: np.ndarray, kappa: float) -> np.ndarray:
    """f'(u) for f(u) = |kappa - 1(u < 0)| u^2 / 2, in the shape of u.

    Eq. 6 has no factor 1/2. A constant factor does not change the implicit policy.
    """
    return np.where(u < 0, 1 - kappa, kappa) * u


def quantile_slope(u: np.ndarray, kappa: float) -> np.ndarray:
    """f'(u) for f(u) = |kappa - 1(u < 0)| |u|, in the shape of u. This f has a kink at 0."""
    return np.where(u < 0, kappa - 1, kappa)


def linex_slope(u: np.ndarray, a: float) -> np.ndarray:
    """f'(u) for f(u) = exp(a u) - a u, in the shape of u."""
    return a * np.expm1(a * u)


def general_weight(slope: Callable, u: np.ndarray) -> np.ndarray:
    """|f'(u)| / |u| of eq. 10, in the shape of u. At u = 0 it is the limit from the right.

    `slope` is f'. Where the limit is infinite, the result is about 1e12.
    """
    away = np.where(np.abs(u) < AT_ZERO, AT_ZERO, u)
    return np.abs(slope(away)) / np.abs(away)


def general_value(behaviour: np.ndarray, q: np.ndarray, slope: Callable) -> np.ndarray:
    """V of eq. 9, (S,): where E_mu f'(Q - V) changes its sign, found by bisection.

    `behaviour` is mu and `q` is Q, both (S, A). `slope` is f', an increasing function. If f has a kink, V can
    be equal to one of the Q; then exactly this Q is returned.
    """
    supported = behaviour > 0
    low = np.where(supported, q, np.inf).min(1)
    high = np.where(supported, q, -np.inf).max(1)
    for _ in range(200):
        middle = (low + high) / 2
        above = (behaviour * slope(q - middle[:, None])).sum(1) > 0  # then V is larger than `middle`
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    nearest = np.abs(q - high[:, None]).argmin(1)
    on_it = q[np.arange(len(q)), nearest]
    return np.where(np.abs(on_it - high) < AT_ZERO * np.maximum(1, np.abs(high)), on_it, high)


def general_fixed_point(
    cmdp: CMDP, behaviour: np.ndarray, slope: Callable, steps: int = 2000
) -> tuple[np.ndarray, np.ndarray]:
    """Q (S, A) and V (S,) of eqs. 9 and 7 in the limit of infinite data from mu, by iteration.

    Raises ArithmeticError if they have not converged after `steps` iterations.
    """
    v = np.zeros(len(cmdp.initial))
    for _ in range(steps):
        q = cmdp.rewards + cmdp.gamma * cmdp.transitions @ v
        new = general_value(behaviour, q, slope)
        if np.abs(new - v).max() <= 1e-12 * max(1, np.abs(new).max()):
            return q, new
        v = new
    raise ArithmeticError(f"no fixed point after {steps} steps")


def in_sample_optimum(
    cmdp: CMDP, behaviour: np.ndarray, steps: int = 10_000
) -> tuple[np.ndarray, np.ndarray]:
    """The optimal Q (S, A) and V (S,) with the actions that have mu > 0, by value iteration.

    Raises ArithmeticError if they have not converged after `steps` iterations.
    """
    v = np.zeros(len(cmdp.initial))
    for _ in range(steps):
        q = cmdp.rewards + cmdp.gamma * cmdp.transitions @ v
        new = np.where(behaviour > 0, q, -np.inf).max(1)
        if np.abs(new - v).max() <= 1e-13 * max(1, np.abs(new).max()):
            return q, new
        v = new
    raise ArithmeticError(f"no fixed point after {steps} steps")
