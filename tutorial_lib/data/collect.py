"""From behaviour policies to a dataset: `c2iql collect TASK`.

The sources of a dataset are PPO runs of two kinds. A *priced* agent learns many trade-offs between reward and
cost at once. A *lagrangian* agent learns under a limit on the cost of an episode, and the limit falls along
its training. DSRL's data were also made with limits that changed along training. The module
`tutorial_lib.data.behaviour` describes both kinds, and `tutorial_lib.data.ppo` carries out a run.

Every training episode is kept, as in DSRL, so that the data contain beginners and experts. The module
`tutorial_lib.data.thinning` then chooses the episodes of the dataset. Prices, allowances, limits and
multipliers are not stored, so the data look like recordings of many unknown policies.

This module imports `tutorial_lib.data.ppo` and with it stable-baselines3, which takes seconds. Import it
where it is needed.
"""

import json
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np
import pandas as pd
from safetensors.numpy import load_file

from tutorial_lib.data.behaviour import KINDS
from tutorial_lib.data.dataset import KEYS, Dataset, DatasetError
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.data.ppo import episode_files, run_ppo
from tutorial_lib.data.thinning import thin
from tutorial_lib.files import check_output, sha256_of
from tutorial_lib.tasks import Task, simulator_of
from tutorial_lib.tasks.recipes import Recipe

SOURCES = ("priced-0", "lagrangian-0")
"""The sources of a dataset unless others are given: each is a kind and a seed."""


MANTISSA_BITS = 14
"""Numbers are rounded to so many bits, which makes a file a third smaller. The error is at most 3e-5 of a
number, and far below what the critics can tell apart."""


def read_source(source: str) -> tuple[str, int]:
    """The kind and the seed of a source: ('priced', 0) for 'priced-0'. Raises ValueError for another form."""
    kind, _, seed = source.partition("-")
    if kind not in KINDS or not seed.isdecimal() or source != f"{kind}-{int(seed)}":
        raise ValueError(
            f"source {source!r}: write KIND-SEED, e.g. priced-0; the kinds are {', '.join(KINDS)}"
        )
    return kind, int(seed)


def collect(
    task: Task, sources: tuple[str, ...], recipe: Recipe, folder: Path, out: Path, workers: int = 2
) -> Dataset:
    """Run PPO for every source, thin the episodes of all runs together, and write the dataset to `out`.

    Up to `workers` runs are carried out at the same time. The run of a source is kept in the folder
    `folder / task.name / source`, and continues there after a kill.

    A source can also be the file of a dataset that was collected before, so that its runs need not be there
    any more. Its episodes then stand in the place of those runs.

    The dataset has the sources in the order of `sources`, and the episodes of a source in the order in which
    they ended. Equal collections write equal files, also where a run was killed and resumed. The file's
    attribute `episodes_by_source` is a JSON object with the number of episodes of each source. Returns the
    dataset as it is read back from `out`.

    Raises ValueError where `sources` is empty, repeats a source or has one of another form than `read_source`
    takes, where a run was begun with another recipe, and where `thin` raises it. Raises DatasetError for a
    file that is none of the task, or that `collect` did not write.
    """
    check_output(out)
    before = {source: _collected(Path(source), task) for source in sources if source.endswith(".hdf5")}
    runs = {source: folder / task.name / source for source in sources if source not in before}
    names = [name for source in sources for name in (before[source].parts if source in before else [source])]
    if not sources or len(set(names)) < len(names):
        raise ValueError(f"sources {list(sources)}: give at least one, and each of them once")
    kinds_and_seeds = [read_source(source) for source in runs]
    joblib.Parallel(n_jobs=workers)(
        joblib.delayed(run_ppo)(task, recipe, kind, seed, run)
        for (kind, seed), run in zip(kinds_and_seeds, runs.values(), strict=True)
    )
    episodes = pd.concat(
        [
            _table(file, task).assign(source=before[source].of_episodes if source in before else source)
            for source in sources
            for file in ([Path(source)] if source in before else episode_files(runs[source]))
        ],
        ignore_index=True,
    )
    costs, returns, of_source = (episodes[name].to_numpy() for name in ("cost", "return", "source"))
    bounds = task.thresholds, task.cost_range, task.max_return
    kept = thin(costs, returns, of_source, recipe.episodes, *bounds, return_bins=recipe.return_bins)
    chosen = episodes.iloc[kept]
    attributes = _origin(task, recipe) | _counts(names, chosen, len(episodes), recipe, runs, before)
    return read_dataset(write_dataset(out, _read(chosen, task), task, attributes, MANTISSA_BITS), task)


def _counts(
    names: list[str],
    chosen: pd.DataFrame,
    seen: int,
    recipe: Recipe,
    runs: dict[str, Path],
    before: dict[str, "_Collected"],
) -> dict[str, Any]:
    """Returns what a dataset's file says of its sources.

    `names` are all sources, in order. `seen` episodes were read, and those of `chosen` are kept. `runs` and
    `before` are the sources that are runs and those that are files.
    """
    left_out = sum(made.episodes - len(made.of_episodes) for made in before.values())
    counts: dict[str, Any] = {
        "episodes_by_source": json.dumps({name: int((chosen["source"] == name).sum()) for name in names}),
        "collected_episodes": seen + left_out,
        "collected_steps": len(runs) * recipe.steps + sum(made.steps for made in before.values()),
    }
    if before:
        of_files = [f"{Path(source).name} (SHA-256 {made.digest})" for source, made in before.items()]
        counts["made_from"] = ", ".join([*of_files, *runs])
    return counts


def _origin(task: Task, recipe: Recipe) -> dict[str, str]:
    """What a dataset's file says of its origin, whatever the episodes."""
    simulator = simulator_of(task)
    packages = ("stable-baselines3", simulator.engine(), simulator.package, "torch")
    return {
        "task": task.name,
        "made_by": f"c2iql collect {task.name}",
        "recipe": str(asdict(recipe)),
        "versions": ", ".join(f"{package} {version(package)}" for package in packages),
        "licence": "CC BY 4.0",
    }


class _Collected(NamedTuple):
    """What a dataset that was collected before says of its origin."""

    parts: dict[str, int]
    """The number of episodes of each source."""
    of_episodes: list[str]
    """The source of each episode."""
    episodes: int
    """How many episodes its runs had."""
    steps: int
    """How many steps its runs had."""
    digest: str
    """The SHA-256 of the file."""


def _collected(path: Path, task: Task) -> _Collected:
    """Returns what the file of a dataset says of its origin. Raises DatasetError where it does not say it."""
    dataset = read_dataset(path, task)
    try:
        parts = json.loads(str(dataset.attributes["episodes_by_source"]))
        of_episodes = [source for source, count in parts.items() for _ in range(count)]
        if len(of_episodes) != dataset.num_episodes:
            raise ValueError("its sources have another number of episodes than the file")
        counts = int(dataset.attributes["collected_episodes"]), int(dataset.attributes["collected_steps"])
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        reason = f"does not say which episodes are from which source ({error})"
        raise DatasetError(f"{path}: {reason}: name a file that `c2iql collect` wrote") from error
    return _Collected(parts, of_episodes, *counts, sha256_of(path))


# A run of AntCircle is 3 GB. The files are therefore read one at a time, and twice: first for the table of
# their episodes, and then for the few episodes that are kept.


def _load(file: Path, task: Task) -> Dataset:
    """The episodes of a file of a run, or of a dataset."""
    if file.suffix == ".hdf5":
        return read_dataset(file, task)
    arrays: dict[str, Any] = load_file(file)
    return Dataset(**arrays)


def _table(file: Path, task: Task) -> pd.DataFrame:
    """One row for each episode of a file: the file, the episode's place in it, its cost and its return."""
    data = _load(file, task)
    place = np.arange(data.num_episodes)
    return pd.DataFrame(
        {"file": str(file), "place": place, "cost": data.episode_costs, "return": data.episode_returns}
    )


def _read(chosen: pd.DataFrame, task: Task) -> Dataset:
    """The episodes of these rows of the tables, which stand in the order of the tables."""
    parts = [
        _load(Path(str(file)), task).select(rows["place"].to_numpy())
        for file, rows in chosen.groupby("file", sort=False)
    ]
    arrays: dict[str, Any] = {key: np.concatenate([getattr(part, key) for part in parts]) for key in KEYS}
    return Dataset(**arrays)
