"""A player is an agent that plays episodes. A rollout asks it for actions and gives it rewards and costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tutorial_lib.costs.conditioning import told_limit, trained_limit

if TYPE_CHECKING:
    from tutorial_lib.agents.agent import Agent


class Player:
    """One run of an agent that plays E episodes at once, each under its limit.

    This player has no memory and plays the mean action. An algorithm that remembers past costs, or that plays
    random actions, defines its own player (`Agent.player`). `limits` are (E,), in cost per episode.
    """

    def __init__(self, agent: Agent, limits: Sequence[float] | np.ndarray, run: int = 0):
        self.agent, self.limits, self.run = agent, np.asarray(limits, float), run

    @property
    def told(self) -> np.ndarray:
        """The limit that the policy is told at this step, (E,). It is NaN if the policy takes none."""
        return np.full(len(self.limits), np.nan)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Returns actions (E, act) at observations (E, obs)."""
        return self.agent.act(observations, self.told, self.run)

    def see(self, rewards: np.ndarray, costs: np.ndarray) -> None:
        """Receives the rewards and costs (E,) of the step that `act` chose.

        They are zero where an episode is over.
        """

    def predicted_cost(self, observations: np.ndarray) -> np.ndarray:
        """Returns the cost of an episode that the agent predicts at observations (E, obs), (E,), or NaN."""
        return self.agent.predicted_cost(observations, self.limits, self.run)


class CountingPlayer(Player):
    """A player that counts the steps and what they cost.

    At every step it tells the policy what is left of the limit, and the time. The agent's `act` takes the
    step `t` as another argument.
    """

    agent: Any

    def __init__(self, agent: Agent, limits: Sequence[float] | np.ndarray, run: int = 0):
        super().__init__(agent, limits, run)
        self.spent, self.t = np.zeros(len(self.limits)), 0

    @property
    def told(self) -> np.ndarray:
        """What is left of the limit at this step, and zero where it is exceeded, (E,)."""
        return np.maximum(self.limits - self.spent, 0.0)

    def act(self, observations: np.ndarray) -> np.ndarray:
        return self.agent.act(observations, self.told, self.run, self.t)

    def see(self, rewards: np.ndarray, costs: np.ndarray) -> None:
        """Counts the costs (E,) of the step."""
        self.spent, self.t = self.spent + costs, self.t + 1


class BudgetPlayer(CountingPlayer):
    """A player that tells the policy at every step what is left of the limit (eq. 23)."""

    @property
    def told(self) -> np.ndarray:
        """The limit that the policy is told at this step, (E,)."""
        task, config = self.agent.task, self.agent.config
        if config.tell == "throughout":
            return trained_limit(task, config, self.limits)
        if config.tell == "switch":
            return trained_limit(task, config, np.where(self.spent < self.limits, np.inf, 0.0))
        remaining = config.time_limits == "mask"  # the critics then predict the remaining cost
        return told_limit(task, config, self.limits, self.spent, self.t, remaining)

    def predicted_cost(self, observations: np.ndarray) -> np.ndarray:
        return self.agent.predicted_cost(observations, self.told, self.run, self.t)
