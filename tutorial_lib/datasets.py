"""Datasets in DSRL's HDF5 layout: find, read, check, write and fetch them; batches to train on.

A dataset is seven arrays with one row per transition, episode after episode (DSRL: Liu et al. 2024).
`terminals` (the robot fell) and `timeouts` (the horizon was reached) both end an episode and are never
merged: after a terminal nothing follows, whereas a time limit only ends the recording.
"""

import hashlib
import os
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import torch

from tutorial_lib.files import written_whole
from tutorial_lib.tasks import TASKS, Task, get_task

KEYS = ("observations", "next_observations", "actions", "rewards", "costs", "terminals", "timeouts")
FLAGS = ("terminals", "timeouts")
DSRL_URL = "https://huggingface.co/datasets/YYY-45/DSRL/resolve/main/"
SHIPPED_DATA = Path(__file__).resolve().parents[1] / "data"
# One column per chunk and shuffled bytes put like beside like, which is what gzip can use: 72% of the raw
# size on CarCircle, against 75% with whole rows and 87% with whole rows and no shuffle.
CHUNK_ROWS = 16384
STORAGE = {"compression": "gzip", "compression_opts": 9, "shuffle": True}


class DatasetError(ValueError):
    """A dataset that cannot be used. One line: the file, the key, what is wrong, what to do."""


class Batch(NamedTuple):
    """B transitions as float32: observations (B, obs), actions (B, act), the others (B,), flags 0 or 1."""

    observations: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    costs: torch.Tensor
    next_observations: torch.Tensor
    terminals: torch.Tensor
    timeouts: torch.Tensor


@dataclass(frozen=True, eq=False)
class Dataset:
    """N transitions that make up whole episodes, in order.

    observations, next_observations (N, obs), actions (N, act), rewards, costs (N,) are float32;
    terminals, timeouts (N,) are bool. `attributes` tells where the data come from. The last row must
    end an episode: DatasetError if not.
    """

    observations: np.ndarray
    next_observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    costs: np.ndarray
    terminals: np.ndarray
    timeouts: np.ndarray
    attributes: dict = field(default_factory=dict)

    def __post_init__(self):
        if not len(self) or not (self.terminals[-1] or self.timeouts[-1]):
            raise DatasetError("a dataset needs whole episodes: its last row must be a terminal or a timeout")

    def __len__(self) -> int:
        return len(self.rewards)

    @cached_property
    def ends(self) -> np.ndarray:
        """(num_episodes,): one past the last row of each episode, so that rows are [start, end)."""
        return np.flatnonzero(self.terminals | self.timeouts) + 1

    @cached_property
    def starts(self) -> np.ndarray:
        """(num_episodes,): the first row of each episode."""
        return np.concatenate(([0], self.ends[:-1]))

    @property
    def num_episodes(self) -> int:
        return len(self.ends)

    @property
    def episode_lengths(self) -> np.ndarray:
        """(num_episodes,): steps."""
        return self.ends - self.starts

    @cached_property
    def episode_returns(self) -> np.ndarray:
        """(num_episodes,) float64: undiscounted sums of rewards."""
        return np.add.reduceat(self.rewards, self.starts, dtype=np.float64)

    @cached_property
    def episode_costs(self) -> np.ndarray:
        """(num_episodes,) float64: undiscounted sums of costs, which a threshold bounds."""
        return np.add.reduceat(self.costs, self.starts, dtype=np.float64)

    @cached_property
    def episode_index(self) -> np.ndarray:
        """(N,): the episode of each row."""
        return np.repeat(np.arange(self.num_episodes), self.episode_lengths)

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of all values, in hexadecimal: the same for the same data, however a file packs them."""
        digest = hashlib.sha256()
        for key in KEYS:
            digest.update(np.ascontiguousarray(getattr(self, key)))
        return digest.hexdigest()

    def select(self, episodes) -> "Dataset":
        """These episodes alone, a mask or indices in the order wanted: `d.select(d.episode_costs < 30)`."""
        chosen = np.arange(self.num_episodes)[episodes]
        if not len(chosen):
            raise DatasetError(f"select: none of {self.num_episodes} episodes chosen: a dataset needs one")
        rows = np.concatenate([np.arange(self.starts[i], self.ends[i]) for i in chosen])
        return Dataset(**{key: getattr(self, key)[rows] for key in KEYS}, attributes=self.attributes)

    def tensors(self, device="cpu") -> Batch:
        """All N transitions as one Batch on `device`, a copy, so that training samples by indexing it."""
        options = {"dtype": torch.float32, "device": device}
        return Batch(**{key: torch.tensor(getattr(self, key), **options) for key in KEYS})


def sample_batch(data: Batch, batch_size: int, generators: Sequence[torch.Generator]) -> Batch:
    """A batch for each of S runs, (S, batch_size, ...): rows of `data`, uniform, with replacement.

    Every run draws from its own CPU generator, so its batches depend neither on the runs beside it nor
    on the device of the data.
    """
    count = len(data.rewards)
    rows = torch.stack([torch.randint(count, (batch_size,), generator=generator) for generator in generators])
    flat = rows.flatten().to(data.rewards.device, non_blocking=True)
    return Batch(*(values.index_select(0, flat).unflatten(0, rows.shape) for values in data))


# --- Files ---


def read_dataset(path: Path | str, task: Task | str) -> Dataset:
    """Read and check a file in DSRL's layout. Columns may be (N, 1). Whatever it holds besides is ignored.

    An unfinished tail belongs to no episode: it is dropped, with a warning that counts it. Raises
    DatasetError for a file that is missing, empty, truncated, not HDF5 or another task's; for keys that are
    missing or of the wrong shape for the task; for episodes longer than its horizon; for values that are
    NaN or infinite, flags that are not 0 or 1, and negative costs; and where no episode ends.
    """
    path, task = Path(path), _as_task(task)
    stored, attributes = _read_hdf5(path)
    arrays = _check_arrays(stored, task, path)
    _check_task(attributes, task, path)
    rows = len(arrays["rewards"])
    ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    if not len(ends):
        raise DatasetError(
            f"{path}: terminals, timeouts: none of the {rows} transitions ends an episode: "
            "set timeouts to 1 where the horizon was reached"
        )
    kept = ends[-1]
    if kept < rows:
        warnings.warn(f"{path}: unfinished tail: dropped {rows - kept} of {rows} transitions", stacklevel=2)
    dataset = Dataset(**{key: values[:kept] for key, values in arrays.items()}, attributes=attributes)
    longest = dataset.episode_lengths.max()
    if longest > task.horizon:
        what = f"an episode of {longest} steps, but {task.name} has {task.horizon}"
        raise DatasetError(f"{path}: timeouts: {what}: is it another task's?")
    return dataset


def write_dataset(path: Path | str, dataset: Dataset, task: Task | str, attributes=None) -> Path:
    """Write `dataset` in DSRL's layout: five keys float32, flags bool, as `dsrl` 0.1.0 reads them.

    `attributes` (a dict of str, int, float) join the dataset's own on the file's root, with the task's name.
    The file appears whole or not at all: a write that is killed leaves the old file as it was. Equal
    datasets give equal bytes. Raises DatasetError where `read_dataset` would, before anything is written.
    """
    path, task = Path(path), _as_task(task)
    arrays = _check_arrays({key: getattr(dataset, key) for key in KEYS}, task, path)
    _check_task(dataset.attributes, task, path)
    with written_whole(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(dataset.attributes | (attributes or {}) | {"task": task.name})
        for key, values in arrays.items():
            chunks = (min(CHUNK_ROWS, len(values)),) + (1,) * (values.ndim - 1)
            file.create_dataset(key, data=values, chunks=chunks, **STORAGE)
    return path


def _read_hdf5(path: Path) -> tuple[dict, dict]:
    """The arrays under DSRL's keys, as many as the file has, and the attributes of its root."""
    again = "delete it, then fetch or collect it again"
    if not path.is_file():
        raise DatasetError(f"{path}: no such file: check the path")
    if not path.stat().st_size:
        raise DatasetError(f"{path}: the file is empty (0 bytes): {again}")
    if not h5py.is_hdf5(path):
        raise DatasetError(f"{path}: not an HDF5 file, or its first bytes are lost: {again}")
    arrays, key = {}, "file"
    try:
        with h5py.File(path, "r") as file:
            attributes = {k: v.item() if isinstance(v, np.generic) else v for k, v in file.attrs.items()}
            for key in KEYS:
                if isinstance(file.get(key), h5py.Dataset):
                    arrays[key] = file[key][()]
    except (OSError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"{path}: {key}: truncated or damaged: {again} ({reason})") from error
    return arrays, attributes


def _check_task(attributes: dict, task: Task, path: Path) -> None:
    """DatasetError where the file is another task's by its attribute or, DSRL's having none, by its name."""
    # BallRun and CarRun have the same shapes.
    of_names = {other.dsrl_file: other.name for other in TASKS.values()}
    for what, made_for in (
        ("attribute task", str(attributes.get("task", task.name))),
        ("its name", of_names.get(path.name, task.name)),
    ):
        if made_for in TASKS and made_for != task.name:
            raise DatasetError(f"{path}: {what}: {made_for}, not {task.name}: take another task or file")


def _check_arrays(stored: dict, task: Task, path: Path) -> dict[str, np.ndarray]:
    """The seven arrays with a Dataset's shapes and types, or a DatasetError that names the key."""
    missing = [key for key in KEYS if key not in stored]
    if missing:
        raise DatasetError(f"{path}: {', '.join(missing)}: missing: DSRL's layout has {', '.join(KEYS)}")
    rows = np.shape(stored["observations"])[:1]
    if rows == (0,):
        raise DatasetError(f"{path}: observations: 0 rows, no transitions: fetch or collect some")
    obs, act = (task.obs_dim,), (task.act_dim,)
    widths = {"observations": obs, "next_observations": obs, "actions": act}
    checked = {}
    for key in KEYS:
        values, shape = np.asarray(stored[key]), rows + widths.get(key, ())
        if key not in widths and values.shape == (*shape, 1):
            values = values[:, 0]
        if values.shape != shape:
            what = f"shape {values.shape} should be {shape} for {task.name}"
            raise DatasetError(f"{path}: {key}: {what}: is it another task's, or shorter than observations?")
        checked[key] = _check_values(values, key, path)
    return checked


def _check_values(values: np.ndarray, key: str, path: Path) -> np.ndarray:
    """The values as bool where they are flags and as float32 elsewhere, or a DatasetError."""

    def refuse(bad, what, remedy):
        rows = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))
        if len(rows):
            count = f"{len(rows)} of {len(bad)} rows, the first is row {rows[0]}"
            raise DatasetError(f"{path}: {key}: {what} in {count}: {remedy}")

    if values.dtype.kind not in "biuf":
        raise DatasetError(f"{path}: {key}: {values.dtype} is not a number: store float32, or bool for flags")
    if key in FLAGS:
        refuse((values != 0) & (values != 1), "neither 0 nor 1", "store False or True")
        return values.astype(bool)
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused
        values = values.astype(np.float32, copy=False)
    refuse(~np.isfinite(values), "NaN or infinity", "leave those episodes out")
    if key == "costs":
        refuse(values < 0, "negative cost", "make costs 0 or more")
    return values


def _as_task(task: Task | str) -> Task:
    return get_task(task) if isinstance(task, str) else task


# --- Where datasets are ---


def load_dataset(task: Task | str, source: Path | str = "shipped") -> Dataset:
    """Read a task's dataset from `source` (see `find_dataset`). Raises DatasetError."""
    return read_dataset(find_dataset(task, source), task)


def find_dataset(task: Task | str, source: Path | str = "shipped") -> Path:
    """The file of a task: "shipped" with this project, "dsrl" for DSRL's own, or a path.

    One source never stands in for another: what a name means must not depend on the machine that it is
    said on, or results would not repeat. Raises DatasetError: where it looked, and what to run.
    """
    task = _as_task(task)
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
    task = _as_task(task)
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
        status = f"{error.response.status_code} {error.response.reason}"
        raise DatasetError(f"{url}: the server said {status}: has the file moved?") from error
    except requests.RequestException as error:
        remedy = f"check the network and try again, or put the file into {folder.parent} yourself"
        raise DatasetError(f"{url}: no connection, or it broke: {remedy}") from error
    except OSError as error:
        reason = error.strerror or error
        raise DatasetError(f"{folder.parent}: {reason}: make room there, or choose another folder") from error
