"""Behaviour cloning (BC): of all episodes, of the safe or of the best ones, or with the budget as an input.

These are baselines that offline methods should beat. They have no critic. BC-Frontier shows what a choice of
episodes does alone, and BC (budget rule) what conditioning and feedback do alone.

Sources: Open Safe RL (OSRL), as used in DSRL's benchmark: a deterministic policy, the mean squared error of
the actions, Adam with a learning rate of 1e-3, for BC-Safe only the episodes that keep the limit, and for
BC-Frontier only the episodes near the frontier of cost and return. BC (budget rule) is not published: it is
OSRL's mode `multi-task`, which has the cost of the episode as an input, with eq. 23 of the C2IQL paper.

Departures:

1. The learning rate decays to zero along a half cosine, as for the policies of IQL, CIQL and C2IQL. In OSRL
   it stays constant.
2. BC-Frontier: the frontier is the highest return of the episodes that cost at most as much, and the range
   below it is a share of the range of returns. OSRL takes a function and a number for each task. As in OSRL,
   the limit plays no part: the frontier has episodes of all costs.
3. BC (budget rule): the input is the cost that is still to come, and the time. In OSRL it is the cost of the
   whole episode.

Measured: in profile `small` with seed 0 only, 10 episodes, normalised reward / cost. BC (budget rule) had
0.86 / 1.02, 0.96 / 1.01 and 0.77 / 0.96 on BallCircle under limits of 30, 50 and 70, and 0.72 / 1.06,
0.81 / 0.95 and 0.87 / 1.02 on CarCircle. So it spends its budget nearly exactly. At BallCircle's limit of 70
it earns less than at 50, because it clones all episodes that cost so much, and most of them earn less.
BC-Frontier had a normalised reward of 0.85 and a cost of 22 on BallCircle, and of 0.89 and 71 on CarCircle,
whatever the limit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor, nn

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.player import CountingPlayer, Player
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import NOT_NEGATIVE, Config
from tutorial_lib.data.dataset import Dataset, DatasetError
from tutorial_lib.data.recordings import best_left
from tutorial_lib.networks import mlp


@dataclass(frozen=True)
class BCConfig(Config):
    """The options of behaviour cloning."""

    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-3
    """Adam's learning rate for the policy, as in OSRL."""


@dataclass(frozen=True)
class BCFrontierConfig(BCConfig):
    """The options of BC-Frontier."""

    frontier_range: Annotated[float, NOT_NEGATIVE] = 0.05
    """How far an episode's return may be below the frontier, in units of the range of the episodes'
    returns."""


class DeterministicPolicy(nn.Module):
    """a = pi(s): a network whose output is a tanh."""

    def __init__(self, inputs: int, act_dim: int, config: Config):
        super().__init__()
        self.net = mlp(inputs, config.hidden_width, config.hidden_layers, act_dim)

    def forward(self, x: Tensor) -> tuple[Tensor, None]:
        """Returns the action (B, act) at inputs (B, inputs), and None, because it has no log-std."""
        return torch.tanh(self.net(x)), None


class BCAll(Agent):
    """Clones every episode, whatever its cost. It takes no limit."""

    name = "BC-All"
    Config = BCConfig
    scalars = {"policy_loss": "mean squared error of the actions"}
    config: BCConfig

    def build(self) -> dict[str, nn.Module | Tensor]:
        policy = DeterministicPolicy(self.task.obs_dim, self.task.act_dim, self.config)
        return super().build() | {"policy": policy}

    def optimiser(self, name: str) -> Rates:
        return Rates(self.config.policy_lr, cosine=True)

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        action, _ = net.policy(self.network_input(net, batch.observations, batch.limit))
        return {"policy": (action - batch.actions).square().mean()}, {}


class BCSafe(BCAll):
    """Clones the episodes whose undiscounted cost is at most the limit. A run is trained for one limit.

    A recording may end within an episode, which would then seem cheaper than it was. `read_dataset` drops it.
    """

    name = "BC-Safe"
    needs_limit = True

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        """Returns the safe episodes. Raises DatasetError if there are none."""
        safe = dataset.episode_costs <= limit
        if not safe.any():
            least = f"the cheapest of {dataset.num_episodes} costs {dataset.episode_costs.min():g}"
            raise DatasetError(f"{self.name}: no episode costs at most {limit:g}: {least}")
        return super().select(dataset.select(safe), limit)


class BCFrontier(BCAll):
    """Clones the episodes near the frontier: near the highest return at their cost. It takes no limit."""

    name = "BC-Frontier"
    Config = BCFrontierConfig
    config: BCFrontierConfig

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        """Returns the episodes near the frontier, the highest return of the episodes that cost at most c."""
        returns = dataset.episode_returns
        _, frontier = best_left(dataset, dataset.episode_costs)
        near = returns >= frontier - self.config.frontier_range * np.ptp(returns)
        return super().select(dataset.select(near), limit)


class BCBudget(BCAll):
    """Clones every episode, given the cost that the episode still has. Playing, it is told what is left.

    With the time as another input, what is left says as much as the budget of eq. 23. A run takes no limit.
    """

    name = "BC (budget rule)"

    def build(self) -> dict[str, nn.Module | Tensor]:
        policy = DeterministicPolicy(self.task.obs_dim + 2, self.task.act_dim, self.config)
        return super().build() | {"policy": policy}

    def budget_input(self, net: Networks, observations: Tensor, budget: Tensor, timesteps: Tensor) -> Tensor:
        """Returns normalised observations, budgets and times (..., obs + 2), for (..., obs), (...) and (...).

        A budget is in units of the cost range and at most 1, and a time is a share of the horizon.
        """
        budget = budget.clamp(max=self.task.cost_range) / self.task.cost_range
        more = torch.stack([budget, timesteps / self.task.horizon], -1)
        return torch.cat([self.network_input(net, observations, budget), more], -1)

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        s = self.budget_input(net, batch.observations, batch.costs_to_go, batch.timesteps)
        action, _ = net.policy(s)
        return {"policy": (action - batch.actions).square().mean()}, {}

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0, t: int = 0) -> np.ndarray:
        """Returns the actions (E, act) at observations (E, obs) of step t. `limits` (E,) are what is left."""
        with torch.no_grad():
            net, budget = self.networks(run), self._tensor(limits)
            times = torch.full_like(budget, t)
            action, _ = net.policy(self.budget_input(net, self._tensor(observations), budget, times))
            return action.cpu().numpy()

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        return CountingPlayer(self, limits, run)
