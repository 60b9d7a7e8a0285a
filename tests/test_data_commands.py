"""`c2iql data` as a student types it: what `check` prints, and how `convert` and `export` are called."""

import sys
import types

import h5py
import numpy as np
import pytest

from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.tasks import TASKS

T = TASKS["CarRun"].horizon
COSTS = (0, 5, 10, 11, 30)
RETURNS = (100.0, 91.0, 89.0, -20.0, 300.0)


@pytest.fixture
def dataset():
    """Five episodes of CarRun with known costs and returns."""
    states = np.random.default_rng(0).normal(size=(5, T + 1, 7)).cumsum(axis=1).astype(np.float32)
    step = np.arange(T)
    return Dataset(
        observations=states[:, :-1].reshape(-1, 7),
        next_observations=states[:, 1:].reshape(-1, 7),
        actions=np.zeros((5 * T, 2), np.float32),
        rewards=np.concatenate([np.where(step == 3, total, 0) for total in RETURNS]).astype(np.float32),
        costs=np.concatenate([step < cost for cost in COSTS]).astype(np.float32),
        terminals=np.zeros(5 * T, bool),
        timeouts=np.tile(step == T - 1, 5),
        attributes={"licence": "CC BY 4.0", "odd": "two\nlines \x1b[31m"},
    )


def rows_of(out):
    return [line.split() for line in out.splitlines()]


def test_check_describes_a_good_file(c2iql, tmp_path, dataset):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    status, out, err = c2iql("data", "check", path, "--task", "CarRun")
    assert status == 0 and "ERROR" not in out and "WARNING" not in out
    assert f"5 episodes, {5 * T} transitions, 0 terminals, 5 time limits" in out
    rows = rows_of(out)
    assert ["length", "200.0", "200.0", "200.0", "200.0"] in rows
    assert ["cost", "0.0", "10.0", "11.2", "30.0"] in rows  # min, median, mean, max
    assert ["return", "-20.0", "91.0", "112.0", "300.0"] in rows
    # Of limits 10, 20 and 40: the share of episodes within, the best return, and those from 90% of it.
    assert ["10", "60.0%", "100.0", "2"] in rows
    assert ["20", "80.0%", "100.0", "2"] in rows
    assert ["40", "100.0%", "300.0", "1"] in rows
    assert "licence: CC BY 4.0" in out and "task: CarRun" in out
    assert "odd: two lines  [31m" in out and "\x1b" not in out
    assert out.splitlines()[-1] == f"{path}: usable for CarRun, warnings: 0"


def test_check_lists_every_error_and_warning_and_fails(c2iql, tmp_path, dataset):
    path = write_dataset(tmp_path / "a.hdf5", dataset, "CarRun")
    with h5py.File(path, "r+") as file:
        file["costs"][4] = 3
        file["terminals"][T - 1] = True
        file["actions"][7] = 2
    status, out, err = c2iql("data", "check", path, "--task", "CarRun")
    assert (status, err) == (2, f"c2iql: {path}: not usable for CarRun: errors: 2\n")
    found = [line.split(": ") for line in out.splitlines() if line.startswith(("ERROR", "WARNING"))]
    kinds = [(line[0], line[1]) for line in found]
    error, warning = f"ERROR {path}", f"WARNING {path}"
    assert kinds == [(error, "terminals"), (error, "costs")] + [
        (warning, key) for key in ("terminals, timeouts", "actions")
    ]
    assert f"5 episodes, {5 * T} transitions" in out


def test_check_of_a_file_without_a_dataset(c2iql, tmp_path):
    (tmp_path / "page.hdf5").write_text("<html>")
    status, out, err = c2iql("data", "check", tmp_path / "page.hdf5", "--task", "CarRun")
    assert status == 2 and err.endswith("not usable for CarRun: errors: 1\n")
    assert out.startswith(f"ERROR {tmp_path}/page.hdf5: not an HDF5 file") and "episodes" not in out


def test_check_where_no_episode_keeps_a_limit(c2iql, tmp_path, dataset):
    path = write_dataset(tmp_path / "a.hdf5", dataset.select([4]), "CarRun")
    status, out, err = c2iql("data", "check", path, "--task", "CarRun")
    assert status == 0 and ["10", "0.0%", "NaN", "0"] in rows_of(out)


def test_check_of_an_unknown_task(c2iql, tmp_path):
    status, _, err = c2iql("data", "check", tmp_path / "a.hdf5", "--task", "CarRum")
    assert status == 2 and "unknown task 'CarRum': did you mean CarRun" in err


def test_convert_and_export_hand_their_arguments_on(c2iql, dataset, monkeypatch, tmp_path):
    called = []
    converting = types.ModuleType("tutorial_lib.data.convert")
    converting.convert = lambda *given: called.append(given) or dataset
    converting.export_minari = lambda *given: called.append(given)
    monkeypatch.setitem(sys.modules, converting.__name__, converting)
    monkeypatch.setattr("tutorial_lib.data.convert", converting, raising=False)
    source, out = tmp_path / "source", tmp_path / "out.hdf5"
    status, printed, _ = c2iql("data", "convert", source, "--out", out, "--task", "CarRun")
    assert status == 0 and printed == f"{out}: 5 episodes, {5 * T} transitions\n"
    status, _, err = c2iql("data", "export", out, "--task", "CarRun", "--minari", "carrun/mixed-v0")
    assert status == 0
    assert called == [(source, out, "CarRun"), (out, "CarRun", "carrun/mixed-v0")]


@pytest.mark.parametrize("command", ["check", "convert", "export"])
def test_every_command_has_help_for_its_arguments(c2iql, command):
    status, out, err = c2iql("data", command, "--help")
    assert status == 0 and f"usage: c2iql data {command}" in out and "PATH" in out and "--task" in out
    assert command in c2iql("data", "--help")[1]
