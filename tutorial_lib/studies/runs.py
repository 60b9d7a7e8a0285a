"""One entry of a study: a training run for each seed (and limit), all trained together, and the episodes they
play.

Its name ends in a hash of its options, seeds and data, so a finished entry is a file of that name, and a
changed option or dataset makes another entry. The code is not in the hash: whoever changes an algorithm
begins with another folder of runs.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from safetensors import SafetensorError, safe_open

from tutorial_lib import checkpoints, training
from tutorial_lib.agents import Agent, get_algorithm, slug
from tutorial_lib.config import Config
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.sources import SHIPPED_DATA, load_dataset
from tutorial_lib.playing import evaluate
from tutorial_lib.scores import save_results
from tutorial_lib.tasks import get_task


@dataclass(frozen=True)
class Runs:
    """Training runs of one algorithm that differ in seed and limit, and their episodes."""

    task: str
    algorithm: str
    config: Config
    seeds: tuple[int, ...]
    trained_for: tuple[float, ...] | None
    """The limits of an algorithm that is trained for one: every seed is trained for each."""
    limits: tuple[float, ...] | None
    """The limits of the episodes; None: the task's own."""
    at_test: tuple[dict, ...]
    """Changes to options that only playing reads: every agent plays under each."""
    label: str
    """What distinguishes these runs from the others of the study, for people."""
    columns: tuple[str, ...]
    """The options that the study varies."""
    diagnoses: bool
    """Do the results have the agent's own `diagnose`?"""
    checksum: str
    """The dataset's."""
    data: str = "shipped"
    episodes: int = 10

    @property
    def name(self) -> str:
        """What it is, for people, and a hash of its options, seeds and data."""
        words = "-".join(
            part.replace(" ", "-") for part in (self.task, slug(self.algorithm), self.label) if part
        )
        everything = dataclasses.asdict(self)
        del everything["data"]  # a path: what it holds is in the checksum
        return f"{words}-{hashlib.sha256(json.dumps(everything).encode()).hexdigest()[:8]}"

    @property
    def pairs(self) -> list[tuple[int, float | None]]:
        """The seed and the limit of each run."""
        return [(seed, limit) for limit in self.trained_for or (None,) for seed in self.seeds]

    def build(self) -> Agent:
        """The agent, untrained."""
        seeds, limits = zip(*self.pairs, strict=True)
        kind = get_algorithm(self.algorithm)
        return kind(
            get_task(self.task), self.config, seeds=seeds, limits=limits if self.trained_for else None
        )


def train_and_play(runs: Runs, folder: Path, tell: Callable[[int], object] = lambda updates: None) -> Path:
    """Train (or continue, or take an equal agent that is there), play, write `folder`/NAME.csv. Returns its
    path.

    `tell` is called now and then with the number of updates made. Raises ValueError where the dataset is
    another than the study's.
    """
    path = results_path(runs, folder)
    if path.exists():
        return path
    torch.set_num_threads(1)  # a study runs several of these side by side
    dataset = load_dataset(runs.task, runs.data)
    if dataset.checksum != runs.checksum:
        raise ValueError(f"{runs.name}: the dataset here has another checksum than the study's")
    agent = find_trained(runs, folder)
    if agent is None:
        agent = runs.build()
        run_dir = folder / runs.name
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
    """The file that finished runs have."""
    return folder / f"{runs.name}.csv"


def play(runs: Runs, agent: Agent, dataset: Dataset) -> pd.DataFrame:
    """Raw results: the columns of `evaluate`, the options that the study varies, and diagnoses if it asks."""
    frames = []
    for changes in runs.at_test:
        player = agent.playing_with(**changes)
        results = evaluate(player, runs.limits, runs.episodes, seeds=runs.seeds)
        columns = {name: getattr(player.config, name) for name in runs.columns}
        columns |= player.diagnose(dataset) if runs.diagnoses else {}
        frames.append(results.assign(**columns))
    return pd.concat(frames, ignore_index=True)


def find_trained(runs: Runs, folder: Path) -> Agent | None:
    """An agent of equal runs, these or more, shipped or of any study beside `folder`."""
    places = [*(SHIPPED_DATA / "agents").glob("*.safetensors"), *folder.parent.glob("*/*/agent.safetensors")]
    for path in sorted(places):
        if _has_equal_runs(path, runs):
            agent = checkpoints.load_agent(path)
            if agent.updates == runs.config.updates:
                return agent
    return None


def _has_equal_runs(path: Path, runs: Runs) -> bool:
    kind = get_algorithm(runs.algorithm)
    try:
        with safe_open(path, "pt") as file:
            header = {key: _read(value) for key, value in (file.metadata() or {}).items()}
        if [header[key] for key in ("task", "algorithm", "data")] != [
            runs.task,
            runs.algorithm,
            runs.checksum,
        ]:
            return False
        config = kind.Config(**header["config"])
        pairs = list(zip(header["seeds"], header["limits"] or [None] * len(header["seeds"]), strict=True))
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        return False  # of another version, or being written
    same = {name: getattr(runs.config, name) for name in kind.at_test}
    return config.changed(**same) == runs.config and set(runs.pairs) <= set(pairs)


def _read(value: str) -> Any:
    try:
        return json.loads(value)
    except json.JSONDecodeError:  # a name
        return value


def collect(chosen: Sequence[Runs], folder: Path, path: Path, keep: bool = False) -> int:
    """Stack the results that are finished in `folder` into one CSV. Returns how many of `chosen` are
    finished.

    `keep` the rows that the CSV already has of other runs: a clone has the results, but not the runs. Raises
    ValueError where these rows are of a study with other options.
    """
    done = [results_path(runs, folder) for runs in chosen if results_path(runs, folder).exists()]
    if not done:
        return 0
    results = pd.concat([pd.read_csv(file) for file in done], ignore_index=True)
    if keep and path.exists():
        before = pd.read_csv(path)
        key = ["task", "algorithm", "threshold", *chosen[0].columns]
        if missing := set(key) - set(before.columns):
            raise ValueError(
                f"{path} has no column {', '.join(sorted(missing))}, so it is of another study: move it away"
            )
        again = pd.MultiIndex.from_frame(before[key]).isin(pd.MultiIndex.from_frame(results[key]))
        results = pd.concat([before[~again], results], ignore_index=True)
        place = {(runs.task, runs.algorithm): i for i, runs in reversed(list(enumerate(chosen)))}
        of_rows = zip(results["task"], results["algorithm"], strict=True)
        rows = [place.get(pair, len(chosen)) for pair in of_rows]  # tasks that the grid lost come last
        results = results.iloc[np.argsort(rows, kind="stable")]
    save_results(results, path)
    return len(done)
