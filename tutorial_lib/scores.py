"""Scores as DSRL normalises them, their intervals, and the file of raw results."""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from tutorial_lib.files import written_whole
from tutorial_lib.tasks import Task, get_task


def normalised_return(returns, task: Task):
    """(R - R_min) / (R_max - R_min) with DSRL's constants."""
    return (np.asarray(returns) - task.min_return) / (task.max_return - task.min_return)


def normalised_cost(costs, threshold):
    """C / L, as DSRL: (C + 1) / (L + 1) where L = 0. At most one means that the limit was kept."""
    epsilon = np.where(np.asarray(threshold) == 0, 1.0, 0.0)
    return (np.asarray(costs) + epsilon) / (np.asarray(threshold) + epsilon)


def with_scores(results: pd.DataFrame) -> pd.DataFrame:
    """Raw results with two more columns, `reward_score` and `cost_score`."""
    if results.empty:
        return results.assign(reward_score=0.0, cost_score=0.0)
    parts = []
    for name, part in results.groupby("task", sort=False):
        rewards = normalised_return(part["return"], get_task(name))
        parts.append(
            part.assign(reward_score=rewards, cost_score=normalised_cost(part["cost"], part["threshold"]))
        )
    return pd.concat(parts, ignore_index=True)


def summarise(results: pd.DataFrame, by=("task", "algorithm", "profile", "threshold")) -> pd.DataFrame:
    """Mean scores per group with 95% bootstrap intervals over its episodes, and the number of episodes."""
    rows = []
    for key, part in with_scores(results).groupby(list(by), sort=False):
        row = dict(zip(by, key, strict=True)) | {"seeds": part["seed"].nunique(), "episodes": len(part)}
        for score in ("reward_score", "cost_score"):
            row[score] = part[score].mean()
            row[f"{score}_low"], row[f"{score}_high"] = _interval(part[score].to_numpy())
        rows.append(row)
    return pd.DataFrame(rows)


def _interval(values: np.ndarray) -> tuple[float, float]:
    if len(values) < 2 or np.ptp(values) == 0:
        return float(values.mean()), float(values.mean())
    interval = stats.bootstrap(
        (values,), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return float(interval.low), float(interval.high)


def save_results(results: pd.DataFrame, path: Path) -> None:
    """Write raw results as CSV, whole or not at all."""
    with written_whole(path) as temporary:
        results.to_csv(temporary, index=False, float_format="%.6g")
