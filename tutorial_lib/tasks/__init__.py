"""Tasks: what a task is (`record`), where it takes place (`scene`), who simulates it (`bullet`, `mujoco`)."""

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

from tutorial_lib.tasks.record import (
    DSRL_FRONTIER,
    MUJOCO_TASKS,
    TASKS,
    Task,
    all_tasks,
    get_task,
    scene_of,
)


def as_task(task: Task | str) -> Task:
    """The record of a task that is given by its record or its name. Raises ValueError for an unknown name."""
    return get_task(task) if isinstance(task, str) else task


class Simulator(NamedTuple):
    """Who simulates the tasks of a family. Nothing slow is imported before `make` or `engine` is called."""

    make: Callable
    """Makes the environment of a task, with the options of `make_env`."""
    package: str
    """The package that has the tasks."""
    engine: Callable[[], str]
    """Returns the name of the package that has the physics. It can differ between systems."""
    modules: tuple[str, ...]
    """The modules without which there is no simulator."""
    remedy: str
    """How to install it, as an instruction."""

    def missing(self) -> list[str]:
        """Those of `modules` that are not installed. None of them is imported."""
        return [module for module in self.modules if importlib.util.find_spec(module) is None]


def _bullet(task: Task, **options):
    from tutorial_lib.tasks.bullet import BulletTask

    return BulletTask(task, **options)


def _pybullet_package() -> str:
    from tutorial_lib.tasks.bullet import pybullet_package

    return pybullet_package()


def _mujoco(task: Task, **options):
    from tutorial_lib.tasks.mujoco import MujocoTask

    return MujocoTask(task, **options)


SIMULATORS = {
    "bullet": Simulator(
        _bullet,
        "bullet-safety-gym",
        _pybullet_package,
        ("pybullet", "bullet_safety_gym"),
        "install all that the library needs: pip install --no-deps --requirement environment.lock",
    ),
    "mujoco": Simulator(
        _mujoco,
        "safety-gymnasium",
        lambda: "mujoco",
        ("safety_gymnasium", "mujoco", "glfw", "imageio", "xmltodict"),
        "run `make mujoco`",
    ),
}
"""By family: who simulates it. `mujoco` is an extra, which most of the course does without."""


def simulator_of(task: Task) -> Simulator:
    """Who simulates a task, installed or not. Raises ValueError for an unknown family."""
    if task.family not in SIMULATORS:
        families = ", ".join(SIMULATORS)
        raise ValueError(f"{task.name}: unknown family {task.family!r}: the families are {families}")
    return SIMULATORS[task.family]


def check_installed(task: Task) -> None:
    """Raises ValueError where the simulator of a task is not installed. Nothing is imported."""
    simulator = simulator_of(task)
    if missing := simulator.missing():
        raise ValueError(
            f"{task.name} is simulated by {simulator.package}, and module {missing[0]!r} is not installed: "
            f"{simulator.remedy}"
        )


def make_env(task: Task | str, **options):
    """The environment of a task, by its record or its name.

    It is a `gymnasium.Env` with float32 observations. `step` puts the cost into `info["cost"]`, and never
    merges `terminated` (the robot fell) with `truncated` (the horizon was reached). A seed that is given to
    `reset` repeats an episode bit for bit. `position` is the robot's (x, y) in metres, where the task has a
    scene. Options: `render_mode`, None or 'rgb_array', and `image_size`, (width, height) in pixels.

    Raises ValueError for an unknown name or family, and where the simulator is not installed.
    """
    task = as_task(task)
    check_installed(task)
    return simulator_of(task).make(task, **options)
