"""A cell of a study: one training run, its seeds together, and the episodes that its agent plays.

Its name ends in a hash of its options, seeds and data, so a finished cell is a file of that name, and a
changed option or dataset is another cell. The code is not in it: who changes an algorithm begins with
another folder of runs.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from safetensors import SafetensorError, safe_open

from tutorial_lib import checkpoints, training
from tutorial_lib.agents import Agent, get_algorithm
from tutorial_lib.config import Config
from tutorial_lib.costs.reconstruction import reconstruction_error
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.sources import SHIPPED_DATA, load_dataset
from tutorial_lib.playing import evaluate
from tutorial_lib.scores import save_results
from tutorial_lib.tasks import get_task

AT_TEST = ("infinite_at_test",)
"""Options that training never looks at: their variants share one agent."""


@dataclass(frozen=True)
class Cell:
    """One training run and its episodes. `checksum` is its dataset's; `columns` are its study's."""

    task: str
    algorithm: str
    config: Config
    threshold: float | None
    seeds: tuple[int, ...]
    limits: tuple[float, ...] | None
    at_test: tuple[dict, ...]
    label: str
    columns: tuple[str, ...]
    checksum: str
    data: str = "shipped"
    episodes: int = 10

    @property
    def name(self) -> str:
        """What it is, for people, and the hash of its options, seeds and data, for the file system."""
        parts = (self.task, self.algorithm.replace("/", ""), self.label)
        threshold = () if self.threshold is None else (f"{self.threshold:g}",)
        words = "-".join(part.replace(" ", "-") for part in (*parts, *threshold) if part)
        everything = dataclasses.asdict(self)
        del everything["data"]  # a path: what it holds is in the checksum
        return f"{words}-{hashlib.sha256(json.dumps(everything).encode()).hexdigest()[:8]}"

    def build(self) -> Agent:
        """The agent, untrained."""
        kind = get_algorithm(self.algorithm)
        return kind(get_task(self.task), self.config, seeds=self.seeds, threshold=self.threshold)


def run_cell(cell: Cell, folder: Path, tell: Callable[[int], None] = lambda updates: None) -> Path:
    """Train (or go on, or take an equal agent that is there), play, write `folder`/NAME.csv. Returns it.

    `tell` hears of the updates made, now and then.
    """
    path = results_path(cell, folder)
    if path.exists():
        return path
    torch.set_num_threads(1)  # the cells are the parallel work
    dataset = load_dataset(cell.task, cell.data)
    if dataset.checksum != cell.checksum:
        raise ValueError(f"{cell.name}: the dataset here has another checksum than the study's")
    agent = find_trained(cell, folder)
    if agent is None:
        agent = cell.build()
        run_dir = folder / cell.name
        training.train(
            agent,
            dataset,
            run_dir=run_dir,
            checkpoint_every=1_000,
            on_checkpoint=lambda agent: tell(agent.updates),
            progress=False,
        )
        checkpoints.save_agent(agent, run_dir / "agent.safetensors")
    save_results(play(cell, agent, dataset), path)
    return path


def results_path(cell: Cell, folder: Path) -> Path:
    """The file that a finished cell has."""
    return folder / f"{cell.name}.csv"


def play(cell: Cell, agent: Agent, dataset: Dataset) -> pd.DataFrame:
    """The cell's raw results: `evaluate`'s columns, the study's varied options, and the model's error."""
    frames = []
    for changes in cell.at_test:
        agent.config = dataclasses.replace(cell.config, **changes)
        results = evaluate(agent, cell.limits, cell.episodes, seeds=cell.seeds)
        columns = {name: getattr(agent.config, name) for name in cell.columns}
        if any(name.startswith("crm") for name in cell.columns) and hasattr(agent, "reconstruction"):
            error = reconstruction_error(agent.reconstruction, agent.task, agent.config, dataset)
            columns["reconstruction_error"] = error
        frames.append(results.assign(**columns))
    return pd.concat(frames, ignore_index=True)


def find_trained(cell: Cell, folder: Path) -> Agent | None:
    """An agent of an equal run with these seeds or more, shipped or of any study beside `folder`."""
    places = [*(SHIPPED_DATA / "agents").glob("*.safetensors"), *folder.parent.glob("*/*/agent.safetensors")]
    for path in sorted(places):
        if _is_of_equal_run(path, cell):
            agent = checkpoints.load_agent(path)
            if agent.updates == cell.config.steps:
                return agent
    return None


def _is_of_equal_run(path: Path, cell: Cell) -> bool:
    try:
        with safe_open(path, "pt") as file:
            header = {key: _read(value) for key, value in (file.metadata() or {}).items()}
        config = Config(**header["config"])
    except (OSError, SafetensorError, KeyError, TypeError):
        return False  # of another version, or being written
    wanted = {"task": cell.task, "algorithm": cell.algorithm, "threshold": cell.threshold}
    wanted |= {"data": cell.checksum}
    same = {name: getattr(cell.config, name) for name in AT_TEST}
    return (
        all(header.get(key, "") == value for key, value in wanted.items())
        and dataclasses.replace(config, **same) == cell.config
        and set(cell.seeds) <= set(header["seeds"])
    )


def _read(value: str):
    try:
        return json.loads(value)
    except json.JSONDecodeError:  # a name
        return value


def collect(chosen: list[Cell], folder: Path, path: Path, keep: bool = False) -> int:
    """Stack the results of the cells that are finished in `folder` into one CSV. Returns how many they are.

    `keep` the rows that the CSV already has of other cells: a clone has the results, but not the runs.
    Raises ValueError where these rows are of a study with other options.
    """
    done = [results_path(cell, folder) for cell in chosen if results_path(cell, folder).exists()]
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
        place = {(cell.task, cell.algorithm): i for i, cell in reversed(list(enumerate(chosen)))}
        pairs = zip(results["task"], results["algorithm"], strict=True)
        rows = [place.get(pair, len(chosen)) for pair in pairs]  # tasks that the grid lost come last
        results = results.iloc[np.argsort(rows, kind="stable")]
    save_results(results, path)
    return len(done)
