"""A study of many entries whose workers are killed, many times the data, and the tests with other kernels."""

import json
import os
import platform
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pandas as pd

from benchmarks.reliability.samples import make_dataset
from tutorial_lib.data.dataset import KEYS
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.data.sources import find_dataset
from tutorial_lib.studies import cluster, grids
from tutorial_lib.studies.report import ROOT
from tutorial_lib.studies.runs import Runs, results_path, train_and_play

SUITE = (sys.executable, "-m", "pytest", "-q", "tests")
"""The command of the tests."""
TILES = 8
"""The most copies of a dataset that are in memory at once while the large file is written."""

# --- Many entries ---


def _entries(count: int, data: Path) -> list[Runs]:
    """Entries of a study that train for 30 updates and play ten episodes each."""
    rates = tuple({"policy_lr": rate} for rate in np.geomspace(1e-4, 1e-2, count).round(9).tolist())
    grid = grids.Grid(("BallRun",), ("BC-All",), rates, seeds=1, limits=lambda task: (40.0,))
    small = {"hidden_width": 8, "hidden_layers": 1, "batch_size": 8, "updates": 30}
    study = grids.Study("Does nothing get lost?", (grid,))
    return grids.entries(study, change=lambda config: config.changed(**small), data=str(data))


def _kill_workers(client: cluster.Client, folder: Path, after: Sequence[int], killed: list[int]) -> None:
    """Kills a worker whenever another number of entries is finished."""
    chance = random.Random(0)
    for count in after:
        while len(list(folder.glob("*.csv"))) < count:
            time.sleep(0.05)
        number = chance.choice(list(client.run(os.getpid).values()))
        os.kill(number, signal.SIGKILL)
        killed.append(number)


def cells(count: int = 200, kills: int = 3) -> pd.DataFrame:
    """Runs a study with two workers, of which one is killed every now and then. Returns one row.

    Every entry's results are compared, byte by byte, with those of the same entry in one process.
    """
    killed: list[int] = []
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        chosen = _entries(count, write_dataset(root / "data.hdf5", make_dataset(), "BallRun"))
        after = [round((number + 1) * count / (kills + 1)) for number in range(kills)]
        with cluster.connect(workers=2) as client:
            began, folder = time.monotonic(), root / "many" / "study"
            arguments = (client, folder, after, killed)
            killer = threading.Thread(target=_kill_workers, args=arguments, daemon=True)
            killer.start()
            failures = cluster.run_all(chosen, folder, client, progress=False)
            seconds = time.monotonic() - began
        alone = [train_and_play(entry, root / "one" / "study").read_bytes() for entry in chosen]
        paths = [results_path(entry, folder) for entry in chosen]
        equal = [
            path.exists() and path.read_bytes() == whole for path, whole in zip(paths, alone, strict=True)
        ]
    row = {"entries": count, "workers killed": len(killed), "failed": len(failures)}
    return pd.DataFrame([row | {"equal to one process": sum(equal), "seconds": round(seconds)}])


# --- Large data ---

MEASURE = """
import json, sys, time

from tutorial_lib.agents import C2IQL
from tutorial_lib.data.hdf5 import read_dataset
from tutorial_lib.tasks import TASKS
from tutorial_lib.training import train

agent, row, options = C2IQL(TASKS["BallRun"], C2IQL.configure("small", crm_steps=10)), {}, {"progress": False}

def note(what, began):
    row[f"{what}, s of CPU"] = round(time.process_time() - began, 2)
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    row[f"peak after {what}, MB"] = int(status["VmHWM"].split()[0]) // 1024

note("imports", 0.0)
began = time.process_time()
dataset = read_dataset(sys.argv[1], "BallRun")
note("reading", began)
began = time.process_time()
train(agent, dataset, updates=1, **options)
note("preparing", began)
began = time.process_time()
train(agent, dataset, updates=51, **options)
note("50 updates", began)
print(json.dumps({"transitions": len(dataset)} | row))
"""
"""What a process of its own does with a dataset: it reads it, prepares training, and makes 50 updates."""


def large(factor: int = 50, source: Path | None = None) -> pd.DataFrame:
    """Trains on a dataset and on `factor` copies of it in one file. One row for each: seconds and memory.

    The default of `source` is the shipped dataset of BallRun. Works on Linux, which says what a process's
    memory was at most.
    """
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "large.hdf5"
        _tile(source or find_dataset("BallRun"), path, factor)
        for name in (source or find_dataset("BallRun"), path):
            command = [sys.executable, "-c", MEASURE, str(name)]
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
            megabytes = round(name.stat().st_size / 1e6, 1)
            rows.append({"file, MB": megabytes} | json.loads(done.stdout.splitlines()[-1]))
    return pd.DataFrame(rows, dtype=object)  # as they are, also in a column beside fractions


def _tile(source: Path, path: Path, factor: int) -> None:
    """Writes the rows of a dataset so many times into one file, uncompressed."""
    with h5py.File(source) as small, h5py.File(path, "w") as file:
        for key in KEYS:
            values = small[key][()]
            whole = file.create_dataset(key, (factor * len(values), *values.shape[1:]), values.dtype)
            for first in range(0, factor, TILES):
                part = np.concatenate([values] * min(TILES, factor - first))
                whole[first * len(values) : first * len(values) + len(part)] = part


# --- Other kernels ---


def suite(command: Sequence[str] = SUITE) -> pd.DataFrame:
    """Runs the tests with PyTorch's plainest kernels. Returns one row with the last line of the output."""
    environment = os.environ | {"ATEN_CPU_CAPABILITY": "default"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    last = (done.stdout.strip().splitlines() or [done.stderr.strip()])[-1]
    return pd.DataFrame([{"kernels": "default", "processor": platform.machine(), "result": last.strip("= ")}])
