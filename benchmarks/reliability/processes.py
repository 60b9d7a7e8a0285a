"""Runs a command in a process of its own that can be killed, and says how it ended.

The process is a fork of this one, in which PyTorch is imported already. A command so starts in milliseconds.
Forks exist on Linux and macOS alone.
"""

import io
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import torch
from tqdm import auto, std

from tutorial_lib import __main__ as cli

Work = Callable[[], object]
MEMORY = 6_000_000_000
"""The number of bytes of address space that a process may take beside what this one has."""


class Ended(NamedTuple):
    """How a process ended."""

    status: int | None
    """The exit status. None where the process was killed."""
    out: str
    err: str
    seconds: float

    @property
    def verdict(self) -> str:
        """One of `clear`, `accepted`, `traceback` and `killed`.

        `clear` means exit status 2 and one line that begins with `c2iql: `, or one message by the parser of
        the command line, which ends with where the help is.
        """
        text = self.out + self.err
        lines = [line for line in self.err.splitlines() if line.strip()]
        if self.status is None:
            return "killed"
        if self.status == 0:
            return "accepted"
        ours = [line for line in lines if line.startswith("c2iql: ")]
        one_line = lines and ours == lines[-1:]
        by_parser = not ours and text.count("For full helptext") == 1
        clear = self.status == 2 and "Traceback" not in text and (one_line or by_parser)
        return "clear" if clear else "traceback"


def typed(*words: object) -> Work:
    """The command `c2iql WORDS`, as if it was typed."""

    def work() -> None:
        sys.argv = ["c2iql", *map(str, words)]
        cli.main()

    return work


def called(function: Callable[..., object], *arguments: Any, **named: Any) -> Work:
    """A function of the library that is called as a command, so that its errors are those of a command."""

    def work() -> None:
        cli._run = lambda words: function(*arguments, **named)
        cli.main()

    return work


def start(work: Work, folder: Path, memory: int = MEMORY) -> int:
    """Starts a process, with `folder` as its current folder, and returns its number.

    The process leads a group of its own. What it prints is in `folder`.out and `folder`.err.
    """
    sys.stdout.flush()
    if child := os.fork():
        return child
    status = 1
    try:
        os.setsid()
        os.chdir(folder)
        for number, suffix in ((1, ".out"), (2, ".err")):
            os.dup2(os.open(f"{folder}{suffix}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        for name, number in (("stdout", 1), ("stderr", 2)):  # a test's own streams are not those of a process
            setattr(sys, name, io.TextIOWrapper(os.fdopen(number, "wb", buffering=0), write_through=True))
        most = psutil.Process().memory_info().vms + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        torch.set_num_threads(1)
        for bar in (std.tqdm, auto.tqdm):  # forks share a lock, which a killed process would hold for ever
            bar.set_lock(threading.RLock())
        work()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def wait(child: int, folder: Path, seconds: float) -> Ended:
    """Waits until a process has ended, or kills it and its children after so many seconds."""
    began = time.monotonic()
    while not (found := os.waitpid(child, os.WNOHANG))[0] and time.monotonic() - began < seconds:
        time.sleep(0.002)
    took = time.monotonic() - began
    if not found[0]:
        kill(child)
        found = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(found[1])
    out, err = (Path(f"{folder}{suffix}").read_text(errors="replace") for suffix in (".out", ".err"))
    return Ended(None if code < 0 else code, out, err, took)


def kill(child: int) -> None:
    """Sends SIGKILL to a process and to those that it started, as a machine that is switched off would."""
    try:
        os.killpg(child, signal.SIGKILL)
    except ProcessLookupError:  # it has no group yet
        os.kill(child, signal.SIGKILL)


def run(work: Work, folder: Path, seconds: float = 120.0) -> Ended:
    """Runs a process in `folder` to its end."""
    return wait(start(work, folder), folder, seconds)


def contents(folder: Path, without: Sequence[str] = ()) -> dict[str, bytes]:
    """The bytes of all files under a folder, hidden ones too, by their path, less those with these names."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in without)
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
