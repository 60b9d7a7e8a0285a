"""Files are written as a whole or not at all, and by one process at a time."""

import contextlib
import datetime
import functools
import hashlib
import json
import os
import re
import socket
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
from safetensors import SafetensorError

LOCK, HOLDER = ".lock", ".lock.json"
"""The files of a folder that is locked: the lock of the operating system, and who has it since when."""
TEMPORARY = re.compile(r"\.(.+)\.([0-9a-f]{8})([0-9a-f]{8})[0-9a-f]{16}\.tmp")
"""The names of the temporary files of `written_whole`: of which file, of which machine and which process."""


@functools.cache
def _machine() -> str:
    """Returns 8 digits for this machine. Containers that do not see each other's processes differ."""
    name = socket.gethostname()
    with contextlib.suppress(OSError):
        name += os.readlink("/proc/self/ns/pid")
    return hashlib.sha256(name.encode()).hexdigest()[:8]


def sha256_of(file: Path) -> str:
    """Returns the SHA-256 of a file's bytes, in hexadecimal. Raises OSError where it cannot be read."""
    with open(file, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _temporary(path: Path) -> Path:
    """Returns the name of a new temporary file beside `path`. It is unique, also among several machines."""
    return path.with_name(f".{path.name}.{_machine()}{os.getpid():08x}{uuid.uuid4().hex[:16]}.tmp")


def _was_killed(digits: re.Match) -> bool:
    """Returns whether the process that made a temporary file ran on this machine and runs no longer."""
    import psutil

    return digits[2] == _machine() and not psutil.pid_exists(int(digits[3], 16))


def _remove_halves(path: Path) -> None:
    """Removes what killed processes had written of the file `path`."""
    with contextlib.suppress(OSError):  # whoever may not look into the folder may still write there
        for half in path.parent.glob(".*.tmp"):
            digits = TEMPORARY.fullmatch(half.name)
            if digits and digits[1] == path.name and _was_killed(digits):
                half.unlink(missing_ok=True)


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write to. It replaces `path` when the block ends without an error.

    A reader finds the whole old file or the whole new file, also after a crash. Missing folders are made, and
    what killed processes had written of this file is removed. Raises OSError where there is no space or no
    permission.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_halves(path)
    temporary = _temporary(path)
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except SafetensorError as error:  # the error of a full disk
        raise OSError(f"{path}: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_output(path: Path) -> None:
    """Checks before long work begins that a file can be written at `path` when it ends.

    It writes an empty temporary file and removes it. No folder is made. Raises OSError, in one line, where
    `path` is a folder, where a part of its folder's path is a file, and where there is no permission.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder: name a file")
    folder = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
    refused = f"nothing can be written to {path.parent}: choose another path: {folder}"
    if not folder.is_dir():
        raise NotADirectoryError(f"{refused} is not a folder")
    probe = _temporary(folder / path.name)
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise OSError(f"{refused}: {error.strerror}") from error


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Locks a folder while the block runs, so that no other process writes to it.

    A thread that has the lock may take it again. The operating system frees the lock when its process ends,
    also when it is killed. A file system that is shared by machines may not know the locks of the others: if
    the last process with the lock was on another machine and did not end the block, the lock is respected.
    Temporary files that killed processes left in the folder are removed.

    Raises BlockingIOError at once, in one line, if another process has the lock, and OSError if nothing can
    be written to the folder. A missing folder is made.
    """
    check_output(folder / HOLDER)
    folder.mkdir(parents=True, exist_ok=True)
    holder = folder.resolve() / HOLDER
    lock = filelock.FileLock(holder.with_name(LOCK), timeout=0, is_singleton=True)
    try:
        lock.acquire()
    except filelock.Timeout:
        words = f"{folder}: is in use{_by_whom(_read_holder(holder))}"
        raise BlockingIOError(f"{words}: wait until it ends, or choose another folder") from None
    try:
        if lock.lock_counter > 1:  # this thread has it already
            yield
            return
        _take(folder, holder)
        try:
            yield
        finally:
            holder.unlink(missing_ok=True)
            with contextlib.suppress(PermissionError):  # Windows, where releasing removes it
                holder.with_name(LOCK).unlink(missing_ok=True)
    finally:
        lock.release()


def _take(folder: Path, holder: Path) -> None:
    """Writes down who has the lock, and removes old temporary files.

    Raises BlockingIOError if a process of another machine had the lock and did not end its work.
    """
    last, here = _read_holder(holder), socket.gethostname()
    if last.get("host", here) != here:
        raise BlockingIOError(
            f"{folder}: is in use{_by_whom(last)}: if that process runs no longer, delete {folder / HOLDER}"
        )
    now = datetime.datetime.now().astimezone().isoformat(" ", "seconds")
    with written_whole(holder) as temporary:
        temporary.write_text(json.dumps({"host": here, "pid": os.getpid(), "since": now}))
    sweep(folder)


def _read_holder(path: Path) -> dict[str, Any]:
    """Returns what the file says of the process that has the lock. It is empty without a readable file."""
    try:
        found = json.loads(path.read_text())
        return found if isinstance(found, dict) else {}
    except (OSError, ValueError, RecursionError):
        return {}


def _by_whom(holder: dict[str, Any]) -> str:
    """Returns the words for an error message on the process that has a lock, in one line."""
    pid, host, since = (" ".join(str(holder.get(key, "?")).split()) for key in ("pid", "host", "since"))
    return f" by process {pid} on {host} since {since}" if holder else " by another process"


def sweep(folder: Path) -> None:
    """Removes the temporary files in a folder that killed processes left.

    A table that is younger than an hour is left unless its process is known to be dead: `evaluate` writes
    tables beside an agent without the folder's lock.
    """
    for path in folder.glob(".*.tmp"):
        with contextlib.suppress(FileNotFoundError):
            digits, young = TEMPORARY.fullmatch(path.name), time.time() - path.stat().st_mtime < 3600
            if digits and not (young and ".csv." in path.name and not _was_killed(digits)):
                path.unlink()


def sort_metadata(path: Path) -> None:
    """Sorts the metadata in the header of a safetensors file, which the library writes in a random order.

    Files of equal tensors and equal metadata are then equal.
    """
    with open(path, "rb+") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        assert len(text) <= size, "the sorted header has the characters of the old one"
        file.seek(8)
        file.write(text.ljust(size))
