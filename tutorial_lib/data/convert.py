"""Converts recordings between DSRL's layout and others: `c2iql data convert` and `c2iql data export`.

Every reader returns the seven arrays of `dataset.KEYS` with the shapes and types of a Dataset, whole episodes
only. What it leaves out or infers, it counts in a warning.
"""

import re
import shutil
import warnings
from pathlib import Path

import h5py
import numpy as np

from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError
from tutorial_lib.data.formats import (
    Arrays,
    array_in,
    by_number,
    checked_arrays,
    episode_files,
    joined,
    opened_hdf5,
    read_folder,
)
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.tasks import Task, as_task


def convert(source: Path, out: Path, task: Task | str) -> Dataset:
    """Convert a recording of `task` to DSRL's layout, write it to `out`, and return it as `out` is read.

    `source` is one of these:

    - an HDF5 file in D4RL's layout (one array per key) or Minari's (one group per episode);
    - the folder of a Minari dataset, for example `~/.minari/datasets/ballrun/mixed-v0`. The package minari is
      not needed to read it;
    - a folder with one CSV or npz file per episode, as `formats.read_folder` describes.

    Values and flags stay as they were. What is left out or inferred is counted in a warning. Raises
    DatasetError for a source that is missing, damaged, of another layout or task, or the same file as `out`,
    and where `write_dataset` or `read_dataset` refuses the result. `out` is then not written.
    """
    source, out, task = Path(source).expanduser(), Path(out).expanduser(), as_task(task)
    if source.exists() and out.exists() and source.samefile(out):
        raise DatasetError(f"{source}: is also the result: choose another name for the result")
    arrays, attributes = _read(source, task)
    try:
        dataset = Dataset(**arrays, attributes=attributes | {"converted_from": source.name})
        write_dataset(out, dataset, task)
        return read_dataset(out, task)
    except DatasetError as error:
        raise DatasetError(f"{source}: not converted: {error}") from error


def _read(source: Path, task: Task) -> tuple[Arrays, dict]:
    """The seven arrays of a recording in any layout, and the attributes of a file in DSRL's."""
    if source.is_dir():
        for file in (source / "main_data.hdf5", source / "data" / "main_data.hdf5"):
            if file.is_file():
                return _read_minari(file, task), {}
        if episode_files(source):
            return read_folder(source, task), {}
        what = "no CSV or npz files, and no main_data.hdf5 of Minari (its format arrow is not read)"
        raise DatasetError(f"{source}: {what}: check the folder")
    if not source.is_file():
        raise DatasetError(f"{source}: no such file or folder: check the path")
    with opened_hdf5(source) as file:
        names = set(file)
    if any(name.startswith("episode_") for name in names):
        return _read_minari(source, task), {}
    if not names.issuperset(KEYS):
        return _read_d4rl(source, task), {}
    dataset = read_dataset(source, task)  # D4RL's layout with all keys is DSRL's
    plain = {key: value for key, value in dataset.attributes.items() if isinstance(value, (str, int, float))}
    return {key: getattr(dataset, key) for key in KEYS}, plain


def _read_d4rl(path: Path, task: Task) -> Arrays:
    """The recording in a file in D4RL's layout that lacks some of DSRL's keys.

    Costs may be under `infos/cost` instead of `costs`. Two keys may be missing altogether:

    - `timeouts`. An episode without a terminal is then taken to have `task.horizon` steps. This is checked:
      with `next_observations`, episodes must end exactly where a row does not follow the row before. Without
      them, the last row must end an episode.
    - `next_observations`. They are then the observations of the next row. The state after a time limit was
      not recorded, and training needs its value, because an episode only stops there. So the last transition
      of such an episode is dropped, as D4RL's own loaders do, and the time limit moves to the row before. No
      backup uses the state after a terminal: such a row repeats its own observation.

    Raises DatasetError for other missing keys, for arrays that do not fit the task, and where the ends of
    the episodes cannot be inferred.
    """
    with opened_hdf5(path) as file:
        found = {key: array_in(file, key, path) for key in KEYS}
        if found["costs"] is None:
            found["costs"] = array_in(file, "infos/cost", path)
    stored = {key: values for key, values in found.items() if values is not None}
    needed = [key for key in KEYS if key in stored or key not in ("next_observations", "timeouts")]
    arrays = checked_arrays(stored, needed, task, str(path))
    if "timeouts" not in arrays:
        arrays["timeouts"] = _timeouts_by_horizon(arrays, task.horizon, path)
    rows = len(arrays["rewards"])
    ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    if not len(ends):
        raise DatasetError(f"{path}: terminals, timeouts: none of {rows} rows ends an episode: mark the ends")
    if ends[-1] < rows:
        what = f"unfinished tail: dropped {rows - ends[-1]} of {rows} transitions"
        warnings.warn(f"{path}: {what}", stacklevel=2)
        arrays = {key: values[: ends[-1]] for key, values in arrays.items()}
    return arrays if "next_observations" in arrays else _with_next_observations(arrays, path)


def _timeouts_by_horizon(arrays: Arrays, horizon: int, path: Path) -> np.ndarray:
    """True in the last row of every episode that has `horizon` steps and no terminal, (N,) bool."""
    observations, terminals = arrays["observations"], arrays["terminals"]
    rows = np.arange(len(terminals))
    starts = np.maximum.accumulate(np.where(np.append(True, terminals)[: len(rows)], rows, 0))
    timeouts = ((rows - starts + 1) % horizon == 0) & ~terminals
    ends = terminals | timeouts
    remedy = f"the episodes do not end after {horizon} steps each: add the key timeouts"
    if "next_observations" in arrays:
        follows = (arrays["next_observations"][:-1] == observations[1:]).all(axis=1)
        for row in np.flatnonzero(ends[:-1] == follows)[:1]:
            what = f"the next observation of row {row} is {'' if follows[row] else 'not '}the next row's"
            raise DatasetError(f"{path}: timeouts: missing, and {what}: {remedy}")
    elif len(ends) and not ends[-1]:
        left = len(rows) - 1 - int(np.flatnonzero(ends)[-1]) if ends.any() else len(rows)
        raise DatasetError(f"{path}: timeouts: missing, and the last {left} rows end nowhere: {remedy}")
    what = f"{timeouts.sum()} episodes are taken to end after {horizon} steps"
    warnings.warn(f"{path}: timeouts: missing: {what}", stacklevel=2)
    return timeouts


def _with_next_observations(arrays: Arrays, path: Path) -> Arrays:
    """Adds `next_observations`, and drops the last transitions of time-limited episodes (`_read_d4rl`)."""
    observations, terminals = arrays["observations"], arrays["terminals"]
    limited = arrays["timeouts"] & ~terminals
    following = np.append(observations[1:], observations[-1:], axis=0)
    following[terminals] = observations[terminals]
    timeouts = arrays["timeouts"].copy()
    # Of an episode of one step nothing is left. The row before it is a terminal, or limited and dropped too.
    timeouts[:-1] |= limited[1:] & ~terminals[:-1]
    if limited.all():
        raise DatasetError(f"{path}: next_observations: missing, and no episode has two steps: record them")
    if limited.any():
        what = f"dropped the last step of {limited.sum()} episodes, whose next state was not recorded"
        effect = "their returns and costs lack it, and their time limits stand one step early"
        warnings.warn(f"{path}: next_observations: missing: {what}: {effect}", stacklevel=2)
    arrays = arrays | {"next_observations": following, "timeouts": timeouts}
    return {key: values[~limited] for key, values in arrays.items()}


def _read_minari(path: Path, task: Task) -> Arrays:
    """The recording in Minari's HDF5 file: a group `episode_0`, `episode_1`, ... for every episode.

    An episode of T steps has T + 1 `observations`, and `actions`, `rewards`, `terminations` and `truncations`
    with T rows. `infos/cost` has T rows, or T + 1 where the first belongs to the reset. Terminations become
    terminals and truncations timeouts. An episode that ends with neither was cut off, and is dropped. Raises
    DatasetError for missing keys and arrays that do not fit the task, and where no whole episode is left.
    """
    with opened_hdf5(path) as file:
        names = [name for name in sorted(file, key=by_number) if name.startswith("episode_")]
        return joined(path, ((f"{path}: {name}", _minari_episode(file, name, path, task)) for name in names))


def _minari_episode(file: h5py.File, name: str, path: Path, task: Task) -> Arrays:
    """The arrays of one episode, after checks. Raises DatasetError."""
    keys = ("observations", "actions", "rewards", "terminations", "truncations", "infos/cost")
    found = {key: array_in(file, f"{name}/{key}", path) for key in keys}
    stored = {key: values for key, values in found.items() if values is not None}
    missing = [key for key in keys if key not in stored]
    if missing:
        remedy = "record them (infos/cost is info['cost'], with record_infos=True)"
        raise DatasetError(f"{path}: {name}: {', '.join(missing)}: missing: {remedy}")
    observations, actions, rewards, terminals, timeouts, costs = stored.values()
    if not rewards.ndim or observations.shape[:1] != (len(rewards) + 1,):
        what = f"shape {observations.shape}, but rewards {rewards.shape}"
        raise DatasetError(f"{path}: {name}: observations: {what}: T steps have T + 1 states: store all")
    if costs.shape[:1] == observations.shape[:1]:
        costs = costs[1:]
    values = (observations[:-1], observations[1:], actions, rewards, costs, terminals, timeouts)
    return checked_arrays(dict(zip(KEYS, values, strict=True)), KEYS, task, f"{path}: {name}")


def export_minari(file: Path, task: Task | str, dataset_id: str) -> None:
    """Write the dataset in `file`, which is in DSRL's layout, as a Minari dataset with this id.

    Minari keeps it in the folder `dataset_id` of `MINARI_DATASETS_PATH`, or of `~/.minari/datasets`. An id is
    `name-v0` or `group/name-v0`. An episode of T steps has T + 1 observations. Its costs are in
    `infos["cost"]`, with T + 1 rows as Minari's own collector records them: the first belongs to the reset,
    and is 0. `convert` reads the dataset back exactly.

    Raises DatasetError where the package minari is not installed, for an id of another form or that exists,
    where `read_dataset` refuses the file, and where the rows of an episode do not follow each other, because
    Minari's layout has no place for two different observations.
    """
    try:
        from gymnasium.spaces import Box
        from minari import create_dataset_from_buffers
        from minari.storage import get_dataset_path
    except ImportError as error:
        remedy = "to install it, run: pip install 'minari[hdf5]'"
        raise DatasetError(f"{dataset_id}: the package minari is missing: {remedy} ({error})") from error
    if not re.fullmatch(r"([\w-]{2,}/)*[\w-]+-v[0-9]+", dataset_id):
        raise DatasetError(f"{dataset_id}: not an id of Minari: write name-v0 or group/name-v0")
    task = as_task(task)
    episodes = _minari_episodes(read_dataset(file, task), Path(file))
    folder = get_dataset_path(dataset_id)
    if folder.exists():
        raise DatasetError(f"{dataset_id}: {folder} exists: delete it, or raise the number of the version")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # on authors and links that are not given
            create_dataset_from_buffers(
                dataset_id,
                episodes,
                observation_space=Box(-np.inf, np.inf, (task.obs_dim,), np.float32),
                action_space=Box(-1.0, 1.0, (task.act_dim,), np.float32),
                description=f"Recordings of {task.name} ({task.env_id}), with costs in infos['cost'].",
                data_format="hdf5",
            )
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)  # half a dataset
        raise


def _minari_episodes(dataset: Dataset, path: Path) -> list:
    """The episodes as buffers of Minari. Raises DatasetError where rows do not follow each other."""
    from minari.data_collector import EpisodeBuffer

    inner = np.setdiff1d(np.arange(len(dataset)), dataset.ends - 1)
    follows = (dataset.next_observations[inner] == dataset.observations[inner + 1]).all(axis=1)
    for row in inner[~follows][:1]:
        what = f"that of row {row} is not the next row's observation"
        raise DatasetError(f"{path}: next_observations: {what}: Minari cannot store it: correct the file")
    return [
        EpisodeBuffer(
            observations=np.append(dataset.observations[rows], dataset.next_observations[rows][-1:], axis=0),
            actions=dataset.actions[rows],
            rewards=dataset.rewards[rows],
            terminations=dataset.terminals[rows],
            truncations=dataset.timeouts[rows],
            infos={"cost": np.append(np.float32(0), dataset.costs[rows])},
        )
        for rows in map(slice, dataset.starts, dataset.ends)
    ]
