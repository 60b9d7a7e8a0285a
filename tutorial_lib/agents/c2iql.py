"""C2IQL: CIQL with reconstructed costs, and with the limit as an input of every network.

Sources: Algorithms 1 and 2 of the C2IQL paper. The numbers of Algorithm 2's lines stand beside the code. The
two ablations of Section 4.2 are the classes after `C2IQL`, and each changes one switch.

Departures:

1. The departures of CIQL.
2. A limit is drawn for every transition (`thresholds_per`), which has a lower variance than one per batch.
3. The policy is told an infinite limit as soon as nothing can break the limit any more (`infinite_at_test`),
   and an infinite limit enters the networks as 1.5 cost ranges.
4. In profile `small`, the reconstruction model is trained with more noise (`crm_noise_rate`), because the
   paper's noise is smaller than the critics' error.
5. In profile `small`, the networks see the time (`clock`). A limit is then one on the remaining cost. It is
   drawn from a range (`thresholds`), and shrinks by what is paid.
6. In profile `small`, the policy is extracted only where the limit is what the own episode still costs, or
   infinite (`policy_thresholds`). V_c learns from the mean of the cost critics (`evaluated_critic`), and the
   price of cost is in units of the advantages' spread (`price_unit`).
7. In profile `small`, a tenth of every limit is kept in reserve (`margin`). `evaluators` predict what the
   policy that acts will pay, and brake when a limit is nearly spent (`candidates`).

The paper leaves points 2 and 3 open. Measured: studies `table1`, `ablations`, and `tuning`, on which profile
`small` was chosen (`data/README.md`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from tutorial_lib import losses
from tutorial_lib.agents import evaluation
from tutorial_lib.agents.evaluation import EvaluationConfig, Evaluators
from tutorial_lib.agents.implicit import ConstrainedAgent, ConstrainedConfig
from tutorial_lib.agents.player import BudgetPlayer, Player
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.costs.conditioning import after_step, draw_thresholds, encode, policy_weight
from tutorial_lib.costs.reconstruction import (
    CostReconstruction,
    ReconstructionConfig,
    reconstruction_error,
    train_reconstruction,
)
from tutorial_lib.data.dataset import Batch, Dataset
from tutorial_lib.networks import gaussian_log_prob
from tutorial_lib.tasks import Task


@dataclass(frozen=True)
class C2IQLConfig(ConstrainedConfig, ReconstructionConfig, EvaluationConfig):
    """The options of C2IQL: those of CIQL, of the reconstruction model and of constraint conditioning."""

    profiles = {"small": {"time_limits": "mask"}}  # which the clock needs


@dataclass(frozen=True)
class WithoutCRConfig(ConstrainedConfig, EvaluationConfig):
    """The options of C2IQL without cost reconstruction."""

    profiles = {"small": {"time_limits": "mask"}}


@dataclass(frozen=True)
class WithoutCCConfig(ConstrainedConfig, ReconstructionConfig):
    """The options of C2IQL without constraint conditioning."""


class C2IQL(ConstrainedAgent):
    """C2IQL, Algorithm 2. The numbers of its lines stand beside the code."""

    name = "C2IQL"
    Config: ClassVar[type[ConstrainedConfig]] = C2IQLConfig
    config: Any  # a C2IQLConfig; the ablations lack some of its options
    scalars = ConstrainedAgent.scalars | {
        "evaluators_loss": "squared error of the evaluators, summed over them, in cost ranges",
        "cost_mean": "mean expected cost of an episode, in unsafe steps: what line 9 compares with the limit",
    }
    at_test: ClassVar[tuple[str, ...]] = ("infinite_at_test", "tell", "margin", "candidates")
    conditioned = True
    """True if the limit is an input of every network."""
    reconstructs = True
    """True if the cost of an episode is reconstructed from m heads."""

    def __init__(self, task: Task, config: Any, *args: Any, **kwargs: Any):
        super().__init__(task, config, *args, **kwargs)
        if self.clock and config.time_limits != "mask":
            raise ValueError("clock=True needs time_limits='mask': its limits are on the remaining cost")
        self.gammas = torch.tensor(self.cost_gammas, device=self.device)  # (m,)

    @property
    def cost_gammas(self) -> tuple[float, ...]:
        return self.task.gammas if self.reconstructs else (self.config.gamma,)

    @property
    def clock(self) -> bool:
        """True if the networks see the time, and limits shrink by every recorded cost."""
        return self.conditioned and self.config.clock

    @property
    def evaluates(self) -> bool:
        """True if there are evaluators, which learn what the policy that acts will pay."""
        return self.conditioned and self.config.evaluators > 0

    @property
    def extra_inputs(self) -> int:
        return int(self.conditioned) + int(self.clock)

    def build(self) -> dict[str, nn.Module | Tensor]:
        built = super().build()
        if self.evaluates:
            inputs = self.task.obs_dim + self.extra_inputs
            built["evaluators"] = Evaluators(inputs, self.task.act_dim, self.config)
        if self.reconstructs:  # untrained until `prepare` or `load_state`
            built["reconstruction"] = CostReconstruction(self.task, self.config)
        return built

    @property
    def fixed(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("reconstruction",) if self.reconstructs else ()

    @property
    def targets(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*ConstrainedAgent.targets, *(("evaluators",) if self.evaluates else ()))

    def prepare(self, datasets: Sequence[Dataset], progress: bool = True) -> None:
        """Trains the reconstruction model of every seed, then does what CIQL does before the first update."""
        models: dict[int, CostReconstruction] = {}
        for run, seed in enumerate(self.seeds if self.reconstructs else ()):
            if seed not in models:  # runs with other limits learn from the same episodes
                models[seed] = train_reconstruction(
                    self.task, self.config, datasets[run], seed, self.device, progress
                )
            self.fill_network("reconstruction", run, models[seed])
        super().prepare(datasets, progress)

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns a batch of transitions, and thresholds (B,) as its `limit` (lines 4 and 5)."""
        batch = super().draw(data, generator, limit)
        if not self.conditioned:
            return batch
        return batch | {"limit": draw_thresholds(self.task, self.config, generator, batch)}

    def network_input(
        self, net: Networks, observations: Tensor, limit: Tensor, timesteps: Tensor | float = 0.0
    ) -> Tensor:
        """Returns normalised observations with the encoded limit as one more input, (..., obs + 1).

        With a `clock`, the share of the episode that is over is another one. `timesteps` (...) are the steps
        before.
        """
        observations = super().network_input(net, observations, limit)
        if not self.conditioned:
            return observations
        more = [encode(limit, self.task)]
        if self.clock:
            more.append(torch.zeros_like(limit) + timesteps / self.task.horizon)
        return torch.cat([observations, torch.stack(more, -1)], -1)

    def _inputs(self, net: Networks, batch: Fields) -> tuple[Tensor, Tensor]:
        """Returns the networks' inputs at s and at s', both (B, inputs)."""
        limit, t = batch.limit, batch.timesteps
        # Without a clock, a limit stands for a cost rate, which stays. With one, a cost uses it up.
        left = after_step(limit, batch.costs) if self.clock else limit
        s = self.network_input(net, batch.observations, limit, t)
        return s, self.network_input(net, batch.next_observations, left, t + 1)

    def episode_cost(self, net: Networks, q_cost: Tensor, timesteps: Tensor | float = 0.0) -> Tensor:
        """Returns the cost of an episode, (...,), for discounted costs (..., m) (lines 6 to 8).

        It is in unsafe steps per episode. Of `timesteps`, only eq. 2 needs to know.
        """
        horizon, gammas = self.task.horizon, self.gammas
        if not self.reconstructs:
            return super().episode_cost(net, q_cost, timesteps)  # Q_c / (L~ / L)
        if self.config.time_limits == "rate":  # the sum has no end: keep the share of the first T steps
            q_cost = q_cost * (1 - gammas**horizon)
        return net.reconstruction(q_cost)

    def untouched(self, cost: Tensor, state_cost: Tensor, limit: Tensor) -> Tensor:
        """Returns true where the limit is infinite, (B,). No V_r there contains a payment."""
        return limit.isinf() if self.conditioned else super().untouched(cost, state_cost, limit)

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, a, limit, over = self.config, batch.actions, batch.limit, self.clock * batch.timesteps
        s, s_next = self._inputs(net, batch)  # with a clock, limits are on the cost after `over` steps

        # Lines 6-8: cost reconstruction. The critic that predicts the highest cost counts.
        q_cost = net.target_cost_critics(s, a)  # (k, B, m)
        costs = self.episode_cost(net, q_cost, over)  # (k, B)
        cost, q_cost = costs.amax(0), self.evaluated_heads(q_cost, costs)  # (B,) and (B, m)

        # Line 18: its target, the cost of the recorded step. Eq. 16 prints V_c(s), but V_c(s') is meant.
        mask = self.cost_mask(batch)[:, None]
        cost_target = losses.td_target(batch.costs[:, None], self.gammas, net.cost_value(s_next), mask)
        if config.recorded_step:
            cost = torch.maximum(cost, self.episode_cost(net, cost_target.detach(), over))

        # Lines 9-10: constraint penalisation.
        q_reward = net.target_critics(s, a).amin(0)
        v_cost = net.cost_value(s)  # (B, m)
        state_cost = self.state_cost(net, v_cost, over)
        q = self.penalised_q(net, q_reward, cost, state_cost, limit)

        # Lines 11-12: value function.
        v = net.value(s)
        value_loss = losses.expectile_loss(q, v, config.kappa_1)

        # Lines 13-14: cost value function of the implicit policy that V_r above defines.
        weight = losses.expectile_weight(q - v, config.evaluated_kappa)
        cost_value_loss = losses.cost_value_loss(weight, q_cost, v_cost)

        # Lines 15-16: Q-value function.
        target = losses.td_target(batch.rewards, config.gamma, net.value(s_next), self.reward_mask(batch))
        critic_loss = losses.td_loss(target, net.critics(s, a))

        # Lines 17-18: cost Q-value function, for all gamma_i at once.
        cost_critic_loss = losses.td_loss(cost_target, net.cost_critics(s, a))

        # Lines 19-20: policy extraction.
        weight = losses.expectile_weight(q - v, config.kappa_2) * policy_weight(config, batch)
        policy_loss = losses.policy_loss(weight, gaussian_log_prob(a, *net.policy(s)))

        of_networks = {"value": value_loss, "cost_value": cost_value_loss, "critic": critic_loss}
        of_networks |= {"cost_critic": cost_critic_loss, "policy": policy_loss}
        if self.evaluates:
            of_networks["evaluators"] = evaluation.evaluation_loss(net, batch, s, s_next, self.task)
        return of_networks, self.logged(cost, limit, v, q_reward, state_cost) | {"cost_mean": cost.mean()}

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        return BudgetPlayer(self, limits, run) if self.conditioned else super().player(limits, seeds, run)

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0, t: int = 0) -> np.ndarray:
        """Returns actions (E, act) at observations (E, obs) of step t under limits (E,).

        They are the policy's means, unless it brakes harder (`candidates`).
        """
        return self._choose(observations, limits, run, t)[0].cpu().numpy()

    def predicted_cost(
        self, observations: np.ndarray, limits: np.ndarray, run: int = 0, t: int = 0
    ) -> np.ndarray:
        """Returns the cost of the rest of an episode, (E,), that is predicted for the actions of `act`.

        It is in unsafe steps: the highest of the evaluators', or of the cost critics' where there are no
        evaluators. The observations of step t are (E, obs) and the limits are (E,).
        """
        return self._choose(observations, limits, run, t)[1].cpu().numpy()

    @torch.no_grad()
    def _choose(
        self, observations: np.ndarray, limits: np.ndarray, run: int, t: int
    ) -> tuple[Tensor, Tensor]:
        """Returns the actions (E, act) that are played, and the cost (E,) that is predicted for each."""
        net, limit = self.networks(run), self._tensor(limits)
        s = self.network_input(net, self._tensor(observations), limit, t)
        mean, log_std = net.policy(s)
        if not self.evaluates:
            over = t if self.clock else 0.0
            return mean, self.episode_cost(net, net.cost_critics(s, mean), over).amax(0)
        count = self.config.candidates if evaluation.is_nearly_zero(limit, self.task).any() else 0
        actions = evaluation.proposals(mean, log_std, count)  # (E, n, act)
        episodes, n, _ = actions.shape
        shares = net.evaluators(s.repeat_interleave(n, 0), actions.flatten(0, 1)).amax(0)
        costs = shares.view(episodes, n) * evaluation.most_cost(self.task, t)
        played = evaluation.braking(costs, limit, self.task)[:, None]  # (E, 1)
        return actions.take_along_dim(played[..., None], 1).squeeze(1), costs.take_along_dim(
            played, 1
        ).squeeze(1)

    def diagnose(self, dataset: Dataset, run: int = 0) -> dict[str, float]:
        """Returns the error of a run's reconstruction model, in unsafe steps per episode."""
        if not self.reconstructs:
            return {}
        model = self.networks(run).reconstruction
        return {"reconstruction_error": reconstruction_error(model, self.task, self.config, dataset)}


class C2IQLWithoutCR(C2IQL):
    """C2IQL without cost reconstruction (Section 4.2). It has one discount factor, and L~ is the limit."""

    name = "C2IQL w/o CR"
    in_table1 = False
    Config = WithoutCRConfig
    reconstructs = False


class C2IQLWithoutCC(C2IQL):
    """C2IQL without constraint conditioning (Section 4.2). It is trained for one limit, which is no input."""

    name = "C2IQL w/o CC"
    in_table1 = False
    Config = WithoutCCConfig
    scalars = {name: words for name, words in C2IQL.scalars.items() if name != "evaluators_loss"}
    needs_limit = True
    at_test = ()
    conditioned = False
