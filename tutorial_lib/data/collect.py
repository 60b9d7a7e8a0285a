"""From behaviour policies to a dataset: `c2iql collect TASK`.

The sources of the data are PPO agents of two kinds. PPO is stable-baselines3's, the maintained reference.

- A *priced* agent learns a whole family of behaviours at once. Every episode draws a price for an unsafe
  step and a free allowance of unsafe steps. The policy sees both. Its reward is r - price * cost once the
  allowance is used up. Prices alone give steady trade-offs between reward and cost (a Lagrangian with a fixed
  multiplier). Allowances reach the costs in between where the best policy is all or nothing, as in the Run
  tasks.
- A *lagrangian* agent learns one behaviour, which changes along its training: its limit on the cost of an
  episode falls from the task's cost range to zero, and a Lagrange multiplier follows the limit. DSRL's data
  were made with limits that changed along training, too. The policy sees neither multiplier nor limit.

Every training episode is kept, as DSRL does, so that the data hold beginners and experts; a grid over cost
and return then thins them. Prices, allowances and limits are not stored: the data look like recordings of
many unknown policies.

A run is cut into slices. Every slice starts from files alone, whether or not the run was killed before it,
so the same seeds give the same file on the same machine.
"""

import json
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import gymnasium
import joblib
import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tqdm.auto import tqdm

from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.files import written_whole
from tutorial_lib.tasks import Task, make_env

KINDS = ("priced", "lagrangian")
SOURCES = ("priced-0", "lagrangian-0")
"""The sources of a dataset unless others are asked for: a kind and a seed each."""
SLICE_STEPS = 204_800
"""Simulator steps between two states on disk: what a killed run loses at most."""

FIELDS = ("observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts")


@dataclass(frozen=True)
class Recipe:
    """How one task's data is collected."""

    episodes: int
    """About how many episodes the dataset keeps: DSRL's number, or what 14 to 18 MB hold."""
    return_cells: int = 20
    """Episodes of like cost are thinned evenly over so many cells of return. 1: by chance, so that experts
    are as frequent as in the run; where one episode in forty is kept, they would be too few otherwise."""
    steps: int = 2_000_000
    """Simulator steps of one PPO run."""
    prices: tuple[float, float] = (0.02, 4.0)
    """Range of the price of an unsafe step, in units of the task's best mean reward per step."""
    allowance_share: float = 0.5
    """Share of episodes with a free allowance, at the highest price; the others have a price alone."""
    allowances: tuple[float, float] = (0.0, 1.0)
    """Range of the allowance, in cost ranges; below zero is zero."""
    ramp: tuple[float, float] | None = (0.15, 0.5)
    """Shares of the run between which prices rise from nothing to their full size: a robot that cannot move
    yet would learn to stand still. None: full prices at once, where speed itself is unsafe and, once learned,
    hard to unlearn."""
    learning_rate: tuple[float, float] = (1e-3, 3e-4)
    """PPO's learning rate at the first and at the last step."""
    calm: tuple[float, float] | None = None
    """From this share of the run on, actions have at most this noise (standard deviation): a robot that
    stumbles over its own exploration shows less than it can. None: as PPO likes."""
    target_kl: float | None = None
    """PPO goes over a batch ten times, or until the policy has moved 1.5 times this far (KL divergence)."""
    batch_steps: int = 4096
    """Steps between two PPO updates, over 16 environments."""
    width: int = 64
    """Of PPO's two hidden layers."""
    limit_falls: tuple[float, float] = (0.2, 0.95)
    """Shares of the run between which a lagrangian agent's limit falls from the cost range to zero."""
    own_axes: bool = False
    """PPO sees the world along the axes of the robot's body, so that a gait learned in one direction serves
    in all. The data keeps the simulator's observations."""


_RUN = {"prices": (0.2, 1.5), "allowance_share": 1.0, "allowances": (-0.2, 1.0), "ramp": None}
# Without target_kl DroneCircle's drone unlearned to fly: returns peaked after 1.3 million steps, and falls
# rose from 8% to over 30%. At a learning rate of 3e-4 it earned 14 after 200,000 steps, with target_kl 106.
_LONG = {"width": 128, "target_kl": 0.02, "return_cells": 1}

RECIPES = {
    "BallRun": Recipe(episodes=940, steps=1_000_000, **_RUN),
    "CarRun": Recipe(episodes=651, steps=800_000, **_RUN),
    "BallCircle": Recipe(episodes=886, steps=2_000_000),
    "CarCircle": Recipe(episodes=1_100, steps=1_500_000),
    # DSRL's numbers of episodes would make these files larger than all others together.
    "DroneRun": Recipe(episodes=640, steps=2_000_000, width=128, **_RUN),
    "AntRun": Recipe(episodes=340, steps=3_000_000, **_LONG, **_RUN),
    "DroneCircle": Recipe(episodes=410, steps=4_000_000, ramp=(0.25, 0.6), **_LONG),
    # After 800,000 steps the ant earned 114 and fell in 10% of the episodes; along the world's axes, 25 and
    # 42%.
    "AntCircle": Recipe(
        episodes=130,
        steps=10_000_000,
        ramp=(0.25, 0.5),
        learning_rate=(1e-3, 5.8e-4),
        own_axes=True,
        # With half of its noise it earned a fifth more and fell less: 195 and 17% for 163 and 28%.
        calm=(0.76, 0.2),
        **_LONG,
    ),
}


class RecordedTask(gymnasium.Wrapper):
    """Records every episode, and charges for unsafe steps as the kind of source says.

    Rewards are in units of the task's best mean reward per step. `episodes` receives the finished episodes.
    """

    extra_inputs = 0

    def __init__(self, task: Task, recipe: Recipe, rng: np.random.Generator, episodes: list[dict]):
        super().__init__(make_env(task))
        self.task, self.recipe, self.rng, self.episodes = task, recipe, rng, episodes
        self.price_scale = 0.0
        inputs = task.obs_dim + (2 if recipe.own_axes else 0) + self.extra_inputs
        limit = np.full(inputs, 1000.0, np.float32)
        self.observation_space = gymnasium.spaces.Box(-limit, limit)

    def begin_episode(self) -> None:
        """Draw what the next episode needs."""

    def charge(self, cost: float) -> float:
        """What the agent pays for a step of this cost, in units of the task's best mean reward per step."""
        raise NotImplementedError

    def extra(self) -> list[float]:
        """What the policy sees besides the observation."""
        return []

    def reset(self, *, seed=None, options=None):
        self.begin_episode()
        self.observation, info = self.env.reset(seed=int(self.rng.integers(2**31)))
        self.record = {name: [] for name in FIELDS}
        return self._augmented(), info

    def step(self, action):
        last = self.observation
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        row = (last, self.observation, action, reward, info["cost"], terminated, truncated)
        for name, value in zip(FIELDS, row, strict=True):
            self.record[name].append(value)
        if terminated or truncated:
            self.episodes.append({name: np.asarray(values) for name, values in self.record.items()})
        reward = reward * self.task.horizon / self.task.max_return - self.charge(info["cost"])
        return self._augmented(), float(reward), terminated, truncated, info

    def _augmented(self):
        seen = along_own_axes(self.observation) if self.recipe.own_axes else self.observation
        return np.append(seen, self.extra()).astype(np.float32)


class PricedCost(RecordedTask):
    """Every episode has a price and an allowance of its own, and the policy sees both."""

    extra_inputs = 2

    def begin_episode(self):
        low, high = np.log(self.recipe.prices)
        if self.rng.random() < self.recipe.allowance_share:
            share = max(0.0, self.rng.uniform(*self.recipe.allowances))
            self.log_price, self.allowance = high, share * self.task.cost_range
        else:
            self.log_price, self.allowance = self.rng.uniform(low, high), 0.0

    def charge(self, cost):
        self.allowance -= cost
        return np.exp(self.log_price) * (cost * (self.allowance < 0) * self.price_scale)

    def extra(self):
        return [self.log_price, 2 * max(self.allowance, 0.0) / self.task.cost_range]


class LagrangianCost(RecordedTask):
    """All episodes pay the same price, which is the Lagrange multiplier; the policy does not see it."""

    def charge(self, cost):
        return self.price_scale * cost


def along_own_axes(observation: np.ndarray) -> np.ndarray:
    """What an ant or a drone observes (obs,), told along the axes of its body (obs + 2,).

    Their observations begin with the position in tens of metres, the velocity, the attitude (a quaternion)
    and the angular velocity. The position stays, for costs lie at fixed places; the attitude becomes the
    direction of the sky and, along the body's axes as well, the position on the ground.
    """
    position, velocity, attitude, spin, rest = np.split(observation, [3, 6, 10, 13])
    world = np.array([velocity, spin, (0, 0, 1), (*position[:2], 0)])
    own = Rotation.from_quat(attitude).inv().apply(world)
    return np.concatenate([position, own.ravel(), rest])


def run_ppo(
    task: Task, recipe: Recipe, kind: str, seed: int, folder: Path, slice_steps: int = SLICE_STEPS
) -> None:
    """One PPO run. Every finished slice of it is on disk, and a killed run continues after the last one.

    Raises ValueError for a kind that does not exist, and for a folder in which another recipe was begun.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of source {kind!r}: the kinds are {', '.join(KINDS)}")
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    done = len(list(folder.glob("episodes-*.safetensors")))
    made_with = {"recipe": _how_to_play(recipe), "slice_steps": str(slice_steps)}
    if done:
        with safe_open(_state_path(folder, done), "np") as file:
            if file.metadata() != made_with:
                raise ValueError(
                    f"{folder}: was begun with another recipe: choose another folder with --runs"
                )
    slices = -(-recipe.steps // slice_steps)  # the last slice ends with the steps
    bar = tqdm(total=recipe.steps, initial=done * slice_steps, desc=f"{task.name} {kind} {seed}", unit="step")
    for index in range(done, slices):
        started = time.perf_counter()
        episodes: list[dict] = []
        model, schedule = _make_ppo(task, recipe, kind, seed + 1000 * index, episodes)
        before = _load_ppo(model, schedule, _state_path(folder, index)) if index else 0.0
        schedule.first = index * slice_steps
        goal = min(schedule.first + slice_steps, recipe.steps)
        model.learn(goal - schedule.first, callback=schedule)
        seconds = before + time.perf_counter() - started
        _save_ppo(model, schedule, _state_path(folder, index + 1), seconds, made_with)
        arrays = {name: np.concatenate([e[name] for e in episodes]) for name in FIELDS}
        _save(arrays, folder / f"episodes-{index:03d}.safetensors")
        if index:
            _state_path(folder, index).unlink(missing_ok=True)
        bar.update(goal - bar.n)
    bar.close()


def _state_path(folder: Path, slices: int) -> Path:
    """The state after so many slices: written before their last episodes, kept until the next is whole."""
    return folder / f"state-{slices:03d}.safetensors"


class _Schedule(BaseCallback):
    """What changes along a run of `recipe.steps` steps: prices, noise, the learning rate, the multiplier."""

    def __init__(self, task: Task, recipe: Recipe, kind: str, episodes: list[dict]):
        super().__init__()
        self.task, self.recipe, self.kind, self.episodes = task, recipe, kind, episodes
        self.first = 0  # steps before this slice
        self.integral = 0.0  # of the multiplier's violations
        self.looked_at = 0  # episodes that the multiplier has seen
        self.cost = 0.0  # their mean cost, of the last batch that finished any

    @property
    def progress(self) -> float:
        """The share of the run that is over, in [0, 1]."""
        steps = 0 if self.model is None else self.model.num_timesteps
        return min((self.first + steps) / self.recipe.steps, 1.0)

    def learning_rate(self, _) -> float:
        """PPO's learning rate now (its own progress starts anew with every slice)."""
        first, last = self.recipe.learning_rate
        return first + (last - first) * self._at_rollout

    def _on_rollout_start(self):
        self._at_rollout = self.progress
        if self.kind == "priced":
            ramp = self.recipe.ramp
            scale = 1.0 if ramp is None else np.interp(self._at_rollout, ramp, (0, 1))
        else:
            scale = self._multiplier()
        self.model.env.set_attr("price_scale", float(scale))
        calm = self.recipe.calm
        if calm is not None and self._at_rollout >= calm[0]:
            self.model.policy.log_std.data.clamp_(max=np.log(calm[1]))

    def _multiplier(self) -> float:
        """Proportional and integral control of the mean cost of an episode (Stooke et al. 2020)."""
        new = self.episodes[self.looked_at :]
        self.looked_at = len(self.episodes)
        if new:
            self.cost = float(np.mean([episode["costs"].sum() for episode in new]))
            limit = np.interp(self._at_rollout, self.recipe.limit_falls, (self.task.cost_range, 0.0))
            violation = (self.cost - limit) / self.task.cost_range
            self.integral = float(np.clip(self.integral + 0.2 * violation, 0, self.recipe.prices[1]))
            self.value = max(0.0, self.integral + 2 * violation)
        return self.value

    _at_rollout = value = 0.0

    def _on_step(self) -> bool:
        return True


def _how_to_play(recipe: Recipe) -> str:
    """The recipe without what only thinning looks at, as text."""
    played = asdict(recipe)
    del played["episodes"], played["return_cells"]
    return json.dumps(played)


def read_source(source: str) -> tuple[str, int]:
    """The kind and the seed of a source such as 'priced-0'. Raises ValueError for another form."""
    kind, _, seed = source.partition("-")
    if kind not in KINDS or not seed.isdecimal():
        raise ValueError(
            f"source {source!r}: write KIND-SEED, e.g. priced-0; the kinds are {', '.join(KINDS)}"
        )
    return kind, int(seed)


def collect(
    task: Task, sources: tuple[str, ...], recipe: Recipe, folder: Path, out: Path, workers: int = 2
) -> Dataset:
    """Run PPO for every source (side by side, resumable), thin the episodes, and write the dataset to `out`.

    The episodes of a source stand together, in the order of `sources`; the file's attributes say how many
    each has.
    """
    if not sources or len(set(sources)) < len(sources):
        raise ValueError(f"sources {list(sources)}: at least one, each there once")
    runs = [folder / task.name / source for source in sources]
    joblib.Parallel(n_jobs=workers)(
        joblib.delayed(run_ppo)(task, recipe, *read_source(source), run)
        for source, run in zip(sources, runs, strict=True)
    )
    parts = [load_file(file) for run in runs for file in sorted(run.glob("episodes-*.safetensors"))]
    of_run = [len(list(run.glob("episodes-*.safetensors"))) for run in runs]
    ended = [int((part["terminals"] | part["timeouts"]).sum()) for part in parts]
    source_of = np.repeat(np.repeat(np.arange(len(runs)), of_run), ended)  # of every episode
    everything = Dataset(**{name: np.concatenate([part[name] for part in parts]) for name in FIELDS})
    chosen = thin(
        everything.episode_costs,
        everything.episode_returns,
        recipe.episodes,
        task.cost_range,
        task.max_return,
        recipe.return_cells,
    )
    seconds = sum(float(load_file(max(run.glob("state-*.safetensors")))["seconds"]) for run in runs)
    counts = np.bincount(source_of[chosen], minlength=len(runs)).tolist()
    dataset = everything.select(chosen)
    write_dataset(
        out,
        dataset,
        task,
        attributes={
            "task": task.name,
            "made_by": f"c2iql collect {task.name}",
            "episodes_by_source": json.dumps(dict(zip(sources, counts, strict=True))),
            "recipe": str(asdict(recipe)),
            "collected_episodes": everything.num_episodes,
            "wall_seconds": round(seconds),
            "versions": ", ".join(
                f"{p} {version(p)}" for p in ("stable-baselines3", "pybullet", "bullet-safety-gym", "torch")
            ),
            "licence": "CC BY 4.0",
        },
    )
    return dataset


def thin(
    costs, returns, n: int, max_cost: float, max_return: float, return_cells: int = 20, seed: int = 0
) -> np.ndarray:
    """Indices of about n of the episodes within both bounds, even over cost, and within a cost over return.

    The bounds are DSRL's, so that normalised scores mean the same on both. The plane is cut into 20 columns
    of cost, and these into cells of return; every column keeps at most k episodes, with the smallest k that
    gives n in all, and fills them from its cells in turn: no cost and no skill drowns the others. Within a
    cell, episodes on the frontier (none earns as much at as low a cost) come first, the cheapest before the
    others, then chance. Raises ValueError for n < 1.
    """
    if n < 1:
        raise ValueError(f"a dataset keeps at least one episode, not {n}")
    rng = np.random.default_rng(seed)
    within = rng.permutation(np.flatnonzero((costs <= max_cost) & (returns <= max_return)))
    frontier = _on_frontier(costs[within], returns[within])
    within = within[np.argsort(np.where(frontier, costs[within], np.inf), kind="stable")]
    column = _cell(costs[within], 0, max_cost, 20)
    row = _cell(returns[within], returns[within].min(), returns[within].max(), return_cells)
    turn = _rank_within(column * return_cells + row, np.zeros(len(within)))  # 0, 1, 2 ... within each cell
    place = _rank_within(column, turn)  # 0, 1, 2 ... within each column, cells taking turns
    k = np.sort(place)[min(n, len(place)) - 1] + 1
    return np.sort(within[place < k])


def _cell(values: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
    """The index, among `count` equal cells from low to high, of the cell that each value lies in."""
    return np.minimum((values - low) / max(high - low, 1e-9) * count, count - 1).astype(int)


def _on_frontier(costs: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Which episodes (n,) earn more than all others that are as cheap or cheaper; of equals the first."""
    order = np.lexsort((-returns, costs))
    best_before = np.maximum.accumulate(np.append(-np.inf, returns[order][:-1]))
    on = np.empty(len(costs), bool)
    on[order] = returns[order] > best_before
    return on


def _rank_within(group: np.ndarray, key: np.ndarray) -> np.ndarray:
    """The rank of every item among those of its group, by key; ties in their order."""
    order = np.lexsort((key, group))
    first = np.searchsorted(group[order], group[order])
    rank = np.empty(len(group), int)
    rank[order] = np.arange(len(group)) - first
    return rank


def _make_ppo(task: Task, recipe: Recipe, kind: str, seed: int, episodes: list[dict]):
    """PPO for a source, and the schedule that changes it along the run."""
    wrapper = {"priced": PricedCost, "lagrangian": LagrangianCost}[kind]
    rngs = np.random.default_rng([seed, KINDS.index(kind)]).spawn(16)
    envs = VecNormalize(DummyVecEnv([lambda rng=rng: wrapper(task, recipe, rng, episodes) for rng in rngs]))
    schedule = _Schedule(task, recipe, kind, episodes)
    policy = {"net_arch": [recipe.width] * 2, "log_std_init": -0.5}
    model = PPO(
        "MlpPolicy",
        envs,
        schedule.learning_rate,
        recipe.batch_steps // 16,
        512,
        target_kl=recipe.target_kl,
        policy_kwargs=policy,
        seed=seed,
        device="cpu",
    )
    return model, schedule


def _save_ppo(model, schedule, path: Path, seconds: float, metadata: dict[str, str]) -> None:
    """PPO's weights, Adam's moments, running normalisation and multiplier, as plain arrays: no pickle."""
    arrays = {f"policy.{key}": value.numpy() for key, value in model.policy.state_dict().items()}
    for index, moments in model.policy.optimizer.state_dict()["state"].items():
        arrays |= {f"adam.{index}.{key}": np.asarray(value) for key, value in moments.items()}
    for name in ("obs_rms", "ret_rms"):
        rms = getattr(model.env, name)
        arrays |= {f"{name}.{key}": np.asarray(getattr(rms, key)) for key in ("mean", "var", "count")}
    arrays |= {f"multiplier.{key}": np.asarray(getattr(schedule, key)) for key in ("integral", "value")}
    _save(arrays | {"seconds": np.asarray(seconds)}, path, metadata)


def _load_ppo(model, schedule, path: Path) -> float:
    """The inverse of `_save_ppo`. Returns the seconds that the run has taken so far."""
    arrays = load_file(path)
    tensors = {key: torch.as_tensor(value) for key, value in arrays.items()}
    model.policy.load_state_dict(
        {k.removeprefix("policy."): v for k, v in tensors.items() if k.startswith("policy.")}
    )
    state = model.policy.optimizer.state_dict()
    for key, value in tensors.items():
        if key.startswith("adam."):
            _, index, moment = key.split(".")
            state["state"].setdefault(int(index), {})[moment] = value
    model.policy.optimizer.load_state_dict(state)
    for name in ("obs_rms", "ret_rms"):
        for key in ("mean", "var", "count"):
            setattr(getattr(model.env, name), key, arrays[f"{name}.{key}"])
    for key in ("integral", "value"):
        setattr(schedule, key, float(arrays[f"multiplier.{key}"]))
    return float(arrays["seconds"])


def _save(arrays: dict[str, np.ndarray], path: Path, metadata: dict[str, str] | None = None) -> None:
    with written_whole(path) as temporary:
        save_file({k: np.asarray(value, order="C") for k, value in arrays.items()}, temporary, metadata)
