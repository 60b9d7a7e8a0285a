"""What changes along a PPO run: prices, noise, the learning rate, and the Lagrange multiplier.

This module imports stable-baselines3, which takes seconds. Import it where it is needed.
"""

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from tutorial_lib.tasks import Task
from tutorial_lib.tasks.recipes import Recipe


class LagrangeMultiplier:
    """The price of an unsafe step, controlled so that the mean cost of an episode follows a limit.

    With the violation v = (mean cost - limit) / cost_range, each `update` computes

        integral <- clip(integral + 0.2 v, 0, largest_integral),   value <- max(0, integral + 2 v),

    the integral and the proportional control of Stooke et al. 2020, "Responsive Safety in Reinforcement
    Learning by PID Lagrangian Methods". Costs, limits and `cost_range` are costs of an episode. `value` is a
    price of an unsafe step, in units of the task's best mean reward per step, and so is `integral`.
    """

    def __init__(self, cost_range: float, largest_integral: float):
        self.cost_range, self.largest_integral = cost_range, largest_integral
        self.integral = 0.0
        self.value = 0.0

    def update(self, mean_cost: float, limit: float) -> None:
        """Change `integral` and `value` after episodes of this mean cost."""
        violation = (mean_cost - limit) / self.cost_range
        self.integral = float(np.clip(self.integral + 0.2 * violation, 0, self.largest_integral))
        self.value = max(0.0, self.integral + 2 * violation)


class Schedule(BaseCallback):
    """Sets, before every batch, what changes along a run: prices, noise, learning rate and multiplier.

    `price_scale` of the environments becomes, for a priced agent, a factor that rises from 0 to 1 over
    `recipe.ramp`, and for a lagrangian agent the multiplier. The multiplier's limit falls from
    `task.cost_range` to zero over `recipe.limit_falls`.
    """

    def __init__(
        self,
        task: Task,
        recipe: Recipe,
        kind: str,
        episodes: list[dict[str, np.ndarray]],
        first_step: int = 0,
    ):
        """`episodes` is the list to which the environments append; `first_step` counts the steps before."""
        super().__init__()
        self.task, self.recipe, self.kind, self.episodes = task, recipe, kind, episodes
        self.first_step = first_step
        self.progress = 0.0
        """The share of the run that was over when the present batch began, in [0, 1]."""
        self.multiplier = LagrangeMultiplier(task.cost_range, recipe.prices[1])
        self._episodes_seen = 0  # by the multiplier

    def learning_rate(self, _progress_remaining: float) -> float:
        """PPO's learning rate at `progress`. The argument is PPO's own progress, which is one slice's."""
        first, last = self.recipe.learning_rate
        return first + (last - first) * self.progress

    def _on_rollout_start(self) -> None:
        self.progress = min((self.first_step + self.model.num_timesteps) / self.recipe.steps, 1.0)
        self.training_env.set_attr("price_scale", self._price_scale())
        calm = self.recipe.calm
        if calm is not None and self.progress >= calm[0]:
            log_std: Any = self.model.policy.log_std
            log_std.data.clamp_(max=np.log(calm[1]))

    def _price_scale(self) -> float:
        if self.kind == "lagrangian":
            self._update_multiplier()
            return float(self.multiplier.value)
        ramp = self.recipe.ramp
        return 1.0 if ramp is None else float(np.interp(self.progress, ramp, (0, 1)))

    def _update_multiplier(self) -> None:
        """Show the multiplier the episodes that ended in the last batch, if any did.

        A slice has a schedule and a list of episodes of its own, so the multiplier never sees the episodes of
        the last batch of a slice.
        """
        new = self.episodes[self._episodes_seen :]
        self._episodes_seen = len(self.episodes)
        if new:
            mean_cost = float(np.mean([episode["costs"].sum() for episode in new]))
            limit = np.interp(self.progress, self.recipe.limit_falls, (self.task.cost_range, 0.0))
            self.multiplier.update(mean_cost, limit)

    def _on_step(self) -> bool:
        return True  # go on
