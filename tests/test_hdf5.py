"""Files of datasets: against h5py by hand, damaged, unreadable, hostile, of another task, killed half-way.

What the loader of the PyPI package `dsrl` 0.1.0 does is replayed in `dsrl_loads` below.
"""

import builtins
import os
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
from five_episodes import (
    LENGTHS,
    SHORT_TASKS,
    assert_same,
    episodes_by_loop,
    h5_file,
    make_arrays,
    refused,
)

from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.tasks import TASKS

CAR_RUN = SHORT_TASKS["CarRun"]


@pytest.fixture(autouse=True)
def short_tasks(monkeypatch):
    for name, task in SHORT_TASKS.items():
        monkeypatch.setitem(TASKS, name, task)


@pytest.fixture
def arrays():
    return make_arrays()


@pytest.fixture
def dataset(arrays):
    return Dataset(**arrays, attributes={"seed": 3})


def dsrl_loads(path):
    """What `get_dataset` of dsrl 0.1.0 does to a file, and what it asserts.

    It reads every dataset that it meets in the file, needs the seven keys, compares shape[1:] of observations
    and actions with the environment's, flattens (N, 1) and casts the first five to float32. Its filters then
    split episodes where `terminals == 1` or `timeouts == 1` and slice every key that the file has.
    """
    names = []
    with h5py.File(path, "r") as file:
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        data = {key: file[key][:] for key in names}
    rows = data["observations"].shape[0]
    assert data["observations"].shape[1:] == (7,) and data["actions"].shape[1:] == (2,)
    for key in ("rewards", "costs", "terminals", "timeouts"):
        assert data[key].shape == (rows,)
    ends = np.where((data["terminals"] == 1) | (data["timeouts"] == 1))[0]
    return data, ends


def test_written_files_are_what_dsrl_reads(tmp_path, dataset, arrays):
    data, ends = dsrl_loads(write_dataset(tmp_path / "a.hdf5", dataset, "CarRun"))
    assert set(data) == {*arrays, "final_observations"}
    for key, values in arrays.items():
        assert data[key].dtype == values.dtype
        np.testing.assert_array_equal(data[key], values)
    assert list(ends) == [rows[-1] for rows in episodes_by_loop(arrays)]
    # dsrl's filters slice every key as if it had N rows, and keep some of the episodes.
    assert {len(values) for values in data.values()} == {len(arrays["rewards"])}


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
    with pytest.warns(UserWarning, match="tail.hdf5: unfinished tail: dropped 5 of 20") as caught:
        data = read_dataset(path, "CarRun")
    assert len(caught) == 1 and data.num_episodes == 4
    assert_same(data, arrays, rows=slice(0, 15))


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
            file[key] = np.zeros((6, *width), np.float32)
        file["timeouts"][-1] = 1
    with pytest.raises(DatasetError, match="an episode of 6 steps, but BallRun has 5 in 1 of 1 episodes"):
        read_dataset(theirs, "BallRun")


# --- States are stored once ---


def stored_bytes(path):
    with h5py.File(path) as file:
        return {key: file[key].id.get_storage_size() for key in file}


def test_states_are_stored_once_where_rows_follow_each_other(tmp_path, dataset, arrays):
    path = write_dataset(tmp_path / "once.hdf5", dataset, "CarRun")
    assert stored_bytes(path)["next_observations"] == 0
    with h5py.File(path) as file:
        last = np.zeros((20, 7), np.float32)
        for rows in episodes_by_loop(arrays):
            last[rows[-1]] = arrays["next_observations"][rows[-1]]
        np.testing.assert_array_equal(file["final_observations"][()], last)


@pytest.mark.parametrize("harm", [lambda x: x + 1e-6, lambda x: x * -0.0], ids=["a gap", "minus zero"])
def test_states_that_differ_are_stored_twice(tmp_path, arrays, harm):
    arrays["observations"][3] = arrays["next_observations"][2] = 0
    arrays["next_observations"][2] = harm(arrays["next_observations"][2])
    path = write_dataset(tmp_path / "twice.hdf5", Dataset(**arrays), "CarRun")
    assert "final_observations" not in stored_bytes(path) and stored_bytes(path)["next_observations"] > 0
    with h5py.File(path) as file:
        stored = file["next_observations"][()]
    assert stored.tobytes() == arrays["next_observations"].tobytes()


def random_episodes(lengths):
    """The seven arrays of episodes with so many steps, as they would be recorded."""
    rng = np.random.default_rng(1)
    states = [rng.normal(size=(n + 1, 7)).astype(np.float32) for n in lengths]
    rows, last = sum(lengths), np.cumsum(lengths) - 1
    return {
        "observations": np.concatenate([episode[:-1] for episode in states]),
        "next_observations": np.concatenate([episode[1:] for episode in states]),
        "actions": rng.uniform(-1, 1, size=(rows, 2)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "costs": (rng.random(rows) < 0.3).astype(np.float32),
        "terminals": np.isin(np.arange(rows), last[::2]),
        "timeouts": np.isin(np.arange(rows), last[1::2]),
    }


@pytest.mark.filterwarnings("ignore:.*time limits:UserWarning")  # most are before the horizon
@pytest.mark.parametrize("lengths", [[1] * 3, [5], [4] * 300, [1, 3, 2, 4] * 100], ids=len)
def test_h5py_and_this_reader_put_the_states_together_alike(tmp_path, lengths):
    """300 and 400 episodes are more than one mapping of the virtual dataset has."""
    arrays = random_episodes(lengths)
    path = write_dataset(tmp_path / "a.hdf5", Dataset(**arrays), "CarRun")
    assert stored_bytes(path)["next_observations"] == 0
    assert_same(read_dataset(path, "CarRun"), arrays)
    data, _ = dsrl_loads(path)
    np.testing.assert_array_equal(data["next_observations"], arrays["next_observations"])


def test_a_virtual_dataset_of_other_rows_is_read_as_it_says(tmp_path, dataset, arrays):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    with h5py.File(path, "r+") as file:
        del file["next_observations"]
        layout = h5py.VirtualLayout((20, 7), np.float32)
        layout[:19] = h5py.VirtualSource(".", "observations", (20, 7), np.float32)[1:]
        layout[19] = h5py.VirtualSource(".", "final_observations", (20, 7), np.float32)[19]
        file.create_virtual_dataset("next_observations", layout)
        expected = np.concatenate((arrays["observations"][1:], arrays["next_observations"][19:]))
    with pytest.warns(UserWarning, match="next_observations: the next episode's first"):
        found = read_dataset(path, "CarRun").next_observations
    np.testing.assert_array_equal(found, expected)


def test_every_chunk_has_a_checksum_and_values_are_compressed(tmp_path, dataset):
    with h5py.File(write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")) as file:
        plain = [file[key] for key in file if not file[key].is_virtual]
        assert len(plain) == 7 and all(d.fletcher32 and d.compression == "gzip" for d in plain)


def nearest(value, bits):
    """By exact arithmetic: the nearest number with `bits` bits after the leading one, of two the even one."""
    mantissa, exponent = np.frexp(np.float64(value))
    return np.ldexp(np.round(mantissa * 2 ** (bits + 1)), exponent - bits - 1)  # np.round takes the even one


@pytest.mark.parametrize("bits", [1, 4, 14, 22])
def test_rounding_is_to_the_nearest(tmp_path, arrays, bits):
    arrays["rewards"][:7] = [0, -0.0, 1, 1.25, -1.75, 1 + 2**-15, 1 + 3 * 2**-15]
    path = write_dataset(tmp_path / "a.hdf5", Dataset(**arrays), "CarRun", mantissa_bits=bits)
    back, errors = read_dataset(path, "CarRun"), []
    for key in ("observations", "next_observations", "actions", "rewards"):
        np.testing.assert_array_equal(getattr(back, key), nearest(arrays[key], bits), err_msg=key)
        errors.append(np.abs(getattr(back, key) - arrays[key]).max())
    assert_same(back, {key: arrays[key] for key in ("costs", "terminals", "timeouts")})
    assert back.attributes["mantissa_bits"] == bits
    assert back.attributes["largest_rounding_error"] == pytest.approx(max(errors), rel=1e-6)
    assert stored_bytes(path)["next_observations"] == 0


@pytest.mark.parametrize("bits", [0, 23])
def test_a_number_of_bits_that_is_no_rounding_is_refused(tmp_path, dataset, bits):
    with pytest.raises(ValueError, match=f"mantissa_bits is {bits}, and must be between 1 and 22"):
        write_dataset(tmp_path / "a.hdf5", dataset, "CarRun", mantissa_bits=bits)
    assert os.listdir(tmp_path) == []


# --- Values from elsewhere, and sizes that are not true ---


def raw_file(file, folder):
    (folder / "secret").write_bytes(b"\x00\x00\x80\x3f" * 20)
    file.create_dataset("rewards", (20,), "f4", external=[(str(folder / "secret"), 0, 80)])


def external_link(file, folder):
    os.mkfifo(folder / "pipe")  # opening it would wait for ever
    file["rewards"] = h5py.ExternalLink(str(folder / "pipe"), "rewards")


def soft_link(file, folder):
    file["elsewhere"] = np.zeros(20, np.float32)
    file["rewards"] = h5py.SoftLink("/elsewhere")


def virtual(name, of, shape=(20,), rows=slice(None)):
    def make(file, folder):
        file["elsewhere"] = np.ones(shape, np.float32)
        h5_file(folder / "other.hdf5", {"rewards": np.ones(20, np.float32)})
        layout = h5py.VirtualLayout((20,), np.float32)
        layout[rows] = h5py.VirtualSource(name, of, (20,), np.float32)[rows]
        file.create_virtual_dataset("rewards", layout)

    return make


def linked_source(file, folder):
    file["group/link"] = h5py.ExternalLink("other.hdf5", "rewards")
    virtual(".", "group/link")(file, folder)


def huge(rows):
    return lambda file, folder: file.create_dataset("rewards", (rows,), "f4", chunks=(16,))


def huge_everywhere(file, folder):
    for key in KEYS:
        width = {"observations": (7,), "next_observations": (7,), "actions": (2,)}.get(key, ())
        if key in file:
            del file[key]
        file.create_dataset(key, (10**10, *width), "f4", chunks=(16, *width))


HOSTILE = {
    "raw storage": (raw_file, "rewards: its values are stored outside the file"),
    "an external link": (external_link, "rewards: a link to another place"),
    "a soft link": (soft_link, "rewards: a link to another place"),
    "a virtual dataset of another file": (virtual("other.hdf5", "rewards"), "rewards: .* of another file"),
    "a virtual dataset of nothing": (virtual(".", "absent"), "rewards: its source absent is missing"),
    "a virtual dataset of a link": (linked_source, "rewards: a link to another place"),
    "a virtual dataset of itself": (virtual(".", "rewards"), "rewards: .* of virtual datasets"),
    "a short source": (virtual(".", "elsewhere", (19,)), "rewards: its source elsewhere is .* too short"),
    "rows without a source": (virtual(".", "elsewhere", rows=slice(0, 9)), "rewards: .* have no source"),
    "10^9 rows": (huge(10**9), r"rewards: shape \(1000000000,\)"),
    "2^62 rows": (huge(2**62), "rewards: shape"),
    "10^10 rows everywhere": (huge_everywhere, "file: declares .* cannot hold them"),
}


@pytest.mark.parametrize("make, message", HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_files_are_refused_before_anything_is_read(tmp_path, arrays, make, message, monkeypatch):
    path = h5_file(tmp_path / "bad.hdf5", {key: x for key, x in arrays.items() if key != "rewards"})
    with h5py.File(path, "r+") as file:
        make(file, tmp_path)
    monkeypatch.setattr(h5py.Dataset, "__getitem__", None)
    with refused(f"^{path}: {message}.*: [^:]+$"):
        read_dataset(path, "CarRun")


def test_a_filter_that_is_not_installed_is_named(tmp_path, arrays):
    path = h5_file(tmp_path / "packed.hdf5", {key: x for key, x in arrays.items() if key != "costs"})
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    creation.set_chunk((20,))
    creation.set_filter(32015, h5py.h5z.FLAG_OPTIONAL)
    with h5py.File(path, "r+") as file:
        space = h5py.h5s.create_simple((20,))
        h5py.h5d.create(file.id, b"costs", h5py.h5t.NATIVE_FLOAT, space, creation)
        file["costs"].id.write_direct_chunk((0,), b"packed by zstd")
    with refused(f"^{path}: costs: compressed with filter zstd .*32015.*: pip install hdf5plugin") as error:
        read_dataset(path, "CarRun")
    assert "delete" not in str(error)


HOLD = """
import sys, h5py
file = h5py.File(sys.argv[1], "r+")
print("open", flush=True)
sys.stdin.read()
"""


def test_a_file_in_use_is_not_called_damaged(tmp_path, dataset):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"open\n"
        with pytest.raises(
            DatasetError, match=f"^{path}: file: in use by another program: close it"
        ) as error:
            read_dataset(path, "CarRun")
        other.stdin.close()
    assert "delete" not in str(error.value)
    assert len(read_dataset(path, "CarRun")) == 20


def test_a_file_that_may_not_be_read_is_not_called_damaged(tmp_path, dataset, monkeypatch):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")

    def forbid(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(builtins, "open", forbid)  # the superuser may read every file
    with refused(f"^{path}: no permission to read it: "):
        read_dataset(path, "CarRun")


def test_too_little_memory_is_not_called_damage(tmp_path, dataset, monkeypatch):
    def read(*args):
        raise MemoryError

    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    monkeypatch.setattr(h5py.Dataset, "__getitem__", read)
    with refused(f"^{path}: observations: does not fit into memory: "):
        read_dataset(path, "CarRun")


def test_a_fifo_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with refused("pipe: no such file"):
        read_dataset(tmp_path / "pipe", "CarRun")


def test_a_flipped_bit_in_the_stored_values_is_noticed(tmp_path, dataset):
    """Also in chunks that gzip would unpack to other values, such as those that it stores as they are."""
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    whole = path.read_bytes()
    with h5py.File(path) as file:
        chunks = [file[key].id.get_chunk_info(0) for key in file if not file[key].is_virtual]
    for chunk in chunks:
        for place in range(chunk.byte_offset, chunk.byte_offset + chunk.size, 13):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
            with refused("truncated or damaged: delete it"):
                read_dataset(path, "CarRun")
