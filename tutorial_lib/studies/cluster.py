"""Runs the entries of a study on many processes with dask.distributed, on this machine or on a cluster.

When a worker dies, the scheduler gives its entry to another worker, which continues from the entry's last
checkpoint. Only the updates since then are lost. If the worker was killed and the other one is on another
machine, the entry fails instead, because its folder is still locked (see `files.held`). The reason says what
to delete before the study is run again.
"""

import contextlib
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, LocalCluster, as_completed, get_worker
from distributed.scheduler import KilledWorker
from tqdm.auto import tqdm

from tutorial_lib.studies.runs import Runs, results_path, train_and_play

TOPIC = "updates"
"""The name under which workers report their number of updates to the client."""
ONE_THREAD = {f"{library}_NUM_THREADS": 1 for library in ("OMP", "MKL", "OPENBLAS")}
"""The environment variables of the workers. They replace dask's own, which also set MALLOC_TRIM_THRESHOLD_:
with it, the memory of every large tensor is returned to the system and requested again, which takes half of
an update's time."""


@contextlib.contextmanager
def connect(scheduler: str | None = None, workers: int | None = None) -> Iterator[Client]:
    """A client of the scheduler at the address `scheduler`, or of a new local cluster of `workers` processes.

    A local worker has one thread. The default is one worker per core. The workers of another scheduler need
    this project installed, its data, the folder of the runs under the same path, and the environment
    variables `ONE_THREAD`.
    """
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            # No limit on memory: by default a worker may use its share of the machine's memory. Where cores
            # are many, this share is so small that dask kills workers, although an entry needs little.
            options = {"threads_per_worker": 1, "memory_limit": None, "dashboard_address": None}
            options |= {"silence_logs": logging.CRITICAL}  # `run_all` returns the failures
            stack.enter_context(dask.config.set({"distributed.nanny.pre-spawn-environ": ONE_THREAD}))
            scheduler = stack.enter_context(LocalCluster(n_workers=workers, **options))
        yield stack.enter_context(Client(scheduler))


def run_all(chosen: list[Runs], folder: Path, client: Client, progress: bool = True) -> dict[str, str]:
    """Run the entries that are not finished in `folder`. Returns the failures.

    A failure is an entry's name and the reason. When an entry fails, the others continue. The progress bar
    counts updates.
    """
    folder = Path(folder).absolute()
    waiting = {runs.name: runs for runs in chosen if not results_path(runs, folder).exists()}
    total, made = sum(runs.config.updates for runs in waiting.values()), dict.fromkeys(waiting, 0)
    failures: dict[str, str] = {}
    with tqdm(total=total, unit="update", smoothing=0.05, disable=not progress, mininterval=1) as bar:
        bar.set_description(f"{len(chosen) - len(waiting)} of {len(chosen)} entries done")

        def heard(event: tuple[Any, tuple[str, int]]) -> None:
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
    """Train and play one entry in a worker's process, and report its number of updates."""
    worker = get_worker()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they would break the progress bar; metrics.csv has the numbers
        train_and_play(runs, folder, lambda updates: worker.log_event(TOPIC, (runs.name, updates)))


def _reason(future: Future) -> str:
    """Why an entry failed, in one line."""
    if future.status != "error":
        return f"{future.status}: the scheduler gave it up"
    error = future.exception()
    if isinstance(error, KilledWorker):
        return "its process died several times: the memory may be too small"
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
