"""An agent while it plays: what a rollout asks for actions, and tells what they led to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tutorial_lib.agents.agent import Agent


class Player:
    """One run of an agent that plays E episodes at once, each under its limit.

    This player has no memory: it plays the mean action. An algorithm that remembers what was spent, or that
        plays
    by chance, has a player of its own (`Agent.player`).
    """

    def __init__(self, agent: Agent, limits: Sequence[float] | np.ndarray, run: int = 0):
        self.agent, self.limits, self.run = agent, np.asarray(limits, float), run

    @property
    def told(self) -> np.ndarray:
        """The limit that the policy is told at this step, (E,); NaN: its policy takes none."""
        return np.full(len(self.limits), np.nan)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions (E, act) at observations (E, obs)."""
        return self.agent.act(observations, self.told, self.run)

    def see(self, rewards: np.ndarray, costs: np.ndarray) -> None:
        """Hear of the rewards and costs (E,) of the step that `act` chose; zeros where an episode is over."""

    def predicted_cost(self, observations: np.ndarray) -> np.ndarray:
        """The cost of an episode that the agent expects of its action now, (E,); NaN: it cannot tell."""
        return self.agent.predicted_cost(observations, self.limits, self.run)
