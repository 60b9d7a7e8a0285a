"""Good inputs of a few kilobytes, of which the trials make bad ones."""

import csv
from pathlib import Path

import numpy as np

from benchmarks.reliability.processes import run, typed
from tutorial_lib.agents import get_algorithm
from tutorial_lib.checkpoints import save_agent
from tutorial_lib.data import sources
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.files import sha256_of
from tutorial_lib.playing import evaluate
from tutorial_lib.scores import save_results
from tutorial_lib.tasks import TASKS

TASK = TASKS["BallRun"]
TINY = ("--hidden-width", 8, "--hidden-layers", 1, "--batch-size", 8)
"""Sizes of networks with which an update takes a millisecond."""


def make_dataset(episodes: int = 3) -> Dataset:
    """Random walks with BallRun's shapes, whose rows follow each other."""
    rng, length, rows = np.random.default_rng(0), TASK.horizon, episodes * TASK.horizon
    states = rng.normal(size=(episodes, length + 1, TASK.obs_dim)).astype(np.float32)
    return Dataset(
        observations=states[:, :-1].reshape(rows, -1),
        next_observations=states[:, 1:].reshape(rows, -1),
        actions=rng.uniform(-1, 1, size=(rows, TASK.act_dim)).astype(np.float32),
        rewards=rng.normal(5, 5, size=rows).astype(np.float32),
        costs=(rng.random(rows) < 0.4).astype(np.float32),
        terminals=np.zeros(rows, bool),
        timeouts=np.arange(1, rows + 1) % length == 0,
    )


def make_samples(folder: Path) -> Path:
    """Makes a folder with a dataset, an agent, the folder of a run, results and a recording. Returns it."""
    (folder / "episodes").mkdir(parents=True)
    data = make_dataset()
    write_dataset(folder / "data.hdf5", data, TASK)
    write_dataset(folder / "shipped" / "BallRun.hdf5", data, TASK)
    digest = sha256_of(folder / "shipped" / "BallRun.hdf5")
    (folder / "shipped" / sources.CHECKSUMS).write_text(f"{digest}  BallRun.hdf5\n")
    kind = get_algorithm("C2IQL")
    sizes = {"hidden_width": 8, "hidden_layers": 1, "batch_size": 8, "crm_width": 8, "crm_layers": 1}
    agent = kind(TASK, kind.configure("small", **sizes), (0, 1))
    save_agent(agent, folder / "agent.safetensors")
    save_results(evaluate(agent, (30.0, 50.0), episodes=2), folder / "results.csv")
    _write_recording(data, folder / "episodes" / "0.csv")
    words = ("train", "IQL", "BallRun", "--data", "data.hdf5", "--out", "run", *TINY, "--updates", 3)
    ended = run(typed(*words), folder)
    if ended.status != 0:
        raise RuntimeError(f"the good run failed: {ended.err}")
    return folder


def _write_recording(data: Dataset, path: Path) -> None:
    """Writes the first episode as a CSV, as `c2iql data convert` reads it."""
    names = [f"obs_{i}" for i in range(TASK.obs_dim)] + [f"action_{i}" for i in range(TASK.act_dim)]
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*names, "reward", "cost", "terminal", "timeout"])
        for t in range(TASK.horizon):
            row = [*data.observations[t], *data.actions[t], data.rewards[t], data.costs[t]]
            writer.writerow([*row, int(data.terminals[t]), int(data.timeouts[t])])
        writer.writerow([*data.next_observations[TASK.horizon - 1], *[""] * (TASK.act_dim + 4)])
