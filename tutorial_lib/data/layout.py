"""Stores the seven arrays of a dataset in an HDF5 file, and reads them from a file that may be bad.

The state after a step is the state before the next step. So `next_observations` repeats `observations`, apart
from one row per episode. Where that is so to the bit, only `observations` is stored, and the last states of
the episodes in `final_observations`, which has N rows and is zero elsewhere. `next_observations` is then a
virtual dataset over these two in the same file, which h5py fills when it reads. All datasets have N rows,
because the loader of `dsrl` slices every dataset of a file by episode.
"""

import contextlib
import importlib
import math
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from tutorial_lib.data.checks import Report, check_shapes
from tutorial_lib.data.dataset import KEYS
from tutorial_lib.tasks import Task

FINALS = "final_observations"
CHUNK_ROWS = 16384
STORAGE = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "fletcher32": True}
"""How arrays are stored. A chunk holds one column of `CHUNK_ROWS` rows, and its bytes are shuffled: similar
bytes are then neighbours, which gzip compresses well. CarCircle's file has 72% of the raw size. It has 75%
with chunks of whole rows, and 87% with whole rows and no shuffle. Fletcher32 is a checksum of each chunk."""
GROUP = 128
"""The number of episodes in one mapping of a virtual dataset. The time to open a mapping grows with the
square of this number: 5,000 episodes in one take 3 s, and 0.02 s in groups. With a mapping for each episode,
HDF5 before 2.0 unpacks the chunks again for each: AntCircle's 140 episodes take 4 s, and all in one 0.3 s."""
AGAIN = "delete it, then fetch or collect it again"
FILTERS = {32001: "blosc", 32004: "lz4", 32008: "bitshuffle", 32013: "zfp", 32015: "zstd", 32026: "blosc2"}
"""Names of filters that are not part of HDF5, by their registered numbers."""
GZIP_RATIO = 1100
"""Gzip makes no array smaller than 1/1032 of its size, so that no honest file declares more than this."""


class _Refused(Exception):
    """A dataset of the file must not be read: what is wrong, and what to do."""


# --- Writing ---


def write_arrays(file: h5py.File, arrays: dict[str, np.ndarray]) -> None:
    """Write the arrays of a Dataset, and the states once where the rows of all episodes follow each other."""
    ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    states, following = arrays["observations"], arrays["next_observations"]
    # The bits are compared, and not the values: 0.0 equals -0.0.
    differs = (following[:-1].view(np.uint32) != states[1:].view(np.uint32)).any(axis=1)
    differs[ends[:-1] - 1] = False
    once = not differs.any()
    for key, values in arrays.items():
        if key != "next_observations" or not once:
            _create(file, key, values)
    if once:
        finals = np.zeros_like(following)
        finals[ends - 1] = following[ends - 1]
        _create(file, FINALS, finals)
        creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        creation.set_obj_track_times(False)
        for mapping in _mappings(ends, states.shape):
            creation.set_virtual(mapping.to, b".", mapping.name.encode(), mapping.of)
        space = h5py.h5s.create_simple(states.shape)
        h5py.h5d.create(file.id, b"next_observations", h5py.h5t.NATIVE_FLOAT, space, creation)


def _create(file: h5py.File, key: str, values: np.ndarray) -> None:
    chunks = (min(CHUNK_ROWS, len(values)),) + (1,) * (values.ndim - 1)
    file.create_dataset(key, data=values, chunks=chunks, **STORAGE)


class _Mapping(NamedTuple):
    """Rows of a virtual dataset, and the rows of the dataset `name` that they show."""

    name: str
    to: h5py.h5s.SpaceID
    of: h5py.h5s.SpaceID


def _mappings(ends: np.ndarray, shape: tuple[int, int]) -> list[_Mapping]:
    """What `next_observations` shows: the next rows' observations, and at ends of episodes the last states.

    There are two mappings for each `GROUP` episodes.
    """
    starts = np.concatenate(([0], ends[:-1]))
    mappings = []
    for first in range(0, len(ends), GROUP):
        of_group = slice(first, first + GROUP)
        start, end = starts[of_group], ends[of_group]
        last = _rows(shape, end - 1, end)
        mappings.append(_Mapping(FINALS, last, last))
        start, end = start[end - start > 1], end[end - start > 1]
        if len(start):
            inner, following = _rows(shape, start, end - 1), _rows(shape, start + 1, end)
            mappings.append(_Mapping("observations", inner, following))
    return mappings


def _rows(shape: tuple[int, int], starts: np.ndarray, stops: np.ndarray) -> h5py.h5s.SpaceID:
    """The selection of the rows start, ..., stop - 1 of every pair, in an array of `shape`."""
    space = h5py.h5s.create_simple(shape)
    space.select_none()
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        block = (stop - start, shape[1])
        space.select_hyperslab((start, 0), (1, 1), block=block, op=h5py.h5s.SELECT_OR)
    return space


# --- Reading ---


def read_arrays(path: Path, task: Task, report: Report) -> tuple[dict[str, np.ndarray], dict]:
    """The arrays that the file has under DSRL's keys, and the attributes of its root.

    Before anything is read, the links, the storage, the shapes and the types of all arrays are checked. Where
    something is wrong, the report says so, and no arrays are returned.
    """
    if not _can_open(path, report):
        return {}, {}
    key, attributes = "file", {}
    try:
        with h5py.File(path, "r") as file:
            attributes = _attributes(file)
            stored = {}
            for key in KEYS:
                try:
                    stored[key] = _local(file, key)
                except _Refused as refusal:
                    report.error(key, *refusal.args)
            present = {key: dataset for key, dataset in stored.items() if dataset is not None}
            if not report.errors and check_shapes(present, task, report):
                key = "file"
                _check_size(present, path.stat().st_size, report)
            if report.errors:
                return {}, attributes
            arrays: dict[str, np.ndarray] = {}
            for key in (*(key for key in KEYS if key != "next_observations"), "next_observations"):
                arrays[key] = _values(file, present[key], key, arrays)
            return {key: arrays[key] for key in KEYS}, attributes
    except Exception as error:  # a bad file makes HDF5, h5py and NumPy raise errors of many types
        report.error(key, *_reason(error))
        return {}, attributes


def _can_open(path: Path, report: Report) -> bool:
    """Whether `path` is an HDF5 file that may be read. If not, the report says why."""
    try:
        if not path.is_file():
            report.error("", "no such file", "check the path")
        elif not path.stat().st_size:
            report.error("", "the file is empty (0 bytes)", AGAIN)
        else:
            with open(path, "rb"):
                pass
            if not h5py.is_hdf5(path):
                remedy = "check the path, or fetch or collect it again"
                report.error("", "not an HDF5 file, or its first bytes are lost", remedy)
    except PermissionError:
        report.error("", "no permission to read it", "ask its owner, or change its permissions (chmod +r)")
    except OSError as error:
        report.error("", f"cannot be opened: {error.strerror or error}", "check the path and the disk")
    return not report.errors


def _reason(error: Exception) -> tuple[str, str]:
    """What an error in opening or reading a file means, and what to do."""
    said = " ".join(str(error).split())
    if "unable to lock file" in said:
        remedy = "close it there; on a file system without locks, set HDF5_USE_FILE_LOCKING=FALSE"
        return "in use by another program", f"{remedy} ({said})"
    if "already open for write" in said:
        return "not closed by the program that wrote it", f"close it there, or run h5clear -s on it ({said})"
    if isinstance(error, MemoryError):
        return "does not fit into memory", "use a computer with more memory, or fewer episodes"
    if isinstance(error, (OSError, RuntimeError, KeyError)):  # what h5py raises where HDF5 finds damage
        return "truncated or damaged", f"{AGAIN} ({said})"
    return "cannot be read", f"check the program that wrote it ({type(error).__name__}: {said})"


def _attributes(file: h5py.File) -> dict:
    """The attributes of the file's root, without those of types that neither Python nor NumPy has."""
    found = {}
    for name in file.attrs:
        with contextlib.suppress(TypeError, ValueError):
            value = file.attrs[name]
            found[name] = value.item() if isinstance(value, np.generic) else value
    return found


def _local(file: h5py.File, name: str, virtual: bool = True) -> h5py.Dataset | None:
    """The dataset called `name`, or None. Raises _Refused where its values are not stored in this file.

    Values from elsewhere could be any file of the reader's, or silently zero where that file is missing.
    """
    place = file
    for part in name.strip("/").split("/"):
        link = place.get(part, getlink=True) if isinstance(place, h5py.Group) else None
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise _Refused("a link to another place", "store the values themselves under this key")
        place = place[part]
    if not isinstance(place, h5py.Dataset):
        return None
    if place.external:
        raise _Refused("its values are stored outside the file", "store them in the file")
    if place.is_virtual:
        if not virtual:
            raise _Refused("a virtual dataset of virtual datasets", "store the values themselves")
        _check_sources(file, place)
    _check_filters(place)
    return place


def _check_sources(file: h5py.File, dataset: h5py.Dataset) -> None:
    """Raises _Refused for a virtual dataset that shows other files, or that has rows without a source."""
    shown = 0
    for source in dataset.virtual_sources():
        if source.file_name != ".":
            raise _Refused("a virtual dataset of another file", "store the values in this file")
        found, count = _local(file, source.dset_name, virtual=False), source.vspace.get_select_npoints()
        if found is None or not _has_rows(found, source.src_space, count):
            raise _Refused(f"its source {source.dset_name} is missing or too short", "store the values")
        shown += count
    if shown != math.prod(dataset.shape or ()):
        raise _Refused("a virtual dataset with values that have no source", "store the values")


def _has_rows(dataset: h5py.Dataset, space: h5py.h5s.SpaceID, count: int) -> bool:
    """Whether a dataset has all values that a selection takes from it, which are `count`."""
    if space.get_select_type() == h5py.h5s.SEL_ALL:  # the file then does not say how large it should be
        return math.prod(dataset.shape or ()) == count
    last = space.get_select_bounds()[1]
    return all(row < rows for row, rows in zip(last, dataset.shape or (), strict=True))


def _check_filters(dataset: h5py.Dataset) -> None:
    """Raises _Refused where the chunks are compressed with a filter that is not installed."""
    creation = dataset.id.get_create_plist()
    for index in range(creation.get_nfilters()):
        number, _, _, said = creation.get_filter(index)
        if h5py.h5z.filter_avail(number):
            continue
        with contextlib.suppress(ImportError):
            importlib.import_module("hdf5plugin")  # importing it makes its filters known to HDF5
        if not h5py.h5z.filter_avail(number):
            name = FILTERS.get(number) or said.decode(errors="replace").split("\0")[0] or "without a name"
            what = f"compressed with filter {name} (number {number}), which is not installed"
            raise _Refused(what, "pip install hdf5plugin, or store it with gzip")


def _check_size(stored: dict[str, h5py.Dataset], size: int, report: Report) -> None:
    """Reports arrays that are larger than a file of `size` bytes can hold: reading them fills the memory."""
    declared = sum(math.prod(d.shape) * d.dtype.itemsize for d in stored.values())
    if declared > GZIP_RATIO * size:
        what = f"declares {declared:,} bytes of values, but has {size:,} bytes, which cannot hold them"
        report.error("file", what, "write it again")


def _values(file: h5py.File, dataset: h5py.Dataset, key: str, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The values of an array. `next_observations` is put together here if it is stored as we store it.

    That takes a third of the time in which HDF5 does the same.
    """
    if key == "next_observations" and dataset.is_virtual:
        sources = dataset.virtual_sources()
        ends = np.flatnonzero((arrays["terminals"] != 0) | (arrays["timeouts"] != 0)) + 1
        found = [(s.dset_name, _blocks(s.vspace), _blocks(s.src_space)) for s in sources]
        if found == [(m.name, _blocks(m.to), _blocks(m.of)) for m in _mappings(ends, dataset.shape)]:
            states = arrays["observations"]
            following = np.concatenate((states[1:], states[:1]))
            following[ends - 1] = file[FINALS][()][ends - 1]
            return following
    return dataset[()]


def _blocks(space: h5py.h5s.SpaceID) -> bytes | None:
    """The first and the last element of every block that is selected. None for selections without blocks."""
    hyperslab = space.get_select_type() == h5py.h5s.SEL_HYPERSLABS
    return space.get_select_hyper_blocklist().tobytes() if hyperslab else None
