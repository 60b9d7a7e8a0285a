"""Files in DSRL's HDF5 layout: read, check and write them."""

import warnings
from pathlib import Path

import h5py
import numpy as np

from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError
from tutorial_lib.files import written_whole
from tutorial_lib.tasks import TASKS, Task, as_task

FLAGS = ("terminals", "timeouts")


# One column per chunk and shuffled bytes put like beside like, which is what gzip can use: 72% of the raw
# size on CarCircle, against 75% with whole rows and 87% with whole rows and no shuffle.
CHUNK_ROWS = 16384


STORAGE = {"compression": "gzip", "compression_opts": 9, "shuffle": True}


def read_dataset(path: Path | str, task: Task | str) -> Dataset:
    """Read and check a file in DSRL's layout. Columns may be (N, 1). Whatever it holds besides is ignored.

    An unfinished tail belongs to no episode: it is dropped, with a warning that counts it. Raises
    DatasetError for a file that is missing, empty, truncated, not HDF5 or another task's; for keys that are
    missing or of the wrong shape for the task; for episodes longer than its horizon; for values that are
    NaN or infinite, flags that are not 0 or 1, and negative costs; and where no episode ends.
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


def write_dataset(path: Path | str, dataset: Dataset, task: Task | str, attributes=None) -> Path:
    """Write `dataset` in DSRL's layout: five keys float32, flags bool, as `dsrl` 0.1.0 reads them.

    `attributes` (a dict of str, int, float) join the dataset's own on the file's root, with the task's name.
    The file appears whole or not at all: a write that is killed leaves the old file as it was. Equal
    datasets give equal bytes. Raises DatasetError where `read_dataset` would, before anything is written.
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
