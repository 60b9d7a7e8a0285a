"""Reads arrays from HDF5, CSV and npz files of other layouts than DSRL's, for `tutorial_lib.data.convert`.

Values are as they were stored, in float32. Nothing here loads a pickle, and an HDF5 file cannot make it read
another file: see `array_in`.
"""

import contextlib
import csv
import math
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np

from tutorial_lib.data.dataset import KEYS, DatasetError
from tutorial_lib.tasks import Task

Arrays = dict[str, np.ndarray]
FLAGS = ("terminals", "timeouts")
AGAIN = "copy or download it again"
GZIP_RATIO = 1100
"""Gzip makes no array smaller than 1/1032 of its size. A file that declares more would fill the memory."""


@contextlib.contextmanager
def opened_hdf5(path: Path) -> Iterator[h5py.File]:
    """The open file. Raises DatasetError where it is no HDF5 file, or damaged in what the block reads."""
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"{path}: not an HDF5 file, truncated or damaged: {AGAIN} ({reason})") from error


def read_folder(folder: Path, task: Task) -> Arrays:
    """The recording in a folder with a CSV or npz file for every episode, in the order of the names' numbers.

    An npz file has the arrays `dataset.KEYS`, with T rows. A CSV file has a header, in any order: `obs_0`,
    `obs_1`, ..., `action_0`, ..., `reward`, `cost`, `terminal` and `timeout`. Further columns are ignored.
    Each of T rows is a step: the observation before it, the action, and what followed. One more row has only
    the observation after the last step, and nothing in the other columns. Flags are 0, 1, False or True.

    An episode that ends with neither flag was cut off, and is dropped. Other files are ignored. Raises
    DatasetError for files that are damaged or do not fit the task, and where no whole episode is left.
    """
    files = sorted(episode_files(folder), key=lambda path: by_number(path.name))
    readers = {".csv": _read_csv, ".npz": _read_npz}
    stored = ((str(path), readers[path.suffix.lower()](path, task)) for path in files)
    return joined(folder, ((where, checked_arrays(arrays, KEYS, task, where)) for where, arrays in stored))


def episode_files(folder: Path) -> list[Path]:
    """The CSV and npz files of a folder. Hidden files are no episodes."""
    return [p for p in folder.iterdir() if p.suffix.lower() in (".csv", ".npz") and p.name[0] != "."]


def _read_npz(path: Path, _task: Task) -> Arrays:
    """The arrays of a file. Raises DatasetError where it is damaged, or has Python objects in it."""
    try:
        if not zipfile.is_zipfile(path):
            raise zipfile.BadZipFile("no archive of arrays")
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in KEYS if key in file}
    except (OSError, ValueError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"{path}: not an npz file of numbers, or damaged: {AGAIN} ({reason})") from error


def _read_csv(path: Path, task: Task) -> Arrays:
    """The arrays of an episode. Raises DatasetError, which names the line (from 1) and the column."""
    observed = [f"obs_{i}" for i in range(task.obs_dim)]
    rest = [f"action_{i}" for i in range(task.act_dim)] + ["reward", "cost", "terminal", "timeout"]
    lines = _csv_lines(path)
    header = [name.strip() for name in lines[0][1]] if lines else []
    missing = [name for name in observed + rest if header.count(name) != 1]
    if missing:
        what = f"must be there once, as {observed[0]} to {', '.join([observed[-1], *rest])}"
        raise DatasetError(f"{path}: line 1, column {missing[0]}: {what}: add it to the header and the rows")
    others = [n for n in header if re.fullmatch(r"(obs|action)_\d+", n) and n not in observed + rest]
    if others:
        raise DatasetError(f"{path}: line 1, column {others[0]}: {task.name} has none: is it another task's?")
    for line, fields in lines[1:]:
        if len(fields) != len(header):
            column = [*header, "after the last"][min(len(fields), len(header))]
            what = f"{len(fields)} fields, but the header has {len(header)}"
            raise DatasetError(f"{path}: line {line}, column {column}: {what}: is the file truncated?")

    def numbers(rows: list, names: list[str]) -> np.ndarray:
        places = [header.index(name) for name in names]
        return np.array([[_number(row[i], path, line, header[i]) for i in places] for line, row in rows])

    line, last = lines[-1]
    if len(lines) < 3 or any(last[header.index(name)].strip() for name in rest):
        what = "the last row must be the observation after the last step, and have only obs_*"
        raise DatasetError(f"{path}: line {line}, column {rest[0]}: {what}: is the file truncated?")
    seen, table = numbers(lines[1:], observed), numbers(lines[1:-1], rest)
    values = (seen[:-1], seen[1:], table[:, : task.act_dim], *table[:, task.act_dim :].T)
    return dict(zip(KEYS, values, strict=True))


def _csv_lines(path: Path) -> list[tuple[int, list[str]]]:
    """The lines of a CSV file that are not blank, split at the commas, with their numbers from 1."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            return [(reader.line_num, fields) for fields in reader if fields]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path}: not a CSV file in UTF-8: write it again ({error})") from error


def _number(text: str, path: Path, line: int, column: str) -> float:
    """The finite number in a field. Raises DatasetError."""
    try:
        value = float({"true": "1", "false": "0"}.get(text.strip().lower(), text))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(f"{path}: line {line}, column {column}: {text!r} is not a number: correct it")
    return value


def array_in(group: h5py.Group, name: str, path: Path) -> np.ndarray | None:
    """The numbers under a name such as `infos/cost`, or None where there are none.

    Only what is stored in the file itself is read. Otherwise a recording from a stranger could show another
    file of this machine: so DatasetError is raised for links, for external storage and for virtual arrays.
    """
    elsewhere = DatasetError(
        f"{path}: {name}: a reference to another place: store the values in the file itself"
    )
    item = group
    for part in name.encode().split(b"/"):  # h5py's own `in` and `get` would follow a link
        if not isinstance(item, h5py.Group) or not item.id.links.exists(part):
            return None
        if item.id.links.get_info(part).type != h5py.h5l.TYPE_HARD:
            raise elsewhere
        item = item[part]
    if not isinstance(item, h5py.Dataset):
        return None
    if item.external or item.is_virtual:
        raise elsewhere
    if item.shape is None or item.dtype.kind not in "biuf":
        raise DatasetError(f"{path}: {name}: {item.dtype} is not a number: store float32, or bool for flags")
    if item.nbytes > GZIP_RATIO * path.stat().st_size:
        raise DatasetError(
            f"{path}: {name}: shape {item.shape} is more than the file can hold: write it again"
        )
    return item[()]


def checked_arrays(stored: Arrays, keys: Iterable[str], task: Task, where: str) -> Arrays:
    """The arrays under `keys` with the shapes and types of a Dataset. Raises DatasetError."""
    missing = [key for key in keys if key not in stored]
    if missing:
        also = " (or infos/cost)" if "costs" in missing else ""
        raise DatasetError(f"{where}: {', '.join(missing)}{also}: missing: training needs it, so record it")
    rows = np.shape(stored["observations"])[:1]
    obs, act = (task.obs_dim,), (task.act_dim,)
    widths = {"observations": obs, "next_observations": obs, "actions": act}
    checked = {}
    for key in keys:
        values, shape = np.asarray(stored[key]), rows + widths.get(key, ())
        if key not in widths and values.shape == (*shape, 1):
            values = values[:, 0]
        if values.shape != shape or values.dtype.kind not in "biuf":
            what = f"{values.dtype} of shape {values.shape} should be numbers of shape {shape}"
            raise DatasetError(f"{where}: {key}: {what} for {task.name}: is it another task's?")
        with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite
            kept = values.astype(bool if key in FLAGS else np.float32)
        wrong = kept != values if key in FLAGS else ~np.isfinite(kept)
        for row in np.argwhere(wrong)[:1, 0]:
            what = "neither 0 nor 1" if key in FLAGS else "NaN or infinity"
            raise DatasetError(f"{where}: {key}: {what} in row {row}: correct it or leave the episode out")
        checked[key] = kept
    return checked


def joined(path: Path, episodes: Iterable[tuple[str, Arrays]]) -> Arrays:
    """The whole ones of the episodes, one after another. Each comes with its place for messages.

    Raises DatasetError where a flag stands inside an episode, and where no episode is whole.
    """
    whole, cut = [], 0
    for where, arrays in episodes:
        ended = arrays["terminals"] | arrays["timeouts"]
        for row in np.flatnonzero(ended[:-1])[:1]:
            what = f"row {row} ends the episode, but {len(ended) - 1 - row} rows follow"
            raise DatasetError(f"{where}: terminals, timeouts: {what}: store every episode by itself")
        if ended[-1:].any():
            whole.append(arrays)
        else:
            cut += 1
    if not whole:
        what = f"none of {cut} episodes ends with a flag: set timeouts to 1 where the horizon was reached"
        raise DatasetError(f"{path}: terminals, timeouts: {what}")
    if cut:
        what = f"dropped {cut} of {cut + len(whole)} episodes, which end with neither flag"
        warnings.warn(f"{path}: terminals, timeouts: cut off: {what}", stacklevel=2)
    return {key: np.concatenate([arrays[key] for arrays in whole]) for key in KEYS}


def by_number(name: str) -> list:
    """A sorting key that puts episode_2 before episode_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]
