"""What this machine can do: `python -m benchmarks` measures training and simulation in about a minute.

`python -m benchmarks --full` measures every algorithm, a plain version of C2IQL and other libraries' algorithms, and
how cost grows with seeds, batch and data, in some minutes. Tables and figure of speed are made of its files.
"""

import platform
from collections.abc import Callable, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path

import joblib
import pandas as pd
import psutil
import torch
from tqdm.auto import tqdm

from benchmarks.cases import TASKS, groups, measure, side_by_side
from benchmarks.peers import install
from benchmarks.simulation import simulation
from benchmarks.tables import FILES, FOLDER, part_shares, with_shares
from benchmarks.updates import PARTS, PRODUCT, Case
from tutorial_lib.config import PROFILES
from tutorial_lib.files import written_whole
from tutorial_lib.matmul import bfloat16_time
from tutorial_lib.tasks import Task, get_task

__all__ = ["PARTS", "bench", "full", "install", "machine", "training"]
BUSY = 10
"""Percent of the cores' time that others take, from which two processes are not compared with one."""


def bench(
    task: Task, workers: int | None = None, rounds: int = 3, seconds: float = 0.6, device="cpu"
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Both tables, `training` and `simulation`.

    A measurement of training lasts `seconds` or one update, on a GPU twice that.
    """
    workers = workers or joblib.cpu_count()  # the cores that this process may use
    name, kinds = task.name, ({}, {"runs": 3}, {"products": "bfloat16"})
    cases = [Case("C2IQL", name, profile, **kind) for profile in PROFILES for kind in kinds]
    with tqdm(total=(rounds + 1) * (len(cases) + 6), desc="measuring", leave=False) as bar:
        return (
            training(cases, rounds, seconds, device, bar.update),
            simulation(task, workers, rounds, bar.update),
        )


def training(
    cases: Sequence[Case],
    rounds: int = 3,
    seconds: float = 0.6,
    device="cpu",
    done: Callable[[], object] = lambda: None,
) -> pd.DataFrame:
    """One row per case of one task and algorithm: updates per second, each part's share of the time.

    Real updates on random transitions: how long they take does not depend on what they hold.
    `hours` is what the profile's number of updates would take, without its reconstruction model; `of_product`
    compares the arithmetic per second with that of one large float32 product of matrices.
    """
    found = with_shares(measure([Case(PRODUCT, cases[0].task), *cases], rounds, seconds, device, done))
    rows, by = [], ["profile", "products", "runs"]
    for (profile, precision, runs), part in found[found["what"] != PRODUCT].groupby(by, sort=False):
        speed = 1 / part["seconds"].median()
        row = {"profile": profile, "runs": runs, "precision": precision, "updates_per_second": speed}
        row |= {"hours": PROFILES[profile].steps / speed / 3600, "of_product": part["share"].median()}
        rows.append(row | dict(part_shares(part).median()))
    return pd.DataFrame(rows)


def full(
    folder: Path = FOLDER,
    workers: int | None = None,
    rounds: int = 3,
    seconds: float = 0.3,
    device="cpu",
    missing: Callable[[str], object] = tqdm.write,
) -> list[Path]:
    """Measure everything on one thread and write `folder`'s files, whose paths it returns."""
    torch.set_num_threads(1)
    workers, busy = workers or joblib.cpu_count(), psutil.cpu_percent(interval=1)
    everything, parts = groups(), []

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


def machine(device, busy: float) -> pd.DataFrame:
    """What the numbers hold for: one row per fact."""
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
        **{name: version(name) for name in ("torch", "numpy", "pybullet")},
    }
    return pd.DataFrame({"what": facts.keys(), "value": facts.values()})
