"""Notebook 00: the set-up, and its exercises."""

import platform
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from tutorial_lib.course.checks.checker import check_that, try_answer
from tutorial_lib.scores import normalised_return
from tutorial_lib.tasks import get_task

PACKAGES = ("torch", "numpy", "gymnasium", "pybullet", "bullet-safety-gym", "matplotlib", "ipywidgets")


def check_setup() -> None:
    """Python, the packages, and the simulator: does a seed repeat its episode? Prints the versions too."""
    check_that("Python 3.11 or newer", sys.version_info >= (3, 11))
    found = {name: _version(name) for name in PACKAGES}
    check_that("all packages are installed", [number is not None for number in found.values()])
    check_that("the simulator repeats an episode from its seed", _episode_repeats())
    versions = ", ".join(f"{name} {number}" for name, number in found.items())
    print(textwrap.fill(f"here: Python {platform.python_version()}, {versions}", 80))


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _episode_repeats() -> bool:
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
    """Notebook 00: `answer(costs, limit)`, eq. 1: does a policy with these episode costs keep the limit?"""
    cases = (
        ([20.0, 10.0, 30.0], True, "no episode exceeds the limit"),
        ([20.0, 35.0, 5.0], True, "eq. 1 bounds the expectation: one episode may cost more"),
        ([31.0, 29.0, 30.0], True, "eq. 1 says at most: the limit itself is kept"),
        ([0.0, 0.0, 95.0], False, "most episodes are cheap, but their mean is not"),
    )
    try_answer(answer, [((np.array(costs), 30.0), expected, hint) for costs, expected, hint in cases])


def check_normalised_return(answer: Callable) -> None:
    """Notebook 00: `answer(total, task)`, DSRL's normalised return, from the task's record."""
    cases = []
    for name, total in (("BallCircle", 0.38312), ("BallCircle", 600.0), ("CarRun", 574.6533)):
        task = get_task(name)
        hint = f"(R - R_min) / (R_max - R_min), and {name}'s R_min is {task.min_return:g}"
        cases.append(((total, task), float(normalised_return(total, task)), hint))
    try_answer(answer, cases)
