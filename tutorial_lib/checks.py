"""Checks that follow a notebook's claims, and checkers for its exercises.

A check prints a line without the value that it found, so that a notebook's outputs compare across
machines; where the claim fails, it raises AssertionError with the value. An exercise's checker never
raises: it prints what is wrong, or OK.
"""

import platform
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from tutorial_lib.conditioning import nearest_threshold, rescaled_budget
from tutorial_lib.evaluation import normalised_return
from tutorial_lib.tasks import Task, get_task

# --- Claims ---


def check(name: str, value, expected, tolerance: float = 0.0) -> None:
    """Is `value` within `tolerance` of `expected`? Arrays: everywhere, and of the same shape."""
    value, expected = np.asarray(value, float), np.asarray(expected, float)
    if value.shape != expected.shape and expected.ndim:
        raise AssertionError(f"FAILED  {name}: shape {value.shape}, expected {expected.shape}")
    close = np.abs(value - expected) <= tolerance  # False where NaN
    if not np.all(close):
        raise AssertionError(f"FAILED  {name} = {_text(value)}, expected {_text(expected)} +/- {tolerance:g}")
    print(f"OK  {name} = {_text(expected)}" + (f" +/- {tolerance:g}" if tolerance else ""))


def check_at_most(name: str, value: float, bound: float) -> None:
    """Is `value` <= `bound`?"""
    if not value <= bound:
        raise AssertionError(f"FAILED  {name} = {_text(value)}, expected at most {_text(bound)}")
    print(f"OK  {name} <= {_text(bound)}")


def check_that(claim: str, holds) -> None:
    """Does the claim hold? For an array: everywhere."""
    holds = np.asarray(holds)
    if not holds.all():
        where = f" in {np.sum(~holds)} of {holds.size} cases" if holds.ndim else ""
        raise AssertionError(f"FAILED  {claim}: it does not{where}")
    print(f"OK  {claim}")


def _text(value) -> str:
    if isinstance(value, Task):
        return value.name
    if np.ndim(value):
        return "[" + ", ".join(_text(element) for element in value) + "]"
    is_number = isinstance(value, int | float | np.number | np.ndarray) and not isinstance(value, bool)
    return f"{value:.5g}" if is_number else str(value)


# --- The set-up ---

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
    from tutorial_lib.envs import make_env

    env = make_env("BallCircle")
    ends = []
    for _ in range(2):
        env.reset(seed=3)
        for _ in range(20):
            observation, *_ = env.step(np.array([1.0, -0.5]))
        ends.append(observation)
    env.close()
    return np.array_equal(*ends)


# --- Exercises ---


def _try(answer: Callable, cases) -> None:
    """Print the first thing that is wrong with `answer`, or OK. A case: arguments, expected value, hint."""
    for arguments, expected, hint in cases:
        shown = ", ".join(_text(argument) for argument in arguments)
        call = f"{answer.__name__}({shown})"
        try:
            got = answer(*arguments)
        except Exception as error:  # whatever a reader's code may do
            print(f"NOT YET  {call} raised {type(error).__name__}: {error}")
            return
        if got is None:
            print(f"NOT YET  {answer.__name__} returns nothing: write it in place of the `...`")
            return
        if not _is_close(got, expected):
            print(f"NOT YET  {call} = {_text(got)}, expected {_text(expected)}: {hint}")
            return
    print(f"OK  {answer.__name__} is right in {len(cases)} cases")


def _is_close(got, expected) -> bool:
    try:
        return np.shape(got) == np.shape(expected) and np.allclose(got, expected, atol=1e-6)
    except (TypeError, ValueError):  # no number
        return False


def check_keeps_limit(answer: Callable) -> None:
    """Notebook 00: `answer(costs, limit)`, eq. 1: does a policy with these episode costs keep the limit?"""
    _try(
        answer,
        [
            (([20.0, 10.0, 30.0], 30.0), True, "no episode exceeds the limit"),
            (([20.0, 35.0, 5.0], 30.0), True, "eq. 1 bounds the expectation: one episode may cost more"),
            (([31.0, 29.0, 30.0], 30.0), True, "eq. 1 says at most: the limit itself is kept"),
            (([0.0, 0.0, 95.0], 30.0), False, "most episodes are cheap, but their mean is not"),
        ],
    )


def check_normalised_return(answer: Callable) -> None:
    """Notebook 00: `answer(total, task)`, DSRL's normalised return, from the task's record."""
    cases = []
    for name, total in (("BallCircle", 0.38312), ("BallCircle", 600.0), ("CarRun", 574.6533)):
        task = get_task(name)
        hint = f"(R - R_min) / (R_max - R_min), and {name}'s R_min is {task.min_return:g}"
        cases.append(((total, task), float(normalised_return(total, task)), hint))
    _try(answer, cases)


def check_implicit_cost_value(answer: Callable) -> None:
    """Notebook 08: `answer(q, v, q_cost, kappa)`, V_c of one state: the cost under the implicit policy."""
    cost = np.array([0.0, 10.0, 20.0])
    _try(
        answer,
        [
            (
                (np.array([1.0, 1.0, 1.0]), 0.0, cost, 0.7),
                10.0,
                "equal weights give the plain mean: divide by the sum of M",
            ),
            (
                (np.array([-1.0, -1.0, -1.0]), 0.0, cost, 0.7),
                10.0,
                "below V all weigh the same: divide by the sum of M",
            ),
            ((np.array([1.0, -1.0, -1.0]), 0.0, cost, 0.5), 10.0, "at kappa = 0.5 all weigh the same"),
            (
                (np.array([5.0, 2.0, 3.0]), 4.0, cost, 0.7),
                90 / 13,
                "M is kappa where Q >= V, and 1 - kappa elsewhere",
            ),
            (
                (np.array([1.0, 0.0, -1.0]), 0.0, cost, 0.9),
                110 / 19,
                "an action just as good as V counts as better",
            ),
        ],
    )


def check_condition(answer: Callable) -> None:
    """Notebook 08: `answer(limit, spent, t, horizon, thresholds)`, the threshold of eq. 23 for a step."""
    task = get_task("BallCircle")
    hints = {
        (30.0, 0.0, 0): "at the start nothing is spent: the limit itself",
        (30.0, 0.0, 100): "half the time is left and all of the budget: it counts double",
        (50.0, 40.0, 100): "10 left for half of the time is a rate of 20 per episode: the nearest is 30",
        (30.0, 45.0, 150): "overspent: the budget is negative, and the smallest threshold is the nearest",
        (70.0, 0.0, 199): "near the end eq. 23 grows without bound: the largest threshold is the nearest",
        (45.0, 5.0, 50): "40 left for three quarters of the time is 53 per episode",
    }
    cases = []
    for (limit, spent, t), hint in hints.items():
        wish = rescaled_budget(limit, spent, t, task.horizon)
        expected = float(nearest_threshold(wish, task))
        cases.append(((limit, spent, t, task.horizon, task.thresholds), expected, hint))
    _try(answer, cases)
