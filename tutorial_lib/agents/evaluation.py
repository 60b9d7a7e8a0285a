"""Fitted Q evaluation of the policy that acts: it predicts what the rest of an episode will cost.

Source: Le, Voloshin and Yue 2019, "Batch Policy Learning under Constraints" (fitted Q evaluation). It is not
in the C2IQL paper. The cost critics of C2IQL learn the cost of the implicit policy of V_r, from recorded
actions alone. The policy that acts is another one: it is extracted with another expectile, a Gaussian is
fitted to it, and its mean is played. So what C2IQL's critics predict is not what the policy pays. A critic
of this module bootstraps at the action that the policy takes in s', under what is then left of the limit.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from torch import Tensor

from tutorial_lib import losses
from tutorial_lib.agents.critic import goes_on
from tutorial_lib.agents.seeds import Fields, Networks
from tutorial_lib.config import NOT_NEGATIVE
from tutorial_lib.costs.conditioning import ConditioningConfig
from tutorial_lib.networks import Critics
from tutorial_lib.tasks import Task

LIMITS_TO_TELL = 41
"""The number of limits among which `limits_to_tell` lets an agent choose."""


@dataclass(frozen=True)
class EvaluationConfig(ConditioningConfig):
    """The options of constraint conditioning and of fitted Q evaluation."""

    evaluators: Annotated[int, NOT_NEGATIVE] = 0
    """The number of critics that learn what the policy that acts will pay. The highest counts. With 0 there
    are none. They need `clock=True`."""
    tell: Literal["left", "predicted", "throughout", "switch"] = "left"
    """Which limit the policy is told at each step. With 'left', it is what is left of the limit (eq. 23).
    With 'predicted', it is the largest finite limit for which the evaluators predict no more cost than is
    left. The other two are controls. With 'throughout', it is the limit itself at every step, so that nothing
    counts the cost. With 'switch', it is infinity as long as anything is left, and then zero, so that the
    network knows of no limit between the two."""

    def __post_init__(self):
        super().__post_init__()
        if self.evaluators and not self.clock:
            raise ValueError("evaluators need clock=True: they predict the remaining cost")
        if self.tell == "predicted" and not self.evaluators:
            raise ValueError("tell='predicted' needs evaluators: set evaluators=1")


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


def limits_to_tell(task: Task) -> np.ndarray:
    """Returns the limits that an agent can choose to be told, (n,): from zero to the task's cost range.

    Infinity is not among them. A policy that is told infinity may go where no limit is kept afterwards.
    """
    return np.linspace(0, task.cost_range, LIMITS_TO_TELL)


def largest_that_fits(limits: np.ndarray, costs: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Returns the largest of `limits` (n,) whose cost (E, n) is at most what is left (E,), or zero, (E,).

    `limits` rise.
    """
    fits = costs <= left[:, None]
    last = len(limits) - 1 - fits[:, ::-1].argmax(1)
    return np.where(fits.any(1), limits[last], 0.0)
