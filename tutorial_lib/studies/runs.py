"""One entry of a study: runs of one algorithm that are trained together, and the episodes that they play.

There is one run for each seed, or for each seed and limit. The name of an entry ends in a hash of its
options, seeds and data. A finished entry has a file of results with this name, and a changed option or
dataset makes a new entry. The code is not part of the hash: after a change of an algorithm, use a new folder
of runs.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from tutorial_lib import checkpoints, training
from tutorial_lib.agents import Agent, get_algorithm, slug
from tutorial_lib.config import Config
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.sources import SHIPPED_DATA, load_dataset
from tutorial_lib.files import held, sweep
from tutorial_lib.playing import evaluate
from tutorial_lib.scores import save_results
from tutorial_lib.studies.results import read_results
from tutorial_lib.tasks import get_task


@dataclass(frozen=True)
class Runs:
    """An entry: training runs of one algorithm that differ in seed and limit, and their episodes."""

    task: str
    algorithm: str
    config: Config
    seeds: tuple[int, ...]
    trained_for: tuple[float, ...] | None
    """For an algorithm that is trained for one limit: the limits. Every seed is trained for each of them."""
    limits: tuple[float, ...] | None
    """The limits that the episodes are played under. None: the task's thresholds."""
    at_test: tuple[dict, ...]
    """Changes of options that only playing reads. Every agent plays its episodes once with each."""
    label: str
    """Words for what distinguishes these runs from the others of the study."""
    columns: tuple[str, ...]
    """The names of the options that the study varies."""
    diagnoses: bool
    """Do the results have the columns of `Agent.diagnose`?"""
    checksum: str
    """The checksum of the dataset."""
    data: str = "shipped"
    """Where the dataset is, as for `find_dataset`."""
    episodes: int = 10
    """The number of episodes per run and limit."""

    @property
    def name(self) -> str:
        """The entry's name: its task, algorithm and label, and a hash of its options, seeds and data."""
        words = "-".join(part.replace(" ", "-") for part in (self.task, slug(self.row), self.label) if part)
        everything = dataclasses.asdict(self)
        del everything["data"]  # a path: the checksum stands for the data themselves
        return f"{words}-{hashlib.sha256(json.dumps(everything).encode()).hexdigest()[:8]}"

    @property
    def row(self) -> str:
        """The name of these runs in the results."""
        return get_algorithm(self.algorithm).row_name(self.config.profile)

    @property
    def pairs(self) -> list[tuple[int, float | None]]:
        """The seed and the limit of each run. The limit is None where the algorithm is trained for none."""
        return [(seed, limit) for limit in self.trained_for or (None,) for seed in self.seeds]

    def build(self) -> Agent:
        """A new agent with these runs, not yet trained."""
        seeds, limits = zip(*self.pairs, strict=True)
        kind = get_algorithm(self.algorithm)
        return kind(
            get_task(self.task), self.config, seeds=seeds, limits=limits if self.trained_for else None
        )


def train_and_play(runs: Runs, folder: Path, tell: Callable[[int], object] = lambda updates: None) -> Path:
    """Train an entry, play its episodes, and write the results to `folder`/NAME.csv. Returns this path.

    A finished entry is left as it is, an interrupted training is continued, and an equal trained agent that
    exists is used. `tell` is called at every checkpoint with the number of updates so far. Raises ValueError
    where the dataset is not the study's, and BlockingIOError where another process trains the entry.
    """
    path = results_path(runs, folder)
    if path.exists():
        return path
    torch.set_num_threads(1)  # several entries run at once, each on its own core
    dataset = load_dataset(runs.task, runs.data)
    if dataset.checksum != runs.checksum:
        raise ValueError(f"{runs.name}: the dataset here has another checksum than the study's")
    agent = find_trained(runs, folder)
    if agent is None:
        agent = runs.build()
        run_dir = folder / runs.name
        with held(run_dir):
            training.train(
                agent,
                dataset,
                run_dir=run_dir,
                checkpoint_every=1_000,
                on_checkpoint=lambda agent: tell(agent.updates),
                progress=False,
            )
            checkpoints.save_agent(agent, run_dir / "agent.safetensors")
    save_results(play(runs, agent, dataset), path)
    return path


def results_path(runs: Runs, folder: Path) -> Path:
    """The file of a finished entry's results."""
    return folder / f"{runs.name}.csv"


def play(runs: Runs, agent: Agent, dataset: Dataset) -> pd.DataFrame:
    """The raw results of an entry's episodes: one row per run, limit, element of `at_test` and episode.

    The columns are those of `evaluate`, the options that the study varies, and the diagnoses if it asks for
    them.
    """
    frames = []
    for changes in runs.at_test:
        player = agent.playing_with(**changes)
        results = evaluate(player, runs.limits, runs.episodes, seeds=runs.seeds)
        if runs.trained_for:  # an agent that was found may have been trained for more limits
            results = results[results["threshold"].isin(runs.trained_for)]
        columns = {name: getattr(player.config, name, None) for name in runs.columns}
        results = results.assign(**columns)
        if getattr(player.config, "tell", "") == "throughout":
            results = results.assign(told=results["threshold"])
        if runs.diagnoses:
            found = pd.DataFrame([player.diagnose(dataset, run) for run in range(len(player.seeds))])
            found = found.assign(seed=player.seeds).drop_duplicates("seed")
            results = results.merge(found, how="left", on="seed")
        frames.append(results)
    return pd.concat(frames, ignore_index=True)


def find_trained(runs: Runs, folder: Path) -> Agent | None:
    """A trained agent with the same options and data that has at least these runs, or None.

    It is looked for among the shipped agents and in the folders of all studies beside `folder`.
    """
    places = [*(SHIPPED_DATA / "agents").glob("*.safetensors"), *folder.parent.glob("*/*/agent.safetensors")]
    for path in sorted(places):
        if _has_equal_runs(path, runs):
            agent = checkpoints.load_agent(path)
            if agent.updates == runs.config.updates:
                return agent
    return None


def _has_equal_runs(path: Path, runs: Runs) -> bool:
    """Does this file hold an agent with the same task, algorithm, data and options, and all of these runs?"""
    kind = get_algorithm(runs.algorithm)
    try:
        header = checkpoints.load_header(path)
    except checkpoints.TrainingError:
        return False  # written by another version, or not yet complete
    if (header.task.name, header.kind, header.data) != (runs.task, kind, runs.checksum):
        return False
    pairs = set(zip(header.seeds, header.limits or [None] * len(header.seeds), strict=True))
    same = {name: getattr(runs.config, name) for name in kind.at_test}
    return header.config.changed(**same) == runs.config and set(runs.pairs) <= pairs


def collect(chosen: Sequence[Runs], folder: Path, path: Path, keep: bool = False) -> int:
    """Write the results of the finished entries in `folder` into one CSV, `path`.

    Returns the number of finished entries. With `keep`, the CSV's rows of other entries stay: a clone of the
    project has the results but not the runs. Nothing is written before all files are checked. Raises
    ValueError for a file that `read_results` refuses, and where these rows are of a study with other options.
    """
    sweep(folder)
    done = [results_path(runs, folder) for runs in chosen if results_path(runs, folder).exists()]
    if not done:
        return 0
    results = pd.concat([read_results(file) for file in done], ignore_index=True)
    if keep and path.exists():
        before = read_results(path)
        key = ["task", "algorithm", "threshold", *chosen[0].columns]
        if missing := set(key) - set(before.columns):
            raise ValueError(
                f"{path} has no column {', '.join(sorted(missing))}, so it is of another study: move it away"
            )
        again = pd.MultiIndex.from_frame(before[key]).isin(pd.MultiIndex.from_frame(results[key]))
        results = pd.concat([before[~again], results], ignore_index=True)
        place = {(runs.task, runs.row): i for i, runs in reversed(list(enumerate(chosen)))}
        of_rows = zip(results["task"], results["algorithm"], strict=True)
        rows = [place.get(pair, len(chosen)) for pair in of_rows]  # tasks outside the grid come last
        results = results.iloc[np.argsort(rows, kind="stable")]
    save_results(results, path)
    return len(done)
