"""The command line: `c2iql tasks | collect | fetch | data | train | evaluate | study | report`.

tyro makes commands with types and help from functions and dataclasses, so each option is written only once.
The commands import the other modules when they run, so that `c2iql --help` is fast.
"""

import dataclasses
import functools
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from tutorial_lib.studies.runs import Runs

Device = Literal["cpu", "cuda"]


def tasks() -> None:
    """List the tasks with their horizons, dimensions, limits and reference returns."""
    import pandas as pd

    from tutorial_lib.tasks import TASKS

    columns = (
        "name family horizon obs_dim act_dim gammas thresholds cost_range min_return max_return terminates"
    )
    rows = [{name: getattr(task, name) for name in columns.split()} for task in TASKS.values()]
    print(pd.DataFrame(rows).to_string(index=False))


def fetch(task: tyro.conf.Positional[str], directory: Path | None = None) -> None:
    """Download DSRL's dataset of a task and check it.

    Args:
        task: This is the name of the task, e.g. CarCircle.
        directory: The file is written to this folder. The default is DSRL_DATASET_DIR or ~/.dsrl/datasets.
    """
    from tutorial_lib.data.sources import fetch_dataset

    fetch_dataset(task, directory)


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
        sources: These are one PPO run each, with a kind, which is priced or lagrangian, and a seed.
        steps: Each run makes this number of simulator steps. The default is in the task's recipe.
        episodes: The dataset keeps about this number of episodes. The default is in the task's recipe.
        runs: This folder holds the saved state of the collection.
        workers: This number of PPO runs train at the same time.
    """
    from tutorial_lib.data import collect as collecting
    from tutorial_lib.tasks import get_task
    from tutorial_lib.tasks.recipes import RECIPES

    check_counts(steps=steps, episodes=episodes, workers=workers)
    recipe = RECIPES[get_task(task).name]
    recipe = dataclasses.replace(recipe, steps=steps or recipe.steps, episodes=episodes or recipe.episodes)
    out = out or runs / f"{get_task(task).name}.hdf5"
    dataset = collecting.collect(get_task(task), sources, recipe, runs, out, workers)
    print(f"{out}: {dataset.num_episodes} episodes, {len(dataset)} transitions")


def data(words: tuple[str, ...] = ()) -> None:
    """Check, convert and export files of datasets: `c2iql data check FILE --task TASK`."""
    from tutorial_lib.data.commands import main

    main(words)


def train(words: tuple[str, ...] = ()) -> None:
    """Train an agent and save it with its log: `c2iql train [ALGORITHM] TASK [options]`.

    Several seeds train together. A run that was killed continues from its last checkpoint when you run the
    command again. Without options, the command trains with the settings of the table of results.
    `c2iql train ALGORITHM --help` shows all options of an algorithm. The default algorithm is C2IQL.
    """
    from tutorial_lib import checkpoints, training
    from tutorial_lib.agents import slug
    from tutorial_lib.data import load_dataset
    from tutorial_lib.options import parse_training
    from tutorial_lib.tasks import get_task

    kind, args = parse_training(list(words))
    task = get_task(args.task)
    limits = args.limits or task.thresholds
    if args.limits and not kind.needs_limit:
        raise ValueError(f"--limits: {kind.name} is trained for no limit; it is told one when it plays")
    if not args.seeds:
        raise ValueError("--seeds: give at least one")
    pairs = [(seed, limit) for limit in (limits if kind.needs_limit else (None,)) for seed in args.seeds]
    device = check_device(args.device)
    seeds, of_runs = zip(*pairs, strict=True)
    agent = kind(task, args.config, seeds, of_runs if kind.needs_limit else None, device)
    suffix = "".join(f"-{limit:g}" for limit in args.limits)
    out = args.out or Path("runs") / task.name / f"{slug(kind.name)}{suffix}-{args.config.profile}"
    training.train(agent, load_dataset(task, args.data), run_dir=out)
    checkpoints.save_agent(agent, out / "agent.safetensors")
    log = out / checkpoints.METRICS
    print(f"{out}/agent.safetensors: trained for {agent.updates} updates; its log is {log}")


def evaluate(
    agent: tyro.conf.Positional[Path],
    out: Path | None = None,
    limits: tuple[float, ...] | None = None,
    episodes: int = 10,
    workers: int = 2,
) -> None:
    """Run a trained agent in the simulator, print its scores and save the results of every episode.

    Args:
        agent: This is the path of an agent.safetensors or a checkpoint.safetensors.
        out: The results are written to this CSV. The default is beside the agent, e.g. agent-results.csv.
        limits: These are limits of the episode cost. The default is the limits for which the agent was
            trained, or the task's own limits.
        episodes: This is the number of episodes per run and limit.
        workers: This is the number of processes. The results do not depend on it.
    """
    from tutorial_lib import checkpoints, playing, scores

    check_counts(episodes=episodes, workers=workers)
    out = out or agent.with_name(f"{agent.stem}-results.csv")
    if out.is_dir():
        raise ValueError(f"--out {out}: is a folder: name a file")
    results = playing.evaluate(checkpoints.load_agent(agent), limits, episodes, workers)
    print(scores.summarise(results).round(3).to_string(index=False))
    print("(low, high: 95% bootstrap intervals over episodes, all seeds pooled)")
    scores.save_results(results, out)
    print(f"{out}: {len(results)} episodes")


def study(
    name: tyro.conf.Positional[str],
    only: str = "*",
    scheduler: str | None = None,
    workers: int | None = None,
    profile: str = "small",
    option: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = (),
    data: str = "shipped",
    runs: Path = Path("runs/studies"),
    out: Path | None = None,
    dry: Annotated[bool, tyro.conf.arg(name="list")] = False,
) -> None:
    """Run a study and write its results to one CSV.

    A study is a grid of training runs, which are then evaluated. Each entry of the grid is one set of runs.
    Entries that are finished are skipped. Entries that were killed continue from their last checkpoint. An
    agent is not trained again where an equal agent is shipped or was trained in another study.

    Args:
        name: This is the name of the study, e.g. ablations. An unknown name prints the list of studies.
        only: Only entries whose name contains this pattern are run, e.g. CarCircle*CIQL.
        scheduler: This is the address of a dask scheduler. Without it, one process runs on each core of this
            machine.
        workers: This is the number of processes on this machine.
        profile: This is the profile of every run.
        option: These are changes for a trial, e.g. updates=200 crm_steps=100. Each changes every run that has
            the option.
        data: This is shipped or dsrl.
        runs: This folder holds the runs of all studies.
        out: The results are written to this CSV. The default is data/results/NAME.csv, and in a trial
            runs/studies/NAME.csv.
        dry: The command only lists the entries and says which are finished.
    """
    check_counts(workers=workers)
    question, whole, chosen = _entries(name, only, profile, option, data)
    trial = bool(option) or profile != "small" or data != "shipped"
    print(question)
    if dry:
        _list_entries(chosen, runs / name)
    else:
        _run_entries(whole, chosen, runs / name, out, trial, scheduler, workers)


def _entries(
    name: str, only: str, profile: str, option: tuple[str, ...], data: str
) -> tuple[str, list["Runs"], list["Runs"]]:
    """Returns a study's question, all of its entries, and the entries that `only` selects."""
    from tutorial_lib.options import with_options
    from tutorial_lib.studies import grids

    record = grids.get_study(name)
    change = functools.partial(with_options, options=option, others=grids.options_of(record))
    whole, chosen = (grids.entries(record, fits, change, profile, data) for fits in ("*", only))
    return record.question, whole, chosen


def _list_entries(chosen: list["Runs"], folder: Path) -> None:
    """Prints the name of each entry and whether it is finished."""
    from tutorial_lib.studies.runs import results_path

    for entry in chosen:
        print("done   " if results_path(entry, folder).exists() else "waiting", entry.name)


def _run_entries(
    whole: list["Runs"],
    chosen: list["Runs"],
    folder: Path,
    out: Path | None,
    trial: bool,
    scheduler: str | None,
    workers: int | None,
) -> None:
    """Runs the chosen entries and writes the results of the whole study.

    Raises ValueError where an entry failed.
    """
    from tutorial_lib.studies import cluster, results
    from tutorial_lib.studies.runs import collect as gather

    out = out or (folder.parent if trial else results.RESULTS) / f"{folder.name}.csv"
    with cluster.connect(scheduler, workers) as client:
        failures = cluster.run_all(chosen, folder, client)
    done = gather(whole, folder, out, keep=not trial)
    print(f"{out}: {done} of {len(whole)} entries are finished here")
    for entry, reason in failures.items():
        print(f"FAILED {entry}: {reason}")
    if failures:
        some = f"{len(failures)} of {len(chosen)} entries failed"
        raise ValueError(f"{some}; run the study again to try them again")


def report(name: tyro.conf.Positional[str | None] = None) -> None:
    """Make tables and figures from the results' files, for one study or for all studies.

    Args:
        name: This is a study whose table is printed and whose figure is drawn. Without it, the command
            writes README.md, data/README.md, the figures of the datasets and the figures of all
            studies.
    """
    from tutorial_lib.studies import report as reporting

    if name is None:
        print("\n".join(f"wrote {path}" for path in reporting.write()))
        return
    path = reporting.write_study(name)
    print(reporting.study_section(name))
    print(f"wrote {path}" if path else "no figure")


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


def main() -> None:
    """Runs the command line. A ValueError or an OSError is printed in one line, without a traceback."""
    words = sys.argv[1:]
    if words == ["--version"]:
        print(f"c2iql {version('c2iql-tutorial')}")
        return
    commands = {f.__name__: f for f in (tasks, collect, fetch, data, train, evaluate, study, report)}
    try:
        parsers = {"train": train, "data": data}  # their options depend on their first arguments
        if words and words[0] in parsers:
            parsers[words[0]](tuple(words[1:]))
        else:
            tyro.extras.subcommand_cli_from_dict(
                commands, prog="c2iql", description="Safe offline reinforcement learning with C2IQL."
            )
    except (ValueError, OSError) as error:
        sys.exit(f"c2iql: {error}")


if __name__ == "__main__":
    main()
