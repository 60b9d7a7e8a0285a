"""Budgets on the shortcut: laps, policies for a rate of cost, and what a policy that sees the budget pays."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tutorial_lib.course.tabular.cmdp import CMDP
from tutorial_lib.course.tabular.examples import SHORTCUT, shortcut
from tutorial_lib.course.tabular.optimal import solve


def laps(slip: float = 0.1, gamma: float = 0.99) -> CMDP:
    """The shortcut again and again: from the goal, which pays 1, the next step leads back to the start."""
    once = shortcut(slip, gamma)
    goal = "".join(SHORTCUT).index("G")
    transitions = once.transitions.copy()
    transitions[goal] = once.initial
    return CMDP(transitions, once.rewards, once.costs, once.initial, gamma)


def rate_policy(cmdp: CMDP, limit: float, horizon: int) -> np.ndarray:
    """The best policy, (S, A), whose cost falls at the rate of `limit` per `horizon` steps.

    Eq. 2 over an endless episode: its limit is the rate over 1 - gamma. Raises ValueError where no policy
    is that cheap.
    """
    return solve(cmdp, limit / horizon / (1 - cmdp.gamma)).policy


class Spending(NamedTuple):
    """What a policy earns in `horizon` steps, and the chances of what it has spent."""

    reward: float
    """expected sum of rewards"""
    chances: np.ndarray
    """(T+1, T+1): the probability that c is spent before step t"""

    @property
    def cost(self) -> float:
        """Expected sum of costs."""
        return float(self.chances[-1] @ np.arange(len(self.chances)))

    def exceeds(self, limit: float) -> float:
        """Share of episodes that cost more than `limit`."""
        return float(self.chances[-1, np.arange(len(self.chances)) > limit].sum())


def follow(cmdp: CMDP, horizon: int, policy: Callable[[int], np.ndarray]) -> Spending:
    """Exactly, without simulation: `policy(t)` gives (T+1, S, A), the policy after each sum c already spent.

    Costs must be 0 or 1, as in all of the course's tasks: else ValueError.
    """
    if not np.isin(cmdp.costs, (0, 1)).all():
        raise ValueError("costs must be 0 or 1")
    states = len(cmdp.initial)
    here = np.zeros((horizon + 1, states))  # P(spent c, in state s)
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
