"""Sequences of steps: how they are read from the data, a causal transformer, and a player that keeps them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from tutorial_lib.agents.player import Player
from tutorial_lib.data.dataset import Batch, Dataset
from tutorial_lib.data.recordings import best_left
from tutorial_lib.networks import Output

if TYPE_CHECKING:
    from tutorial_lib.agents.cdt import CDT

TOKENS = 4
"""The tokens of a step, in this order: return-to-go, cost-to-go, observation, action."""
STATE, ACTION = 2, 3
"""The places of the observation's and of the action's token."""
LOG_STD = (-5.0, 2.0)
"""The bounds of the log-std of an action."""


def sequences(data: Batch, rows: Tensor, length: int) -> dict[str, Tensor]:
    """Returns the `length` steps that begin at each of `rows` (B,), by name, (B, length, ...), and `inside`.

    `inside` (B, length) is 1 for steps of the row's episode, and 0 after its end. Transformers are causal, so
    what stands there changes nothing before it.
    """
    steps, last = torch.arange(length, device=rows.device), len(data.rewards) - 1
    places = rows[:, None] + steps
    names = ("observations", "actions", "costs", "returns_to_go", "costs_to_go", "timesteps")
    fields = {name: getattr(data, name)[places.clamp(max=last)] for name in names}
    same_episode = fields["timesteps"] == data.timesteps[rows][:, None] + steps
    return fields | {"inside": ((places <= last) & same_episode).float()}


def totals(data: Batch, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the cost and the return of the episode of each row, both with the shape of `rows`."""
    first = rows - data.timesteps[rows].long()
    return data.costs_to_go[first], data.returns_to_go[first]


def below_frontier(dataset: Dataset) -> np.ndarray:
    """Returns how far each episode's return is below the highest one at its cost or less, (num_episodes,)."""
    return best_left(dataset, dataset.episode_costs)[1] - dataset.episode_returns


def first_tokens(
    observations: np.ndarray, returns: np.ndarray, costs: np.ndarray, t: int, act_dim: int
) -> dict[str, np.ndarray]:
    """Returns step t of E episodes by name, each (E, ...), with zero in the place of the actions.

    The observations are (E, obs), the returns-to-go and costs-to-go are (E,).
    """
    return {
        "observations": np.array(observations),  # a copy: a rollout overwrites its own
        "actions": np.zeros((len(observations), act_dim), np.float32),
        "returns_to_go": returns,
        "costs_to_go": costs,
        "timesteps": np.full(len(observations), t),
    }


class Layer(nn.Module):
    """A layer of a transformer: attention, and a network of one hidden layer, each after a LayerNorm."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.attention_norm, self.norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries_keys_values = nn.Linear(width, 3 * width, bias=False)
        self.mix = nn.Linear(width, width)
        self.net = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        """Returns tokens (B, n, width) for tokens of the same shape.

        `hidden` (n, n) is added to the scores. It is minus infinity where a token (row) must not see another
        (column), and zero elsewhere. (Plain products are as fast as PyTorch's own attention: 70 and 77 ms of
        a core for the layers of one run, and 231 and 244 ms for three. PyTorch's warns under vmap.)
        """
        split = self.queries_keys_values(self.attention_norm(x)).unflatten(-1, (3, self.heads, -1))
        q, k, v = split.movedim(-3, 0).transpose(-2, -3)  # each (B, heads, n, width / heads)
        scores = (q / math.sqrt(q.shape[-1])) @ k.transpose(-1, -2) + hidden  # (B, heads, n, n)
        x = x + self.mix((scores.softmax(-1) @ v).transpose(-2, -3).flatten(-2))
        return x + self.net(self.norm(x))


class SequencePolicy(nn.Module):
    """A causal transformer over the tokens of K steps. It predicts each step's action and then its cost."""

    def __init__(self, obs_dim: int, act_dim: int, horizon: int, width: int, layers: int, heads: int):
        super().__init__()
        self.embed = nn.ModuleList(nn.Linear(size, width) for size in (1, 1, obs_dim, act_dim))
        self.time = nn.Embedding(horizon, width)
        self.first_norm, self.last_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.layers = nn.ModuleList(Layer(width, heads) for _ in range(layers))
        self.action, self.cost = Output(width, 2 * act_dim), Output(width, 1)
        for part in self.modules():
            if isinstance(part, nn.Linear | nn.Embedding):
                nn.init.normal_(part.weight, std=0.02)
            if isinstance(part, nn.Linear) and part.bias is not None:
                nn.init.zeros_(part.bias)

    def forward(
        self, returns: Tensor, costs: Tensor, observations: Tensor, actions: Tensor, timesteps: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the action's mean and log-std (B, K, act), and the logit that the step costs (B, K).

        The scaled returns-to-go and costs-to-go are (B, K), the normalised observations (B, K, obs), the
        actions (B, K, act) and the whole numbers `timesteps` (B, K). The action of a step is predicted from
        this step's first three tokens and from earlier steps, and its cost from its action, too.
        """
        parts = (returns.unsqueeze(-1), costs.unsqueeze(-1), observations, actions)
        tokens = torch.stack([embed(part) for embed, part in zip(self.embed, parts, strict=True)], -2)
        x = self.first_norm((tokens + self.time(timesteps).unsqueeze(-2)).flatten(-3, -2))  # (B, 4 K, width)
        hidden = torch.full(2 * x.shape[-2:-1], -torch.inf, device=x.device).triu(1)
        for layer in self.layers:
            x = layer(x, hidden)
        x = self.last_norm(x).unflatten(-2, (-1, TOKENS))  # (B, K, 4, width)
        mean, log_std = self.action(x[..., STATE, :]).chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD), self.cost(x[..., ACTION, :]).squeeze(-1)


class SequencePlayer(Player):
    """A player that remembers the last steps, and says what is left of the target return and of the limit."""

    agent: CDT

    def __init__(self, agent: CDT, limits: Sequence[float] | np.ndarray, run: int = 0):
        super().__init__(agent, limits, run)
        self.returns_to_go, self.spent = agent.target_returns(self.limits, run), np.zeros(len(self.limits))
        self.past: deque[dict[str, np.ndarray]] = deque(maxlen=agent.config.context - 1)
        self.t = 0

    @property
    def told(self) -> np.ndarray:
        """The cost-to-go that the policy is told at this step, (E,): what is left of the limit."""
        return np.maximum(self.limits - self.spent, 0.0)

    def act(self, observations: np.ndarray) -> np.ndarray:
        act_dim = self.agent.task.act_dim
        self.now = first_tokens(observations, self.returns_to_go, self.told, self.t, act_dim)
        steps = [*self.past, self.now]
        context = {name: np.stack([step[name] for step in steps], 1) for name in self.now}
        self.now["actions"] = self.agent.act_after(context, self.run)
        return self.now["actions"]

    def see(self, rewards: np.ndarray, costs: np.ndarray) -> None:
        """Remembers the step, and reduces what is to come by its rewards and costs (E,)."""
        self.past.append(self.now)
        self.returns_to_go, self.spent = self.returns_to_go - rewards, self.spent + costs
        self.t += 1
