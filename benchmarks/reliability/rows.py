"""The faults that the trials put into tables of results and into recordings of episodes."""

import csv
import io
from collections.abc import Callable
from pathlib import Path

from hypothesis import strategies as st

from benchmarks.reliability.damage import BYTES, CUTS, SHARES, Fault, rewritten
from benchmarks.reliability.words import NO_NUMBERS
from tutorial_lib.studies.results import OWN_COLUMNS


def _table(change: Callable[[list[list[str]]], object]) -> Callable[[Path], object]:
    """Writes a CSV again after a change of its rows, the first of which is the header."""

    def make(path: Path) -> None:
        rows = list(csv.reader(io.StringIO(path.read_text(), newline="")))
        change(rows)
        with open(path, "w", newline="") as file:
            csv.writer(file).writerows(rows)

    return make


def _of_cell(column: str, share: float, text: str) -> Fault:
    def change(rows: list[list[str]]) -> None:
        rows[1 + int(share * (len(rows) - 2))][rows[0].index(column)] = text

    return Fault(f"{column} is {text!r} at {share:.3f}", _table(change))


def _of_rows(columns: list[str]) -> st.SearchStrategy[Fault]:
    """Faults of any table of numbers."""
    wrong = NO_NUMBERS | st.sampled_from(["nan", "1e999", "--1"])
    return st.one_of(
        BYTES,
        st.builds(_of_cell, st.sampled_from(columns), SHARES, wrong),
        st.sampled_from(columns).map(
            lambda c: Fault(f"column {c} missing", _table(lambda rows: _drop(rows, c)))
        ),
        SHARES.map(
            lambda s: Fault(f"a short row at {s:.3f}", _table(lambda rows: rows[int(s * len(rows))].pop()))
        ),
        st.just(Fault("semicolons", rewritten(lambda old: old.replace(b",", b";")))),
    )


def _drop(rows: list[list[str]], column: str) -> None:
    place = rows[0].index(column)
    for row in rows:
        del row[place]


def _again(rows: list[list[str]], share: float) -> None:
    rows.append(rows[1 + int(share * (len(rows) - 1))])


def _without(rows: list[list[str]], share: float) -> None:
    del rows[1 + int(share * (len(rows) - 1))]


def _at(share: float, change: Callable[[bytes, bytes], bytes]) -> Callable[[Path], object]:
    """Changes the bytes before and after a place."""
    return rewritten(lambda old: change(old[: int(share * len(old))], old[int(share * len(old)) :]))


def of_results() -> st.SearchStrategy[Fault]:
    """Faults of a table of results."""
    words = ("task", "algorithm", "profile", "predicted_cost")
    mark = b"<<<<<<< HEAD\n"
    return st.one_of(
        _of_rows([name for name in OWN_COLUMNS if name not in words]),
        SHARES.map(lambda s: Fault(f"a row twice, {s:.3f}", _table(lambda rows: _again(rows, s)))),
        SHARES.map(lambda s: Fault(f"a row missing, {s:.3f}", _table(lambda rows: _without(rows, s)))),
        SHARES.map(lambda s: Fault(f"cut in a row, {s:.3f}", _at(s, lambda old, _: old.rstrip(b"\r\n")))),
        SHARES.map(lambda s: Fault(f"NUL, {s:.3f}", _at(s, lambda old, rest: old + b"\0" + rest))),
        st.just(Fault("a conflict's mark", rewritten(lambda old: mark + old))),
        st.just(_of_cell("task", 0.5, "Humanoid")),
    )


def of_recordings() -> st.SearchStrategy[Fault]:
    """Faults of an episode that is to be converted."""
    columns = [f"obs_{i}" for i in range(7)] + [
        "action_0",
        "action_1",
        "reward",
        "cost",
        "terminal",
        "timeout",
    ]
    return st.one_of(_of_rows(columns), CUTS)
