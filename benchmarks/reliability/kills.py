"""Commands that are killed at random moments, run twice at once, or run out of space, and are then run again.

What they wrote in the end must be equal to what one undisturbed run writes, to the byte.
"""

import contextlib
import os
import random
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd

from benchmarks.reliability.jobs import Job, jobs, train, written
from benchmarks.reliability.processes import Ended, Work, kill, run, start, wait
from benchmarks.reliability.samples import make_samples

SECONDS = 300
"""A job takes some seconds, and a study some ten more for its workers."""
DISK, PAGE = 2**25, 4096
"""The bytes of a small file system, and of its smallest part."""
IN_A_ROW = 3
"""A job is killed so often before it is let run to its end."""


@contextlib.contextmanager
def workplace() -> Iterator[tuple[Path, list[Job]]]:
    """A folder that is removed in the end, and the jobs that run in its folders."""
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        make_samples(root / "samples")
        with jobs(root) as made:
            yield root, made


def undisturbed(work: Work, folder: Path) -> tuple[dict[str, bytes], float]:
    """What a job writes, and how many seconds it takes. Raises RuntimeError where it fails."""
    folder.mkdir()
    ended = run(work, folder, SECONDS)
    if ended.status != 0:
        raise RuntimeError(f"{folder.name} failed without being disturbed: {ended.err[-2000:]}")
    return written(folder), ended.seconds


def killed(
    job: Job, root: Path, wanted: int, chance: random.Random, disturb: Callable[[int], None] = kill
) -> dict[str, object]:
    """Kills a job `wanted` times in all, and returns its row of the table.

    `disturb` does the killing. A moment is drawn uniformly from the time that the undisturbed job takes.
    """
    expected, seconds = undisturbed(job.work, root / job.name)
    kills = resumes = exact = 0
    while kills < wanted:
        folder = root / f"{job.name}-{resumes}"
        folder.mkdir()
        for _ in range(min(IN_A_ROW, wanted - kills)):
            kills += _killed_once(job.work, folder, chance.uniform(0, seconds), disturb)
        ended = run(job.work, folder, SECONDS)
        resumes += 1
        exact += ended.status == 0 and written(folder) == expected
    return {"command": job.name, "kills": kills, "resumed to the end": resumes, "exact": exact}


def _killed_once(work: Work, folder: Path, delay: float, disturb: Callable[[int], None]) -> bool:
    """Starts a job and kills it after a time. Returns whether it was still running."""
    child, began = start(work, folder), time.monotonic()
    while time.monotonic() - began < delay:
        if os.waitpid(child, os.WNOHANG)[0]:
            return False
        time.sleep(0.001)
    disturb(child)
    os.waitpid(child, 0)
    return True


def kills(share: float = 1.0) -> pd.DataFrame:
    """Kills every job. With a share below one each is killed once, but the study, which takes too long."""
    chance = random.Random(0)
    with workplace() as (root, made):
        if share < 1:
            made = [job for job in made if job.name != "study"]
        return pd.DataFrame([killed(job, root, max(1, round(share * job.kills)), chance) for job in made])


# --- Two processes ---


def pairs(count: int = 10) -> pd.DataFrame:
    """Starts two trainings with different seeds in one folder. One row per pair: did one win, whole?"""
    rows, chance = [], random.Random(0)
    with workplace() as (root, _):
        alone = {seed: undisturbed(train(seed=seed), root / f"seed {seed}") for seed in (1, 2)}
        for number in range(count):
            (folder := root / f"pair {number}").mkdir()
            (second := root / f"second {number}").symlink_to(folder)  # its output is in files of its own
            children = []
            for seed, place in ((1, folder), (2, second)):
                children.append((start(train(seed=seed), place), place))
                time.sleep(chance.uniform(0, 0.5) * alone[1][1])
            ended = [wait(child, place, SECONDS) for child, place in children]
            rows.append(_judged(ended, written(folder), [alone[seed][0] for seed in (1, 2)]))
    return pd.DataFrame(rows)


def _judged(ended: list[Ended], found: dict[str, bytes], alone: list[dict[str, bytes]]) -> dict[str, bool]:
    verdicts = [one.verdict for one in ended]
    one = sorted(verdicts) == ["accepted", "clear"]
    return {"one ran, one was refused": one, "exact": one and found == alone[verdicts.index("accepted")]}


# --- A full disk ---


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """Mounts an empty file system of `DISK` bytes at `folder`. Yields False where this process may not."""
    folder.mkdir()
    options = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(options, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)


def _with_small_files(work: Work, size: int) -> Work:
    """A job that can write no file larger than `size`. It stands in for a full disk."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
        work()

    return limited


def full_disks(shares: tuple[float, ...] = (0.2, 0.5, 0.8)) -> pd.DataFrame:
    """Gives every job but the study a share of the space that it needs, and then enough. One row for each."""
    rows = []
    with workplace() as (root, made):
        for job in (job for job in made if job.name != "study"):
            expected, _ = undisturbed(job.work, root / job.name)
            for share in shares:
                rows.append({"command": job.name, "share": share} | _filled(job, root, expected, share))
    return pd.DataFrame(rows)


def _filled(job: Job, root: Path, expected: dict[str, bytes], share: float) -> dict[str, object]:
    folder = root / f"{job.name} {share}"
    sizes, filler = [len(data) for data in expected.values()], folder / "filler"
    with small_disk(folder) as mounted:
        if mounted:
            filler.write_bytes(bytes(DISK - int(share * sum(sizes)) // PAGE * PAGE))
        work = job.work if mounted else _with_small_files(job.work, int(share * max(sizes)))
        first = run(work, folder, SECONDS)
        filler.unlink(missing_ok=True)
        again = run(job.work, folder, SECONDS)
        exact = again.status == 0 and written(folder) == expected
    how = "a full file system" if mounted else "a limit on the size of files"
    return {
        "by": how,
        "clear error": first.verdict == "clear",
        "said": first.err[-300:],
        "exact afterwards": exact,
    }
