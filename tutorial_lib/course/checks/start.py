"""This module checks the installation and the answers to the exercises of notebook 0."""

import platform
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from tutorial_lib.course.checks.checker import check_that, try_answer
from tutorial_lib.scores import normalised_return
from tutorial_lib.tasks import get_task
from tutorial_lib.tasks.bullet import pybullet_package

PACKAGES = (
    "torch", "numpy", "gymnasium", pybullet_package(), "bullet-safety-gym", "matplotlib", "ipywidgets",
)  # fmt: skip


def check_setup() -> None:
    """Checks Python, the packages and the simulator, and prints the versions.

    The simulator must produce the same episode twice from one seed.
    """
    check_that("Python 3.11 or newer", sys.version_info >= (3, 11))
    found = {name: _version(name) for name in PACKAGES}
    check_that("all packages are installed", [number is not None for number in found.values()])
    check_that("the simulator repeats an episode from its seed", _episode_repeats())
    versions = ", ".join(f"{name} {number}" for name, number in found.items())
    print(textwrap.fill(f"here: Python {platform.python_version()}, {versions}", 80))


def _version(name: str) -> str | None:
    """Returns the version of an installed package, or None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _episode_repeats() -> bool:
    """Returns whether the simulator produces the same observation after 20 steps from the same seed."""
    from tutorial_lib.tasks import make_env

    env = make_env("BallCircle")
    ends = []
    for _ in range(2):
        env.reset(seed=3)
        for _ in range(20):
            observation, *_ = env.step(np.array([1.0, -0.5]))
        ends.append(observation)
    env.close()
    return np.array_equal(*ends)


def check_keeps_limit(answer: Callable) -> None:
    """Checks an exercise of notebook 0.

    `answer(costs, limit)` returns whether a policy with these episode costs keeps the limit of eq. 1.
    """
    cases = (
        ([20.0, 10.0, 30.0], True, "no episode exceeds the limit"),
        ([20.0, 35.0, 5.0], True, "eq. 1 bounds the expectation: one episode may cost more"),
        ([31.0, 29.0, 30.0], True, "eq. 1 says at most: the limit itself is kept"),
        ([0.0, 0.0, 95.0], False, "most episodes are cheap, but their mean is not"),
    )
    try_answer(answer, [((np.array(costs), 30.0), expected, hint) for costs, expected, hint in cases])


def check_normalised_return(answer: Callable) -> None:
    """Checks an exercise of notebook 0.

    `answer(total, task)` returns DSRL's normalised return. The task's record holds the reference returns.
    """
    cases = []
    outside = ", and nothing clips the result to [0, 1]: the two returns are references, not bounds"
    for name, total, more in (
        ("BallCircle", 0.38312, ""),
        ("BallCircle", 600.0, ""),
        ("CarRun", 574.6533, ""),
        ("BallCircle", 950.0, outside),
        ("CarRun", 100.0, outside),
    ):
        task = get_task(name)
        hint = f"(R - R_min) / (R_max - R_min), and {name}'s R_min is {task.min_return:g}{more}"
        cases.append(((total, task), float(normalised_return(total, task)), hint))
    try_answer(answer, cases)
