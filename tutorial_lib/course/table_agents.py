"""Agents of safe offline RL that keep tables in place of networks: healthy ones, and faulty ones.

**If you want to diagnose the patients of notebook 16, do not read on:** each faulty class overrides one
method of a healthy one, and its name says which fault that is.

They learn Q_r and Q_c of recorded actions, as C2IQL does. They live on the laps of notebook 9, where the cost
and the return of a policy are exact.
"""

import functools
from typing import NamedTuple

import numpy as np

from tutorial_lib.course import laps, tabular

GAMMA = 0.98
"""The discount factor of all patients."""
HORIZON = laps.TASK.horizon
"""T = 100: the steps of an episode."""
WORLD = tabular.laps(gamma=GAMMA)
"""The laps: S = 15 states, A = 4 actions."""
START = int(WORLD.initial.argmax())
"""The state in which every episode begins."""
SHARPNESS = 0.05
"""The temperature of the policies, in reward: an action's weight is exp(advantage / temperature)."""


class Rows(NamedTuple):
    """n recorded episodes of T steps. Each field is (n, T)."""

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    next_states: np.ndarray
    terminals: np.ndarray
    timeouts: np.ndarray


def record(limits: tuple[float, ...], episodes: int, seed: int = 0) -> Rows:
    """Returns recorded episodes: `episodes` for each of the best policies under these limits per episode.

    A quarter of the actions is replaced with random ones. Nothing on the laps ends an episode but the time
    limit.
    """
    rng, played = np.random.default_rng(seed), []
    for policy in laps.policies(limits).values():
        played.append(tabular.simulate(WORLD, 0.75 * policy + 0.25 / 4, HORIZON + 1, episodes, rng))
    states, actions = (np.concatenate([getattr(x, name) for x in played]) for name in ("states", "actions"))
    here = states[:, :-1], actions[:, :-1]
    never, last = np.zeros(here[0].shape, bool), np.zeros(here[0].shape, bool)
    last[:, -1] = True
    return Rows(*here, WORLD.rewards[here], WORLD.costs[here], states[:, 1:], never, last)


@functools.cache
def recordings() -> Rows:
    """Returns the recordings from which most patients learn: 300 episodes of ten kinds."""
    return record((0, 5, 10, 15, 20, 25, 30, 40, 50, 60), 30)


class Fit(NamedTuple):
    """What a `TableAgent` has learned for one limit. The arrays are (S, A)."""

    policy: np.ndarray
    q_reward: np.ndarray
    q_cost: np.ndarray
    worth: np.ndarray


class TableAgent:
    """A healthy agent that keeps tables. It has a policy of its own for each limit.

    V_r is the minimum of eq. 13 for f(u) = exp(u) - u with u in units of `SHARPNESS`. The policy is mu
    exp(u), as in advantage weighted regression, and needs no normalisation with this V_r. Q_c is the cost of
    this policy. The penalty is a price on cost. It is raised until the predicted cost keeps the limit.
    """

    def __init__(self, rows: Rows):
        self.rows = rows = self.read(rows)
        where, count = (rows.states, rows.actions), np.zeros(WORLD.rewards.shape)
        reward, cost, follows = np.zeros_like(count), np.zeros_like(count), np.zeros(WORLD.transitions.shape)
        np.add.at(count, where, 1)
        np.add.at(reward, where, rows.rewards)
        np.add.at(cost, where, rows.costs)
        np.add.at(follows, (*where, rows.next_states), self.goes_on(rows))
        seen = count.clip(1)
        self.reward, self.cost, self.follows = reward / seen, cost / seen, follows / seen[..., None]
        visits = count.sum(1, keepdims=True)
        self.mu: np.ndarray = np.where(visits > 0, count / visits.clip(1), 1 / len(count[0]))

    def read(self, rows: Rows) -> Rows:
        """Returns the recordings as the agent reads them from the file."""
        return rows

    def goes_on(self, rows: Rows) -> np.ndarray:
        """Returns 1 where something follows a row, and 0 elsewhere, (n, T)."""
        return 1.0 - rows.terminals

    def episode_cost(self, discounted):
        """Returns the cost of an episode of T steps that has the cost rate of an endless discounted sum."""
        return discounted * (1 - GAMMA) * HORIZON

    def values(self, policy: np.ndarray, signal: np.ndarray) -> np.ndarray:
        """Returns Q of a policy for a signal, both (S, A), by a linear solve on the recorded rows."""
        step = np.einsum("sa,saz->sz", policy, self.follows)
        v = np.linalg.solve(np.eye(len(step)) - GAMMA * step, (policy * signal).sum(1))
        return signal + GAMMA * self.follows @ v

    def extract(self, worth: np.ndarray) -> np.ndarray:
        """Returns the policy mu exp(u / SHARPNESS), (S, A), for the worth of actions, (S, A)."""
        weight = self.mu * np.exp((worth - worth.max(1, keepdims=True)) / SHARPNESS)
        return weight / weight.sum(1, keepdims=True)

    def priced(self, price: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns the policy for a price on cost, and the worth of actions, both (S, A)."""
        signal = self.reward - price * self.cost
        worth = signal
        for _ in range(50):  # policy iteration: some ten rounds are enough
            policy = self.extract(worth)
            ratio = np.where(policy > 0, policy / np.where(self.mu > 0, self.mu, 1.0), 1.0)
            before, worth = worth, self.values(policy, signal - SHARPNESS * np.log(ratio))
            worth = worth + SHARPNESS * np.log(ratio)  # the action itself pays nothing for being chosen
            if np.abs(worth - before).max() < 1e-9:
                break
        return policy, worth

    def fit(self, limit: float) -> Fit:
        """Returns what the agent learns for a limit: the lowest price whose predicted cost keeps it."""

        def predicted(price: float) -> float:
            policy, _ = self.priced(price)
            return self.start(policy, self.episode_cost(self.values(policy, self.cost)))

        low, high = 0.0, 10.0 if predicted(0.0) > limit else 0.0
        while high - low > 1e-7:
            price = (low + high) / 2
            low, high = (low, price) if predicted(price) <= limit else (price, high)
        policy, worth = self.priced(high)
        costs = self.episode_cost(self.values(policy, self.cost))
        return Fit(policy, self.values(policy, self.reward), costs, worth)

    def start(self, policy: np.ndarray, q: np.ndarray) -> float:
        """Returns the mean of q (S, A) over the policy's actions in the first state."""
        return float(policy[START] @ q[START])


class ComparesDiscounted(TableAgent):
    """Fault 'discounted'."""

    def episode_cost(self, discounted):
        return discounted


class EndsAtTimeLimits(TableAgent):
    """Fault 'terminal': `done` merges both flags."""

    def goes_on(self, rows: Rows) -> np.ndarray:
        return 1.0 - (rows.terminals | rows.timeouts)


class ReadsLate(TableAgent):
    """Fault 'late': row t has the cost of step t - 1, as if a file held what `env.step` said before."""

    def read(self, rows: Rows) -> Rows:
        late = np.concatenate([np.zeros_like(rows.costs[:, :1]), rows.costs[:, :-1]], 1)
        return rows._replace(costs=late)


class ZeroPenalty(TableAgent):
    """A healthy agent with the penalty of eq. 11: an unsafe action is worth zero.

    Its robot pays 1 for every step, and 0 at the goal. It shifts rewards so that none is negative.
    """

    def read(self, rows: Rows) -> Rows:
        rewards = rows.rewards - 1
        return rows._replace(rewards=rewards - rewards.min())

    def fit(self, limit: float) -> Fit:
        """Returns what the agent learns for a limit, by an iteration that takes small steps.

        Otherwise the indicator of eq. 11 flips for ever (notebook 8).
        """
        policy, v = self.mu, np.zeros(len(self.mu))
        for _ in range(500):
            q_reward = self.reward + GAMMA * self.follows @ v
            costs = self.episode_cost(self.values(policy, self.cost))
            worth = np.where(costs <= limit, q_reward, 0.0)  # eq. 11
            best = worth.max(1)
            mean = (self.mu * np.exp((worth - best[:, None]) / SHARPNESS)).sum(1)
            v = v + 0.1 * (best + SHARPNESS * np.log(mean) - v)
            policy = policy + 0.1 * (self.extract(worth) - policy)
        return Fit(policy, q_reward, costs, worth)


class KeepsSign(ZeroPenalty):
    """Fault 'sign': the rewards stay as they are."""

    def read(self, rows: Rows) -> Rows:
        return rows._replace(rewards=rows.rewards - 1)
