"""Datasets against oracles that share no code with them: slow loops, h5py by hand, sha256sum, a real server.

What the loader of the PyPI package `dsrl` 0.1.0 does is replayed in `dsrl_loads` below.
"""

import contextlib
import errno
import hashlib
import http.server
import os
import shutil
import signal
import subprocess
import threading
import time

import h5py
import numpy as np
import pooch
import pytest
import torch

from tutorial_lib.data import sources
from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError, sample_batch
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.tasks import TASKS

CAR_RUN = TASKS["CarRun"]
LENGTHS = (5, 1, 7, 3, 4)
FALLS = (1, 3)  # the episodes that end in a terminal; the others reach the time limit


@pytest.fixture
def arrays():
    """Five episodes with CarRun's dimensions, as a plain dict. The costs are not all 0 or 1."""
    rng = np.random.default_rng(0)
    rows = sum(LENGTHS)
    last = np.cumsum(LENGTHS) - 1
    terminals = np.zeros(rows, bool)
    terminals[last[list(FALLS)]] = True
    timeouts = np.zeros(rows, bool)
    timeouts[np.delete(last, FALLS)] = True
    return {
        "observations": rng.normal(size=(rows, 7)).astype(np.float32),
        "next_observations": rng.normal(size=(rows, 7)).astype(np.float32),
        "actions": rng.uniform(-1, 1, size=(rows, 2)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "costs": rng.choice([0, 0, 1, 2.5], size=rows).astype(np.float32),
        "terminals": terminals,
        "timeouts": timeouts,
    }


@pytest.fixture
def dataset(arrays):
    return Dataset(**arrays, attributes={"seed": 3})


def h5_file(path, arrays, **attributes):
    """A file written by hand."""
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes)
        for key, values in arrays.items():
            file[key] = values
    return path


def episodes_by_loop(arrays):
    """The rows of each episode, found one transition at a time."""
    episodes, current = [], []
    for row in range(len(arrays["rewards"])):
        current.append(row)
        if arrays["terminals"][row] or arrays["timeouts"][row]:
            episodes.append(current)
            current = []
    return episodes


def assert_same(dataset, arrays, rows=slice(None)):
    for key, values in arrays.items():
        np.testing.assert_array_equal(getattr(dataset, key), values[rows], err_msg=key)


@contextlib.contextmanager
def refused(message):
    """Expects a DatasetError of one line that matches."""
    with pytest.raises(DatasetError, match=message) as error:
        yield
    assert "\n" not in str(error.value)


# --- A dataset in memory ---


def test_episodes_agree_with_a_slow_loop(dataset, arrays):
    episodes = episodes_by_loop(arrays)
    assert [len(rows) for rows in episodes] == list(LENGTHS)  # the oracle itself
    assert len(dataset) == sum(LENGTHS) and dataset.num_episodes == len(episodes)
    assert list(dataset.starts) == [rows[0] for rows in episodes]
    assert list(dataset.ends) == [rows[-1] + 1 for rows in episodes]
    assert list(dataset.episode_lengths) == list(LENGTHS)
    returns = [sum(float(arrays["rewards"][row]) for row in rows) for rows in episodes]
    costs = [sum(float(arrays["costs"][row]) for row in rows) for rows in episodes]
    np.testing.assert_allclose(dataset.episode_returns, returns, rtol=1e-12)
    np.testing.assert_allclose(dataset.episode_costs, costs, rtol=1e-12)
    assert [list(np.flatnonzero(dataset.episode_index == i)) for i in range(5)] == episodes


def test_sums_do_not_lose_what_float32_loses():
    """2**24 + 1 is not a float32: sums of many steps need float64."""
    rewards = np.array([2**24, 1], np.float32)
    column = np.zeros((2, 1), np.float32)
    data = Dataset(column, column, column, rewards, rewards, np.zeros(2, bool), np.array([False, True]))
    assert data.episode_returns.tolist() == data.episode_costs.tolist() == [2**24 + 1]


@pytest.mark.parametrize("wanted", [[3, 0], [-1], np.array([False, True, True, False, False])])
def test_select_keeps_whole_episodes_in_the_order_given(dataset, arrays, wanted):
    episodes = episodes_by_loop(arrays)
    indices = [i for i in range(5) if wanted[i]] if isinstance(wanted, np.ndarray) else wanted
    chosen = dataset.select(wanted)
    assert_same(chosen, arrays, rows=[row for i in indices for row in episodes[i]])
    assert chosen.num_episodes == len(indices) and chosen.attributes == {"seed": 3}


def test_select_of_nothing_is_an_error(dataset):
    with pytest.raises(DatasetError, match="none of 5 episodes"):
        dataset.select(dataset.episode_costs > 1e9)


def test_a_dataset_ends_with_an_episode(arrays):
    with pytest.raises(DatasetError, match="whole episodes"):
        Dataset(**{key: values[:-1] for key, values in arrays.items()})
    with pytest.raises(DatasetError, match="whole episodes"):
        Dataset(**{key: values[:0] for key, values in arrays.items()})


def test_tensors_hold_the_arrays_and_are_a_copy(dataset, arrays):
    before = {key: values.copy() for key, values in arrays.items()}
    batch = dataset.tensors()
    assert set(batch._fields) == set(arrays)
    for key in arrays:
        tensor = getattr(batch, key)
        assert tensor.dtype == torch.float32 and tensor.shape == arrays[key].shape
        np.testing.assert_array_equal(tensor.numpy(), arrays[key].astype(np.float32))
        tensor.fill_(-9)
    assert_same(dataset, before)


def test_sampled_rows_belong_together_and_are_uniform(dataset):
    data = dataset.tensors()._replace(rewards=torch.arange(20.0))  # a reward now names its row
    batch = sample_batch(data, 20_000, torch.Generator().manual_seed(0))
    rows = batch.rewards.long()
    for values, all_values in zip(batch, data, strict=True):
        assert torch.equal(values, all_values[rows])
    counts = torch.bincount(rows, minlength=20)
    assert counts.min() > 850 and counts.max() < 1150  # 1000 expected, standard deviation 31


def test_sampling_depends_on_the_generator_alone(dataset):
    data = dataset.tensors()
    draw = lambda seed: sample_batch(data, 8, torch.Generator().manual_seed(seed))  # noqa: E731
    torch.manual_seed(1)
    first = draw(0)
    torch.manual_seed(2)
    assert torch.equal(first.observations, draw(0).observations)
    assert not torch.equal(first.observations, draw(1).observations)


# --- Files ---


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


# --- Where datasets are ---


@pytest.fixture
def places(tmp_path, monkeypatch):
    """(the shipped data's folder, DSRL's folder), both empty."""
    shipped, dsrl = tmp_path / "data", tmp_path / "dsrl"
    shipped.mkdir(), dsrl.mkdir()
    monkeypatch.setattr(sources, "SHIPPED_DATA", shipped)
    monkeypatch.setenv("DSRL_DATASET_DIR", str(dsrl))
    return shipped, dsrl


def test_each_source_is_its_own_and_shipped_is_the_default(places, dataset, tmp_path):
    shipped, dsrl = places
    write_dataset(shipped / "CarRun.hdf5", dataset.select([0]), "CarRun")
    write_dataset(dsrl / "SafetyCarRun-v0-40-651.hdf5", dataset.select([0, 1]), "CarRun")
    elsewhere = write_dataset(tmp_path / "mine.hdf5", dataset.select([0, 1, 2]), "CarRun")
    load = lambda *source: sources.load_dataset("CarRun", *source).num_episodes  # noqa: E731
    assert [load(), load("shipped"), load("dsrl"), load(elsewhere), load(str(elsewhere))] == [1, 1, 2, 3, 3]


def test_no_source_stands_in_for_another(places, dataset, tmp_path):
    shipped, dsrl = places
    write_dataset(dsrl / CAR_RUN.dsrl_file, dataset, "CarRun")
    write_dataset(shipped / "BallRun.hdf5", dataset, "BallRun")
    for task, source, looked in (
        ("CarRun", "shipped", shipped / "CarRun.hdf5"),
        ("BallRun", "dsrl", dsrl / TASKS["BallRun"].dsrl_file),
        ("CarRun", tmp_path / "absent.hdf5", tmp_path / "absent.hdf5"),
    ):
        with refused(f"^{looked}: .*c2iql fetch {task}`"):
            sources.find_dataset(task, source)


def test_dsrl_keeps_its_files_under_home_unless_told_otherwise(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("DSRL_DATASET_DIR", raising=False)
    assert sources.dsrl_directory() == tmp_path / ".dsrl" / "datasets"
    monkeypatch.setenv("DSRL_DATASET_DIR", "~/elsewhere")
    assert sources.dsrl_directory() == tmp_path / "elsewhere"


def test_the_shipped_data_lie_beside_the_package():
    assert sources.SHIPPED_DATA.parent.joinpath("tutorial_lib", "config.py").is_file()


# --- Fetching ---


class Server(http.server.ThreadingHTTPServer):
    """Serves `body` as CarRun's file; its first `breaks` answers stop half-way. Says no length if `mute`."""

    body, breaks, mute, requests = b"", 0, False, 0


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        server = self.server
        server.requests += 1
        if self.path != f"/files/{CAR_RUN.dsrl_file}":
            return self.send_error(404)
        broken = server.requests <= server.breaks
        self.send_response(200)
        if not server.mute:
            self.send_header("Content-Length", str(len(server.body)))
        self.end_headers()
        self.wfile.write(server.body[: len(server.body) // 2] if broken else server.body)

    def log_message(self, *args):
        pass


@pytest.fixture
def server(tmp_path_factory, dataset, monkeypatch):
    """A server on localhost, and its address in `.url`. Nobody waits before another try."""
    monkeypatch.setattr(pooch.core.time, "sleep", lambda seconds: None)
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "127.0.0.1")
    file = write_dataset(tmp_path_factory.mktemp("served") / "served.hdf5", dataset, "CarRun")
    server = Server(("127.0.0.1", 0), Handler)
    server.body = file.read_bytes()
    server.url = f"http://127.0.0.1:{server.server_port}/files/"
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


def fetch(server, directory, task="CarRun"):
    return sources.fetch_dataset(task, directory, server.url)


@pytest.mark.parametrize("breaks", [0, 1, 2])
def test_fetch_survives_broken_connections(server, tmp_path, capsys, breaks):
    server.breaks = breaks
    path = fetch(server, tmp_path / "new")
    assert server.requests == breaks + 1
    assert path == tmp_path / "new" / CAR_RUN.dsrl_file and path.read_bytes() == server.body
    assert sorted(os.listdir(path.parent)) == [path.name, f"{path.name}.sha256"]
    shown = capsys.readouterr()
    assert f"{len(server.body):,} bytes, SHA-256 {hashlib.sha256(server.body).hexdigest()}" in shown.out
    assert "100%" in shown.err  # the progress bar


def test_fetch_goes_to_dsrls_folder_and_its_file_is_found(server, places, dataset):
    assert sources.fetch_dataset("CarRun", base_url=server.url).parent == places[1]
    assert sources.load_dataset("CarRun", "dsrl").num_episodes == dataset.num_episodes


@pytest.mark.skipif(not shutil.which("sha256sum"), reason="needs sha256sum")
def test_the_checksum_is_in_sha256sums_format(server, tmp_path):
    path = fetch(server, tmp_path)
    check = ["sha256sum", "--check", f"{path.name}.sha256"]
    assert subprocess.run(check, cwd=tmp_path, capture_output=True).returncode == 0
    with open(path, "ab") as file:
        file.write(b"!")
    assert subprocess.run(check, cwd=tmp_path, capture_output=True).returncode == 1


@pytest.mark.parametrize("mute", [False, True], ids=["length known", "length unknown"])
def test_fetch_gives_up_and_leaves_nothing(server, tmp_path, mute):
    server.breaks, server.mute = 99, mute
    with refused("not kept: .*file: truncated" if mute else f"^{server.url}.*: no connection, or it broke"):
        fetch(server, tmp_path)
    assert os.listdir(tmp_path) == []
    assert server.requests == (1 if mute else 3)


def test_a_second_fetch_verifies_and_downloads_nothing(server, tmp_path):
    path = fetch(server, tmp_path)
    assert fetch(server, tmp_path) == path and server.requests == 1
    with open(path, "ab") as file:
        file.write(b"!")
    digests = [hashlib.sha256(content).hexdigest() for content in (server.body + b"!", server.body)]
    with refused(f"^{path}: SHA-256 is {digests[0]}, but was {digests[1]} when first fetched"):
        fetch(server, tmp_path)
    assert path.read_bytes() == server.body + b"!"  # the user's file is the user's


def test_a_checksum_that_a_full_disk_cut_short_is_written_anew(server, tmp_path):
    path = fetch(server, tmp_path)
    memory = path.with_name(f"{path.name}.sha256")
    whole = memory.read_text()
    memory.write_text("")
    assert fetch(server, tmp_path) == path and server.requests == 1 and memory.read_text() == whole


def test_a_server_that_changed_its_file_is_noticed(server, tmp_path, dataset):
    path = fetch(server, tmp_path)
    path.unlink()
    other = write_dataset(tmp_path / "other.hdf5", dataset.select([0]), "CarRun")
    server.body = other.read_bytes()
    with refused(f"^{path}: what {server.url} sent is wrong, and not kept: .*SHA-256 is"):
        fetch(server, tmp_path)
    assert not path.exists()
    path.with_name(f"{path.name}.sha256").unlink()  # what the error says accepts it
    assert fetch(server, tmp_path).read_bytes() == server.body


def test_a_file_that_was_there_before_is_kept_and_remembered(server, tmp_path, dataset):
    path = write_dataset(tmp_path / CAR_RUN.dsrl_file, dataset.select([1, 2]), "CarRun")
    before = path.read_bytes()
    assert fetch(server, tmp_path) == path and server.requests == 0 and path.read_bytes() == before
    assert path.with_name(f"{path.name}.sha256").read_text().startswith(hashlib.sha256(before).hexdigest())


def test_a_page_instead_of_the_file_is_not_kept(server, tmp_path):
    server.body = b"<html>Please log in</html>"
    with refused("not an HDF5 file"):
        fetch(server, tmp_path)
    assert os.listdir(tmp_path) == []


def test_what_a_killed_fetch_left_is_dropped(server, tmp_path):
    leftover = tmp_path / f".{CAR_RUN.dsrl_file}.partial"
    leftover.mkdir()
    (leftover / CAR_RUN.dsrl_file).write_bytes(server.body[:-10])
    assert fetch(server, tmp_path).read_bytes() == server.body
    assert not leftover.exists()


def test_a_file_that_the_server_lacks(server, tmp_path):
    with refused(f"^{server.url}{TASKS['BallRun'].dsrl_file}: the server said 404 Not Found"):
        fetch(server, tmp_path, "BallRun")
    assert os.listdir(tmp_path) == []


def test_no_network(server, tmp_path):
    server.url = server.url.replace(str(server.server_port), "1")
    with refused(f"^{server.url}{CAR_RUN.dsrl_file}: no connection"):
        fetch(server, tmp_path)


def test_a_full_disk(server, tmp_path, monkeypatch):
    def write(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(pooch.HTTPDownloader, "__call__", write)
    with refused(f"^{tmp_path}: No space left on device: make room"):
        fetch(server, tmp_path)
    assert os.listdir(tmp_path) == []


# --- Checksum ---


def test_a_checksum_is_of_the_values_and_not_of_the_file(arrays, tmp_path):
    digest = hashlib.sha256()
    for key in KEYS:
        digest.update(arrays[key].tobytes())
    plain = h5_file(tmp_path / "plain.hdf5", arrays)
    packed = write_dataset(tmp_path / "packed.hdf5", Dataset(**arrays), CAR_RUN, {"seed": 4})
    assert plain.read_bytes() != packed.read_bytes()
    assert read_dataset(plain, CAR_RUN).checksum == read_dataset(packed, CAR_RUN).checksum
    assert read_dataset(plain, CAR_RUN).checksum == digest.hexdigest()
    for key in KEYS:
        changed = arrays | {key: arrays[key].copy()}
        changed[key][0] = 1 - changed[key][0] if changed[key].dtype != bool else ~changed[key][0]
        assert Dataset(**changed).checksum != digest.hexdigest(), key
