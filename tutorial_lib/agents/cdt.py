"""Constrained Decision Transformer (CDT): a sequence model that is told the reward and the cost to come.

It clones the recorded actions, given the observations and actions of the last steps, the return-to-go and the
cost-to-go. When it plays, it is told a return to reach and the limit, and both are reduced by what each step
brings.

Sources: Liu et al. 2023 (CDT); Chen et al. 2021 (Decision Transformer); the files `cdt.py` and `dataset.py`
of Open Safe RL (OSRL), whose settings are used here: 10 steps of four tokens, 3 layers of 128 units and 8
heads with the norm before each part, a Gaussian action, temperature 0.1, AdamW, and an augmentation of the
data.

Departures:

1. There is no dropout (0.1 in OSRL), because runs that are trained together cannot draw their own masks.
2. In profile `small` a batch has 32 sequences, which are 320 actions, and the learning rate is 1e-3 with a
   cosine. In OSRL it is 1e-4 over 100,000 updates of 2,048 sequences. So the learning rates of a whole run
   sum to about as much: 6 here, and 10 there.
3. Return-to-go and cost-to-go enter in units of the largest return and of the cost range, so that they are
   of order one. In OSRL they enter as 0.1 R and 50 - C. A cost above the range, or an infinite one, enters as
   the cost range.
4. OSRL draws an episode with weight max(0, 70 - cost), so it never sees costs of 70 or more, and the paper's
   limits reach 160. Here the 70 is 1.5 cost ranges (`cost_reach`). A task's highest limit then has 0.33 to
   0.53 of the weight of a cost of zero, and OSRL's highest limit, 40, has 0.43 of it. OSRL draws whole
   episodes, and here each step has its episode's weight. The two agree where all episodes are equally long.
5. The frontier is the highest return of the episodes that cost at most C, a step function without parameters.
   In OSRL it is a polynomial, with a degree and a filter for each task.
6. The target return at a limit is this frontier at the limit. OSRL has a table of targets by hand.
7. The augmentation is drawn anew for every batch. OSRL draws it once, samples a pair of cost and return above
   the frontier, and relabels the closest cheaper episode with it. Here an episode near the frontier is drawn
   first, and then a pair of higher cost and return for it.
8. The target of the entropy is -1 per dimension of the action. In OSRL it is -(dimensions), but the entropy
   is a mean over the dimensions. The temperature takes a plain step on its logarithm, not one of Adam.
9. The log-std is clamped to [-5, 2]. OSRL's bounds are never applied.
10. The cost-to-go that is told is never negative. In OSRL it is negative as soon as the limit is exceeded.
11. The linear layers of queries, keys and values have no bias: a bias of the keys has no effect and no
    gradient.

Measured: seed 0 only, 10 episodes, profile `small` with *fewer* updates than its 12,000. On BallCircle, after
2,500 updates, the normalised reward and cost were 0.86 / 0.98, 0.91 / 0.91 and 0.80 / 0.91 under limits of
30, 50 and 70. At 70 the target return is reached in the data at a cost of about 50, and few episodes that
cost 70 earn so much. On CarCircle they were, after only 1,200 updates, 0.68 / 1.97, 0.71 / 1.29 and
0.76 / 1.11. An update takes 93 ms of a core.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.player import Player
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.agents.sequences import (
    SequencePlayer,
    SequencePolicy,
    below_frontier,
    first_tokens,
    sequences,
    totals,
)
from tutorial_lib.config import COUNT, NOT_NEGATIVE, PAIR, POSITIVE, Bound, Config
from tutorial_lib.data.dataset import Batch, Dataset
from tutorial_lib.data.recordings import best_left
from tutorial_lib.networks import gaussian_log_prob

PART = Bound(lambda x: 0 <= x < 1, "0 or more, and below 1")

TARGET_ENTROPY = -1.0
"""What the entropy of the action should be, per dimension of the action, in nats."""
TRIES = 16
"""How often a sequence is drawn anew until its episode's weight accepts it."""


@dataclass(frozen=True)
class CDTConfig(Config):
    """The options of CDT. The defaults are those of OSRL."""

    batch_size: Annotated[int, PAIR] = 2048
    """The number of sequences per update."""
    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """AdamW's learning rate. It decays to zero along a half cosine after the warm-up."""
    hidden_width: Annotated[int, COUNT] = 128
    """The number of units of a token. It must be a multiple of `heads`."""
    hidden_layers: Annotated[int, NOT_NEGATIVE] = 3
    """The number of layers of the transformer."""
    heads: Annotated[int, COUNT] = 8
    """The number of attention heads of each layer."""
    context: Annotated[int, COUNT] = 10
    """The number of steps that the transformer sees, K."""
    weight_decay: Annotated[float, NOT_NEGATIVE] = 1e-4
    """AdamW's weight decay."""
    gradient_clip: Annotated[float, POSITIVE] = 0.25
    """The largest norm of the gradient."""
    warm_up: Annotated[int, NOT_NEGATIVE] = 500
    """The number of updates over which the learning rate rises linearly."""
    temperature: Annotated[float, POSITIVE] = 0.1
    """The weight of the entropy of the actions at the start."""
    temperature_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """The step of the logarithm of the temperature, per nat by which the entropy misses its target."""
    cost_loss_weight: Annotated[float, NOT_NEGATIVE] = 0.02
    """The weight of the cross-entropy of the cost after each action."""
    cost_reach: Annotated[float, POSITIVE] = 1.5
    """The cost, in cost ranges, from which on an episode is not drawn. Cheaper episodes are drawn with a
    weight that falls linearly with their cost."""
    augmented_share: Annotated[float, PART] = 0.2
    """The share of the sequences that are augmented: their return-to-go and cost-to-go are raised to a pair
    that no episode has reached."""
    nearness: Annotated[float, NOT_NEGATIVE] = 0.1
    """How far the augmentation reaches. It takes episodes whose return is at most this far below the
    frontier, in units of the range of returns, and raises their cost by at most this many cost ranges. The
    raised return exceeds the highest one by at most this many times the largest return."""

    # The temperature must move as far in 12,000 updates as in OSRL's 100,000.
    profiles = {"small": {"batch_size": 32, "policy_lr": 1e-3, "temperature_lr": 1e-3}}

    def __post_init__(self):
        super().__post_init__()
        if self.hidden_width % self.heads:
            raise ValueError(
                f"hidden_width is {self.hidden_width}, and must be a multiple of {self.heads} heads"
            )


class CDT(Agent):
    """CDT. It is trained for no limit, and is told one while it plays."""

    name = "CDT"
    Config = CDTConfig
    scalars = {
        "policy_loss": "minus the log-likelihood and the weighted entropy, and the weighted cross-entropy",
        "log_likelihood": "mean log-likelihood of the recorded actions, per dimension, in nats",
        "entropy": "mean entropy of the predicted actions, per dimension, in nats",
        "cost_cross_entropy": "mean cross-entropy of the cost after an action, in nats",
        "temperature": "the weight of the entropy",
    }
    config: CDTConfig

    def build(self) -> dict[str, nn.Module | Tensor]:
        """Returns the transformer, the temperature, and what `measure` finds in the data.

        This is the frontier, the largest return, and the number of rows near the frontier.
        """
        task, config = self.task, self.config
        sizes = task.obs_dim, task.act_dim, task.horizon
        return super().build() | {
            "policy": SequencePolicy(*sizes, config.hidden_width, config.hidden_layers, config.heads),
            "log_temperature": torch.tensor(math.log(config.temperature)),
            "frontier": torch.zeros(len(self._frontier_costs)),
            "return_scale": torch.ones(()),
            "near_rows": torch.ones(()),
        }

    def select(self, dataset: Dataset, limit: float) -> Dataset:
        """Returns all episodes, in the order of their distance from the frontier.

        So those near it can be drawn without a list of their rows.
        """
        return super().select(dataset.select(np.argsort(below_frontier(dataset), kind="stable")), limit)

    def measure(self, dataset: Dataset) -> dict[str, Tensor]:
        returns, costs = dataset.episode_returns, dataset.episode_costs
        near = below_frontier(dataset) <= self.config.nearness * np.ptp(returns)
        _, frontier = best_left(dataset, np.maximum(self._frontier_costs, costs.min()))
        measured = {
            "frontier": frontier,
            "return_scale": np.abs(returns).max() or 1.0,
            "near_rows": dataset.episode_lengths[near].sum(),
        }
        tensors = {name: torch.tensor(value, dtype=torch.float32) for name, value in measured.items()}
        return super().measure(dataset) | tensors

    @property
    def _frontier_costs(self) -> np.ndarray:
        """The costs at which the frontier is stored: 0, 1, ..., the cost range, and infinity."""
        return np.append(np.arange(int(self.task.cost_range) + 1.0), np.inf)

    def target_returns(self, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """Returns the highest return of the recorded episodes that keep each limit, (E,), for limits (E,).

        Where no episode keeps a limit, it is that of the cheapest ones.
        """
        places = np.minimum(limits, len(self._frontier_costs) - 1).astype(int)
        return self.variables["frontier"][run].cpu().numpy()[places]

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns sequences of K steps (B, K, ...), of which the first ones are augmented, and `inside`.

        `inside` (B, K) is 1 for steps of the sequence's episode, and 0 after its end.
        """
        rows = self._draw_rows(data, generator)  # (B,)
        more_return, more_cost = self._draw_raises(data, rows, generator)  # (B,)
        drawn = sequences(data, rows, self.config.context)
        return drawn | {
            "returns_to_go": drawn["returns_to_go"] + more_return[:, None],
            "costs_to_go": drawn["costs_to_go"] + more_cost[:, None],
        }

    def _draw_rows(self, data: Batch, generator: torch.Generator) -> Tensor:
        """Returns the first row of each sequence, (B,).

        Augmented sequences come from the episodes near the frontier, and the others from all episodes with
        the weight max(0, cost_reach * cost_range - cost). A row is drawn until its weight accepts it, but at
        most `TRIES` times.
        """
        size, device = self.config.batch_size, data.rewards.device
        rows = torch.randint(len(data.rewards), (TRIES, size), generator=generator).to(device)
        chance = torch.rand(TRIES, size, generator=generator).to(device)
        near = torch.rand(self._augmented, generator=generator).to(device)
        cost, _ = totals(data, rows)
        accepted = chance < 1 - cost / (self.config.cost_reach * self.task.cost_range)
        rows = rows.take_along_dim(accepted.int().argmax(0, keepdim=True), 0).squeeze(0)
        # They stand first (`select`), and are the same in all runs. A product could be rounded up.
        near_rows = (near * self.variables["near_rows"][0]).long().clamp(max=len(data.rewards) - 1)
        return torch.cat([near_rows, rows[self._augmented :]])

    def _draw_raises(self, data: Batch, rows: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Returns what is added to the return-to-go and cost-to-go of each sequence, both (B,).

        They turn the (cost, return) of an augmented sequence's episode into a pair of a higher cost and of a
        return between the frontier at this cost and a little above the highest return.
        """
        count, nearness, frontier = self._augmented, self.config.nearness, self.variables["frontier"][0]
        chance = torch.rand(2, count, generator=generator).to(rows.device)
        cost, episode_return = totals(data, rows[:count])
        more_cost = chance[0] * nearness * self.task.cost_range
        lowest = frontier[(cost + more_cost).clamp(max=len(frontier) - 1).long()]
        highest = frontier[-1] + nearness * self.variables["return_scale"][0]
        more_return = lowest + chance[1] * (highest - lowest) - episode_return
        others = (0, len(rows) - count)
        return F.pad(more_return, others), F.pad(more_cost, others)

    @property
    def _augmented(self) -> int:
        """The number of augmented sequences of a batch."""
        return round(self.config.augmented_share * self.config.batch_size)

    def optimiser(self, name: str) -> Rates:
        config = self.config
        return Rates(config.policy_lr, config.weight_decay, config.gradient_clip, True, config.warm_up)

    def predict(self, net: Networks, batch: Fields) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the action's mean and log-std (B, K, act), and the logit that the step costs (B, K)."""
        returns = batch.returns_to_go / net.return_scale
        costs = batch.costs_to_go.clamp(max=self.task.cost_range) / self.task.cost_range
        s = self.network_input(net, batch.observations, batch.costs_to_go)
        return net.policy(returns, costs, s, batch.actions, batch.timesteps.long())

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        mean, log_std, logit = self.predict(net, batch)

        def average(x: Tensor) -> Tensor:  # over the steps that lie inside their episodes
            return (x * batch.inside).sum() / batch.inside.sum()

        log_prob = gaussian_log_prob(batch.actions, mean, log_std) / self.task.act_dim  # (B, K)
        scalars = {
            "log_likelihood": average(log_prob),
            "entropy": average(log_std.mean(-1)) + 0.5 * math.log(2 * math.pi * math.e),
            "cost_cross_entropy": average(
                F.binary_cross_entropy_with_logits(logit, (batch.costs > 0).float(), reduction="none")
            ),
            "temperature": net.log_temperature.exp(),
        }
        policy_loss = (
            -scalars["log_likelihood"]
            - scalars["temperature"] * scalars["entropy"]
            + self.config.cost_loss_weight * scalars["cost_cross_entropy"]
        )
        return {"policy": policy_loss}, scalars

    def step(self, net: Networks, batch: Fields, scalars: dict[str, Tensor]) -> dict[str, Tensor]:
        """Raises the temperature where the entropy is below its target, and lowers it above."""
        excess = scalars["entropy"] - TARGET_ENTROPY
        return {"log_temperature": net.log_temperature - self.config.temperature_lr * excess}

    def act_after(self, context: dict[str, np.ndarray], run: int = 0) -> np.ndarray:
        """Returns the actions (E, act) of the last step of a context of steps (E, K, ...), by name."""
        with torch.no_grad():
            batch = Fields(**{name: self._tensor(values) for name, values in context.items()})
            mean, _, _ = self.predict(self.networks(run), batch)
            return mean[:, -1].clamp(-1, 1).cpu().numpy()

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """Returns the actions (E, act) of first steps at observations (E, obs) under limits (E,)."""
        step = first_tokens(observations, self.target_returns(limits, run), limits, 0, self.task.act_dim)
        return self.act_after({name: values[:, None] for name, values in step.items()}, run)

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        return SequencePlayer(self, limits, run)
