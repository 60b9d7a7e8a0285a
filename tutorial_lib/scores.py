"""Computes DSRL's normalised scores and their confidence intervals, and writes the file of raw results."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from tutorial_lib.files import written_whole
from tutorial_lib.tasks import Task, get_task


def normalised_return(returns: ArrayLike, task: Task) -> np.ndarray:
    """Returns (R - R_min) / (R_max - R_min) with DSRL's constants, with the shape of `returns`."""
    return (np.asarray(returns) - task.min_return) / (task.max_return - task.min_return)


def normalised_cost(costs: ArrayLike, threshold: ArrayLike) -> np.ndarray:
    """Returns C / L for costs C and limits L of episodes, whose shapes broadcast.

    Where L = 0 it is (C + 1) / (L + 1), as in DSRL. A value of at most one means that the limit was kept.
    """
    epsilon = np.where(np.asarray(threshold) == 0, 1.0, 0.0)
    return (np.asarray(costs) + epsilon) / (np.asarray(threshold) + epsilon)


def with_scores(results: pd.DataFrame) -> pd.DataFrame:
    """Returns raw results with two more columns, `reward_score` and `cost_score`."""
    if results.empty:
        return results.assign(reward_score=0.0, cost_score=0.0)
    parts = []
    for name, part in results.groupby("task", sort=False):
        rewards = normalised_return(part["return"], get_task(name))
        parts.append(
            part.assign(reward_score=rewards, cost_score=normalised_cost(part["cost"], part["threshold"]))
        )
    return pd.concat(parts, ignore_index=True)


def summarise(
    results: pd.DataFrame, by: Sequence[str] = ("task", "algorithm", "profile", "threshold")
) -> pd.DataFrame:
    """Returns one row per group: its numbers of seeds and episodes, its mean scores, and their intervals.

    `by` are the columns that define a group. The intervals are 95% bootstrap intervals over the group's
    episodes.
    """
    rows = []
    for key, part in with_scores(results).groupby(list(by), sort=False):
        row = dict(zip(by, key, strict=True)) | {"seeds": part["seed"].nunique(), "episodes": len(part)}
        for score in ("reward_score", "cost_score"):
            row[score] = part[score].mean()
            row[f"{score}_low"], row[f"{score}_high"] = _interval(part[score].to_numpy())
        rows.append(row)
    return pd.DataFrame(rows)


def certificate(results: pd.DataFrame) -> pd.DataFrame:
    """Returns what raw results prove of each run and limit: one row per task, algorithm, seed and threshold.

    `cost` is the mean cost of an episode, and `cost_low` and `cost_high` are its 95% interval by Student's t.
    `exceeds` is the share of episodes that cost more than the limit, and `exceeds_low` and `exceeds_high` are
    the exact 95% interval of its chance (Clopper and Pearson 1934). `predicted` is the mean cost that the
    run's critics predicted at the first step, or NaN. Costs are in unsafe steps per episode.
    """
    rows = []
    by = ["task", "algorithm", "seed", "threshold"]
    for key, part in results.groupby(by, sort=False):
        costs, limit = part["cost"].to_numpy(), key[-1]
        over = stats.binomtest(int((costs > limit).sum()), len(costs)).proportion_ci(0.95, "exact")
        half = stats.t.ppf(0.975, len(costs) - 1) * stats.sem(costs) if len(costs) > 1 else np.inf
        rows.append(
            dict(zip(by, key, strict=True))
            | {"episodes": len(costs), "cost": costs.mean(), "predicted": part["predicted_cost"].mean()}
            | {"cost_low": max(costs.mean() - half, 0.0), "cost_high": costs.mean() + half}
            | {"exceeds": (costs > limit).mean(), "exceeds_low": over.low, "exceeds_high": over.high}
        )
    return pd.DataFrame(rows)


def _interval(values: np.ndarray) -> tuple[float, float]:
    if len(values) < 2 or np.ptp(values) == 0:
        return float(values.mean()), float(values.mean())
    interval = stats.bootstrap(
        (values,), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return float(interval.low), float(interval.high)


def save_results(results: pd.DataFrame, path: Path) -> None:
    """Writes raw results as a CSV file, as a whole or not at all. Raises OSError if it cannot be written."""
    with written_whole(path) as temporary:
        results.to_csv(temporary, index=False, float_format="%.6g")
