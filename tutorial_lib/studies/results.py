"""Results of studies, read from their files: means per seed, intervals over seeds, and verdicts on claims.

The unit of observation is the seed. Ten episodes of one agent tell how that agent plays. How the algorithm
performs can only be learned from more training runs, and the spread between episodes says nothing about it.

Two scores are compared, as in DSRL: `reward_score` is the normalised return, `cost_score` the normalised cost
C / L, which is at most 1 where the limit L is kept. `results` is always a table of raw results: one row per
episode, with the columns `OWN_COLUMNS` and those of the options that the study varies.
"""

import csv
import io
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import stats

from tutorial_lib.data.places import why_missing
from tutorial_lib.data.sources import SHIPPED_DATA
from tutorial_lib.scores import with_scores
from tutorial_lib.studies.paper import Claim
from tutorial_lib.tasks import all_tasks

RESULTS = SHIPPED_DATA / "results"
"""The folder of the shipped results."""
SCORES = ("reward_score", "cost_score")
OWN_COLUMNS = (
    "task algorithm profile seed threshold episode return cost length predicted_cost updates".split()
)
"""The columns that the results of every study have. The column `threshold` holds the limit of the episode."""
MEASURED = ("episode", "return", "cost", "length", "predicted_cost", "reconstruction_error")
"""The columns in which the rows of one run and limit differ, or may differ."""
WHOLE = ("seed", "episode", "length", "updates", "update")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
CONFLICT = ("<<<<<<<", "|||||||", "=======", ">>>>>>>")
"""How Git begins the lines that it writes around two versions of a file."""


def load_results(name: str, folder: Path = RESULTS) -> pd.DataFrame:
    """The raw results of a study. The table has no rows where the study was not run.

    Raises ValueError for a file that `read_results` refuses.
    """
    path = folder / f"{name}.csv"
    return read_results(path) if path.exists() else pd.DataFrame(columns=OWN_COLUMNS)


def read_results(path: Path) -> pd.DataFrame:
    """The raw results in a CSV file, or the log of a training if the file's name ends in `-training.csv`.

    Every line is checked. Raises ValueError in one line, which names the file and the line, for a file that
    is no CSV, was cut off or has the marks of a conflict; for a missing column, a value of another type and a
    number that is NaN or infinite (limits may be infinite, and an algorithm may predict no cost); and for an
    episode that is there twice or is missing.
    """
    is_log, data = path.stem.endswith("-training"), path.read_bytes()
    try:
        rows = _rows_of(data, ["seed", "update"] if is_log else OWN_COLUMNS)
        for line, row in rows:
            for column, text in row.items():
                if problem := _problem_of(column, text, is_log):
                    raise ValueError(f"line {line}: {column} is {text!r}, and {problem}")
        if not is_log:
            _check_options(rows)
            _check_episodes(rows)
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path}: {error}") from None
    return pd.read_csv(io.BytesIO(data))


def _rows_of(data: bytes, required: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """The rows of a CSV, each with the number of its line. Raises ValueError for what is no whole CSV."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"line {data.count(10, 0, error.start) + 1}: is not text in UTF-8") from None
    for line, words in enumerate(text.split("\n"), 1):
        if "\0" in words:
            raise ValueError(f"line {line}: has a NUL byte")
        if words.startswith(CONFLICT):
            raise ValueError(f"line {line}: is the mark of a conflict: keep one of the two versions")
    if not text.endswith("\n"):
        raise ValueError(f"line {line}: has no end, so the file was cut off")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header = next(reader)
    if missing := [name for name in required if name not in header]:
        raise ValueError(f"line 1: has no column {', '.join(missing)} (commas separate columns)")
    if len(set(header)) < len(header):
        raise ValueError("line 1: has two columns with one name")
    rows = []
    for row in reader:
        if len(row) != len(header):
            raise ValueError(f"line {reader.line_num}: has {len(row)} values for {len(header)} columns")
        rows.append((reader.line_num, dict(zip(header, row, strict=True))))
    return rows


def _problem_of(column: str, text: str, is_log: bool) -> str:
    """What is wrong with a value, or no words. The columns of options are checked by `_check_options`."""
    if column == "task":
        return "" if text in all_tasks() else "must be the name of a task"
    if not (is_log or column in OWN_COLUMNS or column == "reconstruction_error"):
        return ""
    if column in ("algorithm", "profile"):
        return "" if text else "must be a name"
    if column == "predicted_cost" and not text or column in ("threshold", "limit") and text == "inf":
        return ""
    if not NUMBER.fullmatch(text) or not math.isfinite(float(text)):
        return "must be a finite number"
    if column in WHOLE and not (float(text) >= 0 and float(text).is_integer()):
        return "must be a whole number, 0 or more"
    return "must be 0 or more" if column in ("cost", "threshold") and float(text) < 0 else ""


def _check_options(rows: list[tuple[int, dict[str, str]]]) -> None:
    """Raises ValueError where a column of an option has numbers in some lines and words in others."""
    kinds: dict[str, tuple[bool, int]] = {}
    for line, row in rows:
        for column in set(row) - {*OWN_COLUMNS, "reconstruction_error"}:
            if text := row[column]:  # an algorithm that does not have the option has no value
                is_number = NUMBER.fullmatch(text) is not None or text == "inf"  # a limit that is told
                first, where = kinds.setdefault(column, (is_number, line))
                if is_number != first:
                    raise ValueError(
                        f"line {line}: {column} is {text!r}, of another type than in line {where}"
                    )


def _check_episodes(rows: list[tuple[int, dict[str, str]]]) -> None:
    """Raises ValueError where an episode is there twice, or where a run has fewer episodes than another."""
    episodes: dict[tuple, dict[int, int]] = {}
    for line, row in rows:
        run = tuple(text for column, text in row.items() if column not in MEASURED)
        lines, episode = episodes.setdefault(run, {}), int(float(row["episode"]))
        if episode in lines:
            raise ValueError(f"line {line}: is the same episode as line {lines[episode]}")
        lines[episode] = line
    most = max(map(len, episodes.values()), default=0)
    for lines in episodes.values():
        if set(lines) != set(range(most)):
            words = f"has {len(lines)} episodes, and other runs have {most}: lines are missing"
            raise ValueError(f"line {max(lines.values())}: the last one of its run, which {words}")


def not_run(name: str) -> str:
    """The words that are shown instead of a study's numbers where it was not run."""
    if not RESULTS.is_dir():
        return why_missing(RESULTS)
    return f"Not run: `c2iql study {name}` makes it"


def options_of(results: pd.DataFrame) -> list[str]:
    """The names of the columns that hold the options which a study varies."""
    return [name for name in results.columns if name not in (*OWN_COLUMNS, "reconstruction_error")]


def seed_means(results: pd.DataFrame, by: Sequence[str] = ("task", "algorithm")) -> pd.DataFrame:
    """One row per group of `by` and seed: both scores, averaged over episodes, then over limits."""
    keys = list(dict.fromkeys([*by, "seed", "threshold"]))
    means = with_scores(results).groupby(keys, sort=False, dropna=False)[list(SCORES)].mean().reset_index()
    return means.groupby([*by, "seed"], sort=False, dropna=False)[list(SCORES)].mean().reset_index()


def seed_interval(values: ArrayLike) -> tuple[float, float]:
    """The 95% confidence interval of the mean of values (seeds,), by Student's t. (NaN, NaN) for one seed."""
    values = np.asarray(values, float)
    if len(values) < 2:
        return np.nan, np.nan
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return float(values.mean() - half), float(values.mean() + half)


def over_seeds(results: pd.DataFrame, by: Sequence[str] = ("task", "algorithm")) -> pd.DataFrame:
    """One row per group of `by`: mean, standard deviation and 95% interval over seeds of both scores.

    The columns of a score are its name, and its name with `_std`, `_low` and `_high`. `seeds` is their
    number.
    """
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
    """The score in the rows `high` minus the score in the rows `low`: one value for each seed that has both.

    `high` and `low` map columns to the values that select the rows. Where `low` is a number, this number is
    subtracted.

    The differences are paired: runs of one seed begin their episodes in the same states, and they train on
    the same batches if they draw the same random numbers. (Conditioned agents also draw limits.)
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
    """One row per claim and task: the difference, its 95% interval over seeds, and the verdict on the claim.

    The verdict is 'agrees' where the whole interval is above zero, 'contradicts' where it is below, and
    'undecided' otherwise. A single seed has no interval.
    """
    rows = []
    for claim in claims:
        chosen = results
        for key, value in claim.where.items():
            chosen = chosen[chosen[key] == value] if key in chosen else chosen[:0]  # no column: not run
        for task in chosen["task"].unique() if len(chosen) else ["-"]:
            part = chosen[chosen["task"] == task]
            values = difference(part, claim.score, claim.high, claim.low) if len(part) else np.array([])
            rows.append({"the paper says": claim.words, "where": claim.source, "task": task} | _judge(values))
    return pd.DataFrame(rows)


def _judge(values: np.ndarray) -> dict:
    """The mean of one claim's differences (seeds,), its interval, and the verdict, as words by column."""
    if not len(values):
        return {"difference": "", "95% over seeds": "", "ours": "not run"}
    low, high = seed_interval(values)
    verdict = "agrees" if low > 0 else "contradicts" if high < 0 else "undecided"
    interval = "" if np.isnan(low) else f"{low:+.2f} to {high:+.2f}"
    return {"difference": f"{values.mean():+.2f}", "95% over seeds": interval, "ours": verdict}


def against(results: pd.DataFrame, base: dict) -> pd.DataFrame:
    """One row per task and variant: its differences from the variant `base`, with 95% intervals over seeds.

    A variant is a combination of the values of the columns that `base` names. The differences are paired by
    seed. Their verdict is 'higher' where the whole interval is above zero, 'lower' where it is below, and
    'undecided' otherwise.
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
    """One row per task and algorithm: the mean normalised cost, and how often the limit was kept.

    'agents and limits kept' is the share of pairs (seed, limit) whose mean cost over episodes is at most the
    limit. 'episodes kept' is the share of single episodes.
    """
    scores, by = with_scores(results), ["task", "algorithm"]
    agents = scores.groupby([*by, "seed", "threshold"], sort=False)["cost_score"].mean().le(1)
    episodes = scores.assign(kept=scores["cost_score"].le(1)).groupby(by, sort=False)["kept"].mean()
    columns = {
        "mean cost": over_seeds(results).set_index(by)["cost_score"],
        "agents and limits kept": agents.groupby(by, sort=False).mean(),
        "episodes kept": episodes,
    }
    return pd.DataFrame(columns).reset_index()
