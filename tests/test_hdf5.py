"""Files of datasets: against h5py by hand, damaged, of another task, killed half-way.

What the loader of the PyPI package `dsrl` 0.1.0 does is replayed in `dsrl_loads` below.
"""

import os
import signal
import time

import h5py
import numpy as np
import pytest
from five_episodes import LENGTHS, assert_same, episodes_by_loop, h5_file, make_arrays, refused

from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.tasks import TASKS

CAR_RUN = TASKS["CarRun"]


@pytest.fixture
def arrays():
    return make_arrays()


@pytest.fixture
def dataset(arrays):
    return Dataset(**arrays, attributes={"seed": 3})


def dsrl_loads(path):
    """What `get_dataset` of dsrl 0.1.0 does to a file, and what it asserts.

    It reads every dataset of the file, needs the seven keys, compares shape[1:] of observations and
    actions with the environment's, flattens (N, 1) and casts the first five to float32. Its filters then
    split episodes where `terminals == 1` or `timeouts == 1` and slice every key that the file has.
    """
    with h5py.File(path, "r") as file:
        data = {key: file[key][:] for key in file}
    rows = data["observations"].shape[0]
    assert data["observations"].shape[1:] == (7,) and data["actions"].shape[1:] == (2,)
    for key in ("rewards", "costs", "terminals", "timeouts"):
        assert data[key].shape == (rows,)
    ends = np.where((data["terminals"] == 1) | (data["timeouts"] == 1))[0]
    return data, ends


def test_written_files_are_what_dsrl_reads(tmp_path, dataset, arrays):
    data, ends = dsrl_loads(write_dataset(tmp_path / "a.hdf5", dataset, "CarRun"))
    assert set(data) == set(arrays)  # no further key: dsrl's filters slice all of them as if they had N rows
    for key, values in arrays.items():
        assert data[key].dtype == values.dtype
        np.testing.assert_array_equal(data[key], values)
    assert list(ends) == [rows[-1] for rows in episodes_by_loop(arrays)]


def test_what_is_written_is_read(tmp_path, dataset, arrays):
    written = {"behaviour": "PPO", "steps": 300_000, "wall_time_s": 12.5}
    path = write_dataset(tmp_path / "new" / "a.hdf5", dataset, CAR_RUN, written)
    back = read_dataset(path, "CarRun")
    assert_same(back, arrays)
    assert back.attributes == {"seed": 3, "task": "CarRun"} | written
    assert [type(back.attributes[key]) for key in written] == [str, int, float]


def test_equal_datasets_give_equal_bytes(tmp_path, dataset):
    first = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun").read_bytes()
    time.sleep(1.01 - time.time() % 1)  # HDF5 can store the time of writing, in seconds
    assert first == write_dataset(tmp_path / "b.hdf5", dataset, "CarRun").read_bytes()


def test_columns_and_other_types_are_accepted(tmp_path, arrays):
    """Some of DSRL's files hold (N, 1); a foreign file may hold float64, flags as numbers, and more keys."""
    stored = {key: values.astype(np.float64) for key, values in arrays.items()}
    for key in ("rewards", "costs", "terminals", "timeouts"):
        stored[key] = stored[key][:, None]
    stored["timeouts"] = stored["timeouts"].astype(np.uint8)
    path = h5_file(tmp_path / "foreign.hdf5", stored | {"infos": np.zeros(3)}, task="something of theirs")
    data = read_dataset(path, "CarRun")
    assert_same(data, arrays)
    assert data.rewards.dtype == np.float32 and data.terminals.dtype == data.timeouts.dtype == bool


def test_an_unfinished_tail_is_dropped_and_said(tmp_path, arrays):
    arrays["timeouts"][-1] = False  # the last episode, of 4 steps, no longer ends
    path = h5_file(tmp_path / "tail.hdf5", arrays)
    with pytest.warns(UserWarning, match="tail.hdf5: unfinished tail: dropped 4 of 20") as caught:
        data = read_dataset(path, "CarRun")
    assert len(caught) == 1 and data.num_episodes == 4
    assert_same(data, arrays, rows=slice(0, 16))


def without(key):
    return lambda arrays: arrays.pop(key)


def change(key, function):
    return lambda arrays: arrays.update({key: function(arrays[key])})


def put(key, row, value):
    def broken(values):
        values = values.astype(np.float64)
        values[row] = value
        return values

    return change(key, broken)


BAD_ARRAYS = {
    "missing key": (without("costs"), "costs: missing"),
    "missing keys": (lambda arrays: (arrays.pop("timeouts"), arrays.pop("actions")), "actions, timeouts: m"),
    "a group": (lambda arrays: arrays.update({"rewards": None}), "rewards: missing"),
    "short": (change("rewards", lambda x: x[:-1]), r"rewards: shape \(19,\) should be \(20,\)"),
    "short observations": (change("observations", lambda x: x[:-1]), r"next_observations: shape \(20, 7\)"),
    "short flags": (change("timeouts", lambda x: x[:-1]), r"timeouts: shape \(19,\)"),
    "observations of another task": (
        change("observations", lambda x: x[:, :5]),
        r"observations: shape \(20, 5\) should be \(20, 7\) for CarRun",
    ),
    "actions of another task": (change("actions", lambda x: x[:, :1]), r"actions: shape \(20, 1\)"),
    "a matrix of costs": (change("costs", lambda x: np.stack([x, x], 1)), r"costs: shape \(20, 2\)"),
    "a scalar": (change("observations", lambda x: x[0, 0]), r"observations: shape \(\)"),
    "text": (change("rewards", lambda x: np.array([b"one"] * len(x))), "rewards: .* not a number"),
    "NaN": (put("observations", (4, 2), np.nan), "observations: NaN or infinity in 1 of 20 rows, .* row 4"),
    "infinity": (put("rewards", slice(3, 5), -np.inf), "rewards: NaN or infinity in 2 of 20 rows, .* row 3"),
    "beyond float32": (put("rewards", 6, 1e300), "rewards: NaN or infinity in 1 of 20 rows, .* row 6"),
    "NaN cost": (put("costs", 1, np.nan), "costs: NaN or infinity .* row 1"),
    "negative cost": (put("costs", 9, -1), "costs: negative cost in 1 of 20 rows, .* row 9"),
    "a flag of 2": (put("terminals", 7, 2), "terminals: neither 0 nor 1 in 1 of 20 rows, .* row 7"),
    "a flag of one half": (put("timeouts", 8, 0.5), "timeouts: neither 0 nor 1 .* row 8"),
    "a NaN flag": (put("timeouts", 8, np.nan), "timeouts: neither 0 nor 1 .* row 8"),
    "no rows": (lambda arrays: arrays.update({k: v[:0] for k, v in arrays.items()}), "observations: 0 rows"),
    "only a tail": (
        lambda arrays: arrays.update({k: v[:4] for k, v in arrays.items()}),
        "terminals, timeouts: none of the 4 transitions ends an episode",
    ),
}


@pytest.mark.parametrize("harm, message", BAD_ARRAYS.values(), ids=BAD_ARRAYS.keys())
def test_bad_arrays_are_refused_in_one_line(tmp_path, arrays, harm, message):
    harm(arrays)
    path = tmp_path / "bad.hdf5"
    with h5py.File(path, "w") as file:
        for key, values in arrays.items():
            file.create_group(key) if values is None else file.create_dataset(key, data=values)
    with refused(f"^{path}: {message}.*: .+"):
        read_dataset(path, "CarRun")


def damaged_chunk(path):
    with h5py.File(path) as file:
        offset = file["actions"].id.get_chunk_info(0).byte_offset
    with open(path, "rb+") as file:
        file.seek(offset)
        file.write(b"\xff" * 16)


BAD_FILES = {
    "no file": (os.remove, "no such file"),
    "empty": (lambda path: os.truncate(path, 0), "the file is empty"),
    "text": (lambda path: path.write_text("<html>Not found</html>"), "not an HDF5 file"),
    "a few bytes": (lambda path: os.truncate(path, 6), "not an HDF5 file"),
    "a header": (lambda path: os.truncate(path, 100), "file: truncated or damaged"),
    "half": (lambda path: os.truncate(path, path.stat().st_size // 2), "file: truncated or damaged"),
    "all but a byte": (lambda path: os.truncate(path, path.stat().st_size - 1), "file: truncated or damaged"),
    "a damaged chunk": (damaged_chunk, "actions: truncated or damaged"),
}


@pytest.mark.parametrize("harm, message", BAD_FILES.values(), ids=BAD_FILES.keys())
def test_bad_files_are_refused_in_one_line(tmp_path, dataset, harm, message):
    path = write_dataset(tmp_path / "bad.hdf5", dataset, "CarRun")
    harm(path)
    with refused(f"^{path}: {message}.*: .+"):
        read_dataset(path, "CarRun")


def test_a_file_of_another_task_with_the_same_shapes_is_refused(tmp_path, dataset):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "BallRun")
    with pytest.raises(DatasetError, match=f"^{path}: attribute task: BallRun, not CarRun"):
        read_dataset(path, "CarRun")


def test_what_could_not_be_read_is_not_written(tmp_path, dataset, arrays):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    before = path.read_bytes()
    with pytest.raises(DatasetError, match=f"^{path}: costs: negative"):
        write_dataset(path, Dataset(**arrays | {"costs": arrays["costs"] - 1}), "CarRun")
    with pytest.raises(DatasetError, match=f"^{path}: observations: shape"):
        write_dataset(path, dataset, "AntRun")
    with pytest.raises(TypeError):  # no attribute of HDF5
        write_dataset(path, dataset, "CarRun", {"config": {"lr": 1e-3}})
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.hdf5"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked process")
@pytest.mark.parametrize("moment", [(h5py.File, "create_dataset"), (os, "replace")], ids=["early", "late"])
def test_a_killed_write_leaves_the_old_file(tmp_path, dataset, moment, monkeypatch):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    before = path.read_bytes()
    changed = dataset.select([0])
    child = os.fork()
    if child == 0:
        try:
            monkeypatch.setattr(*moment, lambda *args, **kwargs: os.kill(os.getpid(), signal.SIGKILL))
            write_dataset(path, changed, "CarRun")
        finally:
            os._exit(0)  # whatever happened: the other tests are the parent's
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    assert path.read_bytes() == before
    write_dataset(path, changed, "CarRun")  # what the killed one left is not in the way
    assert len(read_dataset(path, "CarRun")) == LENGTHS[0]
    assert [name for name in os.listdir(tmp_path) if not name.startswith(".")] == ["a.hdf5"]


def test_another_tasks_file_is_refused_also_where_its_shapes_fit(tmp_path, arrays, dataset):
    """BallRun and CarRun look alike, and DSRL's files do not say what they are of."""
    theirs = write_dataset(tmp_path / "mine.hdf5", dataset, "CarRun")
    with pytest.raises(DatasetError, match="attribute task: CarRun, not BallRun"):
        write_dataset(tmp_path / "other.hdf5", read_dataset(theirs, "CarRun"), "BallRun")
    with h5py.File(theirs, "r+") as file:
        del file.attrs["task"]
    assert len(read_dataset(theirs, "BallRun")) == len(dataset)  # nothing tells: all episodes are short
    named = theirs.rename(tmp_path / TASKS["CarRun"].dsrl_file)
    with pytest.raises(DatasetError, match="its name: CarRun, not BallRun"):
        read_dataset(named, "BallRun")
    with h5py.File(theirs, "w") as file:
        for key in KEYS:
            width = {"observations": (7,), "next_observations": (7,), "actions": (2,)}.get(key, ())
            file[key] = np.zeros((200, *width), np.float32)
        file["timeouts"][-1] = 1
    assert len(read_dataset(theirs, "CarRun")) == 200
    with pytest.raises(DatasetError, match="an episode of 200 steps, but BallRun has 100"):
        read_dataset(theirs, "BallRun")
