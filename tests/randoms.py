"""Agents and batches of random numbers: where every tensor differs, no term of a loss can hide."""

import numpy as np
import torch

from tutorial_lib.data.dataset import Batch

OBS, ACT = 3, 2
"""Dimensions of the observations and actions of these tests' small task."""


def randomise(agent, seed=0):
    """Random numbers in every tensor, so that online and target networks, and all runs, differ."""
    generator = torch.Generator().manual_seed(seed)
    state = {key: value.clone() for key, value in agent.state().items()}
    for value in state.values():
        if value.is_floating_point():
            value.copy_(0.5 * torch.randn(value.shape, generator=generator))
    if (std := state.get("variable.observation_std")) is not None:
        std.copy_(0.5 + std.abs())
    agent.load_state(state)


def random_data(seed, rows=200):
    """Random transitions (rows, ...), half of them unsafe: all that one run learns from."""
    rng = np.random.default_rng(seed)
    fields = {
        "observations": rng.normal(size=(rows, OBS)),
        "actions": rng.uniform(-1, 1, size=(rows, ACT)),
        "rewards": rng.normal(2, 4, size=rows),
        "costs": rng.random(rows) < 0.5,
        "next_observations": rng.normal(size=(rows, OBS)),
        "terminals": rng.random(rows) < 0.3,
        "timeouts": rng.random(rows) < 0.3,
        "timesteps": rng.integers(0, 10, rows),
        "returns_to_go": rng.normal(20, 9, size=rows),
        "costs_to_go": rng.integers(0, 9, rows),
    }
    return Batch(**{key: torch.tensor(value, dtype=torch.float32) for key, value in fields.items()})


def random_batch(agent, seed=1, **fields):
    """What one update of the agent sees: everything that it draws from random data, (S, ...) each.

    `fields` stand in the place of what was drawn.
    """
    generators = [torch.Generator().manual_seed(100 * seed + run) for run in agent.seeds]
    data = [random_data(seed + run) for run in range(len(agent.seeds))]
    return agent.draw_all(data, generators) | fields


def of_run(batch, run):
    """The batch of one run."""
    return {name: values[run] for name, values in batch.items()}
