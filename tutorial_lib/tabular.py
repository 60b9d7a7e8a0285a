"""Constrained Markov decision processes small enough to solve exactly: the ground truth of the course.

S states, A actions, float64 throughout. A policy is an (S, A) array of probabilities. Values and limits here
are discounted sums (eq. 2) unless a horizon is given; then they are the plain sums of eq. 1.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog


@dataclass(frozen=True)
class CMDP:
    """Section 2.1: transitions (S, A, S), rewards and costs (S, A), initial distribution (S,), and gamma.

    Raises ValueError where shapes do not fit, a distribution does not sum to 1, or gamma is not in (0, 1).
    """

    transitions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    initial: np.ndarray
    gamma: float

    def __post_init__(self):
        states, actions = self.rewards.shape
        shapes = self.transitions.shape, self.costs.shape, self.initial.shape
        if shapes != ((states, actions, states), (states, actions), (states,)):
            raise ValueError(f"shapes {shapes} of transitions, costs, initial do not fit the rewards")
        for name in ("transitions", "initial"):
            chances = getattr(self, name)
            if (chances < 0).any() or not np.allclose(chances.sum(-1), 1):
                raise ValueError(f"{name}: some probabilities are negative or do not sum to 1")
        if not 0 < self.gamma < 1:
            raise ValueError(f"gamma must lie in (0, 1), not {self.gamma}")


# --- Examples ---

ARROWS = ("↑", "→", "↓", "←")
_MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
# S start, G goal, h hazard. Three ways lead to the goal: straight through the hazards (4 steps, 3 of them
# hazardous), over the middle row (6 steps, 1 hazardous), and around (8 steps, none).
SHORTCUT = ("     ", "  h  ", "ShhhG")


def shortcut(slip: float = 0.1, gamma: float = 0.9, layout=SHORTCUT) -> CMDP:
    """The course's running example: a grid where the short way is hazardous. S = cells, A = 4 (`ARROWS`).

    A step taken on a hazard costs 1, a step taken on the goal earns 1, and the goal is never left. With
    probability `slip` a move goes in a random one of the four directions, and one off the grid stays put.
    State row * columns + column is the cell (row, column) of `layout`.
    """
    rows, columns = len(layout), len(layout[0])
    cells = np.array([list(row) for row in layout]).ravel()
    transitions = np.zeros((len(cells), 4, len(cells)))
    for state in range(len(cells)):
        for action in range(4):
            for move, (down, right) in enumerate(_MOVES):
                chance = slip / 4 + (1 - slip) * (move == action)
                row = min(max(state // columns + down, 0), rows - 1)
                column = min(max(state % columns + right, 0), columns - 1)
                transitions[state, action, row * columns + column] += chance
    goal = cells == "G"
    transitions[goal] = np.eye(len(cells))[goal, None]
    per_state = [np.repeat((cells == kind)[:, None].astype(float), 4, axis=1) for kind in "Gh"]
    return CMDP(transitions, *per_state, (cells == "S").astype(float), gamma)


corridor = shortcut


def random_cmdp(
    rng: np.random.Generator, states: int = 6, actions: int = 3, gamma: float = 0.9, branching: int = 3
) -> CMDP:
    """A random one: every action leads to `branching` states, rewards are uniform on (0, 1), costs 0 or 1."""
    transitions = np.zeros((states, actions, states))
    for row in transitions.reshape(-1, states):
        row[rng.permutation(states)[:branching]] = rng.dirichlet(np.ones(branching))
    rewards = rng.random((states, actions))
    costs = (rng.random((states, actions)) < 0.4).astype(float)
    return CMDP(transitions, rewards, costs, rng.dirichlet(np.ones(states)), gamma)


# --- A given policy ---


def state_values(cmdp: CMDP, policy: np.ndarray, signal: str = "rewards", gamma=None) -> np.ndarray:
    """V_r or V_c of a policy, (S,): the solution of V = r_pi + gamma P_pi V. `signal`: rewards or costs."""
    gamma = cmdp.gamma if gamma is None else gamma
    step = np.einsum("sa,saz->sz", policy, cmdp.transitions)
    return np.linalg.solve(np.eye(len(step)) - gamma * step, (policy * getattr(cmdp, signal)).sum(1))


def action_values(cmdp: CMDP, policy: np.ndarray, signal: str = "rewards", gamma=None) -> np.ndarray:
    """Q_r or Q_c of a policy, (S, A)."""
    gamma = cmdp.gamma if gamma is None else gamma
    return getattr(cmdp, signal) + gamma * cmdp.transitions @ state_values(cmdp, policy, signal, gamma)


def occupancy(cmdp: CMDP, policy: np.ndarray) -> np.ndarray:
    """Expected discounted visits d(s, a) = sum_t gamma^t P(s_t = s, a_t = a), (S, A); sums to 1/(1-gamma)."""
    step = np.einsum("sa,saz->sz", policy, cmdp.transitions)
    visits = np.linalg.solve(np.eye(len(step)) - cmdp.gamma * step.T, cmdp.initial)
    return visits[:, None] * policy


class Episodes(NamedTuple):
    """n simulated episodes of T steps, each field (n, T)."""

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray


def simulate(cmdp: CMDP, policy: np.ndarray, horizon: int, n: int, rng: np.random.Generator) -> Episodes:
    """Play a policy, (S, A), or one per step, (horizon, S, A)."""
    policy = np.broadcast_to(policy, (horizon, *cmdp.rewards.shape))
    states, actions = np.zeros((2, n, horizon), int)
    state = _draw(np.tile(cmdp.initial, (n, 1)), rng)
    for t in range(horizon):
        states[:, t], actions[:, t] = state, _draw(policy[t, state], rng)
        state = _draw(cmdp.transitions[state, actions[:, t]], rng)
    return Episodes(states, actions, cmdp.rewards[states, actions], cmdp.costs[states, actions])


def _draw(chances, rng):
    """One index from each row of probabilities, (n, k) -> (n,)."""
    below = chances.cumsum(1) < rng.random((len(chances), 1))
    return np.minimum(below.sum(1), chances.shape[1] - 1)


# --- The best policy under a limit ---


class Solution(NamedTuple):
    """An optimal policy, (S, A), with what it earns and costs, and the price of its limit.

    `price` is the limit's Lagrange multiplier: what one more unit of limit would earn. `occupancy` is the
    policy's own, (S, A). With a horizon both are (T, S, A). Where the policy never comes, it is uniform.
    """

    policy: np.ndarray
    reward: float
    cost: float
    price: float
    occupancy: np.ndarray


def solve(cmdp: CMDP, limit: float = np.inf) -> Solution:
    """Eq. 2 exactly, as a linear programme over occupancies (Altman 1999).

    Raises ValueError, which names the least achievable cost, if no policy keeps the limit.
    """
    return _solve(cmdp.transitions, cmdp.rewards, cmdp.costs, cmdp.initial, cmdp.gamma, limit)


def solve_episodes(cmdp: CMDP, horizon: int, limit: float = np.inf) -> Solution:
    """Eq. 1 exactly: the best expected sum of rewards of `horizon` steps, undiscounted, under a limit on the
    expected sum of costs. The policy, (horizon, S, A), depends on the step. Raises ValueError as `solve`.
    """
    states, actions = cmdp.rewards.shape
    unrolled = np.zeros((horizon, states, actions, horizon, states))
    for t in range(horizon - 1):  # the last step leads nowhere
        unrolled[t, :, :, t + 1] = cmdp.transitions
    unrolled = unrolled.reshape(horizon * states, actions, horizon * states)
    initial = np.concatenate([cmdp.initial, np.zeros((horizon - 1) * states)])
    rewards, costs = (np.tile(signal, (horizon, 1)) for signal in (cmdp.rewards, cmdp.costs))
    found = _solve(unrolled, rewards, costs, initial, 1.0, limit)
    shape = horizon, states, actions
    return found._replace(policy=found.policy.reshape(shape), occupancy=found.occupancy.reshape(shape))


def _solve(transitions, rewards, costs, initial, gamma, limit) -> Solution:
    states, actions = rewards.shape
    leaving = np.repeat(np.eye(states), actions, axis=0)  # (S A, S): a visit of (s, a) leaves s ...
    flow = (leaving - gamma * transitions.reshape(-1, states)).T  # ... and comes discounted to the next state
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


def budget_optimum(cmdp: CMDP, horizon: int, budget: int, stopped: float = 0.0):
    """The best that keeps a budget in *every* episode: exact, by recursion over (steps, budget, state).

    Undiscounted, as eq. 1, with costs that are whole numbers. Returns values (T+1, budget+1, S), the expected
    reward from step t on with b left to spend, and the actions taken, (T, budget+1, S) int. An action that
    costs more than b is not to be had. Where none is, the episode is stopped: the value is `stopped` and the
    action -1. With `stopped=-inf` that must never happen, and -inf marks what no policy can keep for certain.
    Raises ValueError for costs that are not whole or negative.
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


# --- What implicit Q-learning converges to ---


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
