"""`python -m benchmarks` measures in about a minute how fast this machine trains and simulates.

`python -m benchmarks --full` takes some minutes. It measures every algorithm, a plain version of C2IQL, other
libraries' algorithms, and how the time grows with seeds, batch size and data. The tables and the figure of
speed are made from its files.
"""

import platform
from collections.abc import Callable, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import pandas as pd
import psutil
import torch
from tqdm.auto import tqdm

from benchmarks.cases import SIZES, TASKS, groups, measure, side_by_side
from benchmarks.peers import install
from benchmarks.simulation import simulation
from benchmarks.tables import FILES, FOLDER, part_shares, with_shares
from benchmarks.updates import PARTS, PRODUCT, Case, Device
from tutorial_lib.agents import get_algorithm
from tutorial_lib.files import written_whole
from tutorial_lib.matmul import bfloat16_time
from tutorial_lib.tasks import Task, get_task
from tutorial_lib.tasks.bullet import pybullet_package

__all__ = ["PARTS", "bench", "full", "install", "machine", "training"]
BUSY = 10
"""Percent of the cores' time. If other programs use more, several processes are not compared with one."""


def bench(
    task: Task, workers: int | None = None, rounds: int = 3, seconds: float = 0.6, device: Device = "cpu"
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The tables `training` and `simulation` of C2IQL on one task.

    One measurement of training lasts `seconds`, or one update if that is longer, and twice as long on a GPU.
    """
    workers = workers or joblib.cpu_count()  # the number of cores that this process may use
    kinds: tuple[dict[str, Any], ...] = ({}, {"runs": 3}, {"products": "bfloat16"})
    cases = [Case("C2IQL", task.name, profile, **kind) for profile in SIZES for kind in kinds]
    with tqdm(total=(rounds + 1) * (len(cases) + 6), desc="measuring", leave=False) as bar:
        return (
            training(cases, rounds, seconds, device, bar.update),
            simulation(task, workers, rounds, bar.update),
        )


def training(
    cases: Sequence[Case],
    rounds: int = 3,
    seconds: float = 0.6,
    device: Device = "cpu",
    done: Callable[[], object] = lambda: None,
) -> pd.DataFrame:
    """One row per case of one task and algorithm: updates per second, and each part's share of the time.

    The updates are real, the transitions are random. `hours` is the time of all updates of the profile,
    without the training of the reconstruction model. `of_product` is the arithmetic per second as a share of
    that of one large product of float32 matrices.
    """
    found = with_shares(measure([Case(PRODUCT, cases[0].task), *cases], rounds, seconds, device, done))
    rows, by = [], ["profile", "products", "runs"]
    algorithm = get_algorithm(cases[0].what)
    for (profile, precision, runs), part in found[found["what"] != PRODUCT].groupby(by, sort=False):
        speed = 1 / part["seconds"].median()
        row = {"profile": profile, "runs": runs, "precision": precision, "updates_per_second": speed}
        row |= {
            "hours": algorithm.configure(profile).updates / speed / 3600,
            "of_product": part["share"].median(),
        }
        rows.append(row | dict(part_shares(part).median()))
    return pd.DataFrame(rows)


def full(
    folder: Path = FOLDER,
    workers: int | None = None,
    rounds: int = 3,
    seconds: float = 0.3,
    device: Device = "cpu",
    missing: Callable[[str], object] = tqdm.write,
) -> list[Path]:
    """Measure everything on one thread, and write the files of `folder`. Returns their paths.

    `missing` is called with a sentence for everything that is not measured.
    """
    torch.set_num_threads(1)
    workers, busy = workers or joblib.cpu_count(), psutil.cpu_percent(interval=1)
    everything, parts = groups(), list[pd.DataFrame]()

    def write(name: str, tables: list[pd.DataFrame]) -> None:
        with written_whole(folder / FILES[name]) as temporary:
            pd.concat(tables).to_csv(temporary, index=False, float_format="%.6g")

    write("machine", [machine(device, busy)])
    total = (rounds + 1) * sum(map(len, everything.values())) + 5 * (rounds + 1) * len(TASKS)
    with tqdm(total=total, desc="measuring", leave=False) as bar:
        for name, cases in everything.items():
            parts.append(measure(cases, rounds, seconds, device, bar.update, missing).assign(group=name))
            write("updates", parts)
        if str(device) != "cpu":
            missing(f"{workers} processes at once: measured on the CPU only")
        elif busy > BUSY:
            missing(f"{workers} processes at once: not measured, others take {busy:.0f}% of the cores")
        else:
            together = side_by_side(Case("C2IQL", TASKS[0]), workers, rounds)
            write("updates", [*parts, together.assign(group="processes")])
        played = {task: simulation(get_task(task), workers, rounds, bar.update) for task in TASKS}
        write("simulation", [table.assign(task=task) for task, table in played.items()])
    return [folder / file for file in FILES.values()]


def machine(device: Device, busy: float) -> pd.DataFrame:
    """The machine and the software that were measured, one row per fact."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    facts = {
        "date": date.today().isoformat(),
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "cores": joblib.cpu_count(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "a product in bfloat16 on the CPU": f"{bfloat16_time():.2f} of its time in float32",
        "device": torch.cuda.get_device_name() if str(device) == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "busy before the start": f"{busy:.0f}%",
        "system": platform.system(),
        "Python": platform.python_version(),
        **{name: version(name) for name in ("torch", "numpy", pybullet_package())},
    }
    return pd.DataFrame({"what": facts.keys(), "value": facts.values()})
