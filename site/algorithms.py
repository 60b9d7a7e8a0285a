"""Writes one page per algorithm from its docstrings, its options, its log and its results."""

import inspect
import sys
from pathlib import Path

import pandas as pd

from tutorial_lib.agents import ALGORITHMS, Agent, slug
from tutorial_lib.options import describe
from tutorial_lib.scores import with_scores
from tutorial_lib.studies.results import load_results, not_run


def write(folder: Path) -> None:
    """Write `folder`/algorithms.md, a list, and `folder`/algorithms/NAME.md for every algorithm."""
    (folder / "algorithms").mkdir(exist_ok=True)
    results = load_results("table1")
    for name, kind in ALGORITHMS.items():
        (folder / "algorithms" / f"{slug(name)}.md").write_text(page(kind, results))
    rows = [
        f"| [{name}](algorithms/{slug(name)}.md) | {first_sentence(kind)} |"
        for name, kind in ALGORITHMS.items()
    ]
    table = "\n".join(["| algorithm | what it is |", "|---|---|", *rows])
    entries = "\n".join(f"algorithms/{slug(name)}" for name in ALGORITHMS)
    words = "What each algorithm computes, where it departs from its source, its options and its results."
    toctree = f"```{{toctree}}\n:hidden:\n\n{entries}\n```\n"
    (folder / "algorithms.md").write_text(f"# Algorithms\n\n{words}\n\n{table}\n\n{toctree}")


def first_sentence(kind: type[Agent]) -> str:
    """The first paragraph of the class's docstring, as the text of one cell of a table."""
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split()).replace("|", r"\|")


def page(kind: type[Agent], results: pd.DataFrame) -> str:
    """The page of one algorithm, in Markdown. `results` are the raw results of study `table1`."""
    told = "is trained for one limit" if kind.needs_limit else "is trained for no limit in particular"
    module = sys.modules[kind.__module__]
    parts = [
        f"# {kind.name}",
        inspect.getdoc(kind) or "",
        f"An agent {told}. Train one with `c2iql train {slug(kind.name)} BallCircle`.",
        "## Sources and departures",
        f"From the file [{module.__name__}](../reference/{module.__name__}.md).",
        inspect.getdoc(module) or "",
        "## Options",
        "`c2iql train` takes each as `--name`. The defaults of both profiles:",
        options_table(kind),
        "## What it logs",
        "`metrics.csv` has a column for each of these, a row for each run every 250 updates:",
        "\n".join(
            ["| scalar | meaning |", "|---|---|", *(f"| `{k}` | {v} |" for k, v in kind.scalars.items())]
        ),
        "## Results",
        results_table(kind, results),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def options_table(kind: type[Agent]) -> str:
    """A table of the options: the defaults in both profiles, and the meaning."""
    paper, small = kind.configure("paper"), kind.configure("small")
    rows = [
        f"| `{name}` | {getattr(paper, name)} | {getattr(small, name)} | "
        f"{words.replace('|', chr(92) + '|')} |"
        for name, words in describe(kind.Config).items()
        if name != "profile"
    ]
    return "\n".join(["| option | paper | small | meaning |", "|---|---|---|---|", *rows])


def results_table(kind: type[Agent], results: pd.DataFrame) -> str:
    """The algorithm's results for Table 1, one row per task, or a sentence where there are none."""
    part = with_scores(results[results["algorithm"] == kind.name])
    if part.empty:
        return "It is no row of Table 1." if not kind.in_table1 else f"*{not_run('table1')}.*"
    means = part.groupby("task", sort=False)[["reward_score", "cost_score"]].mean()
    seeds = part.groupby("task")["seed"].nunique()
    rows = [f"| {task} | {seeds[task]} | {r:.2f} | {c:.2f} |" for task, (r, c) in means.iterrows()]
    words = (
        "Study `table1` on the shipped data, means over seeds, limits and episodes; "
        "normalised as DSRL does:\n\n"
    )
    return words + "\n".join(["| task | seeds | reward | cost |", "|---|---|---|---|", *rows])
