"""Notions of safety, each solved exactly on a CMDP with a horizon, and a small world on which they differ.

The cost C of an episode is an undiscounted sum (eq. 1), and L is a limit. A notion of safety limits one
number of the distribution of C: its mean, the probability of C > L, the mean of its worst share (CVaR), or
its maximum. A step costs 0 or 1 here, so that C is one of 0, ..., T. A policy that knows the step t and the
cost c that it has spent so far is an array (T, T+1, S, A): the probability of each action at t, c and s.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array

from tutorial_lib.course.tabular.budgets import Spending, follow
from tutorial_lib.course.tabular.cmdp import CMDP
from tutorial_lib.course.tabular.optimal import solve_episodes

AISLE = ("free", "people", "close", "contact")
"""The states of `aisle`."""
SPEEDS = ("slow", "fast")
"""The actions of `aisle`."""


def aisle() -> CMDP:
    """A robot in an aisle with people: four states (`AISLE`), two actions (`SPEEDS`), costs in contacts.

    On a free aisle a slow step earns 1 and a fast one earns 2. People come with probability 1/4. A slow robot
    sees them in time (the state "people"), a fast one does not ("close"). A step in contact costs 1, and
    a contact lasts for one more step with probability 1/2. The discount factor is not used with a horizon.
    """
    free, people, close, contact = range(4)
    transitions, rewards, costs = np.zeros((4, 2, 4)), np.zeros((4, 2)), np.zeros((4, 2))
    transitions[free, 0, [free, people]] = 0.75, 0.25
    transitions[free, 1, [free, close]] = 0.75, 0.25
    transitions[people, 0, [free, people]] = 0.5, 0.5
    transitions[people, 1, [free, contact]] = 0.5, 0.5
    transitions[close, 0, [people, contact]] = 0.75, 0.25
    transitions[close, 1, [free, contact]] = 0.5, 0.5
    transitions[contact, :, free] = transitions[contact, :, contact] = 0.5
    rewards[free] = 1, 2
    rewards[[people, close], 1] = 2
    costs[contact] = 1
    return CMDP(transitions, rewards, costs, np.eye(4)[free], 0.9)


def tail_mean(chances: np.ndarray, share: float) -> float:
    """CVaR: the mean cost of the worst `share` of the episodes, from the probabilities of the costs, (C,).

    It goes down from the highest cost until the share is full.
    """
    total, left = 0.0, share
    for cost in reversed(range(len(chances))):
        part = min(float(chances[cost]), left)
        total, left = total + part * cost, left - part
    return total / share


def worst_costs(cmdp: CMDP, horizon: int) -> np.ndarray:
    """The least cost that an episode can be certain to keep from step t on, (T+1, S).

    It is the value of a game in which the policy chooses the action, and an opponent chooses the next state
    among those that have a positive probability.
    """
    worst = np.zeros((horizon + 1, len(cmdp.initial)))
    for t in reversed(range(horizon)):
        worst[t] = _worst_of_actions(cmdp, worst[t + 1]).min(1)
    return worst


def _worst_of_actions(cmdp: CMDP, worst: np.ndarray) -> np.ndarray:
    """The highest cost that can follow each action, (S, A), if the next state z costs at most worst[z]."""
    return cmdp.costs + np.where(cmdp.transitions > 0, worst, -np.inf).max(-1)


def shield(cmdp: CMDP, horizon: int, limit: float) -> np.ndarray:
    """The actions after which an episode can still be certain to cost at most `limit`, (T, T+1, S, A) bool.

    Where there is no such action, the actions with the least worst cost are allowed.
    """
    worst = worst_costs(cmdp, horizon)
    spent = np.arange(horizon + 1)[:, None, None]
    allowed = np.zeros((horizon, horizon + 1, *cmdp.rewards.shape), bool)
    for t in range(horizon):
        after = _worst_of_actions(cmdp, worst[t + 1])
        kept = spent + after <= limit
        allowed[t] = np.where(kept.any(-1, keepdims=True), kept, after == after.min(1, keepdims=True))
    return allowed


def _spent_after(cmdp: CMDP, horizon: int) -> np.ndarray:
    """The spent cost after each action, (T+1, S, A) int. No episode spends more than T."""
    if not np.isin(cmdp.costs, (0, 1)).all():
        raise ValueError("costs must be 0 or 1")
    return (np.arange(horizon + 1)[:, None, None] + cmdp.costs.astype(int)).clip(max=horizon)


def plan_bill(
    cmdp: CMDP, horizon: int, bill: np.ndarray, allowed: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """The policy (T, T+1, S, A) that maximises E[R - bill(C)], and this maximum.

    `bill` (T+1,) is what an episode of each cost pays at its end, in reward. `allowed`, which broadcasts to
    (T, T+1, S, A), is true for the actions that may be taken. Raises ValueError for costs other than 0 and 1.
    """
    after = _spent_after(cmdp, horizon)
    shape = horizon, horizon + 1, *cmdp.rewards.shape
    may = np.broadcast_to(True if allowed is None else allowed, shape)
    policy, value = np.zeros(shape), np.tile(-bill[:, None], len(cmdp.initial))
    for t in reversed(range(horizon)):
        q = cmdp.rewards + (cmdp.transitions * value[after]).sum(-1)  # (T+1, S, A)
        q = np.where(may[t], q, -np.inf)
        policy[t], value = np.eye(q.shape[-1])[q.argmax(-1)], q.max(-1)
    return policy, float(cmdp.initial @ value[0])


class Limited(NamedTuple):
    """The best policy under a limit on the mean of a function of the cost."""

    policy: np.ndarray
    """(T, T+1, S, A). It is uniform where it never comes."""
    reward: float
    """The expected sum of rewards."""
    price: float
    """The Lagrange multiplier of the limit."""


def solve_spent(
    cmdp: CMDP, horizon: int, function: np.ndarray, bound: float, allowed: np.ndarray | None = None
) -> Limited:
    """The largest expected return with E[function(C)] <= `bound`, by one linear programme.

    Its variables are the probabilities d(t, c, s, a) of acting with a at step t in s with c spent. `function`
    is (T+1,): its value for each cost of an episode. `allowed` (S, A) is true for actions that may be taken.
    Raises ValueError where no policy keeps the bound.
    """
    states, actions = cmdp.rewards.shape
    size = horizon, horizon + 1, states, actions
    t, c, s, a = np.unravel_index(np.arange(np.prod(size)), size)
    after = _spent_after(cmdp, horizon)[c, s, a]
    flow = _flow(cmdp, size, t, c, s, a, after)
    start = np.zeros(size[:3])
    start[0, 0] = cmdp.initial
    ends = np.where(t == horizon - 1, function[after], 0.0)
    top = np.ones(len(t)) if allowed is None else np.where(allowed[s, a], 1.0, 0.0)
    found = linprog(
        -cmdp.rewards[s, a], A_ub=ends[None], b_ub=[bound], A_eq=flow, b_eq=start.ravel(),
        bounds=np.stack([np.zeros(len(t)), top], 1), method="highs",
    )  # fmt: skip
    if found.status:
        raise ValueError(f"no policy keeps the bound {bound:g}: {found.message}")
    visits = found.x.clip(min=0).reshape(size)
    total = visits.sum(-1, keepdims=True)
    seen = total > 1e-10
    fallback = np.broadcast_to(np.full(actions, 1 / actions) if allowed is None else
                               allowed / allowed.sum(1, keepdims=True), size)  # fmt: skip
    policy = np.where(seen, visits / np.where(seen, total, 1), fallback)
    return Limited(policy, float(-found.fun), float(-found.ineqlin.marginals[0]))


def _flow(cmdp: CMDP, size: tuple, t, c, s, a, after) -> csr_array:
    """The matrix of sum_a d(t+1, c, s, a) = sum of what enters (c, s), with a row for each (t, c, s)."""
    variable = np.arange(len(t))
    rows, columns, values = [np.ravel_multi_index((t, c, s), size[:3])], [variable], [np.ones(len(t))]
    goes_on = t < size[0] - 1
    for z in range(size[2]):
        chance = cmdp.transitions[s, a, z]
        k = goes_on & (chance > 0)
        rows.append(np.ravel_multi_index((t[k] + 1, after[k], np.full(k.sum(), z)), size[:3]))
        columns.append(variable[k])
        values.append(-chance[k])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return csr_array(entries, shape=(int(np.prod(size[:3])), len(t)))


def solve_tail(cmdp: CMDP, horizon: int, limit: float, share: float) -> Limited:
    """The largest expected return for which the worst `share` of the episodes cost `limit` on average.

    CVaR is the least value of eta + E[max(C - eta, 0)] / share over eta (Rockafellar and Uryasev 2000). It is
    taken at a cost that can occur, so a linear programme is solved for each eta = 0, 1, ..., `limit`.
    """
    costs = np.arange(horizon + 1)
    found = []
    for eta in range(int(limit) + 1):
        beyond = np.clip(costs - eta, 0, None) / share
        try:
            found.append(solve_spent(cmdp, horizon, beyond, limit - eta))
        except ValueError:  # with this eta no policy keeps the limit; with another one it may
            continue
    if not found:
        raise ValueError(f"no policy keeps the limit {limit:g} in the worst {share:g} of its episodes")
    return max(found, key=lambda one: one.reward)


def replanned(cmdp: CMDP, horizon: int, limit: int) -> np.ndarray:
    """The policy (T, T+1, S, A) that at each step limits the expected cost *to come* to what is left.

    Its action at (t, c, s) is the first one of the best policy for the remaining T - t steps whose expected
    cost is at most `limit` - c. Where there is none, it minimises the expected cost. Where several policies
    are best, the solver chooses: with another solver the aisle's expected costs differed by up to 0.05.
    """
    policy = np.zeros((horizon, horizon + 1, *cmdp.rewards.shape))
    careful = plan_bill(cmdp, horizon, 1e6 * np.arange(horizon + 1.0))[0]
    for t in range(horizon):
        policy[t] = careful[t]
        for s in range(len(cmdp.initial)):
            there = CMDP(cmdp.transitions, cmdp.rewards, cmdp.costs, np.eye(len(cmdp.initial))[s], cmdp.gamma)
            for spent in range(min(limit, t) + 1):
                try:
                    found = solve_episodes(there, horizon - t, limit - spent)
                except ValueError:  # the least expected cost is above what is left
                    continue
                policy[t, spent, s] = found.policy[0, s]
    return policy


def answers(
    cmdp: CMDP, horizon: int, limit: int, share: float = 0.1, price: float = 20.0
) -> dict[str, Spending]:
    """What the best policy under each notion of safety earns and spends, by name.

    `share` is the probability of the chance constraint and the worst share of CVaR. `price` is what a unit of
    cost beyond the limit costs, in reward, where the budget is part of the state.
    """
    costs = np.arange(horizon + 1.0)
    above = (costs > limit).astype(float)
    policies = {
        "no limit": plan_bill(cmdp, horizon, 0 * costs)[0],
        "expected cost": solve_spent(cmdp, horizon, costs, limit).policy,
        "replanned": replanned(cmdp, horizon, limit),
        "chance": solve_spent(cmdp, horizon, above, share).policy,
        "budget, priced": plan_bill(cmdp, horizon, price * np.clip(costs - limit, 0, None))[0],
        "CVaR": solve_tail(cmdp, horizon, limit, share).policy,
        "hard": plan_bill(cmdp, horizon, 0 * costs, shield(cmdp, horizon, limit))[0],
    }
    return {name: follow(cmdp, horizon, policy.__getitem__) for name, policy in policies.items()}
