"""Optimal policies under a limit on the expected cost, or on the cost of every episode."""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from tutorial_lib.course.tabular.cmdp import CMDP, Episodes, draw


class Solution(NamedTuple):
    """An optimal policy under a limit, with its values. With a horizon T, (S, A) is (T, S, A)."""

    policy: np.ndarray
    """(S, A). It is uniform in states that it never visits."""
    reward: float
    """The expected sum of rewards."""
    cost: float
    """The expected sum of costs."""
    price: float
    """The Lagrange multiplier of the limit: the reward that one more unit of limit would add."""
    occupancy: np.ndarray
    """The occupancy of the policy, (S, A)."""


def solve(cmdp: CMDP, limit: float = np.inf) -> Solution:
    """The solution of eq. 2, by a linear programme over occupancies (Altman 1999).

    `limit` is the limit on the discounted cost. Raises ValueError, which says the least achievable cost, if
    no policy keeps the limit.
    """
    return _solve(cmdp.transitions, cmdp.rewards, cmdp.costs, cmdp.initial, cmdp.gamma, limit)


def least_cost(cmdp: CMDP) -> float:
    """The least discounted cost of all policies. No policy keeps a smaller limit."""
    return solve(dataclasses.replace(cmdp, rewards=-cmdp.costs)).cost


def solve_priced(cmdp: CMDP, price: float) -> Solution:
    """The best policy where each unit of discounted cost costs `price` >= 0 of reward, and no limit is set.

    It maximises R - price * C, which is the Lagrangian of eq. 2 without its constant price * limit. The
    solution has the policy's own reward R and cost C. Raises ValueError for a price that is negative or NaN.
    """
    if not price >= 0:
        raise ValueError(f"the price of a limit is at least 0, not {price}")
    found = solve(dataclasses.replace(cmdp, rewards=cmdp.rewards - price * cmdp.costs))
    return found._replace(reward=float((found.occupancy * cmdp.rewards).sum()), price=price)


def solve_episodes(cmdp: CMDP, horizon: int, limit: float = np.inf) -> Solution:
    """The solution of eq. 1: the largest expected return of T = `horizon` steps under a limit.

    The limit is on the expected cost. Both sums are undiscounted. The policy, (T, S, A), depends on the step.
    Raises ValueError, which says the least achievable cost, if no policy keeps the limit.
    """
    states, actions = cmdp.rewards.shape
    steps = np.zeros((horizon, states, actions, horizon, states))
    for t in range(horizon - 1):  # the last step leads nowhere
        steps[t, :, :, t + 1] = cmdp.transitions
    unrolled = steps.reshape(horizon * states, actions, horizon * states)
    initial = np.concatenate([cmdp.initial, np.zeros((horizon - 1) * states)])
    rewards, costs = (np.tile(signal, (horizon, 1)) for signal in (cmdp.rewards, cmdp.costs))
    found = _solve(unrolled, rewards, costs, initial, 1.0, limit)
    shape = horizon, states, actions
    return found._replace(policy=found.policy.reshape(shape), occupancy=found.occupancy.reshape(shape))


def _solve(
    transitions: np.ndarray,
    rewards: np.ndarray,
    costs: np.ndarray,
    initial: np.ndarray,
    gamma: float,
    limit: float,
) -> Solution:
    """The linear programme of `solve`, for the arrays of a CMDP. Here gamma may be 1."""
    states, actions = rewards.shape
    leaving = np.repeat(np.eye(states), actions, axis=0)  # (S A, S): a visit of (s, a) leaves s,
    flow = (leaving - gamma * transitions.reshape(-1, states)).T  # and enters the next state, discounted
    limited = {"A_ub": costs.reshape(1, -1), "b_ub": [limit]} if np.isfinite(limit) else {}
    found = linprog(-rewards.ravel(), **limited, A_eq=flow, b_eq=initial, method="highs")
    if found.status == 2:
        least = linprog(costs.ravel(), A_eq=flow, b_eq=initial, method="highs").fun
        raise ValueError(f"no policy keeps the limit {limit:g}: the least achievable cost is {least:.6g}")
    if found.status:
        raise ArithmeticError(found.message)
    visits = found.x.reshape(states, actions).clip(min=0)
    total = visits.sum(1, keepdims=True)
    seen = total > 1e-9
    policy = np.where(seen, visits / np.where(seen, total, 1), 1 / actions)
    price = float(-found.ineqlin.marginals[0]) if limited else 0.0
    return Solution(policy, float((rewards * visits).sum()), float((costs * visits).sum()), price, visits)


def budget_optimum(
    cmdp: CMDP, horizon: int, budget: int, stopped: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The optimal values and actions if *every* episode must keep a budget.

    They are found by recursion over step, budget and state. Sums are undiscounted (eq. 1), and costs are
    whole numbers. The values, (T+1, budget+1, S), are the expected sums of rewards from step t on, with b of
    the budget left. The actions are (T, budget+1, S) int. An action that costs more than b is not allowed.
    Where no action is allowed, the episode is stopped: the value is `stopped` and the action is -1. With
    `stopped=-inf` stopping is forbidden, and the value is -inf where no policy is certain to keep the budget.
    Raises ValueError for costs that are negative or not whole.
    """
    if (cmdp.costs < 0).any() or (cmdp.costs % 1).any():
        raise ValueError("a budget is counted in whole costs: they must be 0, 1, 2, ...")
    states, actions = cmdp.rewards.shape
    values = np.zeros((horizon + 1, budget + 1, states))
    policy = np.full((horizon, budget + 1, states), -1)
    reach = cmdp.transitions > 0
    for t in reversed(range(horizon)):
        for b in range(budget + 1):
            left = b - cmdp.costs.astype(int)  # (S, A)
            then = values[t + 1, left.clip(min=0)]  # (S, A, S)
            expected = np.where(reach, cmdp.transitions * np.where(reach, then, 0), 0).sum(-1)
            q = np.where(left >= 0, cmdp.rewards + expected, -np.inf)
            best = q.argmax(1)
            values[t, b] = np.where(left.max(1) >= 0, q.max(1), stopped)
            policy[t, b] = np.where(left.max(1) >= 0, best, -1)
    return values, policy


def play_budget(cmdp: CMDP, policy: np.ndarray, n: int, rng: np.random.Generator) -> Episodes:
    """Simulate n episodes of the actions of `budget_optimum`, (T, budget+1, S), from the full budget.

    After an episode is stopped, its rewards and costs are 0.
    """
    horizon, levels, _ = policy.shape
    states, actions = np.zeros((2, n, horizon), int)
    rewards, costs = np.zeros((2, n, horizon))
    state, left, runs = draw(np.tile(cmdp.initial, (n, 1)), rng), np.full(n, levels - 1), np.ones(n, bool)
    for t in range(horizon):
        action = policy[t, left, state]
        runs = runs & (action >= 0)
        states[:, t], actions[:, t] = state, np.where(runs, action, -1)
        rewards[:, t] = np.where(runs, cmdp.rewards[state, action], 0)
        costs[:, t] = np.where(runs, cmdp.costs[state, action], 0)
        left = left - costs[:, t].astype(int)
        state = np.where(runs, draw(cmdp.transitions[state, action], rng), state)
    return Episodes(states, actions, rewards, costs)
