"""Five small commands that write files: they are killed, run twice at once, and given too little space.

Training saves a checkpoint every 20 updates instead of 2,500, and a collection has slices of 1,616 steps
instead of 204,800, so that a second holds many of the moments at which files are written.
"""

import contextlib
import csv
import dataclasses
import functools
import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors.numpy

from benchmarks.reliability import answers
from benchmarks.reliability.processes import Work, called, contents, typed
from benchmarks.reliability.samples import TINY
from tutorial_lib import training
from tutorial_lib.data import release, sources
from tutorial_lib.tasks.recipes import RECIPES

BATCH = 1616
"""An episode of BallRun in each of 16 environments, and a step of the next: one batch is a slice."""


class Job(NamedTuple):
    """A command that writes into its current folder."""

    name: str
    work: Work
    kills: int
    """How often it is killed in a full trial."""


def _train(updates: int, seed: int) -> None:
    training.train = functools.partial(training.train, checkpoint_every=20, log_every=10)  # type: ignore
    words = ("train", "IQL", "BallRun", "--data", "../samples/data.hdf5", "--out", "run", "--seeds", seed)
    typed(*words, *TINY, "--updates", updates)()


def train(updates: int = 300, seed: int = 0) -> Work:
    """`c2iql train` of a tiny agent."""
    return functools.partial(_train, updates, seed)


def _collect() -> None:
    from tutorial_lib.data import collect as collecting

    collecting.run_ppo = functools.partial(collecting.run_ppo, slice_steps=BATCH)  # type: ignore
    small = {"batch_steps": BATCH, "ramp": (0.25, 0.75), "limit_falls": (0.0, 0.01)}
    RECIPES["BallRun"] = dataclasses.replace(RECIPES["BallRun"], **small)  # type: ignore
    words = ("collect", "BallRun", "--out", "out.hdf5", "--runs", "runs", "--sources", "priced-0")
    typed(*words, "--steps", 4 * BATCH, "--episodes", 20, "--workers", 1)()


def _study() -> None:
    from tutorial_lib.studies import grids

    rates = tuple({"policy_lr": rate} for rate in (1e-3, 2e-3, 3e-3))
    grid = grids.Grid(("BallRun",), ("BC-All",), rates, seeds=1, limits=(40.0,))
    grids.STUDIES["reliability"] = grids.Study("Does it resume?", (grid,))
    options = ("hidden_width=8", "hidden_layers=1", "batch_size=8", "updates=2000")
    words = ("study", "reliability", "--data", "../samples/data.hdf5", "--runs", "runs", "--workers", 2)
    typed(*words, "--out", "out.csv", "--option", *options)()


def evaluate() -> Work:
    """`c2iql evaluate` of a tiny agent."""
    words = ("evaluate", "../samples/agent.safetensors", "--episodes", 10, "--workers", 1, "--limits", 40)
    return typed(*words, "--out", "out.csv")


@contextlib.contextmanager
def jobs(root: Path) -> Iterator[list[Job]]:
    """The jobs. `root` has the folder `samples`, and the jobs run in other folders of `root`."""
    (root / "served").mkdir()
    archive = _make_archive(root)
    digest = hashlib.sha256(archive).hexdigest()
    (root / "served" / "course").write_bytes(b"200\n" + archive)
    (root / "served" / "dsrl").write_bytes(b"200\n" + (root / "samples" / "data.hdf5").read_bytes())
    with answers.server(root / "served") as address:
        course = called(release.fetch_course, f"{address}/course", Path("fetched"), digest)
        dsrl = called(sources.fetch_dataset, "BallRun", Path("fetched"), f"{address}/dsrl/")
        yield [
            Job("train", train(), 14),
            Job("collect", _collect, 8),
            Job("study", _study, 6),
            Job("evaluate", evaluate(), 8),
            Job("fetch --course", course, 8),
            Job("fetch", dsrl, 6),
        ]


def _make_archive(root: Path) -> bytes:
    """An archive of 60 files of 100 kB, as a release has it."""
    for number in range(60):
        path = root / "packed" / "results" / f"{number}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(np.random.default_rng(number).bytes(100_000))
    with contextlib.redirect_stdout(io.StringIO()):
        return release.write_archive(root / "packed", root).read_bytes()


def written(folder: Path) -> dict[str, bytes]:
    """What a job wrote, without the numbers of a clock: the speed in a log, the seconds in a state."""
    return {name: _plain(Path(name).name, data) for name, data in contents(folder).items()}


def _plain(name: str, data: bytes) -> bytes:
    if name == "metrics.csv":
        return _plain_log(data)
    return _plain_state(data) if name.startswith("state-") else data


def _plain_log(data: bytes) -> bytes:
    rows = list(csv.DictReader(io.StringIO(data.decode())))
    plain = [{key: text for key, text in row.items() if key != "updates_per_second"} for row in rows]
    return json.dumps(plain).encode()


def _plain_state(data: bytes) -> bytes:
    arrays = safetensors.numpy.load(data)
    arrays.pop("seconds")
    return safetensors.numpy.save(dict(sorted(arrays.items())))
