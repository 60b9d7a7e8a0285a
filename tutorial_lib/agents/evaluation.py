"""Fitted Q evaluation of the policy that acts: it predicts what the rest of an episode will cost.

Source: Le, Voloshin and Yue 2019, "Batch Policy Learning under Constraints" (fitted Q evaluation). It is not
in the C2IQL paper. The cost critics of C2IQL learn the cost of the implicit policy of V_r, from recorded
actions alone. The policy that acts is another one: it is extracted with another expectile, a Gaussian is
fitted to it, and its mean is played. So what C2IQL's critics predict is not what the policy pays. A critic
of this module bootstraps at the action that the policy takes in s', under what is then left of the limit.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from tutorial_lib import losses
from tutorial_lib.agents.critic import goes_on
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import NOT_NEGATIVE
from tutorial_lib.costs.conditioning import ConditioningConfig
from tutorial_lib.networks import Critics
from tutorial_lib.tasks import Task

LESS, NEARLY = 0.2, 0.05
"""The shares in `braking`: of the predicted cost, and of the task's cost range."""


@dataclass(frozen=True)
class EvaluationConfig(ConditioningConfig):
    """The options of constraint conditioning and of fitted Q evaluation."""

    evaluators: Annotated[int, NOT_NEGATIVE] = 0
    """The number of critics that learn what the policy that acts will pay. The highest counts. With 0 there
    are none. They need `clock=True`."""
    candidates: Annotated[int, NOT_NEGATIVE] = 0
    """The number of actions that the policy proposes, besides its mean, when (nearly) nothing is left of the
    limit that it is told. If the evaluators predict more cost than is left, and clearly less for one of the
    proposals, that one is played (see `braking`). With 0, or without evaluators, the mean is always played.
    """
    tell: Literal["left", "throughout", "switch"] = "left"
    """Which limit the policy is told at each step. With 'left', it is what is left of the limit (eq. 23). The
    other two are controls. With 'throughout', it is the limit itself at every step, so that nothing counts
    the cost. With 'switch', it is infinity as long as anything is left, and then zero, so that the network
    knows of no limit between the two."""

    profiles = {"small": {"evaluators": 2, "candidates": 64, "margin": 0.1}}

    def __post_init__(self):
        super().__post_init__()
        if self.evaluators and not self.clock:
            raise ValueError("evaluators need clock=True: they predict the remaining cost")


class Evaluators(Critics):
    """k critics that predict the remaining cost as a share of the largest possible one, in (0, 1)."""

    def __init__(self, inputs: int, act_dim: int, config: EvaluationConfig):
        super().__init__(inputs, act_dim, config, scale=1.0, k=config.evaluators)

    def forward(self, inputs: Tensor, actions: Tensor) -> Tensor:
        """Returns shares (k, B) of inputs (B, inputs) and actions (B, act)."""
        return torch.sigmoid(super().forward(inputs, actions) - 1.0)


def most_cost(task: Task, timesteps: Tensor | float) -> Tensor | float:
    """Returns the largest cost that the steps after `timesteps` (...) can have together, (...)."""
    return (task.horizon - timesteps) * task.max_step_cost


def evaluation_loss(net: Networks, batch: Fields, s: Tensor, s_next: Tensor, task: Task) -> Tensor:
    """Returns the squared error of the evaluators, summed over them, in units of the task's cost range.

    `s` and `s_next` (B, inputs) are the networks' inputs at both ends of the transitions. The target of an
    evaluator is c + Q(s', pi(s')) of its own target network, and c where nothing follows s'. A maximum over
    evaluators in the target would be taken again at every backup, and their errors would add up.
    """
    with torch.no_grad():
        action, _ = net.policy(s_next)
        follows = net.target_evaluators(s_next, action) * most_cost(task, batch.timesteps + 1)  # (k, B)
    target = losses.td_target(batch.costs, 1.0, follows, goes_on(batch, "mask"))
    predicted = net.evaluators(s, batch.actions) * most_cost(task, batch.timesteps)
    return ((target - predicted) / task.cost_range).square().mean(-1).sum()


def proposals(mean: Tensor, log_std: Tensor, count: int) -> Tensor:
    """Returns the actions that a Gaussian policy proposes, (E, 1 + count, act): first its mean (E, act).

    The others are spread as the Gaussian is, always by the same random numbers. So an agent's action is a
    function of the state, the limit and the time. `log_std` is (act,).
    """
    noise = torch.randn(count, mean.shape[-1], generator=torch.Generator().manual_seed(0)).to(mean)
    others = mean[:, None] + log_std.exp() * noise
    return torch.cat([mean[:, None], others.clamp(-1, 1)], 1)


def braking(costs: Tensor, limits: Tensor, task: Task) -> Tensor:
    """Returns which of n proposed actions is played, (E,), by predicted costs (E, n) and limits (E,).

    It is the first, the policy's mean, unless the limit is nearly zero (`is_nearly_zero`), the mean's
    predicted cost exceeds it, and the least predicted cost is lower by at least the share `LESS` of the
    mean's. A network is smooth: told zero just above a speed limit, it brakes as little as a policy that is
    just below. The evaluators have learned from all recorded actions what braking harder would save. Where
    they see little difference it is noise, and the mean is the better choice.
    """
    mean, least = costs[:, 0], costs.min(1)
    brakes = is_nearly_zero(limits, task) & (mean > limits) & (least.values <= (1 - LESS) * mean)
    return torch.where(brakes, least.indices, 0)


def is_nearly_zero(limits: Tensor, task: Task) -> Tensor:
    """Returns true where a limit is at most the share `NEARLY` of the task's cost range, for any shape."""
    return limits <= NEARLY * task.cost_range
