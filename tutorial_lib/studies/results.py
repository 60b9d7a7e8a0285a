"""Results of studies, read from their files: per seed, with intervals over seeds, and against claims.

The unit is the seed. Ten episodes of one agent tell how that agent plays; only another training run tells
what the algorithm does, and the episodes' own spread says nothing about it.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from tutorial_lib.data.sources import SHIPPED_DATA
from tutorial_lib.scores import with_scores
from tutorial_lib.studies.paper import Claim

RESULTS = SHIPPED_DATA / "results"
SCORES = ("reward_score", "cost_score")
OWN_COLUMNS = (
    "task algorithm profile seed threshold episode return cost length predicted_cost updates".split()
)


def load_results(name: str, folder: Path = RESULTS) -> pd.DataFrame:
    """The raw results of a study, or no rows where it was not run."""
    path = folder / f"{name}.csv"
    return pd.read_csv(path) if path.exists() else pd.DataFrame(columns=OWN_COLUMNS)


def not_run(name: str) -> str:
    """What stands where a study's numbers would."""
    return f"not run: `c2iql study {name}` makes it"


def options_of(results: pd.DataFrame) -> list[str]:
    """The columns of the options that a study varies."""
    return [name for name in results.columns if name not in (*OWN_COLUMNS, "reconstruction_error")]


def seed_means(results: pd.DataFrame, by: Sequence[str] = ("task", "algorithm")) -> pd.DataFrame:
    """One row per group and seed: both scores, averaged over episodes, then over limits (equal weights)."""
    keys = list(dict.fromkeys([*by, "seed", "threshold"]))
    means = with_scores(results).groupby(keys, sort=False, dropna=False)[list(SCORES)].mean().reset_index()
    return means.groupby([*by, "seed"], sort=False, dropna=False)[list(SCORES)].mean().reset_index()


def seed_interval(values) -> tuple[float, float]:
    """95% interval of a mean from one value per seed, by Student's t; NaN for a single seed."""
    values = np.asarray(values, float)
    if len(values) < 2:
        return np.nan, np.nan
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return float(values.mean() - half), float(values.mean() + half)


def over_seeds(results: pd.DataFrame, by: Sequence[str] = ("task", "algorithm")) -> pd.DataFrame:
    """One row per group: mean, standard deviation and 95% interval over seeds of both scores."""
    rows = []
    for key, part in seed_means(results, by).groupby(list(by), sort=False, dropna=False):
        row = dict(zip(by, key, strict=True)) | {"seeds": len(part)}
        for score in SCORES:
            values = part[score].to_numpy()
            low, high = seed_interval(values)
            deviation = values.std(ddof=1) if len(values) > 1 else np.nan
            row |= {score: values.mean(), f"{score}_std": deviation}
            row |= {f"{score}_low": low, f"{score}_high": high}
        rows.append(row)
    return pd.DataFrame(rows)


def difference(results: pd.DataFrame, score: str, high: dict, low: dict | float) -> np.ndarray:
    """The score in the rows `high` minus that in the rows `low`, one value for each seed that has both.

    Runs of one seed share their episodes' starts, and their batches where they draw the same random numbers
    (conditioned ones also draw limits), so they are paired.
    """

    def of(rows: dict | float, like: pd.Series | None = None) -> pd.Series:
        if not isinstance(rows, dict):
            return pd.Series(float(rows), index=None if like is None else like.index)
        chosen = results[np.logical_and.reduce([results[key] == value for key, value in rows.items()])]
        if chosen.empty:
            return pd.Series(dtype=float)
        return seed_means(chosen, ("task",)).set_index("seed")[score]

    first = of(high)
    return (first - of(low, first)).dropna().to_numpy()


def verdicts(claims: Sequence[Claim], results: pd.DataFrame) -> pd.DataFrame:
    """One row per claim and task: the difference, its interval over seeds, and what it says of the claim.

    'agrees' and 'contradicts' need an interval on one side of zero; a single seed has none.
    """
    rows = []
    for claim in claims:
        chosen = results
        for key, value in claim.where.items():
            chosen = chosen[chosen[key] == value] if key in chosen else chosen[:0]  # not run
        for task in chosen["task"].unique() if len(chosen) else ["-"]:
            part = chosen[chosen["task"] == task]
            values = difference(part, claim.score, claim.high, claim.low) if len(part) else np.array([])
            rows.append({"the paper says": claim.words, "where": claim.source, "task": task} | _judge(values))
    return pd.DataFrame(rows)


def _judge(values: np.ndarray) -> dict:
    if not len(values):
        return {"difference": "", "95% over seeds": "", "ours": "not run"}
    low, high = seed_interval(values)
    verdict = "agrees" if low > 0 else "contradicts" if high < 0 else "undecided"
    interval = "" if np.isnan(low) else f"{low:+.2f} to {high:+.2f}"
    return {"difference": f"{values.mean():+.2f}", "95% over seeds": interval, "ours": verdict}


def against(results: pd.DataFrame, base: dict) -> pd.DataFrame:
    """One row per task and variant other than `base`: what it changes, with intervals over seeds (paired).

    A gain is a difference whose interval lies above zero, a loss one below; else it is undecided.
    """
    names, rows = list(base), []
    for key, part in results.groupby(["task", *names], sort=False, dropna=False):
        variant = dict(zip(names, key[1:], strict=True))
        if variant == base:
            continue
        of_task, row = results[results["task"] == key[0]], {"task": key[0]} | variant
        for score, word in zip(SCORES, ("reward", "cost"), strict=True):
            values = difference(of_task, score, variant, base)
            low, high = seed_interval(values)
            row[word] = f"{values.mean():+.2f}" if len(values) else "not run"
            row[f"{word}, 95%"] = "" if np.isnan(low) else f"{low:+.2f} to {high:+.2f}"
            row[f"{word} is"] = "higher" if low > 0 else "lower" if high < 0 else "undecided"
        rows.append(row | {"seeds": part["seed"].nunique()})
    return pd.DataFrame(rows)


def kept(results: pd.DataFrame) -> pd.DataFrame:
    """By task and algorithm: mean normalised cost; shares of (seed, limit) and of episodes that keep it."""
    scores, by = with_scores(results), ["task", "algorithm"]
    agents = scores.groupby([*by, "seed", "threshold"], sort=False)["cost_score"].mean().le(1)
    episodes = scores.assign(kept=scores["cost_score"].le(1)).groupby(by, sort=False)["kept"].mean()
    columns = {
        "mean cost": over_seeds(results).set_index(by)["cost_score"],
        "agents and limits kept": agents.groupby(by, sort=False).mean(),
        "episodes kept": episodes,
    }
    return pd.DataFrame(columns).reset_index()
