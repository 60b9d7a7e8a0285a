"""Five short episodes with CarRun's dimensions, and what tests of datasets and of their files share."""

import contextlib

import h5py
import numpy as np
import pytest

from tutorial_lib.data.dataset import DatasetError

LENGTHS = (5, 1, 7, 3, 4)
FALLS = (1, 3)  # the episodes that end in a terminal; the others reach the time limit


def make_arrays():
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
