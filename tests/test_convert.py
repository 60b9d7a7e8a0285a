"""Recordings in other layouts: files that are written here by hand, and the arrays that they must give."""

import csv
import os
import pickle
import sys
import warnings
import zipfile

import h5py
import numpy as np
import pytest
from five_episodes import assert_same, h5_file, refused

from tutorial_lib.data.convert import convert, export_minari
from tutorial_lib.data.dataset import KEYS, Dataset
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.tasks import TASKS

EPISODES = {
    "BallRun": [(100, False)] * 12,
    "AntRun": [(200, False), (37, True), (1, True), (200, False), (200, True), (200, False)],
}
"""By task: the length of every episode, and whether the robot falls at its end."""


def make_episode(name, length, falls, rng):
    """A recording that is possible: states follow each other, and one flag stands at the end."""
    task = TASKS[name]
    states = rng.normal(size=(length + 1, task.obs_dim)).astype(np.float32)
    last = np.arange(length) == length - 1
    return {
        "observations": states[:-1],
        "next_observations": states[1:],
        "actions": rng.uniform(-1, 1, (length, task.act_dim)).astype(np.float32),
        "rewards": rng.normal(size=length).astype(np.float32),
        "costs": rng.integers(0, 2, length).astype(np.float32),
        "terminals": last & falls,
        "timeouts": last & (not falls),
    }


def make_episodes(name):
    rng = np.random.default_rng(7)
    return [make_episode(name, length, falls, rng) for length, falls in EPISODES[name]]


def together(episodes):
    return {key: np.concatenate([episode[key] for episode in episodes]) for key in KEYS}


def states_of(episode):
    return np.concatenate([episode["observations"], episode["next_observations"][-1:]])


def as_minari(path, episodes, reset_cost=True):
    """The file that Minari 0.5.4 writes, less attributes. `reset_cost`: infos have a row for the reset."""
    with h5py.File(path, "w") as file:
        for number, episode in enumerate(episodes):
            group = file.create_group(f"episode_{number}")
            group["observations"] = states_of(episode)
            group["actions"], group["rewards"] = episode["actions"], episode["rewards"]
            group["terminations"], group["truncations"] = episode["terminals"], episode["timeouts"]
            group["infos/cost"] = np.append([0.0], episode["costs"]) if reset_cost else episode["costs"]
    return path


def csv_rows(episode):
    """A header and T + 1 rows of text. Python's repr of a number is read back exactly."""
    obs, act = episode["observations"].shape[1], episode["actions"].shape[1]
    names = [f"action_{i}" for i in range(act)] + ["reward", "cost", "terminal", "timeout"]
    rows = [[f"obs_{i}" for i in range(obs)] + names]
    for t, state in enumerate(states_of(episode).tolist()):
        rest = [""] * len(names)
        if t < len(episode["rewards"]):
            rest = [*episode["actions"][t].tolist(), float(episode["rewards"][t]), int(episode["costs"][t])]
            rest += [int(episode["terminals"][t]), bool(episode["timeouts"][t])]  # both kinds of flags
        rows.append([str(value) for value in [*state, *rest]])
    return rows


def as_csv(path, rows):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows(rows)
    return path


def converted_quietly(source, out, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return convert(source, out, name)


def check(source, out, name, expected):
    """Conversion gives these arrays without a warning, and the file has them too."""
    assert_same(converted_quietly(source, out, name), expected)
    with h5py.File(out) as file:
        assert file.attrs["task"] == name
        for key, values in expected.items():
            np.testing.assert_array_equal(file[key], values, err_msg=key)


@pytest.mark.parametrize("name", EPISODES)
def test_dsrl_to_d4rl_to_dsrl(tmp_path, name):
    """Columns, float64, flags as uint8, costs under infos: all is taken, and every value is the same."""
    arrays = together(make_episodes(name))
    stored = {key: values.astype(np.float64) for key, values in arrays.items()}
    stored |= {key: arrays[key].astype(np.uint8)[:, None] for key in ("terminals", "timeouts")}
    stored |= {"rewards": stored["rewards"][:, None], "infos/cost": stored.pop("costs"), "infos/qpos": [b"x"]}
    check(h5_file(tmp_path / "a.hdf5", stored), tmp_path / "out.hdf5", name, arrays)
    plain = write_dataset(tmp_path / "dsrl.hdf5", Dataset(**arrays), name, {"seed": 3})
    check(plain, tmp_path / "same.hdf5", name, arrays)
    read = convert(plain, tmp_path / "same.hdf5", name)
    assert read.attributes == {"seed": 3, "task": name, "converted_from": "dsrl.hdf5"}


@pytest.mark.parametrize("reset_cost", [True, False])
@pytest.mark.parametrize("name", EPISODES)
def test_dsrl_to_a_minari_file_to_dsrl(tmp_path, name, reset_cost):
    """BallRun has 12 episodes: in the order of their names, episode_10 would come before episode_2."""
    episodes = make_episodes(name)
    (tmp_path / "set-v0" / "data").mkdir(parents=True)
    file = as_minari(tmp_path / "set-v0" / "data" / "main_data.hdf5", episodes, reset_cost)
    for source in (file, file.parent, file.parent.parent):
        check(source, tmp_path / "out.hdf5", name, together(episodes))


@pytest.mark.parametrize("name", EPISODES)
def test_dsrl_to_a_folder_of_episodes_to_dsrl(tmp_path, name):
    episodes = make_episodes(name)
    (folder := tmp_path / "episodes").mkdir()
    for number, episode in enumerate(episodes):
        if number % 2:
            np.savez(folder / f"run{number}.npz", **episode, positions=np.zeros(3))
        else:
            rows = csv_rows(episode)
            rows = [[*row[::-1], str(i)] for i, row in enumerate(rows)]  # another order, and one more column
            as_csv(folder / f"run{number}.csv", rows)
    (folder / "README.txt").write_text("not an episode")
    check(folder, tmp_path / "out.hdf5", name, together(episodes))


@pytest.mark.parametrize("name", EPISODES)
def test_dsrl_to_minari_to_dsrl(tmp_path, name, monkeypatch):
    minari = pytest.importorskip("minari", reason="the optional package minari is not installed")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    episodes = make_episodes(name)
    file = write_dataset(tmp_path / "a.hdf5", Dataset(**together(episodes)), name)
    export_minari(file, name, "group/mixed-v0")
    theirs = minari.load_dataset("group/mixed-v0")
    assert theirs.total_episodes == len(episodes) and theirs.observation_space.shape == (TASKS[name].obs_dim,)
    for read, episode in zip(theirs, episodes, strict=True):
        np.testing.assert_array_equal(read.observations, states_of(episode))
        np.testing.assert_array_equal(read.actions, episode["actions"])
        np.testing.assert_array_equal(read.terminations, episode["terminals"])
        np.testing.assert_array_equal(read.truncations, episode["timeouts"])
        np.testing.assert_array_equal(read.infos["cost"], np.append(0, episode["costs"]))
    check(tmp_path / "minari" / "group" / "mixed-v0", tmp_path / "out.hdf5", name, together(episodes))

    with refused("^group/mixed-v0: .* exists: delete it"):
        export_minari(file, name, "group/mixed-v0")
    with refused("^../out-v0: not an id of Minari: write"):
        export_minari(file, name, "../out-v0")
    other = together(episodes)
    other["next_observations"][4] += 1
    file = h5_file(tmp_path / "other.hdf5", other)
    with refused(f"^{file}: next_observations: that of row 4 is not the next row's observation: Minari"):
        with warnings.catch_warnings(action="ignore"):
            export_minari(file, name, "group/other-v0")
    assert not (tmp_path / "minari" / "group" / "other-v0").exists() and not (tmp_path / "out-v0").exists()


def test_a_failed_export_leaves_no_half_dataset(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari", reason="the optional package minari is not installed")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    file = write_dataset(tmp_path / "a.hdf5", Dataset(**together(make_episodes("BallRun"))), "BallRun")

    def full(*args, **kwargs):
        raise OSError("No space left on device")

    monkeypatch.setattr(minari.dataset._storages.hdf5_storage, "_add_episode_to_group", full)
    with pytest.raises(OSError, match="No space"):
        export_minari(file, "BallRun", "mixed-v0")
    assert os.listdir(tmp_path / "minari") == []


def test_without_minari_the_message_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with refused("^mixed-v0: the package minari is missing: .*pip install 'minari"):
        export_minari(tmp_path / "a.hdf5", "BallRun", "mixed-v0")


@pytest.mark.parametrize("layout", ["minari", "folder"])
def test_episodes_that_were_cut_off_are_dropped_and_counted(tmp_path, layout):
    episodes = make_episodes("AntRun")
    for cut in (0, 3):
        episodes[cut]["terminals"][-1] = episodes[cut]["timeouts"][-1] = False
    if layout == "minari":
        source = as_minari(tmp_path / "a.hdf5", episodes)
    else:
        (source := tmp_path / "folder").mkdir()
        for number, episode in enumerate(episodes):
            as_csv(source / f"{number}.csv", csv_rows(episode))
    with pytest.warns(UserWarning, match=f"{source}: .*dropped 2 of 6 episodes"):
        data = convert(source, tmp_path / "out.hdf5", "AntRun")
    assert_same(data, together([episodes[i] for i in (1, 2, 4, 5)]))


def test_an_unfinished_tail_is_dropped_and_counted(tmp_path):
    arrays = together(make_episodes("AntRun"))
    arrays["timeouts"][-1] = False  # the last episode, of 200 steps, no longer ends
    path = h5_file(tmp_path / "a.hdf5", arrays)
    with pytest.warns(UserWarning, match=f"{path}: unfinished tail: dropped 200 of 838 transitions"):
        data = convert(path, tmp_path / "out.hdf5", "AntRun")
    assert_same(data, arrays, rows=slice(0, 638))


@pytest.mark.parametrize("name, limited", [("BallRun", 12), ("AntRun", 3)])
def test_missing_timeouts_are_inferred_from_the_horizon(tmp_path, name, limited):
    arrays = together(make_episodes(name))
    path = h5_file(tmp_path / "a.hdf5", {key: arrays[key] for key in KEYS if key != "timeouts"})
    said = f"{path}: timeouts: missing: {limited} episodes are taken to end after {TASKS[name].horizon} steps"
    with pytest.warns(UserWarning, match=said):
        data = convert(path, tmp_path / "out.hdf5", name)
    assert_same(data, arrays)


def test_missing_timeouts_are_not_guessed(tmp_path):
    rng = np.random.default_rng(1)
    short = together([make_episode("BallRun", length, False, rng) for length in (100, 60, 140)])
    del short["timeouts"]
    with refused(
        "timeouts: missing, and the next observation of row 159 is not the next row's: .*add the key"
    ):
        convert(h5_file(tmp_path / "short.hdf5", short), tmp_path / "out.hdf5", "BallRun")
    long = make_episode("BallRun", 200, False, rng)
    del long["timeouts"]
    with refused("timeouts: missing, and the next observation of row 99 is the next row's: .*add the key"):
        convert(h5_file(tmp_path / "long.hdf5", long), tmp_path / "out.hdf5", "BallRun")
    del short["next_observations"]
    cut = {key: values[:270] for key, values in short.items()}
    with refused("timeouts: missing, and the last 70 rows end nowhere: .*add the key timeouts"):
        convert(h5_file(tmp_path / "cut.hdf5", cut), tmp_path / "out.hdf5", "BallRun")
    assert not (tmp_path / "out.hdf5").exists()


@pytest.mark.parametrize("timeouts", ["recorded", "missing"])
@pytest.mark.parametrize("name, limited", [("BallRun", 12), ("AntRun", 3)])
def test_missing_next_observations_cost_a_time_limited_episode_its_last_step(
    tmp_path, name, limited, timeouts
):
    episodes = make_episodes(name)
    missing = ("next_observations", "timeouts") if timeouts == "missing" else ("next_observations",)
    stored = {key: values for key, values in together(episodes).items() if key not in missing}
    path = h5_file(tmp_path / "a.hdf5", stored)
    with pytest.warns(UserWarning, match=f"next_observations: missing: dropped the last step of {limited} "):
        data = convert(path, tmp_path / "out.hdf5", name)
    expected = []
    for episode in episodes:
        if episode["timeouts"][-1]:
            episode = {key: values[:-1].copy() for key, values in episode.items()}
            episode["timeouts"][-1] = True
        else:
            episode["next_observations"][-1] = episode["observations"][-1].copy()
        expected.append(episode)
    assert_same(data, together(expected))


def test_missing_next_observations_of_episodes_of_one_step(tmp_path):
    """Nothing is left of one that a time limit ended, and its neighbours stay as they are."""
    rng = np.random.default_rng(2)
    kinds = [(5, True), (1, False), (1, False), (3, False), (1, False), (2, True)]
    episodes = [make_episode("AntRun", length, falls, rng) for length, falls in kinds]
    stored = {key: values for key, values in together(episodes).items() if key != "next_observations"}
    with pytest.warns(UserWarning, match="dropped the last step of 4 episodes"):
        data = convert(h5_file(tmp_path / "a.hdf5", stored), tmp_path / "out.hdf5", "AntRun")
    assert list(data.episode_lengths) == [5, 2, 2]
    rows = [0, 1, 2, 3, 4, 7, 8, 11, 12]
    np.testing.assert_array_equal(data.observations, stored["observations"][rows])
    assert list(np.flatnonzero(data.timeouts)) == [6] and list(np.flatnonzero(data.terminals)) == [4, 8]
    one = {key: values[5:6] for key, values in stored.items()}
    with refused("next_observations: missing, and no episode has two steps"):
        convert(h5_file(tmp_path / "one.hdf5", one), tmp_path / "one_out.hdf5", "AntRun")


def replaced(key, row, value):
    def harm(arrays):
        values = arrays[key].astype(np.float64)
        values[row] = value
        arrays[key] = values

    return harm


BAD_ARRAYS = {
    "no costs": (lambda a: a.pop("infos/cost"), r"costs \(or infos/cost\): missing"),
    "no rewards, no terminals": (
        lambda a: (a.pop("rewards"), a.pop("terminals")),
        "rewards, terminals: miss",
    ),
    "another task": (lambda a: a.update(actions=a["actions"][:, :1]), r"actions: .*\(1200, 1\).*\(1200, 2\)"),
    "short": (lambda a: a.update(rewards=a["rewards"][:-1]), r"rewards: .*\(1199,\).*\(1200,\) for BallRun"),
    "text": (lambda a: a.update(rewards=[b"x"] * 1200), r"rewards: \S+ is not a number"),
    "NaN": (replaced("observations", (205, 3), np.nan), "observations: NaN or infinity in row 205"),
    "too large": (replaced("rewards", 7, 1e300), "rewards: NaN or infinity in row 7"),
    "half a flag": (replaced("timeouts", 8, 0.5), "timeouts: neither 0 nor 1 in row 8"),
    "NaN flag": (replaced("terminals", 9, np.nan), "terminals: neither 0 nor 1 in row 9"),
    "no ends": (replaced("timeouts", slice(None), 0), "terminals, timeouts: none of 1200 rows"),
    "too long": (replaced("timeouts", 99, 0), "not converted: .*timeouts: .*200 steps"),
    "negative cost": (replaced("infos/cost", 5, -1), "not converted: .*costs: .*row 5"),
    "no rows": (lambda a: a.update({k: v[:0] for k, v in a.items()}), "terminals, timeouts: none of 0 rows"),
    "a scalar": (lambda a: a.update(observations=1.0), r"observations: .* shape \(\)"),
}


@pytest.mark.parametrize("harm, message", BAD_ARRAYS.values(), ids=BAD_ARRAYS.keys())
def test_bad_d4rl_files_are_refused_in_one_line(tmp_path, harm, message):
    arrays = together(make_episodes("BallRun"))
    arrays["infos/cost"] = arrays.pop("costs")
    harm(arrays)
    (out := tmp_path / "out.hdf5").write_text("old")
    path = h5_file(tmp_path / "bad.hdf5", arrays)
    with refused(f"^{path}: {message}.*: .+"):
        convert(path, out, "BallRun")
    assert out.read_text() == "old"


def change_group(name, value):
    def harm(file):
        del file[name]
        if value is not None:
            file[name] = value(file) if callable(value) else value

    return harm


BAD_EPISODES = {
    "no costs": (change_group("episode_3/infos", None), "episode_3: infos/cost: missing"),
    "T observations": (
        change_group("episode_2/observations", np.zeros((100, 7))),
        r"episode_2: observations: shape \(100, 7\), but rewards \(100,\): T steps have T \+ 1",
    ),
    "a space of parts": (
        change_group("episode_1/observations", lambda file: file["episode_1/infos"]),
        "episode_1: observations: missing",
    ),
    "a flag inside": (
        lambda file: file["episode_4/terminations"].write_direct(np.arange(100) == 50),
        "episode_4: terminals, timeouts: row 50 ends the episode, but 49 rows follow",
    ),
    "costs too short": (change_group("episode_0/infos/cost", np.zeros(99)), r"episode_0: costs: .*\(99,\)"),
    "all cut off": (
        lambda file: [file[f"{name}/truncations"].write_direct(np.zeros(100, bool)) for name in file],
        "terminals, timeouts: none of 12 episodes ends with a flag",
    ),
}


@pytest.mark.parametrize("harm, message", BAD_EPISODES.values(), ids=BAD_EPISODES.keys())
def test_bad_minari_files_are_refused_in_one_line(tmp_path, harm, message):
    path = as_minari(tmp_path / "main_data.hdf5", make_episodes("BallRun"))
    with h5py.File(path, "r+") as file:
        harm(file)
    with refused(f"^{path}: {message}.*: .+"):
        convert(path, tmp_path / "out.hdf5", "BallRun")


def put(line, column, text):
    def harm(rows):
        rows[line - 1][column] = text

    return harm


BAD_ROWS = {
    "text": (put(7, 3, "fast"), "line 7, column obs_3: 'fast' is not a number"),
    "NaN": (put(8, 9, "nan"), "line 8, column reward: 'nan' is not a number"),
    "an empty field": (put(9, 7, ""), "line 9, column action_0: '' is not a number"),
    "cut in a row": (
        lambda rows: rows.__setitem__(slice(49, None), [rows[49][:5]]),
        "line 50, column obs_5: 5",
    ),
    "cut after a row": (
        lambda rows: rows.__delitem__(slice(60, None)),
        "line 60, column action_0: the last row",
    ),
    "no last observation": (lambda rows: rows.pop(), "line 101, column action_0: the last row"),
    "a field too many": (lambda rows: rows[4].append("0"), "line 5, column after the last: 14 fields"),
    "a column less": (lambda rows: [row.pop(10) for row in rows], "line 1, column cost: must be there once"),
    "a column twice": (put(1, 10, "reward"), "line 1, column reward: must be there once"),
    "an observation more": (
        lambda rows: [row.append("obs_7" if row is rows[0] else "0") for row in rows],
        "line 1, column obs_7: BallRun has none",
    ),
    "only a header": (lambda rows: rows.__delitem__(slice(1, None)), "line 1, column action_0: the last row"),
    "nothing": (lambda rows: rows.clear(), "line 1, column obs_0: must be there once"),
    "a flag inside": (put(31, 11, "1"), "terminals, timeouts: row 29 ends the episode, but 70 rows follow"),
}


@pytest.mark.parametrize("harm, message", BAD_ROWS.values(), ids=BAD_ROWS.keys())
def test_bad_csv_files_are_refused_with_their_line_and_column(tmp_path, harm, message):
    (folder := tmp_path / "folder").mkdir()
    episode = make_episodes("BallRun")[0]
    as_csv(folder / "good.csv", csv_rows(episode))
    rows = csv_rows(episode)
    harm(rows)
    path = as_csv(folder / "bad.csv", rows)
    with refused(f"^{path}: {message}"):
        convert(folder, tmp_path / "out.hdf5", "BallRun")


def test_a_csv_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\x01")
    with refused(f"^{tmp_path / 'a.csv'}: not a CSV file in UTF-8"):
        convert(tmp_path, tmp_path / "out.hdf5", "BallRun")


class Touch:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("kind", ["an array of objects", "only a pickle", "a pickle in a zip file"])
def test_pickles_are_not_loaded(tmp_path, kind):
    (folder := tmp_path / "folder").mkdir()
    episode, path = make_episodes("BallRun")[0], folder / "a.npz"
    trap = Touch(tmp_path / "loaded")
    if kind == "an array of objects":
        np.savez(path, allow_pickle=True, **episode | {"rewards": np.array([trap] * 100)})
    elif kind == "only a pickle":
        path.write_bytes(pickle.dumps(trap))
    else:
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("observations.npy", pickle.dumps(trap))
    with refused(f"^{path}: "):
        convert(folder, tmp_path / "out.hdf5", "BallRun")
    assert not (tmp_path / "loaded").exists()


def test_bad_npz_files_are_refused_in_one_line(tmp_path):
    episode, path = make_episodes("BallRun")[0], tmp_path / "a.npz"
    np.savez(path, **{key: values for key, values in episode.items() if key != "costs"})
    with refused(f"^{path}: costs .*: missing"):
        convert(tmp_path, tmp_path / "out.hdf5", "BallRun")
    np.savez_compressed(path, **episode)
    whole = path.read_bytes()
    for content in (whole[:-30], whole[:300] + b"\xff" * 50 + whole[350:], b"", b"text"):
        path.write_bytes(content)
        with refused(f"^{path}: not an npz file"):
            convert(tmp_path, tmp_path / "out.hdf5", "BallRun")


def link(file, name, other):
    file[name] = h5py.ExternalLink(other.name, name)


def soft_link(file, name, other):
    file["elsewhere"] = h5py.ExternalLink(other.name, name)
    file[name] = h5py.SoftLink("/elsewhere")


def external_storage(file, name, other):
    with h5py.File(other) as values:
        raw = other.with_suffix(".raw")
        raw.write_bytes(values[name][()].tobytes())
        shape, dtype = values[name].shape, values[name].dtype
    file.create_dataset(name, shape, dtype, external=[(str(raw), 0, h5py.h5f.UNLIMITED)])


def virtual(file, name, other):
    with h5py.File(other) as values:
        layout = h5py.VirtualLayout(values[name].shape, values[name].dtype)
        layout[:] = h5py.VirtualSource(values[name])
    file.create_virtual_dataset(name, layout)


@pytest.mark.parametrize("refer", [link, soft_link, external_storage, virtual])
@pytest.mark.parametrize("layout", ["d4rl", "minari"])
def test_values_in_other_files_are_not_read(tmp_path, layout, refer):
    """Each of these files is complete where the references are followed."""
    episodes = make_episodes("BallRun")
    path, other = tmp_path / "a.hdf5", tmp_path / "other.hdf5"
    arrays = {key: values for key, values in together(episodes).items() if key != "timeouts"}
    for file in (path, other):
        as_minari(file, episodes) if layout == "minari" else h5_file(file, arrays)
    name = "episode_1/rewards" if layout == "minari" else "rewards"
    with h5py.File(path, "r+") as file:
        del file[name]
        refer(file, name, other)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file[name][:100], episodes[1 if layout == "minari" else 0]["rewards"])
    with refused(f"^{path}: {name}: a reference to another place: store the values"):
        convert(path, tmp_path / "out.hdf5", "BallRun")


def test_a_linked_group_is_not_followed(tmp_path):
    other = as_minari(tmp_path / "other.hdf5", make_episodes("BallRun"))
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["episode_0"] = h5py.ExternalLink(other.name, "episode_0")
    with refused("episode_0/observations: a reference to another place"):
        convert(tmp_path / "a.hdf5", tmp_path / "out.hdf5", "BallRun")


def test_arrays_that_would_fill_the_memory_are_not_read(tmp_path):
    path = h5_file(tmp_path / "a.hdf5", together(make_episodes("BallRun")))
    with h5py.File(path, "r+") as file:
        del file["costs"], file["rewards"]
        file.create_dataset("rewards", (10**14,), np.float32, chunks=True)  # takes no space in the file
    with refused(f"^{path}: rewards: .* is more than the file can hold"):
        convert(path, tmp_path / "out.hdf5", "BallRun")


def test_other_sources_are_refused_in_one_line(tmp_path):
    out = tmp_path / "out.hdf5"
    with refused(f"^{tmp_path / 'none'}: no such file or folder: check"):
        convert(tmp_path / "none", out, "BallRun")
    with refused(f"^{tmp_path}: no CSV or npz files, and no main_data.hdf5"):
        convert(tmp_path, out, "BallRun")
    (tmp_path / "a.hdf5").write_text("<html>Not found</html>")
    with refused(f"^{tmp_path / 'a.hdf5'}: not an HDF5 file, truncated or damaged"):
        convert(tmp_path / "a.hdf5", out, "BallRun")
    path = h5_file(tmp_path / "b.hdf5", together(make_episodes("BallRun")))
    with refused(f"^{path}: is also the result: choose another name"):
        convert(path, path, "BallRun")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with refused(f"^{path}: not an HDF5 file, truncated or damaged"):
        convert(path, out, "BallRun")
    assert not out.exists()


def test_a_file_that_says_that_it_is_of_another_task_is_refused(tmp_path):
    path = h5_file(tmp_path / "a.hdf5", together(make_episodes("BallRun")), task="BallRun")
    with refused(f"^{path}: .*BallRun, not CarRun"):
        convert(path, tmp_path / "out.hdf5", "CarRun")
