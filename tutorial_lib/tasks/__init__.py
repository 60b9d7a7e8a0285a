"""Tasks: what a task is (`record`), where it takes place (`scene`) and who simulates it (`bullet`)."""

from tutorial_lib.tasks.record import DSRL_FRONTIER, TASKS, Task, get_task, scene_of


def as_task(task: Task | str) -> Task:
    """The record of a task that is given by its record or its name. Raises ValueError for an unknown name."""
    return get_task(task) if isinstance(task, str) else task


def _bullet(task: Task, **options):
    from tutorial_lib.tasks.bullet import BulletTask

    return BulletTask(task, **options)


SIMULATORS = {"bullet": (_bullet, "bullet-safety-gym")}
"""By family: a function that imports the simulator, which is slow, and makes the environment of a task; and
the package that the simulator comes with."""


def make_env(task: Task | str, **options):
    """The environment of a task, by its record or its name.

    It is a `gymnasium.Env` with float32 observations. `step` puts the cost into `info["cost"]`, and never
    merges `terminated` (the robot fell) with `truncated` (the horizon was reached). A seed that is given to
    `reset` repeats an episode bit for bit. `position` is the robot's (x, y) in metres, where the task has a
    scene. Options: `render_mode`, None or 'rgb_array', and `image_size`, (width, height) in pixels.

    Raises ValueError for an unknown name or family, and where the simulator is not installed.
    """
    task = as_task(task)
    if task.family not in SIMULATORS:
        families = ", ".join(SIMULATORS)
        raise ValueError(f"{task.name}: unknown family {task.family!r}: the families are {families}")
    make, package = SIMULATORS[task.family]
    try:
        return make(task, **options)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{task.name} is simulated by {package}, and module {error.name!r} is not installed. Install all "
            "that the library needs: pip install --no-deps --requirement environment.lock"
        ) from error
