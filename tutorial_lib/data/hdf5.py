"""Reads, checks and writes files in DSRL's HDF5 layout."""

import warnings
from pathlib import Path

import h5py
import numpy as np

from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError
from tutorial_lib.files import written_whole
from tutorial_lib.tasks import TASKS, Task, as_task

FLAGS = ("terminals", "timeouts")
CHUNK_ROWS = 16384
STORAGE = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
"""How arrays are stored. A chunk holds one column of `CHUNK_ROWS` rows, and its bytes are shuffled: similar
bytes are then neighbours, which gzip compresses well. CarCircle's file has 72% of the raw size. It has 75%
with chunks of whole rows, and 87% with whole rows and no shuffle."""


def read_dataset(path: Path | str, task: Task | str) -> Dataset:
    """The dataset in a file in DSRL's layout, after checks.

    Arrays of shape (N,) may be stored as (N, 1). Other keys of the file are ignored. Rows after the last end
    of an episode are dropped, and a warning says how many they are.

    Raises DatasetError for a file that is missing, empty, truncated, not HDF5, or of another task; for keys
    that are missing or have the wrong shape for the task; for episodes longer than the task's horizon; for
    values that are NaN or infinite, flags that are not 0 or 1, and negative costs; and where no episode ends.
    """
    path, task = Path(path), as_task(task)
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


def write_dataset(
    path: Path | str, dataset: Dataset, task: Task | str, attributes: dict | None = None
) -> Path:
    """Write `dataset` to a file in DSRL's layout, which `dsrl` 0.1.0 reads. Returns the path.

    Five arrays are float32, the two flags are bool. The attributes of the file's root are the dataset's own,
    `attributes` (values of type str, int or float), and the task's name. The file is written whole or not at
    all: if the program is killed, the old file stays as it was. Equal datasets give equal bytes. Raises
    DatasetError where `read_dataset` would, before anything is written.
    """
    path, task = Path(path), as_task(task)
    arrays = _check_arrays({key: getattr(dataset, key) for key in KEYS}, task, path)
    _check_task(dataset.attributes, task, path)
    with written_whole(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(dataset.attributes | (attributes or {}) | {"task": task.name})
        for key, values in arrays.items():
            chunks = (min(CHUNK_ROWS, len(values)),) + (1,) * (values.ndim - 1)
            file.create_dataset(key, data=values, chunks=chunks, **STORAGE)
    return path


def _read_hdf5(path: Path) -> tuple[dict, dict]:
    """The arrays that the file has under DSRL's keys, and the attributes of its root. Raises DatasetError."""
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
    """Raises DatasetError where the attribute `task` or the file's name names another task.

    DSRL's files have no such attribute, so that only the name can tell.
    """
    # The shapes cannot tell: BallRun and CarRun have the same.
    of_names = {other.dsrl_file: other.name for other in TASKS.values()}
    for what, made_for in (
        ("attribute task", str(attributes.get("task", task.name))),
        ("its name", of_names.get(path.name, task.name)),
    ):
        if made_for in TASKS and made_for != task.name:
            raise DatasetError(f"{path}: {what}: {made_for}, not {task.name}: take another task or file")


def _check_arrays(stored: dict, task: Task, path: Path) -> dict[str, np.ndarray]:
    """The seven arrays with the shapes and types of a Dataset. Raises DatasetError, which names the key."""
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
    """The values of one array, as bool for flags and as float32 for others. Raises DatasetError."""

    def refuse(bad: np.ndarray, what: str, remedy: str) -> None:
        rows = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))
        if len(rows):
            count = f"{len(rows)} of {len(bad)} rows, the first is row {rows[0]}"
            raise DatasetError(f"{path}: {key}: {what} in {count}: {remedy}")

    if values.dtype.kind not in "biuf":
        raise DatasetError(f"{path}: {key}: {values.dtype} is not a number: store float32, or bool for flags")
    if key in FLAGS:
        refuse((values != 0) & (values != 1), "neither 0 nor 1", "store False or True")
        return values.astype(bool)
    with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite, and is refused below
        values = values.astype(np.float32, copy=False)
    refuse(~np.isfinite(values), "NaN or infinity", "leave those episodes out")
    if key == "costs":
        refuse(values < 0, "negative cost", "make costs 0 or more")
    return values
