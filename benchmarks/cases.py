"""What is measured, and in which order.

The speed of a machine varies. So everything that is compared is measured in turns, over several rounds, and a
ratio is the median of the ratios of the rounds. All numbers depend on what else is running.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict

import joblib
import pandas as pd
import torch
from joblib.externals.loky import get_reusable_executor

from benchmarks.peers import PEERS, Peer
from benchmarks.updates import EAGER, PRODUCT, Case, Device, OurUpdates, Steps
from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.tasks import TASKS as ALL_TASKS

TASKS = ("AntCircle", "CarCircle")
SIZES = ("paper", "small")
"""The profiles that are measured. Profile `printed` has the sizes of `small`."""
SMALL_CRM = "3 x 128"
"""The layers of a smaller reconstruction model. On the noise that critics make it is 2% less exact than the
paper's model (`data/results/reconstruction.csv`)."""


def groups() -> dict[str, list[Case]]:
    """Everything that `python -m benchmarks --full` measures in one process, by group.

    Cases are compared within a group only.
    """
    ant, car = TASKS
    product = [Case(PRODUCT, ant), Case(PRODUCT, ant, products="default")]

    def yardsticks(task: str) -> list[Case]:
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
            Case(name, task, profile) for profile in SIZES for task in TASKS for name in ALGORITHMS
        ],
        "precision": [
            Case("C2IQL", ant, profile, runs, products=precision)
            for profile in SIZES
            for runs in (1, 5)
            for precision in ("float32", "bfloat16")
        ],
        "seeds": [Case("C2IQL", ant, profile, runs) for profile in SIZES for runs in (1, 2, 5, 10)],
        "batch": [Case("C2IQL", ant, batch=batch) for batch in (128, 256, 512, 1024)],
        "rows": [Case("C2IQL", ant, rows=rows) for rows in (10_000, 100_000, 1_000_000)],
        "tasks": [Case("C2IQL", task, profile) for profile in SIZES for task in ALL_TASKS],
    }


def stopwatch(case: Case, device: Device = "cpu") -> Peer | Steps | OurUpdates:
    """An object whose `measure` times this case. Raises ValueError for a peer that is not installed."""
    if case.what in PEERS:
        return Peer(case, device)
    return Steps(case, device) if case.what in (EAGER, PRODUCT) else OurUpdates(case, device)


def measure(
    cases: Sequence[Case],
    rounds: int = 3,
    seconds: float = 0.6,
    device: Device = "cpu",
    done: Callable[[], object] = lambda: None,
    missing: Callable[[str], object] = print,
) -> pd.DataFrame:
    """One row per case and round: the case, the round, FLOP per update, seconds per update and per part.

    A measurement lasts `seconds`, or one update if that is longer, and twice as long on a GPU. A case that
    cannot be measured is left out, and `missing` is called with the reason.
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
    """One row per number of processes, 1 and `most`, and round: seconds of real time per update of them all.

    Each process has one thread. Where other work keeps the cores busy, this says nothing about the code.
    """
    rows = []
    # At least two, so that a single job, too, is in a process of its own.
    with joblib.Parallel(n_jobs=max(most, 2), batch_size=1) as pool:
        for turn in range(rounds + 1):  # the first turn is a warm-up
            for count in (1, most):
                jobs = [joblib.delayed(_rate)(case, seconds if turn else 0)] * count
                together = sum(pool(jobs))
                if turn:
                    row = asdict(case) | {"batch": case.config.batch_size, "processes": count, "round": turn}
                    rows.append(row | {"seconds": 1 / together})
    get_reusable_executor().shutdown()  # what follows begins with fresh processes
    return pd.DataFrame(rows)


def _rate(case: Case, seconds: float) -> float:
    """Updates per second of real time."""
    torch.set_num_threads(1)
    watch = OurUpdates(case)
    watch.now = time.perf_counter
    watch.measure(0)
    return 1 / watch.measure(seconds)["seconds"]
