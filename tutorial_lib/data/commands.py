"""The commands on files of datasets: `c2iql data check | convert | export`."""

from pathlib import Path

import numpy as np
import pandas as pd
import tyro

from tutorial_lib.data.dataset import Dataset, DatasetError
from tutorial_lib.tasks import Task, get_task

NEAR = 0.1
"""An episode comes near the best return where it misses it by at most this share of it."""


def main(words: tuple[str, ...]) -> None:
    """Runs one of the commands with the arguments after `c2iql data`."""
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
    from tutorial_lib.data.hdf5 import examine

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


def describe(dataset: Dataset, task: Task) -> list[str]:
    """Lines on what a dataset contains: its size, its episodes, how many keep each limit, and its origin."""
    columns = {
        "length": dataset.episode_lengths,
        "cost": dataset.episode_costs,
        "return": dataset.episode_returns,
    }
    rows = [(name, x.min(), np.median(x), x.mean(), x.max()) for name, x in columns.items()]
    spread = pd.DataFrame(rows, columns=["of an episode", "min", "median", "mean", "max"])
    origin = [_printable(f"{key}: {value}")[:200] for key, value in sorted(dataset.attributes.items())]
    return [
        "",
        f"{dataset.num_episodes} episodes, {len(dataset)} transitions, "
        f"{dataset.terminals.sum()} terminals, {dataset.timeouts.sum()} time limits",
        spread.round(1).to_string(index=False),
        "",
        limits_table(dataset, task).to_string(index=False),
        "",
        *(origin or ["no attributes: the file does not say where it comes from"]),
        "",
    ]


def _printable(text: str) -> str:
    """The text in one line, without characters that control a terminal."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def limits_table(dataset: Dataset, task: Task) -> pd.DataFrame:
    """One row for each limit of the task: the share of the episodes that keep it, the best return of these,
    and how many of these come within 10% of the best. Without such episodes, the best return is NaN."""
    rows = []
    for limit in task.thresholds:
        returns = dataset.episode_returns[dataset.episode_costs <= limit]
        best = returns.max() if len(returns) else np.nan
        near = int((returns >= best - NEAR * abs(best)).sum())
        rows.append((limit, f"{len(returns) / dataset.num_episodes:.1%}", round(best, 1), near))
    return pd.DataFrame(rows, columns=["limit", "episodes within", "best return", "within 10% of it"])
