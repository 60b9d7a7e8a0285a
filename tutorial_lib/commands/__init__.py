"""The commands of `c2iql`, and what they check of their arguments.

The modules here import the other modules of the library when a command runs, so that `c2iql --help` is fast.
"""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import tutorial_lib.config
    from tutorial_lib.agents import Agent
    from tutorial_lib.tasks import Task

Device = Literal["cpu", "cuda"]

MOST = {
    "episodes": 1_000_000,
    "steps": 1_000_000_000,
    "rounds": 1_000,
    "workers": max(8, 4 * (os.cpu_count() or 1)),  # a worker takes some 300 MB
}
"""The largest number that a command takes. It is far above what anybody needs: a slip of the keyboard must
not take all memory, or all time."""
COPIES = 6
"""How often a trained number is in memory: itself, its gradient, Adam's two moments, and its target network,
with some room for the batch."""


def check_counts(**numbers: int | None) -> None:
    """Raises ValueError where a number is less than 1, or larger than in `MOST`. None is allowed."""
    for name, number in numbers.items():
        if number is not None and number < 1:
            raise ValueError(f"--{name} {number}: must be 1 or more")
        if number is not None and number > MOST[name]:
            raise ValueError(f"--{name} {number}: must be at most {MOST[name]:,}")


def check_memory(
    kind: "type[Agent]",
    task: "Task",
    config: "tutorial_lib.config.Config",  # a page of the site links to it, and "Config" alone is ambiguous
    seeds: Sequence[int],
    limits: Sequence[float] | None,
) -> None:
    """Raises ValueError where training these runs together would take more memory than is free.

    Each run has a seed, and a limit if `limits` is not None.
    """
    import psutil

    made = kind.count_parameters(task, config, seeds, limits)
    needed, free = 4 * COPIES * made * len(seeds), psutil.virtual_memory().available
    if needed > free:
        raise ValueError(
            f"{kind.name}: these options need {needed / 1e9:,.1f} GB of memory for {len(seeds)} run(s), "
            f"and {free / 1e9:,.1f} GB are free: choose fewer seeds or limits, or smaller networks"
        )


def check_device(device: Device) -> Device:
    """Returns the device. Raises ValueError for `cuda` where PyTorch finds no CUDA device."""
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: PyTorch finds no CUDA device here: leave it out to train on the CPU")
    return device


def check_limits(limits: tuple[float, ...] | None) -> None:
    """Raises ValueError where limits are given, but none, or one that is negative or NaN."""
    from tutorial_lib.costs.conditioning import check_limit

    if limits == ():
        raise ValueError("--limits: give at least one")
    for limit in limits or ():
        check_limit(limit)
