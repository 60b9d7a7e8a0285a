"""Reads, checks and writes files in DSRL's HDF5 layout."""

import warnings
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from tutorial_lib.data import layout
from tutorial_lib.data.checks import Report, check_dataset, check_shapes, check_task, check_values
from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError
from tutorial_lib.files import written_whole
from tutorial_lib.tasks import Task, as_task

ROUNDED = ("observations", "next_observations", "actions", "rewards")


def read_dataset(path: Path | str, task: Task | str) -> Dataset:
    """The dataset in a file in DSRL's layout, after checks.

    Arrays of shape (N,) may be stored as (N, 1). Other keys of the file are ignored. Rows after the last end
    of an episode are dropped, and a warning says how many they are. There are also warnings for what
    contradicts the task but may be meant (see `checks`).

    Raises DatasetError, and no other error, for a file that cannot be opened or is damaged; for arrays that
    are missing, that are stored outside the file, or that have the wrong shape or type for the task; for
    values that no dataset has, and for flags, rows and values with which training would be wrong.
    """
    dataset, report = examine(path, task)
    if dataset is None or report.errors:
        raise DatasetError(_first(report))
    for warning in report.warnings:
        warnings.warn(warning, stacklevel=2)
    return dataset


class Examined(NamedTuple):
    """What `examine` finds in a file."""

    dataset: Dataset | None
    """None where the values cannot be read, or do not make a dataset."""
    report: Report


def examine(path: Path | str, task: Task | str) -> Examined:
    """The dataset in a file, also where `read_dataset` would refuse it, and all that is wrong with it."""
    path, task = Path(path), as_task(task)
    report = Report(path)
    stored, attributes = layout.read_arrays(path, task, report)
    dataset = _whole_episodes(stored, attributes, report) if stored else None
    check_task(attributes, task, report)
    if dataset is not None:
        check_dataset(dataset, task, report)
    return Examined(dataset, report)


def write_dataset(
    path: Path | str,
    dataset: Dataset,
    task: Task | str,
    attributes: dict | None = None,
    mantissa_bits: int | None = None,
) -> Path:
    """Write `dataset` to a file in DSRL's layout, which `dsrl` 0.1.0 reads. Returns the path.

    Five arrays are float32, the two flags are bool. The attributes of the file's root are the dataset's own,
    `attributes` (values of type str, int or float), and the task's name. The file is written whole or not at
    all: if the program is killed, the old file stays as it was. Equal datasets give equal bytes.

    With `mantissa_bits` from 1 to 22, observations, next observations, actions and rewards are rounded to
    numbers of so many bits after the leading one. A float32 has 23. The file is then smaller. Its attributes
    `mantissa_bits` and `largest_rounding_error` say so.

    Raises DatasetError where `read_dataset` would, before anything is written, and ValueError for another
    number of bits.
    """
    path, task = Path(path), as_task(task)
    attributes = dataset.attributes | (attributes or {}) | {"task": task.name}
    arrays, report = {key: getattr(dataset, key) for key in KEYS}, Report(path)
    if check_shapes(arrays, task, report):
        arrays = check_values(arrays, report)
    check_task(dataset.attributes, task, report)
    if not report.errors:
        check_dataset(Dataset(**arrays), task, report)
    if report.errors:
        raise DatasetError(_first(report))
    if mantissa_bits is not None:
        exact = arrays
        arrays = {key: rounded(x, mantissa_bits) if key in ROUNDED else x for key, x in exact.items()}
        largest = max(float(np.abs(arrays[key] - exact[key]).max()) for key in ROUNDED)
        attributes |= {"mantissa_bits": mantissa_bits, "largest_rounding_error": largest}
    with written_whole(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(attributes)
        layout.write_arrays(file, arrays)
    return path


def rounded(values: np.ndarray, mantissa_bits: int) -> np.ndarray:
    """float32 values, each replaced by the nearest that has `mantissa_bits` bits after the leading one.

    Of two equally near ones, the last bit of the result is 0. The relative error is at most
    2^-(mantissa_bits + 1). Raises ValueError where `mantissa_bits` is not between 1 and 22.
    """
    if not 1 <= mantissa_bits <= 22:
        raise ValueError(f"mantissa_bits is {mantissa_bits}, and must be between 1 and 22")
    dropped = 23 - mantissa_bits
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    # Adding just under half of the last kept bit carries into it where the rest is more than half, and for
    # exactly half where the last kept bit is 1. A carry out of the mantissa rightly raises the exponent.
    bits = bits + np.uint32((1 << dropped - 1) - 1) + (bits >> np.uint32(dropped) & np.uint32(1))
    return (bits & np.uint32(0xFFFFFFFF << dropped & 0xFFFFFFFF)).view(np.float32)


def _whole_episodes(stored: dict[str, np.ndarray], attributes: dict, report: Report) -> Dataset | None:
    """The rows up to the last end of an episode. None where the report has an error."""
    arrays = check_values(stored, report)
    rows = len(arrays["rewards"])
    ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    if not len(ends):
        what = f"none of the {rows} transitions ends an episode"
        report.error("terminals, timeouts", what, "set timeouts to 1 where the horizon was reached")
    if report.errors:
        return None
    kept = ends[-1]
    if kept < rows:
        report.warning("unfinished tail", f"dropped {rows - kept} of {rows} transitions", "")
    return Dataset(**{key: values[:kept] for key, values in arrays.items()}, attributes=attributes)


def _first(report: Report) -> str:
    """The first error, and how many more there are."""
    more = len(report.errors) - 1
    return report.errors[0] + (f" (and {more} more: `c2iql data check` lists them)" if more else "")
