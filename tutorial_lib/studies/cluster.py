"""Entries of a study on many processes: dask.distributed, on this machine or on a cluster.

A worker that dies takes nothing with it but the updates since its entry's last checkpoint: the scheduler
hands the entry to another one, which goes on from there.
"""

import contextlib
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import dask
from distributed import Client, Future, LocalCluster, as_completed, get_worker
from distributed.scheduler import KilledWorker
from tqdm.auto import tqdm

from tutorial_lib.studies.runs import Runs, results_path, train_and_play

TOPIC = "updates"
ONE_THREAD = {f"{library}_NUM_THREADS": 1 for library in ("OMP", "MKL", "OPENBLAS")}
"""The workers' environment: dask's, less its MALLOC_TRIM_THRESHOLD_. That one has the memory of every large
tensor given back to the system and asked for again: half of an update's time."""


@contextlib.contextmanager
def connect(scheduler: str | None = None, workers: int | None = None) -> Iterator[Client]:
    """A client of the scheduler at this address, or of one process per core here, each with one thread.

    The workers of a scheduler elsewhere need this project installed, its data, the folder of the runs under
    the same path, and the environment that `ONE_THREAD` speaks of.
    """
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            # No limit on memory: at its default, a share of the machine's, workers are killed where the cores
            # are many, and an entry needs little.
            options = {"threads_per_worker": 1, "memory_limit": None, "dashboard_address": None}
            options |= {"silence_logs": logging.CRITICAL}  # what matters is reported at the end
            stack.enter_context(dask.config.set({"distributed.nanny.pre-spawn-environ": ONE_THREAD}))
            scheduler = stack.enter_context(LocalCluster(n_workers=workers, **options))
        yield stack.enter_context(Client(scheduler))


def run_all(chosen: list[Runs], folder: Path, client: Client, progress: bool = True) -> dict[str, str]:
    """Run the entries that are not finished. Returns what went wrong, by the names of the entries that
    failed.

    Whatever happens to an entry, the others go on. Progress counts updates.
    """
    folder = Path(folder).absolute()
    waiting = {runs.name: runs for runs in chosen if not results_path(runs, folder).exists()}
    total, made = sum(runs.config.updates for runs in waiting.values()), dict.fromkeys(waiting, 0)
    failures: dict[str, str] = {}
    with tqdm(total=total, unit="update", smoothing=0.05, disable=not progress, mininterval=1) as bar:
        bar.set_description(f"{len(chosen) - len(waiting)} of {len(chosen)} entries done")

        def heard(event):
            _, (name, updates) = event
            made[name] = max(made.get(name, 0), updates)
            bar.update(sum(made.values()) - bar.n)

        client.subscribe_topic(TOPIC, heard)
        futures = [
            client.submit(_run_on_worker, runs, folder, key=runs.name, pure=False)
            for runs in waiting.values()
        ]
        for done, future in enumerate(as_completed(futures), len(chosen) - len(waiting) + 1):
            if future.status != "finished":
                failures[future.key] = _reason(future)
            heard((None, (future.key, waiting[future.key].config.updates)))
            lost = f", {len(failures)} failed" if failures else ""
            bar.set_description(f"{done - len(failures)} of {len(chosen)} entries done{lost}")
        client.unsubscribe_topic(TOPIC)
    return failures


def _run_on_worker(runs: Runs, folder: Path) -> None:
    worker = get_worker()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they would run across the progress bar; metrics.csv has the numbers
        train_and_play(runs, folder, lambda updates: worker.log_event(TOPIC, (runs.name, updates)))


def _reason(future: Future) -> str:
    if future.status != "error":
        return f"{future.status}: the scheduler gave it up"
    error = future.exception()
    if isinstance(error, KilledWorker):
        return "its process died again and again (out of memory?)"
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
