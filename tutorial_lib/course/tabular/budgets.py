"""The repeated shortcut, and policies on it that depend on the cost spent so far."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tutorial_lib.course.tabular.cmdp import CMDP
from tutorial_lib.course.tabular.examples import SHORTCUT, shortcut
from tutorial_lib.course.tabular.optimal import solve


def laps(slip: float = 0.1, gamma: float = 0.99) -> CMDP:
    """The repeated shortcut: the goal pays a reward of 1, and the next step leads back to the start."""
    once = shortcut(slip, gamma)
    goal = "".join(SHORTCUT).index("G")
    transitions = once.transitions.copy()
    transitions[goal] = once.initial
    return CMDP(transitions, once.rewards, once.costs, once.initial, gamma)


def rate_policy(cmdp: CMDP, limit: float, horizon: int) -> np.ndarray:
    """The best policy, (S, A), whose cost per step is at most `limit` / `horizon`.

    It solves eq. 2 for an endless episode, with the limit (limit / horizon) / (1 - gamma) on the discounted
    cost. Raises ValueError where every policy costs more.
    """
    return solve(cmdp, limit / horizon / (1 - cmdp.gamma)).policy


def plan_budget(cmdp: CMDP, horizon: int, budget: int, price: float) -> tuple[np.ndarray, np.ndarray]:
    """The best values and actions of an agent that sees its state, what is left of a budget, and the step.

    The three together are the state of an MDP: a cost c leaves max(b - c, 0) of the budget b, and the step
    rises by one. A cost beyond the budget is paid for with `price` (in reward) per unit. Sums are
    undiscounted (eq. 1), and costs are whole numbers. The values, (T+1, budget+1, S), are the largest
    expected sums of rewards minus payments from step t on, with b left. The actions are (T, budget+1, S) int.
    Raises ValueError for costs that are negative or not whole.
    """
    if (cmdp.costs < 0).any() or (cmdp.costs % 1).any():
        raise ValueError("a budget is counted in whole costs: they must be 0, 1, 2, ...")
    left = np.arange(budget + 1)[:, None, None] - cmdp.costs.astype(int)  # (budget+1, S, A)
    at_once = cmdp.rewards - price * (-left).clip(min=0)
    values = np.zeros((horizon + 1, budget + 1, len(cmdp.initial)))
    actions = np.zeros((horizon, budget + 1, len(cmdp.initial)), int)
    for t in reversed(range(horizon)):
        q = at_once + (cmdp.transitions * values[t + 1, left.clip(min=0)]).sum(-1)
        values[t], actions[t] = q.max(-1), q.argmax(-1)
    return values, actions


class Spending(NamedTuple):
    """The expected return of a policy in T steps, and the distribution of its cost. Both are undiscounted."""

    reward: float
    """The expected sum of rewards."""
    chances: np.ndarray
    """(T+1, T+1): in row t and column c, the probability that the cost before step t is c."""

    @property
    def cost(self) -> float:
        """The expected sum of costs."""
        return float(self.chances[-1] @ np.arange(len(self.chances)))

    def exceeds(self, limit: float) -> float:
        """The probability that an episode costs more than `limit`."""
        return float(self.chances[-1, np.arange(len(self.chances)) > limit].sum())


def follow(cmdp: CMDP, horizon: int, policy: Callable[[int], np.ndarray]) -> Spending:
    """What a policy that depends on the spent cost earns and spends in T = `horizon` steps.

    The result is exact, without simulation. `policy(t)` returns (T+1, S, A): the policy at step t after each
    cost c = 0, ..., T spent so far. Raises ValueError for costs that are not 0 or 1. (In all of the course's
    tasks they are.)
    """
    if not np.isin(cmdp.costs, (0, 1)).all():
        raise ValueError("costs must be 0 or 1")
    states = len(cmdp.initial)
    here = np.zeros((horizon + 1, states))  # the probability of having spent c and being in state s
    here[0] = cmdp.initial
    chances, reward = [here.sum(1)], 0.0
    for t in range(horizon):
        acting = here[:, :, None] * policy(t)  # (T+1, S, A)
        reward += float((acting * cmdp.rewards).sum())
        free = np.einsum("csa,saz->cz", acting * (cmdp.costs == 0), cmdp.transitions)
        paid = np.einsum("csa,saz->cz", acting * (cmdp.costs == 1), cmdp.transitions)
        here = free
        here[1:] += paid[:-1]
        chances.append(here.sum(1))
    return Spending(reward, np.array(chances))
