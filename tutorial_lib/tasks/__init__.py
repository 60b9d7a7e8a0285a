"""Tasks: what a task is (`record`) and who simulates it (`bullet`)."""

from tutorial_lib.tasks.record import DSRL_FRONTIER, TASKS, Task, get_task


def as_task(task: Task | str) -> Task:
    """The record of a task that is given by its record or its name. Raises ValueError for an unknown name."""
    return get_task(task) if isinstance(task, str) else task


def make_env(task: Task | str, **options):
    """The environment of a task, by its record or its name. Raises ValueError for an unknown name."""
    from tutorial_lib.tasks.bullet import BulletTask  # the simulator is slow to import

    return BulletTask(as_task(task), **options)
