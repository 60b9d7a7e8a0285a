"""What is measured, and in which turns.

Machines are noisy, so what is compared is measured in turns, several times: a ratio is the median of the
ratios of measurements that stand side by side. Numbers depend on what else is running.
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context

import pandas as pd
import torch

from benchmarks.peers import PEERS, Peer
from benchmarks.updates import EAGER, PRODUCT, Case, OurUpdates, Steps
from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.config import PROFILES
from tutorial_lib.tasks import TASKS as ALL_TASKS

TASKS = ("AntCircle", "CarCircle")
SMALL_CRM = "3 x 128"
"""On the noise that critics make, 2% less exact than the paper's model: `results/reconstruction.csv`."""


def groups() -> dict[str, list[Case]]:
    """All that `python -m benchmarks --full` measures on one process; within a group everything is comparable."""
    ant, car = TASKS
    product = [Case(PRODUCT, ant), Case(PRODUCT, ant, products="default")]

    def yardsticks(task):
        ours = [Case("C2IQL", task), Case("C2IQL", task, products="default")]
        ours += [Case("C2IQL", task, crm=SMALL_CRM), Case("C2IQL", task, products="bfloat16")]
        ours += [Case("C2IQL", task, crm=SMALL_CRM, products="bfloat16")]
        plain = [Case(EAGER, task, products="default"), Case(EAGER, task)]
        others = [Case("IQL", task), Case("CPQ w/ push", task)]
        others += [Case(name, task, products="default") for name in PEERS]
        return product + ours + plain + others

    return {
        f"yardsticks {ant}": yardsticks(ant),
        f"yardsticks {car}": yardsticks(car),
        "algorithms": [
            Case(name, task, profile) for profile in PROFILES for task in TASKS for name in ALGORITHMS
        ],
        "precision": [
            Case("C2IQL", ant, profile, runs, products=precision)
            for profile in PROFILES
            for runs in (1, 5)
            for precision in ("float32", "bfloat16")
        ],
        "seeds": [Case("C2IQL", ant, profile, runs) for profile in PROFILES for runs in (1, 2, 5, 10)],
        "batch": [Case("C2IQL", ant, batch=batch) for batch in (128, 256, 512, 1024)],
        "rows": [Case("C2IQL", ant, rows=rows) for rows in (10_000, 100_000, 1_000_000)],
        "tasks": [Case("C2IQL", task, profile) for profile in PROFILES for task in ALL_TASKS],
    }


def stopwatch(case: Case, device="cpu"):
    """What times this case. ValueError for a peer that is not installed."""
    if case.what in PEERS:
        return Peer(case, device)
    return Steps(case, device) if case.what in (EAGER, PRODUCT) else OurUpdates(case, device)


def measure(
    cases: Sequence[Case],
    rounds: int = 3,
    seconds: float = 0.6,
    device="cpu",
    done: Callable[[], object] = lambda: None,
    missing: Callable[[str], object] = print,
) -> pd.DataFrame:
    """One row per case and round: the case, the round, FLOP and seconds per update, and of each part.

    A measurement lasts `seconds` or one update, on a GPU twice that. What cannot be measured is left out, and
    `missing` told why.
    """
    watches = {}
    for case in cases:
        try:
            watches[case] = stopwatch(case, device)
        except ValueError as reason:
            missing(str(reason))
    rows = []
    for turn in range(rounds + 1):  # the first turn is a warm-up
        order = list(watches.items())
        for case, watch in order if turn % 2 else reversed(order):
            found = watch.measure(seconds if turn else 0)
            if turn:
                rows.append(asdict(case) | {"config_batch": case.config.batch_size} | {"round": turn})
                rows[-1] |= {"flop": watch.flop} | found
            done()
    return pd.DataFrame(rows).drop(columns="batch").rename(columns={"config_batch": "batch"})


def side_by_side(case: Case, most: int, rounds: int = 3, seconds: float = 2.0) -> pd.DataFrame:
    """One row per number of processes, up to `most`, and round: seconds per update of them all, by the clock.

    One thread each. Where other work keeps the cores busy this says nothing of the code.
    """
    rows, fresh = [], get_context("spawn")  # a single one, too, is a process of its own
    with contextlib.ExitStack() as stack:
        pools = {n: stack.enter_context(ProcessPoolExecutor(n, mp_context=fresh)) for n in (1, most)}
        for turn in range(rounds + 1):
            for count, pool in pools.items():
                together = sum(pool.map(_rate, [case] * count, [seconds if turn else 0] * count))
                if turn:
                    row = asdict(case) | {"batch": case.config.batch_size, "processes": count, "round": turn}
                    rows.append(row | {"seconds": 1 / together})
    return pd.DataFrame(rows)


def _rate(case: Case, seconds: float) -> float:
    """Updates per second by the clock on the wall."""
    torch.set_num_threads(1)
    watch = OurUpdates(case)
    watch.now = time.perf_counter
    watch.measure(0)
    return 1 / watch.measure(seconds)["seconds"]
