"""What the contract of algorithms runs on: all algorithms and two more, a toy task, and a toy dataset."""

import dataclasses
import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from randoms import ACT, OBS

from tutorial_lib.agents import ALGORITHMS, Agent, slug
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import TASKS


def loaded(name) -> type[Agent]:
    """The algorithm in a file of this folder, loaded by its path as a module of its own."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    kinds = [kind for kind in vars(module).values() if isinstance(kind, type) and kind.__module__ == name]
    return next(kind for kind in kinds if issubclass(kind, Agent))


ODD, TEMPLATE = loaded("odd_algorithm"), loaded("template_algorithm")
KINDS = ALGORITHMS | {kind.name: kind for kind in (ODD, TEMPLATE)}
every_algorithm = pytest.mark.parametrize("kind", KINDS.values(), ids=map(slug, KINDS))

T, UPDATES = 10, 12
TASK = dataclasses.replace(
    TASKS["BallRun"], name="Toy", horizon=T, obs_dim=OBS, act_dim=ACT, gammas=(0.6, 0.8, 0.9),
    thresholds=(1, 3, 6), cost_range=8, min_return=-5.0, max_return=40.0,
)  # fmt: skip
TINY = {  # of these options, each algorithm takes those that it has
    "updates": UPDATES,
    "batch_size": 16,
    "hidden_width": 8,
    "hidden_layers": 1,
    "crm_width": 8,
    "crm_layers": 1,
    "crm_steps": 20,
}


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """The toy task and the two algorithms of this folder are found by their names. Import it to have it."""
    monkeypatch.setitem(TASKS, TASK.name, TASK)
    for kind in (ODD, TEMPLATE):
        monkeypatch.setitem(ALGORITHMS, kind.name, kind)


def make_dataset(episodes=60) -> Dataset:
    """Random transitions in episodes of 4 to 10 steps, which cost from nothing to all of their steps."""
    rng = np.random.default_rng(0)
    lengths = rng.integers(4, T + 1, episodes)
    ends, rows = np.cumsum(lengths), lengths.sum()
    last = np.isin(np.arange(1, rows + 1), ends)
    fell = last & np.repeat(lengths < T, lengths)
    rates = np.repeat(np.linspace(0, 1, episodes), lengths)
    return Dataset(
        observations=rng.normal(3, 2, size=(rows, OBS)).astype(np.float32),
        next_observations=rng.normal(3, 2, size=(rows, OBS)).astype(np.float32),
        actions=rng.uniform(-1, 1, size=(rows, ACT)).astype(np.float32),
        rewards=rng.normal(2, 4, size=rows).astype(np.float32),
        costs=(rng.random(rows) < rates).astype(np.float32),
        terminals=fell,
        timeouts=last & ~fell,
    )


DATA = make_dataset()


def runs_of(kind):
    """Three runs, as pairs of seed and limit: they differ in seed, or in limit if they have one.

    The larger limit is ten times the horizon. An endless discounted sum of cost can be so far above the cost
    of an episode (CIQL).
    """
    return ((0, 100.0), (0, 0.0), (7, 0.0)) if kind.needs_limit else ((0, None), (3, None), (7, None))


def make_agent(kind, runs=None, device="cpu", **changes):
    seeds, limits = zip(*(runs or runs_of(kind)), strict=True)
    names = [field.name for field in dataclasses.fields(kind.Config)]
    tiny = {name: value for name, value in TINY.items() if name in names}
    config = kind.configure("small", **tiny | changes)
    return kind(TASK, config, seeds, limits if kind.needs_limit else None, device)


def start(agent):
    """The agent as it is before its first update: with the data and the generator of each run."""
    parts = [agent.select(DATA, limit) for limit in agent.limits or [math.inf] * len(agent.seeds)]
    agent.prepare(parts, progress=False)
    generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
    return [part.tensors(agent.device) for part in parts], generators
