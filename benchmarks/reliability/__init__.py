"""`python -m benchmarks reliability` tries to break the commands and writes RELIABILITY.md.

Every part is a function that returns a table, and has a section of the page. A part that is run again
replaces only its own section. `--quick` takes a few cases of every part but the tests, and writes nothing.
"""

import os
import platform
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path

import joblib
import pandas as pd
import torch
import tyro

from benchmarks.reliability import inputs, kills, load, samples
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.files import written_whole
from tutorial_lib.studies.report import ROOT, between_marks, markdown

PAGE = ROOT / "RELIABILITY.md"
FEW = 0.02
"""The share of the cases that `--quick` takes. Every part has a smallest number of cases."""
SHOWN = 20
"""At most this number of cases that did not end as they should are listed on the page."""


def bad_inputs(share: float) -> str:
    """The section on bad inputs, of a share of the cases."""
    return of_inputs(inputs.trials(share))


def of_inputs(trials: pd.DataFrame) -> str:
    """The table of bad inputs by kind, and the cases that did not end in one clear line without a loss."""
    columns = {"clear": "clear error", "accepted": "accepted", "traceback": "traceback", "killed": "no end"}
    counts = pd.crosstab(trials["kind"], trials["verdict"])
    table = counts.reindex(index=trials["kind"].unique(), columns=list(columns), fill_value=0)
    table = table.rename(columns=columns).rename_axis(index="bad input", columns=None)
    table.insert(0, "tried", table.sum(axis=1))
    table["lost a file"] = trials.groupby("kind")["lost"].sum()
    wrong = trials[(trials["verdict"] != "clear") | trials["lost"]]
    lines = [
        f"- {row.kind}: `{row.words[:120]!r}`: {row.verdict}{', lost a file' if row.lost else ''}"
        for row in wrong.head(SHOWN).itertuples()
    ]
    listed = ["", f"Not as they should be: {len(wrong)}", "", *lines] if lines else []
    return "\n".join([markdown(sums(table.reset_index())), *listed])


def sums(table: pd.DataFrame) -> pd.DataFrame:
    """The table with one more row, the sums of its columns of numbers."""
    whole = table.select_dtypes("number").sum()
    return pd.concat(
        [table, pd.DataFrame([{table.columns[0]: "**all**"} | whole.to_dict()])], ignore_index=True
    )


def killed(share: float) -> str:
    """The section on kills."""
    return markdown(sums(kills.kills(share)))


def two_processes(share: float) -> str:
    """The section on two processes in one folder."""
    found = kills.pairs(max(1, round(10 * share)))
    return markdown(pd.DataFrame([{"pairs": len(found)} | found.sum().astype(int).to_dict()]))


def full_disk(share: float) -> str:
    """The section on a full disk."""
    found = kills.full_disks((0.2, 0.5, 0.8) if share == 1 else (0.5,))
    by = found.groupby(["command", "by"], sort=False)
    columns = {
        "tried": by.size(),
        "clear error": by["clear error"].sum(),
        "exact afterwards": by["exact afterwards"].sum(),
    }
    return markdown(sums(pd.DataFrame(columns).reset_index()))


def cells(share: float) -> str:
    """The section on a study of many entries."""
    return markdown(load.cells() if share == 1 else load.cells(max(4, round(200 * share)), 1))


def large(share: float) -> str:
    """The section on many times the data. Less than a full trial takes a made-up dataset twice."""
    if share == 1:
        return markdown(load.large().T.reset_index().set_axis(["what", "shipped", "50 times"], axis=1))
    with tempfile.TemporaryDirectory() as folder:
        source = write_dataset(Path(folder) / "data.hdf5", samples.make_dataset(), "BallRun")
        return markdown(load.large(2, source).T.reset_index().set_axis(["what", "one", "twice"], axis=1))


def suite(share: float) -> str:
    """The section on the tests with other kernels."""
    return markdown(load.suite())


PARTS: dict[str, Callable[[float], str]] = {
    "inputs": bad_inputs,
    "kills": killed,
    "pairs": two_processes,
    "disk": full_disk,
    "cells": cells,
    "large": large,
    "suite": suite,
}
"""The parts, by the name of their section."""
QUICK = tuple(name for name in PARTS if name != "suite")


def section(name: str, share: float) -> str:
    """Runs a share of a part, and returns its table under a line that says when, where and how it was run."""
    began = time.monotonic()
    table = PARTS[name](share)
    part = "" if share == 1 else f" --share {share:g}"
    facts = f"{joblib.cpu_count()} cores with a load of {os.getloadavg()[0]:.0f}, {platform.system()}, "
    facts += (
        f"Python {platform.python_version()}, PyTorch {torch.__version__}, {time.monotonic() - began:.0f} s"
    )
    command = f"`python -m benchmarks reliability --parts {name}{part}`"
    return f"{command}, {date.today().isoformat()}: {facts}.\n\n{table}\n"


def main(parts: tuple[str, ...] = QUICK, share: float = 1.0, quick: bool = False) -> None:
    """Try to break the commands, and write tables of what came of it to RELIABILITY.md.

    Args:
        parts: run these parts: inputs, kills, pairs, disk, cells, large and suite. The last runs all tests,
            so it is left out unless it is named.
        share: take this share of the cases. The page says so.
        quick: take a few cases, print the tables, and write nothing.
    """
    if unknown := sorted(set(parts) - set(PARTS)):
        raise ValueError(f"--parts {unknown[0]}: the parts are {', '.join(PARTS)}")
    if not 0 < share <= 1:
        raise ValueError(f"--share {share}: must be above 0 and at most 1")
    for name in parts:
        text = section(name, FEW if quick else share)
        print(f"## {name}\n\n{text}", flush=True)
        if not quick:
            page = between_marks(PAGE.read_text(), name, text)
            with written_whole(PAGE) as temporary:
                temporary.write_text(page)


def command(words: list[str]) -> None:
    """Runs `python -m benchmarks reliability WORDS`."""
    torch.set_num_threads(1)
    tyro.cli(main, args=words, prog="python -m benchmarks reliability")
