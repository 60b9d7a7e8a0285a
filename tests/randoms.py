"""Agents and batches of random numbers: where every tensor differs, no term of a loss can hide."""

import numpy as np
import torch

from tutorial_lib.data.dataset import Batch

OBS, ACT = 3, 2
"""Dimensions of the observations and actions of these tests' small task."""


def randomise(agent, seed=0):
    """Random numbers in every tensor, so that online and target networks, and both runs, all differ."""
    generator = torch.Generator().manual_seed(seed)
    state = {key: value.clone() for key, value in agent.state().items()}
    for value in state.values():
        if value.is_floating_point():
            value.copy_(0.5 * torch.randn(value.shape, generator=generator))
    state["observation_std"] = 0.5 + state["observation_std"].abs()
    agent.load_state(state)


def random_batch(seed, runs=1, size=24):
    """Transitions for each run, (runs, size, ...), half of them unsafe."""
    rng = np.random.default_rng(seed)
    fields = {
        "observations": rng.normal(size=(runs, size, OBS)),
        "actions": rng.uniform(-1, 1, size=(runs, size, ACT)),
        "rewards": rng.normal(2, 4, size=(runs, size)),
        "costs": rng.random((runs, size)) < 0.5,
        "next_observations": rng.normal(size=(runs, size, OBS)),
        "terminals": rng.random((runs, size)) < 0.3,
        "timeouts": rng.random((runs, size)) < 0.3,
    }
    return Batch(**{key: torch.tensor(value, dtype=torch.float32) for key, value in fields.items()})
