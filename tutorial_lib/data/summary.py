"""What a dataset contains, in lines and tables: `c2iql data check` prints them."""

import json

import numpy as np
import pandas as pd

from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.thinning import NEAR_BEST
from tutorial_lib.tasks import Task


def describe(dataset: Dataset, task: Task) -> list[str]:
    """Lines on what a dataset contains: its size, its episodes, how many keep each limit, and its origin."""
    columns = {
        "length": dataset.episode_lengths,
        "cost": dataset.episode_costs,
        "return": dataset.episode_returns,
    }
    rows = [(name, x.min(), np.median(x), x.mean(), x.max()) for name, x in columns.items()]
    spread = pd.DataFrame(rows, columns=["of an episode", "min", "median", "mean", "max"])
    origin = [_printable(f"{key}: {value}")[:200] for key, value in sorted(dataset.attributes.items())]
    return [
        "",
        f"{dataset.num_episodes} episodes, {len(dataset)} transitions, "
        f"{dataset.terminals.sum()} terminals, {dataset.timeouts.sum()} time limits",
        spread.round(1).to_string(index=False),
        "",
        limits_table(dataset, task).to_string(index=False),
        "",
        *(origin or ["no attributes: the file does not say where it comes from"]),
        "",
    ]


def _printable(text: str) -> str:
    """The text in one line, without characters that control a terminal."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def limits_table(dataset: Dataset, task: Task) -> pd.DataFrame:
    """One row for each limit of the task: the share of the episodes that keep it, the best return of these,
    and how many of these come within 10% of the best. Without such episodes, the best return is NaN."""
    rows = []
    for limit in task.thresholds:
        returns = dataset.episode_returns[dataset.episode_costs <= limit]
        best = returns.max() if len(returns) else np.nan
        near = int((returns >= best - (1 - NEAR_BEST) * abs(best)).sum())
        rows.append((limit, f"{len(returns) / dataset.num_episodes:.1%}", round(best, 1), near))
    return pd.DataFrame(rows, columns=["limit", "episodes within", "best return", "within 10% of it"])


def sources_of(dataset: Dataset) -> str:
    """Returns how many episodes of a dataset come from which run, and the steps of all runs together."""
    counts = json.loads(dataset.attributes.get("episodes_by_source", "{}"))
    if not counts:
        return "one run"  # as the first edition's
    words = ", ".join(f"{count} {source}" for source, count in counts.items())
    return f"{words}; {int(dataset.attributes['collected_steps']) / 1e6:g} million steps"
