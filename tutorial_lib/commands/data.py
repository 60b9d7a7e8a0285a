"""The commands on tasks and their datasets: `c2iql tasks | fetch | collect | data`."""

import dataclasses
from pathlib import Path

import tyro

from tutorial_lib.commands import check_counts


def tasks() -> None:
    """List the tasks with their horizons, dimensions, limits and reference returns.

    The last column says whether the simulator of the task is installed, and what to do where it is not.
    """
    import pandas as pd

    from tutorial_lib.tasks import all_tasks, simulator_of

    columns = (
        "name family horizon obs_dim act_dim gammas thresholds cost_range min_return max_return terminates"
    )
    rows = []
    for task in all_tasks().values():
        simulator = simulator_of(task)
        state = f"not installed: {simulator.remedy}" if simulator.missing() else "installed"
        rows.append({name: getattr(task, name) for name in columns.split()} | {"simulator": state})
    print(pd.DataFrame(rows).to_string(index=False))


def fetch(
    task: tyro.conf.Positional[str | None] = None, directory: Path | None = None, course: bool = False
) -> None:
    """Download DSRL's dataset of a task and check it, or the files of the course.

    Args:
        task: This is the name of the task, e.g. CarCircle.
        directory: The file is written to this folder. The default is DSRL_DATASET_DIR or ~/.dsrl/datasets,
            and for the course's files C2IQL_DATA or ~/.c2iql.
        course: The command brings the datasets, agents and results that a clone of the project has.
    """
    from tutorial_lib.data.release import fetch_course
    from tutorial_lib.data.sources import fetch_dataset

    if course and task is None:
        fetch_course(folder=directory)
    elif task is not None and not course:
        fetch_dataset(task, directory)
    else:
        raise ValueError("fetch: name a task, e.g. `c2iql fetch CarCircle`, or write `c2iql fetch --course`")


def collect(
    task: tyro.conf.Positional[str],
    out: Path | None = None,
    sources: tuple[str, ...] = ("priced-0", "lagrangian-0"),
    steps: int | None = None,
    episodes: int | None = None,
    runs: Path = Path("runs/collect"),
    workers: int = 2,
) -> None:
    """Make a dataset from the simulator with PPO agents of two kinds.

    The episodes are subsampled on a grid of cost and return. A collection that was killed continues from its
    saved state when you run the command again.

    Args:
        task: This is the name of the task, e.g. BallCircle.
        out: The dataset is written to this file. The default is runs/collect/TASK.hdf5.
        sources: These are one PPO run each, with a kind, which is priced or lagrangian, and a seed. A source
            can also be the file of a dataset that was collected before, to which the others are added.
        steps: Each run makes this number of simulator steps. The default is in the task's recipe.
        episodes: The dataset keeps about this number of episodes. The default is in the task's recipe.
        runs: This folder holds the saved state of the collection.
        workers: This number of PPO runs train at the same time.
    """
    from tutorial_lib.tasks import check_installed, get_task
    from tutorial_lib.tasks.recipes import RECIPES

    check_counts(steps=steps, episodes=episodes, workers=workers)
    check_installed(get_task(task))
    from tutorial_lib.data import collect as collecting  # takes seconds

    recipe = RECIPES[get_task(task).name]
    recipe = dataclasses.replace(recipe, steps=steps or recipe.steps, episodes=episodes or recipe.episodes)
    out = out or runs / f"{get_task(task).name}.hdf5"
    dataset = collecting.collect(get_task(task), sources, recipe, runs, out, workers)
    print(f"{out}: {dataset.num_episodes} episodes, {len(dataset)} transitions")


def data(words: tuple[str, ...] = ()) -> None:
    """Check, convert and export files of datasets: `c2iql data check FILE --task TASK`."""
    commands = {function.__name__: function for function in (check, convert, export)}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="c2iql data", description="Check, convert and export files of datasets.", args=words
    )


def check(file: tyro.conf.Positional[Path], task: str) -> None:
    """Print what is wrong with a file, and what is in it. Nothing is trained.

    Errors are what the library refuses to read. Warnings may be meant. The command fails where there is an
    error.

    Args:
        file: This is a file in DSRL's HDF5 layout.
        task: This is the name of the task that the file should be of, e.g. CarCircle.
    """
    from tutorial_lib.data import DatasetError
    from tutorial_lib.data.hdf5 import examine
    from tutorial_lib.data.summary import describe
    from tutorial_lib.tasks import get_task

    record = get_task(task)
    dataset, report = examine(file, record)
    for line in report.errors:
        print(f"ERROR {line}")
    for line in report.warnings:
        print(f"WARNING {line}")
    if dataset is not None:
        print("\n".join(describe(dataset, record)))
    if report.errors:
        raise DatasetError(f"{file}: not usable for {record.name}: errors: {len(report.errors)}")
    print(f"{file}: usable for {record.name}, warnings: {len(report.warnings)}")


def convert(source: tyro.conf.Positional[Path], out: Path, task: str) -> None:
    """Write a recording of another layout to a file in DSRL's layout.

    The source is an HDF5 file in D4RL's or Minari's layout, or a folder with one CSV or npz file per episode.

    Args:
        source: This is the file or the folder.
        out: The dataset is written to this file.
        task: This is the name of the task, e.g. CarCircle.
    """
    from tutorial_lib.data import convert as converting

    dataset = converting.convert(source, out, task)
    print(f"{out}: {dataset.num_episodes} episodes, {len(dataset)} transitions")


def export(file: tyro.conf.Positional[Path], task: str, minari: str) -> None:
    """Write a dataset in DSRL's layout to a new dataset of the package Minari.

    Args:
        file: This is a file in DSRL's HDF5 layout.
        task: This is the name of the task, e.g. CarCircle.
        minari: This is the name of the new Minari dataset, e.g. carcircle/mixed-v0.
    """
    from tutorial_lib.data import convert as converting

    converting.export_minari(file, task, minari)
    print(f"{minari}: written")
