"""Finds datasets (shipped with the project, DSRL's own, or at a path), and downloads DSRL's."""

import contextlib
import functools
import os
import shutil
import time
from pathlib import Path

from tutorial_lib.data.dataset import Dataset, DatasetError
from tutorial_lib.data.hdf5 import read_dataset
from tutorial_lib.data.places import data_folder, in_clone, why_missing
from tutorial_lib.files import sha256_of, written_whole
from tutorial_lib.tasks import TASKS, Task, as_task

DSRL_URL = "https://huggingface.co/datasets/YYY-45/DSRL/resolve/main/"
MAX_BYTES = 5_000_000_000
"""A download may have this number of bytes."""
MAX_SECONDS = 4 * 3600
"""A download may take this number of seconds."""
SHIPPED_DATA = data_folder()
"""The folder of the datasets, agents and results that are shipped with the project."""
CHECKSUMS = "checksums.txt"
"""The file in `SHIPPED_DATA` with the SHA-256 of every dataset, in the format of `sha256sum`."""


def load_dataset(task: Task | str, source: Path | str = "shipped") -> Dataset:
    """The dataset of a task, read from `source` (see `find_dataset`).

    A shipped file is compared with its SHA-256 in `checksums.txt` when a process first reads it. Raises
    DatasetError where there is no file, where the SHA-256 differs, or where `read_dataset` refuses the file.
    """
    path = find_dataset(task, source)
    checksums = SHIPPED_DATA / CHECKSUMS
    if path.resolve().parent == SHIPPED_DATA.resolve() and checksums.is_file():
        with contextlib.suppress(OSError):  # `read_dataset` says why the file cannot be opened
            _verify_shipped(path, path.stat().st_mtime_ns, checksums.read_text())
    return read_dataset(path, task)


@functools.cache
def _verify_shipped(path: Path, changed: int, checksums: str) -> None:
    """Raises DatasetError where the SHA-256 of a file is not its own in the text `checksums`, if it has one.

    The bytes of the file are hashed and not its values: they are fewer, and include the file's structure,
    where a flipped bit can give other values or attributes. `changed` is when the file was last changed.
    """
    lines = (line.partition("  ") for line in checksums.splitlines())
    wanted = {name: digest for digest, _, name in lines}.get(path.name)
    if wanted and (digest := sha256_of(path)) != wanted:
        remedy = "restore it from git, or call sources.write_checksums() if you replaced it yourself"
        raise DatasetError(
            f"{path}: file: damaged: SHA-256 is {digest}, but {CHECKSUMS} has {wanted}: {remedy}"
        )


def write_checksums() -> Path:
    """Write the SHA-256 of the datasets in `SHIPPED_DATA` to its `checksums.txt`. Returns the path.

    Call it whenever a shipped dataset is replaced: `python -c "from tutorial_lib.data import sources;
    sources.write_checksums()"`. In the folder, `sha256sum -c checksums.txt` compares them, too.
    """
    path = SHIPPED_DATA / CHECKSUMS
    files = sorted(SHIPPED_DATA.glob("*.hdf5"))
    with written_whole(path) as temporary:
        temporary.write_text("".join(f"{sha256_of(file)}  {file.name}\n" for file in files))
    return path


def find_dataset(task: Task | str, source: Path | str = "shipped") -> Path:
    """The path of a task's dataset.

    `source` is "shipped" for the file in this project, "dsrl" for DSRL's own file, or the path of a file, or
    of a folder with a file TASK.hdf5 (so a study can read the datasets of all its tasks there). If the file
    is missing, no other source is tried: otherwise the same command could use different data on two machines.
    Raises DatasetError, which says where the file was expected and which command makes or downloads it.
    """
    task = as_task(task)
    fetch = f"`c2iql fetch {task.name}` downloads DSRL's"
    if source == "shipped":
        path = SHIPPED_DATA / f"{task.name}.hdf5"
        if not path.is_file() and not in_clone():
            raise DatasetError(why_missing(path))
        remedy = f"not shipped with the project: `c2iql collect {task.name}` makes a dataset, {fetch}"
    elif source == "dsrl":
        path = dsrl_directory() / task.dsrl_file
        remedy = f"no such file: {fetch}, or set DSRL_DATASET_DIR to the folder that has it"
    else:
        path = Path(source)
        with contextlib.suppress(RuntimeError):  # ~NAME where there is no such user
            path = path.expanduser()
        if os.path.isdir(path):
            path = path / f"{task.name}.hdf5"
        remedy = f"no such file: check the path, or use source 'shipped' or 'dsrl' ({fetch})"
    if not os.path.isfile(path):  # False also where the folder may not be looked into
        raise DatasetError(f"{path}: {remedy}")
    return path


def shipped_tasks() -> list[str]:
    """The names of the tasks whose dataset is shipped with the project, in `data/`."""
    return [name for name in TASKS if (SHIPPED_DATA / f"{name}.hdf5").exists()]


def dsrl_directory() -> Path:
    """The folder of DSRL's files: the environment variable DSRL_DATASET_DIR, or ~/.dsrl/datasets."""
    return Path(os.environ.get("DSRL_DATASET_DIR") or "~/.dsrl/datasets").expanduser()


def fetch_dataset(task: Task | str, directory: Path | str | None = None, base_url: str = DSRL_URL) -> Path:
    """Download DSRL's file of a task into `directory` if it is not there, and return its path.

    The default of `directory` is DSRL's own folder.

    DSRL publishes no checksums. So the first download is trusted: its SHA-256 is printed and stored in
    `<file>.sha256`, which `sha256sum -c` reads. Every later call compares the file with the stored SHA-256. A
    downloaded file gets its name only when it is complete, has the stored SHA-256, and can be read as the
    task's dataset.

    Raises DatasetError where there is no network, no such file on the server, or no space, and for a file
    that is larger than `MAX_BYTES`, takes longer than `MAX_SECONDS`, has another SHA-256 or cannot be read.
    """
    task = as_task(task)
    path = Path(directory or dsrl_directory()).expanduser() / task.dsrl_file
    memory = path.with_name(f"{path.name}.sha256")
    partial = path.with_name(f".{path.name}.partial")  # a folder: all that is left of a killed download
    try:
        if path.exists():
            digest = _verify(path, memory, task)
        else:
            found = _download(base_url, path.name, partial)
            try:
                digest = _verify(found, memory, task)
            except DatasetError as error:
                raise DatasetError(f"{path}: what {base_url} sent is wrong, and not kept: {error}") from None
            with written_whole(path) as temporary:
                os.replace(found, temporary)
        if not _remembered(memory):
            with written_whole(memory) as temporary:
                temporary.write_text(f"{digest}  {path.name}\n")
    except OSError as error:
        raise DatasetError(
            f"{path.parent}: {error.strerror or error}: make room, or choose another folder"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    print(f"{path}: {path.stat().st_size:,} bytes, SHA-256 {digest}")
    return path


def _verify(file: Path, memory: Path, task: Task) -> str:
    """The SHA-256 of a file. Raises DatasetError where it is not the stored one or the data are unusable."""
    digest = sha256_of(file)
    remembered = _remembered(memory) or digest
    if digest != remembered:
        remedy = f"delete it to fetch it again, or delete {memory.name} to accept it"
        raise DatasetError(f"{file}: SHA-256 is {digest}, but was {remembered} when first fetched: {remedy}")
    read_dataset(file, task)
    return digest


def _remembered(memory: Path) -> str | None:
    """The SHA-256 in a `.sha256` file. None where there is no file, or a full disk left it empty."""
    return next(iter(memory.read_text().split()), None) if memory.exists() else None


class _Unbounded(Exception):
    """A download is too large or too slow. This is no ValueError, because pooch repeats after one."""


class _Bounded:
    """A file to write into, which takes at most `MAX_BYTES` within `MAX_SECONDS`."""

    def __init__(self, path: str):
        self.file, self.size, self.end = open(path, "wb"), 0, time.monotonic() + MAX_SECONDS

    def write(self, part: bytes) -> None:
        """Writes what has arrived. Raises _Unbounded where it is too much or too late."""
        self.size += len(part)
        if self.size > MAX_BYTES:
            raise _Unbounded(f"more than {MAX_BYTES:,} bytes: is the address right?")
        if time.monotonic() > self.end:
            raise _Unbounded(f"not complete after {MAX_SECONDS:,} s: try again later")
        self.file.write(part)

    def flush(self) -> None:
        """Does nothing, because closing the file flushes it."""


def _download(base_url: str, name: str, folder: Path) -> Path:
    """Download one file into `folder`. A broken connection is tried again, up to three times in all.

    Raises DatasetError.
    """
    import pooch  # for its progress bar and retries; a file has its name only when complete
    import requests

    shutil.rmtree(folder, ignore_errors=True)
    server = pooch.create(folder, base_url, registry={name: None}, retry_if_failed=2)
    url = server.get_url(name)

    def bounded(url: str, path: str, server: pooch.Pooch) -> None:
        file = _Bounded(path)
        with file.file:  # in small parts, so that a slow server meets the end
            pooch.HTTPDownloader(progressbar=True, chunk_size=2**13)(url, file, server)

    try:
        return Path(server.fetch(name, downloader=bounded))
    except _Unbounded as error:
        raise DatasetError(f"{url}: {error}") from error
    except requests.HTTPError as error:
        answer = error.response
        status = "no" if answer is None else f"{answer.status_code} {answer.reason}"
        raise DatasetError(f"{url}: the server said {status}: has the file moved?") from error
    except requests.RequestException as error:
        remedy = f"check the network and try again, or put the file into {folder.parent} yourself"
        raise DatasetError(f"{url}: no connection, or it broke: {remedy}") from error
    except OSError as error:
        reason = error.strerror or error
        raise DatasetError(f"{folder.parent}: {reason}: make room there, or choose another folder") from error
