"""Five short episodes with CarRun's dimensions, and what tests of datasets and of their files share."""

import contextlib
import dataclasses

import h5py
import numpy as np
import pytest

from tutorial_lib.data.dataset import DatasetError
from tutorial_lib.tasks import TASKS

LENGTHS = (5, 1, 5, 4, 5)
FALLS = (1, 3)  # the episodes that end in a terminal; the others reach the time limit
SHORT_TASKS = {
    name: dataclasses.replace(TASKS[name], horizon=5, terminates=True) for name in ("CarRun", "BallRun")
}
"""Both tasks with these dimensions, but of five steps and with a robot that can fall, as in the episodes."""


def make_arrays():
    """Five episodes with CarRun's dimensions, as a plain dict."""
    rng = np.random.default_rng(0)
    rows = sum(LENGTHS)
    states = [rng.normal(size=(length + 1, 7)).astype(np.float32) for length in LENGTHS]
    last = np.cumsum(LENGTHS) - 1
    terminals = np.zeros(rows, bool)
    terminals[last[list(FALLS)]] = True
    timeouts = np.zeros(rows, bool)
    timeouts[np.delete(last, FALLS)] = True
    return {
        "observations": np.concatenate([episode[:-1] for episode in states]),
        "next_observations": np.concatenate([episode[1:] for episode in states]),
        "actions": rng.uniform(-1, 1, size=(rows, 2)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "costs": rng.choice([0, 0, 1], size=rows).astype(np.float32),
        "terminals": terminals,
        "timeouts": timeouts,
    }


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
