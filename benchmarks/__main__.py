"""`python -m benchmarks` from the project's folder measures how fast this machine trains and simulates.

`python -m benchmarks reliability` tries to break the commands (see `benchmarks.reliability`).
"""

import sys

import torch
import tyro

from benchmarks import PARTS, bench, install, pages
from benchmarks import full as measure_all
from tutorial_lib.commands import Device, check_counts, check_device
from tutorial_lib.tasks import Task, get_task


def main(
    task: str = "BallCircle",
    workers: int | None = None,
    rounds: int = 3,
    device: Device = "cpu",
    full: bool = False,
    peers: bool = False,
    report: bool = False,
) -> None:
    """Measure in about a minute how fast this machine trains agents and plays episodes.

    The table of training has the updates per second, the hours of all updates of the profile, the arithmetic
    per second as a share of that of one large matrix product, and each part's share of an update's time. The
    table of simulation has the steps per second, and their share of the bare simulator's speed times the
    processes. Everything else that runs on the machine changes these numbers.

    Args:
        task: which task's simulator and sizes.
        workers: processes for rollouts; default one for each core.
        rounds: how often each speed is measured; the median is shown.
        device: where to train, cpu or cuda.
        full: measure every algorithm and the other libraries on two tasks, in some minutes, and write the
            files in data/results/bench.
        peers: first install the other libraries with pip into runs/bench/peers.
        report: measure nothing, and write the tables and the figure of the last --full into README.md and
            data/README.md.
    """
    if report:
        print("\n".join(f"wrote {path}" for path in pages.write()))
        return
    record, device = get_task(task), check_device(device)
    check_counts(workers=workers, rounds=rounds)
    if peers:
        install()
    if full:
        written = measure_all(workers=workers, rounds=rounds, device=device)
        print("\n".join(f"wrote {path}" for path in written))
        return
    show(record, workers, rounds, device)


def show(task: Task, workers: int | None, rounds: int, device: Device) -> None:
    """Measure one task and print both tables."""
    training_speeds, simulation_speeds = bench(task, workers, rounds, device=device)
    print(f"C2IQL on {task.name}, {device}, {torch.get_num_threads()} thread(s): shares of an update")
    shares = dict.fromkeys(("of_product", *PARTS), "{:.0%}".format)
    others = {"updates_per_second": "{:.1f}".format, "hours": "{:.2f}".format}
    print(training_speeds.to_string(index=False, formatters=shares | others))
    print(f"\nSimulator of {task.name}: steps per second, and their share of bare simulator x processes")
    formats = {"steps_per_second": "{:.0f}".format, "of_bare": "{:.0%}".format}
    print(simulation_speeds.to_string(index=False, formatters=formats))


if __name__ == "__main__":
    try:
        if sys.argv[1:2] == ["reliability"]:
            from benchmarks import reliability

            reliability.command(sys.argv[2:])
        else:
            tyro.cli(main, prog="python -m benchmarks")
    except (ValueError, OSError) as error:
        sys.exit(f"benchmarks: {error}")
