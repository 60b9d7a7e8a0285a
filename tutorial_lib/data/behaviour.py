"""The environments in which behaviour policies learn. They record every episode and charge for unsafe steps.

There are two kinds of agents, and one environment for each.

- A *priced* agent (`PricedCost`) learns a whole family of behaviours at once. Every episode draws a price for
  an unsafe step and a free allowance of unsafe steps, and the policy observes both. Prices alone give steady
  trade-offs between reward and cost: a Lagrangian with a fixed multiplier. Allowances give the costs in
  between where the best policy for a price has either all of the cost or none of it, as in the Run tasks.
- A *lagrangian* agent (`LagrangianCost`) learns one behaviour at a time. All its episodes pay the same price,
  the Lagrange multiplier, which `tutorial_lib.data.schedule` changes along the run. The policy observes
  neither the multiplier nor the limit.
"""

import gymnasium
import numpy as np
from scipy.spatial.transform import Rotation

from tutorial_lib.data.dataset import KEYS
from tutorial_lib.tasks import Task, make_env
from tutorial_lib.tasks.recipes import Recipe


class RecordedTask(gymnasium.Wrapper):
    """A task whose episodes are recorded, and whose reward is what a behaviour policy maximises.

    The reward of a step is `r * horizon / max_return - charge(cost)`, where r is the simulator's reward. Its
    unit is the task's best mean reward per step. Observations are float32 of shape (obs_dim + extra_inputs,),
    or (obs_dim + 2 + extra_inputs,) with `recipe.own_axes`. The cost of a step stays in `info["cost"]`.
    """

    extra_inputs: int = 0
    """How many numbers `extra` appends to an observation."""

    def __init__(
        self,
        task: Task,
        recipe: Recipe,
        rng: np.random.Generator,
        episodes: list[dict[str, np.ndarray]],
    ):
        """Start the simulator of `task`.

        `rng` draws the first state of every episode, and its price and allowance. A finished episode of T
        steps is appended to `episodes`, as arrays under `dataset.KEYS`: observations and next_observations
        (T, obs_dim), actions (T, act_dim), all others (T,). They are the simulator's, without what the agent
        is charged.
        """
        super().__init__(make_env(task))
        self.task, self.recipe, self.rng, self.episodes = task, recipe, rng, episodes
        self.price_scale = 0.0  # Schedule sets it before every batch
        inputs = task.obs_dim + (2 if recipe.own_axes else 0) + self.extra_inputs
        limit = np.full(inputs, 1000.0, np.float32)
        self.observation_space = gymnasium.spaces.Box(-limit, limit)

    def begin_episode(self) -> None:
        """Draw what the next episode needs. Here, nothing."""

    def charge(self, cost: float) -> float:
        """What the agent pays for a step of this cost, in units of the task's best mean reward per step."""
        raise NotImplementedError

    def extra(self) -> list[float]:
        """The `extra_inputs` numbers that the policy observes besides the observation."""
        return []

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode and return (observation, info). `rng` seeds the simulator: `seed` is ignored."""
        self.begin_episode()
        self.observation, info = self.env.reset(seed=int(self.rng.integers(2**31)))
        self.record: dict[str, list] = {key: [] for key in KEYS}
        return self._observed(), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Take `action` (act_dim,), record it, and return (observation, reward, terminated, truncated, info).

        Raises ValueError for an action of another shape.
        """
        last = self.observation
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        row = {
            "observations": last,
            "next_observations": self.observation,
            "actions": action,
            "rewards": reward,
            "costs": info["cost"],
            "terminals": terminated,
            "timeouts": truncated,
        }
        for key, value in row.items():
            self.record[key].append(value)
        if terminated or truncated:
            self.episodes.append({key: np.asarray(values) for key, values in self.record.items()})
        reward = float(reward) * self.task.horizon / self.task.max_return - self.charge(info["cost"])
        return self._observed(), float(reward), terminated, truncated, info

    def _observed(self) -> np.ndarray:
        seen = along_own_axes(self.observation) if self.recipe.own_axes else self.observation
        return np.append(seen, self.extra()).astype(np.float32)


class PricedCost(RecordedTask):
    """Every episode has its own price and its own allowance of unsafe steps, and the policy observes both.

    An observation ends with the logarithm of the price, and with what is left of the allowance in units of
    half the task's `cost_range`. `price_scale` (0 to 1) multiplies all prices.
    """

    extra_inputs = 2

    def begin_episode(self) -> None:
        """Draw the price and the allowance, from the ranges of the recipe."""
        low, high = np.log(self.recipe.prices)
        if self.rng.random() < self.recipe.allowance_share:
            share = max(0.0, self.rng.uniform(*self.recipe.allowances))
            self.log_price, self.allowance = high, share * self.task.cost_range
        else:
            self.log_price, self.allowance = self.rng.uniform(low, high), 0.0

    def charge(self, cost: float) -> float:
        """The price times the cost, or 0 while the allowance is not used up. Takes the cost off it first."""
        self.allowance -= cost
        return np.exp(self.log_price) * (cost * (self.allowance < 0) * self.price_scale)

    def extra(self) -> list[float]:
        """The logarithm of the price, and what is left of the allowance."""
        return [self.log_price, 2 * max(self.allowance, 0.0) / self.task.cost_range]


class LagrangianCost(RecordedTask):
    """All episodes pay the same price, the Lagrange multiplier. The policy does not observe it.

    `price_scale` is the multiplier: what an unsafe step costs, in units of the best mean reward per step.
    """

    def charge(self, cost: float) -> float:
        """The multiplier times the cost."""
        return self.price_scale * cost


KINDS: dict[str, type[RecordedTask]] = {"priced": PricedCost, "lagrangian": LagrangianCost}
"""The environment of each kind of agent. The place of a kind in this order enters the seeds of its runs."""


def along_own_axes(observation: np.ndarray) -> np.ndarray:
    """An observation of an ant or a drone, (obs,), expressed along the axes of its body, (obs + 2,).

    Their observations begin with the position (3, in tens of metres), the velocity (3), the attitude (4, a
    quaternion x, y, z, w) and the angular velocity (3). The result consists of, in this order,

    - the position (3) as it was, because costs depend on the place;
    - along the axes of the body, the velocity, the angular velocity, the upward direction and the position on
      the ground (3 each), of which the last two replace the attitude;
    - the rest of the observation as it was.
    """
    position, velocity, attitude, spin, rest = np.split(observation, [3, 6, 10, 13])
    world = np.array([velocity, spin, (0, 0, 1), (*position[:2], 0)])
    own = Rotation.from_quat(attitude).inv().apply(world)
    return np.concatenate([position, own.ravel(), rest])
