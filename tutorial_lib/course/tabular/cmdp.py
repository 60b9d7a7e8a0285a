"""A tabular CMDP, the values of a given policy in it, and simulated episodes."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class CMDP:
    """A CMDP (Section 2.1).

    transitions are (S, A, S), rewards and costs (S, A), and the initial distribution is (S,). Raises
    ValueError where shapes do not fit, a distribution does not sum to 1, or gamma is not in (0, 1).
    """

    transitions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    initial: np.ndarray
    gamma: float

    def __post_init__(self) -> None:
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


def state_values(
    cmdp: CMDP, policy: np.ndarray, signal: str = "rewards", gamma: float | None = None
) -> np.ndarray:
    """V_r or V_c of a policy, (S,): the solution of V = r_pi + gamma P_pi V.

    `signal` is "rewards" for V_r and "costs" for V_c. The default of `gamma` is the CMDP's.
    """
    gamma = cmdp.gamma if gamma is None else gamma
    step = np.einsum("sa,saz->sz", policy, cmdp.transitions)
    return np.linalg.solve(np.eye(len(step)) - gamma * step, (policy * getattr(cmdp, signal)).sum(1))


def action_values(
    cmdp: CMDP, policy: np.ndarray, signal: str = "rewards", gamma: float | None = None
) -> np.ndarray:
    """Q_r or Q_c of a policy, (S, A). The arguments are those of `state_values`."""
    gamma = cmdp.gamma if gamma is None else gamma
    return getattr(cmdp, signal) + gamma * cmdp.transitions @ state_values(cmdp, policy, signal, gamma)


def occupancy(cmdp: CMDP, policy: np.ndarray) -> np.ndarray:
    """The occupancy d(s, a) = sum_t gamma^t P(s_t = s, a_t = a), (S, A). Its sum is 1 / (1 - gamma)."""
    step = np.einsum("sa,saz->sz", policy, cmdp.transitions)
    visits = np.linalg.solve(np.eye(len(step)) - cmdp.gamma * step.T, cmdp.initial)
    return visits[:, None] * policy


class Episodes(NamedTuple):
    """n simulated episodes of T steps. Each field is (n, T). The action of a stopped episode is -1."""

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray


def simulate(cmdp: CMDP, policy: np.ndarray, horizon: int, n: int, rng: np.random.Generator) -> Episodes:
    """Simulate n episodes of a policy, which is (S, A), or (horizon, S, A) if it depends on the step."""
    policy = np.broadcast_to(policy, (horizon, *cmdp.rewards.shape))
    states, actions = np.zeros((2, n, horizon), int)
    state = draw(np.tile(cmdp.initial, (n, 1)), rng)
    for t in range(horizon):
        states[:, t], actions[:, t] = state, draw(policy[t, state], rng)
        state = draw(cmdp.transitions[state, actions[:, t]], rng)
    return Episodes(states, actions, cmdp.rewards[states, actions], cmdp.costs[states, actions])


def draw(chances: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One random index, (n,), for each row of probabilities, (n, k)."""
    below = chances.cumsum(1) < rng.random((len(chances), 1))
    return np.minimum(below.sum(1), chances.shape[1] - 1)
