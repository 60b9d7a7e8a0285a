"""From behaviour policies to a dataset: `c2iql collect TASK`.

One PPO agent (stable-baselines3, the maintained reference implementation) learns a whole family of
behaviours at once. Every episode draws a price for an unsafe step and a free allowance of them, the
policy sees both, and its reward is r - price * cost once the allowance is used up. Prices alone give
steady trade-offs between reward and cost (a Lagrangian with a fixed multiplier); allowances reach the
costs in between where the best policy is all or nothing, as in the Run tasks. Every training episode
is kept, as DSRL does, so that the data holds beginners and experts; a grid over cost and return then
thins it. Neither price nor allowance is stored: the data looks like logs of many unknown policies.
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
from tqdm.auto import tqdm

from tutorial_lib.datasets import Dataset, write_dataset
from tutorial_lib.envs import make_env
from tutorial_lib.files import written_whole
from tutorial_lib.tasks import Task

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
        steps=6_000_000,
        ramp=(0.25, 0.5),
        learning_rate=(1e-3, 5.8e-4),
        own_axes=True,
        # With half of its noise it earned a fifth more and fell less: 195 and 17% for 163 and 28%.
        calm=(0.76, 0.2),
        **_LONG,
    ),
}


class PricedCost(gymnasium.Wrapper):
    """Appends (price, allowance left) to the observation, charges for unsafe steps, records the episode."""

    def __init__(self, task: Task, recipe: Recipe, rng: np.random.Generator, episodes: list[dict]):
        super().__init__(make_env(task))
        self.task, self.recipe, self.rng, self.episodes = task, recipe, rng, episodes
        self.price_scale = 0.0
        limit = np.full(task.obs_dim + (2 if recipe.own_axes else 0) + 2, 1000.0, np.float32)
        self.observation_space = gymnasium.spaces.Box(-limit, limit)

    def reset(self, *, seed=None, options=None):
        low, high = np.log(self.recipe.prices)
        if self.rng.random() < self.recipe.allowance_share:
            share = max(0.0, self.rng.uniform(*self.recipe.allowances))
            self.log_price, self.allowance = high, share * self.task.cost_range
        else:
            self.log_price, self.allowance = self.rng.uniform(low, high), 0.0
        self.observation, info = self.env.reset(seed=int(self.rng.integers(2**31)))
        self.record = {name: [] for name in FIELDS}
        return self._augmented(), info

    def step(self, action):
        last = self.observation
        self.observation, reward, terminated, truncated, info = self.env.step(action)
        row = (last, self.observation, action, reward, info["cost"], terminated, truncated)
        for name, value in zip(FIELDS, row, strict=True):
            self.record[name].append(value)
        self.allowance -= info["cost"]
        charged = info["cost"] * (self.allowance < 0) * self.price_scale
        if terminated or truncated:
            self.episodes.append({name: np.asarray(values) for name, values in self.record.items()})
        reward = reward * self.task.horizon / self.task.max_return - np.exp(self.log_price) * charged
        return self._augmented(), float(reward), terminated, truncated, info

    def _augmented(self):
        left = max(self.allowance, 0.0) / self.task.cost_range
        seen = along_own_axes(self.observation) if self.recipe.own_axes else self.observation
        return np.append(seen, [self.log_price, 2 * left]).astype(np.float32)


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


def run_ppo(task: Task, recipe: Recipe, seed: int, folder: Path, slice_steps: int = 100_000) -> None:
    """One PPO run; every slice of it, once done, is on disk, and a killed run goes on from there.

    Raises ValueError for a folder in which another recipe was begun.
    """
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    done = len(list(folder.glob("episodes-*.safetensors")))
    made_with = {"recipe": _how_to_play(recipe)}
    if done:
        with safe_open(folder / "state.safetensors", "np") as file:
            if file.metadata() != made_with:
                raise ValueError(
                    f"{folder}: was begun with another recipe: choose another folder with --runs"
                )
    slices = -(-recipe.steps // slice_steps)  # the last one ends with the steps
    if done == slices:
        return
    episodes: list[dict] = []
    clock = {"progress": 0.0}
    model = _make_ppo(task, recipe, seed + 1000 * done, episodes, clock)
    if done:
        _load_ppo(model, folder / "state.safetensors")
        # Killed between its two files, a slice has left its state but no episodes: it is played again.
        batch = model.n_steps * model.n_envs
        model.num_timesteps = -(-done * slice_steps // batch) * batch
    bar = tqdm(total=recipe.steps, initial=done * slice_steps, desc=f"{task.name} seed {seed}", unit="step")
    for index in range(done, slices):
        started = time.perf_counter()
        goal = min((index + 1) * slice_steps, recipe.steps)
        clock["progress"] = index / slices
        scale = 1.0 if recipe.ramp is None else np.interp(clock["progress"], recipe.ramp, (0, 1))
        model.env.set_attr("price_scale", float(scale))
        if recipe.calm is not None and clock["progress"] >= recipe.calm[0]:
            model.policy.log_std.data.clamp_(max=np.log(recipe.calm[1]))
        model.learn(goal - model.num_timesteps, reset_num_timesteps=False)
        arrays = {name: np.concatenate([e[name] for e in episodes]) for name in FIELDS}
        episodes.clear()
        _save_ppo(model, folder / "state.safetensors", time.perf_counter() - started, made_with)
        _save(arrays, folder / f"episodes-{index:03d}.safetensors")
        bar.update(goal - bar.n)
    bar.close()


def _how_to_play(recipe: Recipe) -> str:
    """The recipe without what only thinning looks at, as text."""
    played = asdict(recipe)
    del played["episodes"], played["return_cells"]
    return json.dumps(played)


def collect(
    task: Task, seeds: tuple[int, ...], recipe: Recipe, folder: Path, out: Path, workers: int = 2
) -> Dataset:
    """Run PPO for every seed (side by side, resumable), thin the episodes, and write the dataset to `out`."""
    runs = [folder / task.name / f"seed-{seed}" for seed in seeds]
    joblib.Parallel(n_jobs=workers)(
        joblib.delayed(run_ppo)(task, recipe, seed, run) for seed, run in zip(seeds, runs, strict=True)
    )
    parts = [load_file(file) for run in runs for file in sorted(run.glob("episodes-*.safetensors"))]
    everything = Dataset(**{name: np.concatenate([part[name] for part in parts]) for name in FIELDS})
    chosen = thin(
        everything.episode_costs,
        everything.episode_returns,
        recipe.episodes,
        task.cost_range,
        task.max_return,
        recipe.return_cells,
    )
    seconds = sum(float(load_file(run / "state.safetensors")["seconds"]) for run in runs)
    dataset = everything.select(chosen)
    write_dataset(
        out,
        dataset,
        task,
        attributes={
            "task": task.name,
            "made_by": f"c2iql collect {task.name}",
            "seeds": str(list(seeds)),
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


def _make_ppo(task: Task, recipe: Recipe, seed: int, episodes: list[dict], clock: dict[str, float]):
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    rngs = np.random.default_rng(seed).spawn(16)
    envs = VecNormalize(
        DummyVecEnv([lambda rng=rng: PricedCost(task, recipe, rng, episodes) for rng in rngs])
    )
    first, last = recipe.learning_rate

    def learning_rate(_):  # stable-baselines3's own progress starts anew with every slice
        return first + (last - first) * clock["progress"]

    policy = {"net_arch": [recipe.width] * 2, "log_std_init": -0.5}
    return PPO(
        "MlpPolicy",
        envs,
        learning_rate,
        recipe.batch_steps // 16,
        512,
        target_kl=recipe.target_kl,
        policy_kwargs=policy,
        seed=seed,
        device="cpu",
    )


def _save_ppo(model, path: Path, seconds: float, metadata: dict[str, str]) -> None:
    """PPO's weights, Adam's moments, the running normalisation and the clock; plain arrays, no pickle."""
    arrays = {f"policy.{key}": value.numpy() for key, value in model.policy.state_dict().items()}
    for index, moments in model.policy.optimizer.state_dict()["state"].items():
        arrays |= {f"adam.{index}.{key}": np.asarray(value) for key, value in moments.items()}
    for name in ("obs_rms", "ret_rms"):
        rms = getattr(model.env, name)
        arrays |= {f"{name}.{key}": np.asarray(getattr(rms, key)) for key in ("mean", "var", "count")}
    before = float(load_file(path)["seconds"]) if path.exists() else 0.0
    clock = {"steps": np.asarray(model.num_timesteps), "seconds": np.asarray(before + seconds)}
    _save(arrays | clock, path, metadata)


def _load_ppo(model, path: Path) -> None:
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
    model.num_timesteps = int(arrays["steps"])


def _save(arrays: dict[str, np.ndarray], path: Path, metadata: dict[str, str] | None = None) -> None:
    with written_whole(path) as temporary:
        save_file({k: np.asarray(value, order="C") for k, value in arrays.items()}, temporary, metadata)
