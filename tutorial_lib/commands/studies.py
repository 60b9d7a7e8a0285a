"""The commands `c2iql study` and `c2iql report`. They import the other modules when they run."""

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tutorial_lib.commands import check_counts, check_memory

if TYPE_CHECKING:
    from tutorial_lib.studies.runs import Runs


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

    Raises ValueError where an entry needs more memory than is free, and where one failed.
    """
    from tutorial_lib.agents import get_algorithm
    from tutorial_lib.files import check_output
    from tutorial_lib.studies import cluster, results
    from tutorial_lib.studies.runs import collect as gather
    from tutorial_lib.tasks import get_task

    for entry in chosen:
        seeds, limits = zip(*entry.pairs, strict=True)
        of_runs = limits if entry.trained_for else None
        check_memory(get_algorithm(entry.algorithm), get_task(entry.task), entry.config, seeds, of_runs)
    out = out or (folder.parent if trial else results.RESULTS) / f"{folder.name}.csv"
    for path in (out, folder / "entry.csv"):
        check_output(path)
    if not trial and out.exists():
        results.read_results(out)  # a damaged file is named before hours of work, and not after
    with cluster.connect(scheduler, workers) as client:
        failures = cluster.run_all(chosen, folder, client)
    done = gather(whole, folder, out, keep=not trial)
    print(f"{out}: {done} of {len(whole)} entries are finished here")
    for name, reason in failures.items():
        print(f"FAILED {name}: {reason}")
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
