"""One PPO run: a behaviour policy learns, and every episode that it plays is kept.

PPO is stable-baselines3's, the maintained reference, with running normalisation of observations and rewards.
`tutorial_lib.data.behaviour` has its environments, and `tutorial_lib.data.schedule` what changes along a run.

A run is cut into slices. After every slice its episodes and the state of PPO are on disk, and every slice
begins from these files alone, whether or not the run was killed before it. The same arguments therefore give
the same files on the same machine, however often a run is killed and started again.

This module imports stable-baselines3, which takes seconds. Import it where it is needed.
"""

import functools
import json
import math
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tqdm.auto import tqdm

from tutorial_lib.data.behaviour import KINDS
from tutorial_lib.data.dataset import KEYS
from tutorial_lib.data.schedule import Schedule
from tutorial_lib.files import held, sort_metadata, written_whole
from tutorial_lib.tasks import Task
from tutorial_lib.tasks.recipes import Recipe

SLICE_STEPS = 204_800
"""Simulator steps of a slice. A killed run loses at most so many."""
ENVIRONMENTS = 16
"""Environments that one PPO agent plays in at the same time."""


def run_ppo(
    task: Task, recipe: Recipe, kind: str, seed: int, folder: Path, slice_steps: int = SLICE_STEPS
) -> None:
    """Train one PPO agent for `recipe.steps` simulator steps and write all its episodes into `folder`.

    Every finished slice of `slice_steps` is on disk (`episode_files`). A run that was killed continues after
    the last finished one; where all are there, nothing is done. Slice k draws from the seed `seed + 1000 k`,
    so the seeds of one kind should differ by less than 1000. Raises ValueError for a kind that is not in
    `KINDS`, and for a folder whose run was begun with another recipe or another `slice_steps`. Raises OSError
    where another process writes into the folder.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of source {kind!r}: the kinds are {', '.join(KINDS)}")
    torch.set_num_threads(1)
    with held(folder):
        _run_slices(task, recipe, kind, seed, folder, slice_steps)


def _run_slices(task: Task, recipe: Recipe, kind: str, seed: int, folder: Path, slice_steps: int) -> None:
    """Make the slices of a run that are missing in its folder."""
    made_with = {"recipe": _text_of(recipe), "slice_steps": str(slice_steps)}
    done = len(episode_files(folder))
    if done:
        _check_begun_with(made_with, folder, done)
    bar = tqdm(total=recipe.steps, initial=done * slice_steps, desc=f"{task.name} {kind} {seed}", unit="step")
    for index in range(done, math.ceil(recipe.steps / slice_steps)):
        started = time.perf_counter()
        first = index * slice_steps
        last = min(first + slice_steps, recipe.steps)
        episodes: list[dict[str, np.ndarray]] = []
        model, schedule = make_ppo(task, recipe, kind, seed + 1000 * index, episodes, first)
        before = load_ppo(model, schedule, _state_path(folder, index)) if index else 0.0
        envs = model.get_env()
        assert envs is not None
        model.learn(last - first, callback=schedule)
        seconds = before + time.perf_counter() - started
        envs.close()  # otherwise 16 simulators stay in memory after every slice: 1.4 GB for CarCircle
        save_ppo(model, schedule, _state_path(folder, index + 1), seconds, made_with)
        arrays = {key: np.concatenate([episode[key] for episode in episodes]) for key in KEYS}
        save_arrays(arrays, folder / f"episodes-{index:03d}.safetensors")
        if index:
            _state_path(folder, index).unlink(missing_ok=True)
        bar.update(last - bar.n)
    bar.close()


def episode_files(folder: Path) -> list[Path]:
    """The files of the finished slices of a run, in order. Each has one array for each of `dataset.KEYS`."""
    return sorted(folder.glob("episodes-*.safetensors"))


def _state_path(folder: Path, slices: int) -> Path:
    """The state after this many slices.

    It is written before the episodes of its last slice, and it is kept until the next slice is on disk. A
    folder with n files of episodes therefore always has the state after n slices.
    """
    return folder / f"state-{slices:03d}.safetensors"


def _text_of(recipe: Recipe) -> str:
    """The recipe as JSON, without the two fields that only thinning reads."""
    played = asdict(recipe)
    del played["episodes"], played["return_bins"]
    return json.dumps(played)


def _check_begun_with(made_with: dict[str, str], folder: Path, slices: int) -> None:
    with safe_open(_state_path(folder, slices), "np") as file:
        if file.metadata() != made_with:
            raise ValueError(f"{folder}: was begun with another recipe: choose another folder with --runs")


def make_ppo(
    task: Task,
    recipe: Recipe,
    kind: str,
    seed: int,
    episodes: list[dict[str, np.ndarray]],
    first_step: int = 0,
) -> tuple[PPO, Schedule]:
    """An untrained PPO agent, and the schedule to train it with: `model.learn(steps, callback=schedule)`.

    `kind` is one of `KINDS`. The environments append their episodes to `episodes`. `first_step` is the number
    of steps that the run has made before.
    """
    rngs = np.random.default_rng([seed, list(KINDS).index(kind)]).spawn(ENVIRONMENTS)
    envs = VecNormalize(
        DummyVecEnv([functools.partial(KINDS[kind], task, recipe, rng, episodes) for rng in rngs])
    )
    schedule = Schedule(task, recipe, kind, episodes, first_step)
    model = PPO(
        "MlpPolicy",
        envs,
        learning_rate=schedule.learning_rate,
        n_steps=recipe.batch_steps // ENVIRONMENTS,
        batch_size=512,
        target_kl=recipe.target_kl,
        policy_kwargs={"net_arch": [recipe.width] * 2, "log_std_init": -0.5},
        seed=seed,
        device="cpu",
    )
    return model, schedule


def save_ppo(model: PPO, schedule: Schedule, path: Path, seconds: float, metadata: dict[str, str]) -> None:
    """Write the state of a run to `path`: plain arrays without pickle, under `metadata`.

    The state consists of the weights of PPO, Adam's moments, the running means and variances, the Lagrange
    multiplier, and the `seconds` that the run has taken. Raises OSError where the file cannot be written.
    """
    arrays = {f"policy.{key}": value.numpy() for key, value in model.policy.state_dict().items()}
    for index, moments in model.policy.optimizer.state_dict()["state"].items():
        arrays |= {f"adam.{index}.{key}": np.asarray(value) for key, value in moments.items()}
    for name in ("obs_rms", "ret_rms"):
        rms = getattr(model.env, name)
        arrays |= {f"{name}.{key}": np.asarray(getattr(rms, key)) for key in ("mean", "var", "count")}
    for key in ("integral", "value"):
        arrays[f"multiplier.{key}"] = np.asarray(getattr(schedule.multiplier, key))
    save_arrays(arrays | {"seconds": np.asarray(seconds)}, path, metadata)


def load_ppo(model: PPO, schedule: Schedule, path: Path) -> float:
    """Put a state that `save_ppo` wrote into `model` and `schedule`, and return its `seconds`.

    Both must be made for the same task, kind and `recipe.width` as those that were saved. Raises
    FileNotFoundError where there is no file, and RuntimeError where the networks have other shapes.
    """
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
        setattr(schedule.multiplier, key, float(arrays[f"multiplier.{key}"]))
    return float(arrays["seconds"])


def save_arrays(arrays: dict[str, np.ndarray], path: Path, metadata: dict[str, str] | None = None) -> None:
    """Write arrays to a safetensors file. It appears whole or not at all. Raises OSError where it cannot."""
    with written_whole(path) as temporary:
        save_file({k: np.asarray(value, order="C") for k, value in arrays.items()}, temporary, metadata)
        if metadata:
            sort_metadata(temporary)
