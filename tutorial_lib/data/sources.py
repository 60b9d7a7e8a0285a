"""Where datasets are: shipped with the project, DSRL's own, or a path; and how DSRL's are fetched."""

import hashlib
import os
import shutil
from pathlib import Path

from tutorial_lib.data.dataset import Dataset, DatasetError
from tutorial_lib.data.hdf5 import read_dataset
from tutorial_lib.files import written_whole
from tutorial_lib.tasks import TASKS, Task, as_task

DSRL_URL = "https://huggingface.co/datasets/YYY-45/DSRL/resolve/main/"


SHIPPED_DATA = Path(__file__).resolve().parents[2] / "data"


def load_dataset(task: Task | str, source: Path | str = "shipped") -> Dataset:
    """Read a task's dataset from `source` (see `find_dataset`). Raises DatasetError."""
    return read_dataset(find_dataset(task, source), task)


def find_dataset(task: Task | str, source: Path | str = "shipped") -> Path:
    """The file of a task: "shipped" with this project, "dsrl" for DSRL's own, or a path.

    One source never stands in for another: what a name means must not depend on the machine that it is
    said on, or results would not repeat. Raises DatasetError: where it looked, and what to run.
    """
    task = as_task(task)
    fetch = f"`c2iql fetch {task.name}` downloads DSRL's"
    if source == "shipped":
        path = SHIPPED_DATA / f"{task.name}.hdf5"
        remedy = f"not shipped with the project: `c2iql collect {task.name}` makes a dataset, {fetch}"
    elif source == "dsrl":
        path = dsrl_directory() / task.dsrl_file
        remedy = f"no such file: {fetch}, or set DSRL_DATASET_DIR to the folder that has it"
    else:
        path = Path(source).expanduser()
        remedy = f"no such file: check the path, or use source 'shipped' or 'dsrl' ({fetch})"
    if not path.is_file():
        raise DatasetError(f"{path}: {remedy}")
    return path


def shipped_tasks() -> list[str]:
    """The tasks whose dataset is in `data/`."""
    return [name for name in TASKS if (SHIPPED_DATA / f"{name}.hdf5").exists()]


def dsrl_directory() -> Path:
    """Where DSRL keeps its files: DSRL_DATASET_DIR, or ~/.dsrl/datasets."""
    return Path(os.environ.get("DSRL_DATASET_DIR") or "~/.dsrl/datasets").expanduser()


def fetch_dataset(task: Task | str, directory: Path | str | None = None, base_url: str = DSRL_URL) -> Path:
    """Download DSRL's file of a task into `directory` (DSRL's own by default), unless it is there.

    DSRL publishes no checksums: the first fetch is trusted, and its SHA-256 is shown and remembered in
    `<file>.sha256` (which `sha256sum -c` reads); a later fetch verifies the file. It appears in the
    directory only when it is whole, as remembered, and readable as the task's. Raises DatasetError: no
    network, no such file on the server, no space, or a file that differs or cannot be read.
    """
    task = as_task(task)
    path = Path(directory or dsrl_directory()).expanduser() / task.dsrl_file
    memory = path.with_name(f"{path.name}.sha256")
    partial = path.with_name(f".{path.name}.partial")  # a folder: a killed fetch leaves no other trace
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
    """The SHA-256 of a file that is as remembered, if it is remembered, and readable as the task's."""
    with open(file, "rb") as content:
        digest = hashlib.file_digest(content, "sha256").hexdigest()
    remembered = _remembered(memory) or digest
    if digest != remembered:
        remedy = f"delete it to fetch it again, or delete {memory.name} to accept it"
        raise DatasetError(f"{file}: SHA-256 is {digest}, but was {remembered} when first fetched: {remedy}")
    read_dataset(file, task)
    return digest


def _remembered(memory: Path) -> str | None:
    """The SHA-256 in a `.sha256` file; None where there is none, or a full disk cut it short."""
    return next(iter(memory.read_text().split()), None) if memory.exists() else None


def _download(base_url: str, name: str, folder: Path) -> Path:
    """Download one file into `folder`. A connection that breaks is tried again, three times in all."""
    import pooch  # progress bar, retries, and a file that bears its name only once it is complete
    import requests

    shutil.rmtree(folder, ignore_errors=True)
    server = pooch.create(folder, base_url, registry={name: None}, retry_if_failed=2)
    url = server.get_url(name)
    try:
        return Path(server.fetch(name, downloader=pooch.HTTPDownloader(progressbar=True, chunk_size=2**16)))
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
