"""The faults that the trials put into good files. Hypothesis draws their places and values."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import torch
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import save_file

from benchmarks.reliability.words import NAMES, NO_NUMBERS, NOT_A_COUNT, NOT_FINITE, WORDS
from tutorial_lib.data.dataset import KEYS
from tutorial_lib.tasks import TASKS


class Fault(NamedTuple):
    """What is wrong with a file, and how it comes into a good one."""

    words: str
    make: Callable[[Path], object]


SHARES = st.floats(0, 0.999)
"""Where in a file or an array a fault is, as a share of its length."""


# --- Any file ---


def rewritten(change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(change(path.read_bytes()))


CUTS = SHARES.map(lambda s: Fault(f"cut after {s:.4f}", rewritten(lambda old: old[: int(s * len(old))])))
BYTES = st.binary(max_size=300).map(lambda new: Fault(f"other bytes: {new!r}", rewritten(lambda old: new)))


def _flipped(old: bytes, share: float, bit: int) -> bytes:
    place = int(share * len(old))
    return old[:place] + bytes([old[place] ^ 1 << bit]) + old[place + 1 :]


FLIPS = st.tuples(SHARES, st.integers(0, 7)).map(
    lambda at: Fault(f"bit {at[1]} at {at[0]:.4f}", rewritten(lambda old: _flipped(old, *at)))
)

# --- Datasets ---


def _changed(key: str, change: Callable[[np.ndarray], np.ndarray | None]) -> Callable[[Path], object]:
    """Writes all arrays again as plain ones, one of them changed. It is left out where it becomes None."""

    def make(path: Path) -> None:
        with h5py.File(path) as file:
            arrays: dict[str, Any] = {name: file[name][()] for name in KEYS}
        arrays[key] = change(arrays[key])
        with h5py.File(path, "w") as file:
            file.update({name: values for name, values in arrays.items() if values is not None})

    return make


def _with_value(values: np.ndarray, share: float, value: float) -> np.ndarray:
    values = values.copy()
    values.reshape(-1)[int(share * values.size)] = value
    return values


def _referring(key: str, how: str) -> Callable[[Path], object]:
    """Replaces an array by a reference to another place."""

    def make(path: Path) -> None:
        other = path.with_name("other.hdf5")
        other.write_bytes(path.read_bytes())
        _changed(key, lambda values: None)(path)
        with h5py.File(other) as file:
            shape, kind = file[key].shape, file[key].dtype
        with h5py.File(path, "r+") as file:
            if how == "an external link":
                file[key] = h5py.ExternalLink(str(other), key)
            elif how == "a soft link":
                file[key] = h5py.SoftLink("/rewards")
            elif how == "storage outside the file":
                file.create_dataset(key, shape, kind, external=[(str(other), 0, h5py.h5f.UNLIMITED)])
            else:
                layout = h5py.VirtualLayout(shape, kind)
                layout[:] = h5py.VirtualSource(str(other), key, shape)
                file.create_virtual_dataset(key, layout)

    return make


def _huge(rows: int) -> Callable[[Path], object]:
    def make(path: Path) -> None:
        _changed("rewards", lambda values: None)(path)
        with h5py.File(path, "r+") as file:
            file.create_dataset("rewards", (rows,), "f4", chunks=(16,))

    return make


def _of_array(key: str, what: str, change: Callable[[np.ndarray], np.ndarray | None]) -> Fault:
    return Fault(f"{key}: {what}", _changed(key, change))


def _of_value(key: str, share: float, value: float) -> Fault:
    return _of_array(key, f"{value} at {share:.3f}", lambda x: _with_value(x, share, value))


def _of_length(key: str, rows: int) -> Fault:
    return _of_array(key, f"{rows} rows fewer", lambda x: x[:-rows])


def of_datasets() -> st.SearchStrategy[Fault]:
    """Faults of a file in DSRL's layout."""
    hows = ("an external link", "a soft link", "storage outside the file", "a virtual dataset")
    keys = st.sampled_from(KEYS)
    absurd = NOT_FINITE | st.floats(2e6, 1e38) | st.floats(-1e38, -2e6)
    costs = st.floats(-1e30, -1e-3) | st.floats(1.01, 1e30)
    refer = st.tuples(keys, st.sampled_from(hows)).filter(lambda pair: pair != ("rewards", "a soft link"))
    others = [name for name in TASKS if name != "BallRun"]
    return st.one_of(
        CUTS,
        BYTES,
        keys.map(lambda key: _of_array(key, "missing", lambda x: None)),
        st.builds(
            lambda key, n: _of_array(key, f"{n} rows fewer", lambda x: x[:-n]), keys, st.integers(1, 299)
        ),
        keys.map(lambda key: _of_array(key, "as text", lambda x: x.astype("S6"))),
        st.sampled_from(KEYS[:3]).map(lambda key: _of_array(key, "a column fewer", lambda x: x[:, 1:])),
        st.builds(_of_value, st.sampled_from(KEYS[:5]), SHARES, absurd),
        st.builds(_of_value, st.just("costs"), SHARES, costs),
        st.builds(_of_value, st.just("terminals"), SHARES, st.just(True)),
        st.floats(5, 1e5).map(lambda f: _of_array("actions", f"times {f}", lambda x: f * x)),
        st.floats(1.5, 1e5).map(lambda f: _of_array("costs", f"times {f}", lambda x: f * x)),
        st.just(_of_array("timeouts", "never", lambda x: x & False)),
        st.just(_of_array("next_observations", "backwards", lambda x: x[::-1])),
        refer.map(lambda pair: Fault(f"{pair[0]}: {pair[1]}", _referring(*pair))),
        st.integers(10**9, 2**62).map(lambda rows: Fault(f"{rows} rows are declared", _huge(rows))),
        st.sampled_from(others).map(_of_task),
    )


def _of_task(name: str) -> Fault:
    def make(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file.attrs["task"] = name

    return Fault(f"of task {name}", make)


# --- Agents and checkpoints ---


def _with(change: Callable[[dict, dict], object]) -> Callable[[Path], object]:
    """Writes a file of an agent again, after a change of its header and its tensors."""

    def make(path: Path) -> None:
        with safe_open(path, "pt") as file:
            header = dict(file.metadata())
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        change(header, tensors)
        save_file({name: x.contiguous() for name, x in tensors.items()}, path, metadata=header)

    return make


def _of_tensors(share: float, how: str, value: float) -> Fault:
    def change(header: dict, tensors: dict[str, torch.Tensor]) -> None:
        names = sorted(name for name, x in tensors.items() if x.dtype == torch.float32 and x.dim() > 1)
        name = names[int(share * len(names))]
        if how == "missing":
            del tensors[name]
        elif how == "narrow":
            tensors[name] = tensors[name][..., :-1]
        elif how == "of float64":
            tensors[name] = tensors[name].double()
        else:
            tensors[name].view(-1)[-1] = value

    return Fault(f"tensor {share:.3f}: {how} {value}", _with(change))


def _with_header(key: str, text: str | None) -> Fault:
    def change(header: dict, tensors: dict) -> None:
        header.pop(key)
        if text is not None:
            header[key] = text

    return Fault(f"header: {key} is {text!r}", _with(change))


def _with_option(name: str, value: Any) -> Fault:
    def change(header: dict, tensors: dict) -> None:
        header["config"] = json.dumps(json.loads(header["config"]) | {name: value})

    return Fault(f"option {name} is {value!r}", _with(change))


TENSORS = st.builds(
    _of_tensors, SHARES, st.sampled_from(["missing", "narrow", "of float64", "with"]), NOT_FINITE
)


def of_checkpoints() -> st.SearchStrategy[Fault]:
    """Faults of the file from which training continues."""
    return st.one_of(CUTS, BYTES, TENSORS)


def of_agents() -> st.SearchStrategy[Fault]:
    """Faults of an agent's file: its header, its tensors, or its bytes."""
    keys = st.sampled_from(["task", "algorithm", "config", "seeds", "limits", "data"])
    numbers = st.sampled_from(
        ["hidden_width", "hidden_layers", "cost_critics", "batch_size", "crm_layers", "gamma"]
    )
    values = NOT_A_COUNT | WORDS | st.none() | st.lists(st.integers(), max_size=2)
    return st.one_of(
        CUTS,
        BYTES,
        TENSORS,
        st.builds(_with_header, keys, st.none() | NO_NUMBERS),
        st.builds(_with_option, numbers, values),
        st.builds(_with_option, NAMES, st.integers(0, 9)),
        st.integers(3, 10**6).map(lambda n: _with_header("seeds", json.dumps(list(range(n))))),
    )
