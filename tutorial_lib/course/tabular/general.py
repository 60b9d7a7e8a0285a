"""IDQL's general f (eq. 9; Hansen-Estruch et al. 2023): V minimises E_mu f(Q - V), for a convex f."""

from collections.abc import Callable

import numpy as np

from tutorial_lib.course.tabular.cmdp import CMDP

AT_ZERO = 1e-12
"""|f'(u)| / |u| is 0 / 0 at u = 0. Nearer than this to 0, f'(u) is as at 0 and |u| is this."""


def expectile_slope(u, kappa: float):
    """f'(u) of f(u) = |kappa - 1(u < 0)| u^2 / 2, in the shape of u. (Eq. 6 has no half: no weight minds.)"""
    return np.where(u < 0, 1 - kappa, kappa) * u


def quantile_slope(u, kappa: float):
    """f'(u) of f(u) = |kappa - 1(u < 0)| |u|, which has a kink at 0, in the shape of u."""
    return np.where(u < 0, kappa - 1, kappa)


def linex_slope(u, a: float):
    """f'(u) of f(u) = exp(a u) - a u, in the shape of u."""
    return a * np.expm1(a * u)


def general_weight(slope: Callable, u: np.ndarray) -> np.ndarray:
    """Eq. 10's |f'(u)| / |u|, in the shape of u; at u = 0 its limit from the right (infinity: about 1e12)."""
    away = np.where(np.abs(u) < AT_ZERO, AT_ZERO, u)
    return np.abs(slope(away)) / np.abs(away)


def general_value(behaviour: np.ndarray, q: np.ndarray, slope: Callable) -> np.ndarray:
    """Eq. 9: the V where E_mu f'(Q - V) changes its sign, by bisection; (S, A) and (S, A) to (S,).

    `slope` is f', a rising function of u. Where f has a kink V may sit on one of the Q: that one is returned.
    """
    supported = behaviour > 0
    low = np.where(supported, q, np.inf).min(1)
    high = np.where(supported, q, -np.inf).max(1)
    for _ in range(200):
        middle = (low + high) / 2
        above = (behaviour * slope(q - middle[:, None])).sum(1) > 0  # V must grow
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    nearest = np.abs(q - high[:, None]).argmin(1)
    on_it = q[np.arange(len(q)), nearest]
    return np.where(np.abs(on_it - high) < AT_ZERO * np.maximum(1, np.abs(high)), on_it, high)


def general_fixed_point(cmdp: CMDP, behaviour: np.ndarray, slope: Callable, steps: int = 2000):
    """Eqs. 9 and 7 with all of mu's data: Q (S, A), V (S,). ArithmeticError if it does not settle."""
    v = np.zeros(len(cmdp.initial))
    for _ in range(steps):
        q = cmdp.rewards + cmdp.gamma * cmdp.transitions @ v
        new = general_value(behaviour, q, slope)
        if np.abs(new - v).max() <= 1e-12 * max(1, np.abs(new).max()):
            return q, new
        v = new
    raise ArithmeticError(f"no fixed point after {steps} steps")


def in_sample_optimum(cmdp: CMDP, behaviour: np.ndarray, steps: int = 10_000):
    """The best that actions with mu > 0 can do, by value iteration: Q (S, A) and V (S,)."""
    v = np.zeros(len(cmdp.initial))
    for _ in range(steps):
        q = cmdp.rewards + cmdp.gamma * cmdp.transitions @ v
        new = np.where(behaviour > 0, q, -np.inf).max(1)
        if np.abs(new - v).max() <= 1e-13 * max(1, np.abs(new).max()):
            return q, new
        v = new
    raise ArithmeticError(f"no fixed point after {steps} steps")
