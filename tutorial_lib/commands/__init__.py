"""The commands of `c2iql`, and what they check of their arguments.

The modules here import the other modules of the library when a command runs, so that `c2iql --help` is fast.
"""

from typing import Literal

Device = Literal["cpu", "cuda"]


def check_counts(**numbers: int | None) -> None:
    """Raises ValueError where a number is less than 1. None is allowed."""
    for name, number in numbers.items():
        if number is not None and number < 1:
            raise ValueError(f"--{name} {number}: must be 1 or more")


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
