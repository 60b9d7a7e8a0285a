"""A small dataset and small agents: what the tests of training and of its files share."""

import csv
import dataclasses

import numpy as np
from safetensors import safe_open

from tutorial_lib.agents import get_algorithm
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import TASKS

OPTIONS = {
    "profile": "test",
    "hidden_width": 16,
    "hidden_layers": 1,
    "batch_size": 16,
    "crm_width": 8,
    "crm_layers": 1,
    "crm_steps": 20,
    "updates": 60,
    "gamma": 0.9,
    "target_tau": 0.05,
    "value_lr": 2e-3,
    "critic_lr": 1e-3,
    "policy_lr": 3e-3,
}
"""Changes of profile `paper`. An algorithm gets those that it reads."""
ROWS = 400
EVERY = {"log_every": 5, "checkpoint_every": 20, "progress": False}


def make_dataset():
    """Random transitions with BallRun's shapes, in episodes of 100 of which the second ends in a terminal."""
    rng = np.random.default_rng(0)
    ends = np.arange(1, ROWS + 1) % 100 == 0
    terminals = np.arange(ROWS) == 199
    return Dataset(
        observations=rng.normal(size=(ROWS, 7)).astype(np.float32),
        next_observations=rng.normal(size=(ROWS, 7)).astype(np.float32),
        actions=rng.uniform(-1, 1, size=(ROWS, 2)).astype(np.float32),
        rewards=rng.normal(5, 5, size=ROWS).astype(np.float32),
        costs=(rng.random(ROWS) < 0.4).astype(np.float32),
        terminals=terminals,
        timeouts=ends & ~terminals,
    )


def make_config(name, **changes):
    """The algorithm's options: the small ones that it reads, then `changes`, all of which it must read."""
    kind = get_algorithm(name)
    known = {field.name for field in dataclasses.fields(kind.Config)}
    small = {option: value for option, value in OPTIONS.items() if option in known}
    return kind.configure("paper").changed(**small | changes)


def make_agent(name="IQL", seeds=(0,), task="BallRun", limits=40.0, device="cpu", **changes):
    kind = get_algorithm(name)
    own = limits if kind.needs_limit else None
    return kind(TASKS[task], make_config(name, **changes), seeds, own, device)


def tensors_in(path):
    with safe_open(path, "pt") as file:
        return {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  (not a mapping)


def metrics_in(run_dir):
    """The rows of metrics.csv, as text, without the one column that a clock wrote."""
    with open(run_dir / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k != "updates_per_second"} for row in csv.DictReader(file)]
