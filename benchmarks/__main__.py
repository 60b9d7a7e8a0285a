"""`python -m benchmarks` from the project's folder measures how fast this machine trains and simulates."""

import sys

import torch
import tyro

from benchmarks import PARTS, bench, install, pages
from benchmarks import full as measure_all
from tutorial_lib.__main__ import Device, check_counts, check_device
from tutorial_lib.tasks import get_task


def main(
    task: str = "BallCircle",
    workers: int | None = None,
    rounds: int = 3,
    device: Device = "cpu",
    full: bool = False,
    peers: bool = False,
    report: bool = False,
) -> None:
    """Measure this machine, in about a minute: how fast agents train, and how fast simulators step.

    The table of training has updates per second, the hours that all the profile's updates take, the rate of
    arithmetic against that of one large matrix product, and the share of the time of each part of an update.
    The table of simulation compares with the bare simulator's speed times the processes. What else runs on
    the machine counts, too.

    Args:
        task: which task's simulator and sizes.
        workers: processes for rollouts; default one for each core.
        rounds: how often each speed is measured; the median is shown.
        device: of the training: cpu or cuda.
        full: measure every algorithm, other libraries' too, at two tasks' sizes, in some minutes, and write
            data/results/bench/; then `--report` makes tables and a figure of it.
        peers: first install the other libraries for --full with pip, into runs/bench/peers.
        report: only write the tables and the figure of the last --full into README.md and data/README.md.
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
    training_speeds, simulation_speeds = bench(record, workers, rounds, device=device)
    print(f"C2IQL on {record.name}, {device}, {torch.get_num_threads()} thread(s): shares of an update")
    shares = dict.fromkeys(("of_product", *PARTS), "{:.0%}".format)
    others = {"updates_per_second": "{:.1f}".format, "hours": "{:.2f}".format}
    print(training_speeds.to_string(index=False, formatters=shares | others))
    print(f"\nSimulator of {record.name}: steps per second, and their share of bare simulator x processes")
    formats = {"steps_per_second": "{:.0f}".format, "of_bare": "{:.0%}".format}
    print(simulation_speeds.to_string(index=False, formatters=formats))


if __name__ == "__main__":
    try:
        tyro.cli(main, prog="python -m benchmarks")
    except (ValueError, OSError) as error:
        sys.exit(f"benchmarks: {error}")
