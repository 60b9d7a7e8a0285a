"""The command line: `c2iql tasks | collect | fetch | train | evaluate | study | report`.

tyro turns functions and dataclasses into commands with help and types, so no option is written twice.
"""

import contextlib
import dataclasses
import inspect
import io
import sys
from pathlib import Path
from typing import Annotated, Literal

import pandas as pd
import torch
import tyro

from tutorial_lib import checkpoints, playing, scores, training
from tutorial_lib.agents import get_algorithm
from tutorial_lib.config import Config, get_profile
from tutorial_lib.data.sources import fetch_dataset, load_dataset
from tutorial_lib.studies import grids
from tutorial_lib.tasks import TASKS, get_task

Positional = tyro.conf.Positional
Device = Literal["cpu", "cuda"]


def tasks() -> None:
    """List the tasks: horizon, dimensions, thresholds, reference returns."""
    table = pd.DataFrame([dataclasses.asdict(task) for task in TASKS.values()])
    print(table.drop(columns=["env_id", "dsrl_file"]).to_string(index=False))


def fetch(task: Positional[str], directory: Path | None = None) -> None:
    """Download DSRL's dataset of a task, and check it.

    Args:
        task: which task, e.g. CarCircle.
        directory: where to; default DSRL_DATASET_DIR or ~/.dsrl/datasets.
    """
    fetch_dataset(task, directory)


def collect(
    task: Positional[str],
    out: Path | None = None,
    sources: tuple[str, ...] = ("priced-0", "lagrangian-0"),
    steps: int | None = None,
    episodes: int | None = None,
    runs: Path = Path("runs/collect"),
    workers: int = 2,
) -> None:
    """Make a dataset from the simulator with PPO agents of two kinds, thinned on a cost-return grid.

    A killed run continues where it was.

    Args:
        task: which task, e.g. BallCircle.
        out: the file to write; default runs/collect/TASK.hdf5.
        sources: one PPO run each: a kind, priced or lagrangian, and a seed.
        steps: simulator steps of each run; default the task's recipe.
        episodes: about how many to keep; default the task's recipe.
        runs: folder for what is kept between a kill and a resume.
        workers: PPO runs side by side.
    """
    from tutorial_lib.data import collect as collecting  # pulls in stable-baselines3: slow to import

    check_counts(steps=steps, episodes=episodes, workers=workers)
    recipe = collecting.RECIPES[get_task(task).name]
    changes = {"steps": steps, "episodes": episodes}
    recipe = dataclasses.replace(
        recipe, **{key: value for key, value in changes.items() if value is not None}
    )
    out = out or runs / f"{get_task(task).name}.hdf5"
    dataset = collecting.collect(get_task(task), sources, recipe, runs, out, workers)
    print(f"{out}: {dataset.num_episodes} episodes, {len(dataset)} transitions")


def train(
    task: Positional[str],
    algorithm: str = "C2IQL",
    profile: str = "small",
    seeds: tuple[int, ...] = (0,),
    threshold: float | None = None,
    data: str = "shipped",
    out: Path | None = None,
    device: Device = "cpu",
    option: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = (),
) -> None:
    """Train an agent (several seeds together) and save it with its log; resumes a killed run.

    Args:
        task: which task, e.g. BallCircle.
        algorithm: a name from the list that a wrong one prints.
        profile: paper, or small, which trains in minutes on a laptop.
        seeds: one run each, trained together.
        threshold: the cost limit, for algorithms that are trained for one.
        data: shipped, dsrl, or a file.
        out: folder of the run; default runs/TASK/ALGORITHM-PROFILE.
        device: cpu or cuda.
        option: changes to the profile, e.g. kappa_2=0.7 time_limits=mask.
    """
    record, kind = get_task(task), get_algorithm(algorithm)
    config = with_options(get_profile(profile), option)
    suffix = "" if threshold is None else f"-{threshold:g}"
    out = (
        out
        or Path("runs") / record.name / f"{algorithm.replace(' ', '-').replace('/', '')}{suffix}-{profile}"
    )
    agent = kind(record, config, seeds=seeds, threshold=threshold, device=check_device(device))
    own = grids.OWN_OPTIONS.get(record.name, {}) if (algorithm, profile) == ("C2IQL", "small") else {}
    if any(getattr(config, name) != value for name, value in own.items()):
        words = " ".join(f"{name}={value}" for name, value in own.items())
        print(f"The agents of {record.name} in the results have options of their own: --option {words}")
    training.train(agent, load_dataset(record, data), run_dir=out)
    checkpoints.save_agent(agent, out / "agent.safetensors")
    log = out / checkpoints.METRICS
    print(f"{out}/agent.safetensors: trained for {agent.updates} updates; its log is {log}")


def evaluate(
    agent: Positional[Path],
    out: Path | None = None,
    thresholds: tuple[float, ...] | None = None,
    episodes: int = 10,
    workers: int = 2,
) -> None:
    """Run a trained agent in the simulator; print scores and save every episode.

    Args:
        agent: an agent.safetensors or a checkpoint.safetensors.
        out: the CSV to write; default beside the agent, e.g. agent-results.csv.
        thresholds: cost limits; default the task's three, or the one that the agent was trained for.
        episodes: per seed and threshold.
        workers: processes; the results do not depend on their number.
    """
    check_counts(episodes=episodes, workers=workers)
    out = out or agent.with_name(f"{agent.stem}-results.csv")
    if out.is_dir():
        raise ValueError(f"--out {out}: is a folder: name a file")
    results = playing.evaluate(checkpoints.load_agent(agent), thresholds, episodes, workers)
    print(scores.summarise(results).round(3).to_string(index=False))
    print("(low, high: 95% bootstrap intervals over episodes, all seeds pooled)")
    scores.save_results(results, out)
    print(f"{out}: {len(results)} episodes")


def study(
    name: Positional[str],
    only: str = "*",
    scheduler: str | None = None,
    workers: int | None = None,
    steps: int | None = None,
    profile: str = "small",
    option: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = (),
    data: str = "shipped",
    runs: Path = Path("runs/studies"),
    out: Path | None = None,
    dry: Annotated[bool, tyro.conf.arg(name="list")] = False,
) -> None:
    """Run a study, a grid of training runs and their episodes, and gather its results in one CSV.

    Cells that are finished are skipped, and those that were killed go on from their last checkpoint. Equal
    agents that are shipped, or that another study trained, are not trained again.

    Args:
        name: which study, e.g. ablations; a wrong one prints the list.
        only: run only the cells whose name has this in it, a pattern such as CarCircle*CIQL.
        scheduler: address of a dask scheduler; default one process for each core of this machine.
        workers: processes on this machine.
        steps: updates of every run, for a trial.
        profile: of every run.
        option: changes to every run, e.g. steps=200 crm_steps=100.
        data: shipped, or dsrl.
        runs: folder of all studies' runs.
        out: the CSV to write; default data/results/NAME.csv, and in a trial runs/studies/NAME.csv.
        dry: only list the cells, and which of them are finished.
    """
    from tutorial_lib.studies import cluster, results, runs  # pulls in dask

    check_counts(workers=workers, steps=steps)
    record, folder = grids.get_study(name), runs / name
    changes = (*option, *(() if steps is None else (f"steps={steps}",)))
    settings = {"change": lambda config: with_options(config, changes), "profile": profile, "data": data}
    grid, chosen = grids.cells(record, **settings), grids.cells(record, only, **settings)
    trial = bool(changes) or profile != "small" or data != "shipped"
    out = out or (runs / f"{name}.csv" if trial else results.RESULTS / f"{name}.csv")
    print(record.question)
    if dry:
        for cell in chosen:
            print("done   " if runs.results_path(cell, folder).exists() else "waiting", cell.name)
        return
    with cluster.connect(scheduler, workers) as client:
        failures = cluster.run_cells(chosen, folder, client)
    done = runs.collect(grid, folder, out, keep=not trial)
    print(f"{out}: {done} of {len(grid)} cells are finished here")
    for cell, reason in failures.items():
        print(f"FAILED {cell}: {reason}")
    if failures:
        raise ValueError(
            f"{len(failures)} of {len(chosen)} cells failed; run the study again to try them again"
        )


def report(name: Positional[str | None] = None) -> None:
    """Make tables and figures from the results' files: of one study, or all, and the pages that show them.

    Args:
        name: a study, whose table is printed and whose figure is drawn; without it README.md, data/README.md,
            the pictures of the datasets and all studies' figures.
    """
    from tutorial_lib.studies import report as reporting

    if name is None:
        print("\n".join(f"wrote {path}" for path in reporting.write()))
        return
    path = reporting.write_study(name)
    print(reporting.study_section(name))
    print(f"wrote {path}" if path else "no figure")


def with_options(config: Config, options: tuple[str, ...]) -> Config:
    """The config with `name=value` changes; values are read as the field's own type. Raises ValueError."""
    types = {field.name: field.type for field in dataclasses.fields(Config) if field.name != "profile"}
    changes = {}
    for option in options:
        name, equals, text = option.partition("=")
        if not equals or name not in types:
            raise ValueError(f"--option {option}: write NAME=VALUE with one of {', '.join(types)}")
        try:
            with contextlib.redirect_stderr(io.StringIO()):  # tyro's message is for another command line
                value = tyro.cli(types[name], args=[text])
        except SystemExit:
            kind = "True or False" if types[name] is bool else inspect.formatannotation(types[name])
            raise ValueError(f"--option {option}: the value must be {kind}") from None
        changes[name] = value
    return dataclasses.replace(config, **changes)  # at once: what fits together may come in any order


def check_counts(**numbers: int | None) -> None:
    """ValueError for an argument that must be at least one and is not."""
    for name, number in numbers.items():
        if number is not None and number < 1:
            raise ValueError(f"--{name} {number}: must be 1 or more")


def check_device(device: Device) -> Device:
    """The device itself, or ValueError where this machine has none."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: PyTorch finds no CUDA device here: leave it out to train on the CPU")
    return device


def main() -> None:
    """Entry point: errors that a user can mend are one line, without a traceback."""
    commands = {f.__name__: f for f in (tasks, collect, fetch, train, evaluate, study, report)}
    try:
        tyro.extras.subcommand_cli_from_dict(
            commands, prog="c2iql", description="Safe offline RL with C2IQL."
        )
    except (ValueError, OSError, checkpoints.TrainingError) as error:
        sys.exit(f"c2iql: {error}")


if __name__ == "__main__":
    main()
