"""Trials of reliability: a few cases of every part, faults that they must notice, and bounds of options."""

import contextlib
import dataclasses
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import psutil
import pytest
import torch

from benchmarks import reliability
from benchmarks.reliability import inputs, kills, load
from benchmarks.reliability.jobs import Job, train
from benchmarks.reliability.processes import Ended, contents, kill, run, start, typed
from benchmarks.reliability.samples import make_samples
from tutorial_lib import files
from tutorial_lib.agents import ALGORITHMS, get_algorithm
from tutorial_lib.checkpoints import CHECKPOINT
from tutorial_lib.commands import COPIES, MOST, check_counts, check_memory
from tutorial_lib.config import LARGEST, MANY
from tutorial_lib.files import HOLDER, held, written_whole
from tutorial_lib.tasks import TASKS

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the trials fork")


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return make_samples(tmp_path_factory.mktemp("good") / "samples")


def rows_of(text):
    """The rows of the table in a section of the page."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return [dict(zip(lines[0], line, strict=True)) for line in lines[2:]]


# --- A few cases of every part ---


@pytest.mark.parametrize("name", reliability.QUICK)
def test_a_few_cases_of_every_part_end_as_they_should(name, capsys):
    page = reliability.PAGE.read_bytes()
    reliability.main(parts=(name,), quick=True)
    said = capsys.readouterr().out
    rows = rows_of(said)
    assert said.startswith(f"## {name}\n") and reliability.PAGE.read_bytes() == page
    equal = {
        "inputs": ("tried", "clear error"),
        "kills": ("resumed to the end", "exact"),
        "pairs": ("pairs", "exact"),
        "disk": ("tried", "exact afterwards"),
        "cells": ("entries", "equal to one process"),
    }
    if name == "large":
        (transitions,) = (row for row in rows if row["what"] == "transitions")
        assert (transitions["one"], transitions["twice"]) == ("300", "600")
    else:
        first, second = equal[name]
        assert rows and all(row[first] == row[second] != "0" for row in rows)
    if name == "disk":
        assert all(row["clear error"] == row["tried"] for row in rows)


def test_the_page_has_a_place_for_every_part_and_no_bad_input_that_ended_badly():
    page = reliability.PAGE.read_text()
    for name in reliability.PARTS:
        assert page.count(f"<!-- {name}:begin -->") == page.count(f"<!-- {name}:end -->") == 1
    found = page.split("<!-- inputs:begin -->")[1].split("<!-- inputs:end -->")[0]
    *kinds, whole = rows_of(found)
    assert int(whole["tried"]) == int(whole["clear error"]) == sum(int(row["tried"]) for row in kinds) >= 300
    assert {whole[name] for name in ("accepted", "traceback", "no end", "lost a file")} == {"0"}


def test_the_command_replaces_one_section_and_refuses_other_words(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- suite:begin -->\nold\n<!-- suite:end -->\nb\n")
    monkeypatch.setattr(reliability, "PAGE", page)
    monkeypatch.setattr(load, "suite", lambda: pd.DataFrame([{"result": "3 passed in 1 s"}]))
    reliability.command(["--parts", "suite"])
    text = page.read_text()
    assert text.startswith("a\n<!--") and text.endswith("-->\nb\n") and "old" not in text
    assert "reliability --parts suite`" in text and "| 3 passed in 1 s |" in text
    for words, message in ((["--parts", "kill"], "--parts kill: the parts"), (["--share", "0"], "--share 0")):
        with pytest.raises(ValueError, match=message):
            reliability.command(words)


def test_the_tests_are_run_with_the_plainest_kernels():
    script = "import torch; print('a'); print('= 1 passed,', torch.backends.cpu.get_cpu_capability(), '=')"
    (row,) = load.suite([load.SUITE[0], "-c", script]).to_dict("records")
    assert row["result"] == "1 passed, DEFAULT"


# --- Cases ---


def test_a_full_trial_has_300_different_cases_and_draws_the_same_again(tmp_path):
    made = {kind.name: kind for kind in inputs.kinds("http://127.0.0.1:1", tmp_path)}
    assert sum(kind.count for kind in made.values()) >= 300
    for name, kind in made.items():
        cases = inputs.drawn(kind.cases, kind.count)
        words = [case.words for case in cases]
        assert len(set(words)) == len(words) == kind.count, name
        if name != "a server's answer":  # its cases are numbered as they are drawn
            assert words == [case.words for case in inputs.drawn(kind.cases, kind.count)]


def of_files(folder):
    """The kinds of bad inputs that are files."""
    others = ("an option of training", "an argument of a command", "a server's answer")
    return [kind for kind in inputs.kinds("http://127.0.0.1:1", folder) if kind.name not in others]


def test_every_fault_changes_its_file(samples, tmp_path):
    for kind in of_files(tmp_path):
        for number, case in enumerate(inputs.drawn(kind.cases, 10)):
            folder = tmp_path / f"{kind.name} {number}"
            shutil.copytree(samples, folder)
            case.damage(folder)
            assert contents(folder) != contents(samples), case.words


def test_the_good_inputs_are_accepted(samples, tmp_path):
    """So the damage is what is refused."""
    works = {case.work for kind in of_files(tmp_path) for case in inputs.drawn(kind.cases, 1)}
    assert len(works) == 6
    for number, work in enumerate(works):
        shutil.copytree(samples, folder := tmp_path / f"good {number}")
        ended = run(work, folder)
        assert ended.verdict == "accepted", ended.err


# --- Faults that must be noticed ---


@pytest.mark.parametrize(
    ("status", "out", "err", "verdict"),
    [
        (0, "", "", "accepted"),
        (2, "", "c2iql: no\n", "clear"),
        (2, "", "  0%|   | 0/3\nc2iql: no\n", "clear"),
        (2, "", "usage\nFor full helptext, run c2iql --help\n", "clear"),
        (2, "", "0/3 [00:00]c2iql: no\n", "traceback"),
        (2, "", "c2iql: no\nc2iql: again\n", "traceback"),
        (2, "", "c2iql: no\nand more\n", "traceback"),
        (2, "", "Traceback (most recent call last):\nc2iql: no\n", "traceback"),
        (1, "", "c2iql: no\n", "traceback"),
        (2, "", "", "traceback"),
        (None, "", "c2iql: no\n", "killed"),
    ],
)
def test_a_verdict(status, out, err, verdict):
    assert Ended(status, out, err, 0.0).verdict == verdict


def refuses():
    print("c2iql: no", file=sys.stderr)
    sys.exit(2)


def spoils_and_refuses():
    Path("data.hdf5").write_bytes(b"half")
    refuses()


def litters_and_refuses():
    Path(".x.tmp").write_bytes(b"")
    refuses()


def accepts_and_deletes():
    Path("agent.safetensors").unlink()


@pytest.mark.parametrize(
    ("work", "verdict", "lost"),
    [
        (refuses, "clear", False),
        (spoils_and_refuses, "clear", True),
        (litters_and_refuses, "clear", True),
        (accepts_and_deletes, "accepted", True),
        (lambda: 1 / 0, "traceback", False),
        (lambda: time.sleep(60), "killed", False),
        (lambda: Path("new.csv").write_bytes(b""), "accepted", False),
        (lambda: bytearray(20_000_000_000), "traceback", False),
    ],
)
def test_a_bad_end_and_a_lost_file_are_noticed(work, verdict, lost, samples, tmp_path, monkeypatch):
    monkeypatch.setattr(inputs, "SECONDS", 2)
    found = inputs.tried(inputs.Case("planted", work), samples, tmp_path / "case")
    assert found[:2] == (verdict, lost)


def test_the_page_lists_what_did_not_end_as_it_should():
    columns = ["kind", "words", "verdict", "lost", "output"]
    trials = pd.DataFrame(
        [("a", "good", "clear", False, ""), ("a", "bad", "accepted", True, "")], columns=columns
    )
    text = reliability.of_inputs(trials)
    assert rows_of(text)[0] | {"bad input": ""} == {
        "bad input": "", "tried": "2", "clear error": "1", "accepted": "1", "traceback": "0", "no end": "0",
        "lost a file": "1",
    }  # fmt: skip
    assert text.endswith("Not as they should be: 1\n\n- a: `'bad'`: accepted, lost a file")


def appends():
    """Is not resumed exactly: it adds to what it wrote before."""
    for _ in range(30):
        with open("log", "a") as file:
            file.write("x")
        time.sleep(0.01)


def test_a_resume_that_is_not_exact_is_noticed(tmp_path):
    row = kills.killed(Job("appends", appends, 2), tmp_path, 2, random.Random(0))
    assert row == {"command": "appends", "kills": 2, "resumed to the end": 1, "exact": 0}


def test_two_winners_and_a_spoilt_winner_are_noticed():
    won, refused = Ended(0, "", "", 1.0), Ended(2, "", "c2iql: in use\n", 1.0)
    alone = [{"a": b"1"}, {"a": b"2"}]
    assert all(kills._judged([refused, won], {"a": b"2"}, alone).values())
    assert not kills._judged([refused, won], {"a": b"1"}, alone)["exact"]
    assert not any(kills._judged([won, won], {"a": b"2"}, alone).values())
    assert not any(kills._judged([refused, refused], {}, alone).values())


def test_without_a_file_system_of_its_own_the_trial_limits_the_size_of_files(samples, tmp_path, monkeypatch):
    @contextlib.contextmanager
    def not_mounted(folder):
        folder.mkdir()
        yield False

    monkeypatch.setattr(kills, "small_disk", not_mounted)
    (tmp_path / "samples").symlink_to(samples)
    job = Job("train", train(20), 1)
    expected, _ = kills.undisturbed(job.work, tmp_path / "whole")
    row = kills._filled(job, tmp_path, expected, 0.5)
    assert row["clear error"] and row["exact afterwards"] and row["by"] == "a limit on the size of files"
    assert not kills._filled(Job("appends", appends, 1), tmp_path, {"log": b"x" * 30}, 0.5)[
        "exact afterwards"
    ]


# --- A lock of another machine ---


def test_a_lock_of_another_machine_is_explained_and_the_run_goes_on_once_it_is_deleted(samples, tmp_path):
    (tmp_path / "samples").symlink_to(samples)
    expected, _ = kills.undisturbed(train(60), tmp_path / "whole")
    (folder := tmp_path / "shared").mkdir()
    child, holder = start(train(60), folder), folder / "run" / HOLDER
    while not (folder / "run" / CHECKPOINT).exists():
        assert not os.waitpid(child, os.WNOHANG)[0]
    kill(child)
    os.waitpid(child, 0)
    holder.write_text(json.dumps({"host": "node7", "pid": 12, "since": "2026-01-02 03:04:05"}))
    ended = run(train(60), folder)
    assert ended.verdict == "clear"
    words = "c2iql: run: is in use by process 12 on node7 since 2026-01-02 03:04:05: "
    assert ended.err.endswith(f"{words}if that process runs no longer, delete run/{HOLDER}\n")
    holder.unlink()
    assert run(train(60), folder).status == 0
    assert kills.written(folder) == expected


# --- Bounds of options ---


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_whole_number_has_a_largest_value(name):
    kind = get_algorithm(name)
    config = kind.configure()
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if type(value) is int:
            most = LARGEST.get(field.name, MANY)
            assert value <= most / 2, field.name
            words = f"^{field.name} is {most + 1}, and must be at most {most:,}$"
            with pytest.raises(ValueError, match=words):
                config.changed(**{field.name: most + 1})


@pytest.mark.parametrize("value", [float("inf"), -float("inf"), float("nan"), 1e39, 10**400])
def test_a_number_that_float32_does_not_have_is_refused(value):
    with pytest.raises(ValueError, match="^unsafe_price is "):
        get_algorithm("C2IQL").configure(unsafe_price=value)


def test_counts_have_a_largest_value():
    for name, most in MOST.items():
        check_counts(**{name: most})
        with pytest.raises(ValueError, match=f"^--{name} {most + 1}: must be at most {most:,}$"):
            check_counts(**{name: most + 1})
    assert MOST["workers"] >= 8


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_memory_that_is_asked_for_is_counted_without_taking_it(name, monkeypatch):
    """The oracle: all numbers of the agents that are built, and not only outlined."""
    kind, task = get_algorithm(name), TASKS["BallRun"]
    limits = (30.0, 50.0) if kind.needs_limit else None
    runs = task, kind.configure("small"), (0, 1), limits
    agent = kind(*runs)
    held = sum(x.numel() for tensors in agent.parameters.values() for x in tensors.values())

    def with_free(numbers):
        free = psutil.virtual_memory()._replace(available=4 * COPIES * numbers)
        monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
        check_memory(kind, *runs)

    generator = torch.get_rng_state()
    with_free(4 * held)  # at most: a network may be built and replaced
    with pytest.raises(
        ValueError, match=f"^{re.escape(kind.name)}: these options need .* GB are free: choose"
    ):
        with_free(held - 1)
    assert torch.equal(torch.get_rng_state(), generator)


def test_networks_that_do_not_fit_are_one_line_at_once(samples, tmp_path):
    (folder := tmp_path / "case").mkdir()
    words = ("train", "BallRun", "--data", samples / "data.hdf5", "--out", "run", "--hidden-width", 8192)
    ended = run(typed(*words, "--hidden-layers", 64), folder)
    assert ended.verdict == "clear" and "choose fewer seeds or limits, or smaller networks" in ended.err
    assert not (folder / "run").exists()


# --- What killed writers leave ---


WRITE = """
import os, pathlib, signal, sys
from tutorial_lib.files import written_whole

blocks = [written_whole(pathlib.Path(sys.argv[1]) / name) for name in sys.argv[2:]]
for block in blocks:
    block.__enter__().write_text("half")
os.kill(os.getpid(), signal.SIGKILL)
"""


def halves_in(folder):
    return sorted(path.name.split(".csv.")[0] for path in folder.glob(".*.tmp"))


def test_what_a_killed_process_wrote_of_a_table_goes_when_the_table_is_written_or_the_folder_locked(tmp_path):
    command = [sys.executable, "-c", WRITE, tmp_path, "a.csv", "b.csv", "c.csv"]
    assert subprocess.run(command, cwd=ROOT).returncode == -signal.SIGKILL
    with written_whole(tmp_path / "mine.csv") as mine:  # this process is alive
        mine.write_text("whole")
        assert halves_in(tmp_path) == [".a", ".b", ".c", ".mine"]
        with written_whole(tmp_path / "b.csv") as temporary:
            temporary.write_text("whole")
        assert halves_in(tmp_path) == [".a", ".c", ".mine"]
        with held(tmp_path):
            assert halves_in(tmp_path) == [".mine"]
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["b.csv", "mine.csv"]


def test_what_a_process_of_another_machine_writes_of_a_table_is_left(tmp_path, monkeypatch):
    command = [sys.executable, "-c", WRITE, tmp_path, "a.csv"]
    assert subprocess.run(command, cwd=ROOT).returncode == -signal.SIGKILL
    monkeypatch.setattr(files, "_machine", lambda: "00000000")
    with held(tmp_path), written_whole(tmp_path / "a.csv") as temporary:
        temporary.write_text("whole")
    assert halves_in(tmp_path) == [".a"]
