"""The command line as a student types it: help, one-line errors, a tiny run from training to scores."""

import contextlib
import dataclasses
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tutorial_lib import __main__ as cli
from tutorial_lib.checkpoints import load_agent
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.studies import cluster
from tutorial_lib.tasks import TASKS

ROOT = Path(__file__).parents[1]
TINY = ["hidden_width=8", "hidden_layers=1", "batch_size=8", "crm_width=8", "crm_layers=1", "crm_steps=5"]


@pytest.fixture
def c2iql(monkeypatch, capsys):
    """Type a command; returns its exit status, what it printed, and what it said went wrong."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["c2iql", *map(str, arguments)])
        status = 0
        try:
            cli.main()
        except SystemExit as error:
            status = error.code
        out, err = capsys.readouterr()
        if isinstance(status, str):  # what Python itself does with it
            status, err = 1, err + status + "\n"
        return status, out, err

    return run


@pytest.fixture
def data(tmp_path):
    """Three random episodes with BallRun's shapes, in a file."""
    rng = np.random.default_rng(0)
    dataset = Dataset(
        observations=rng.normal(size=(300, 7)).astype(np.float32),
        next_observations=rng.normal(size=(300, 7)).astype(np.float32),
        actions=rng.uniform(-1, 1, size=(300, 2)).astype(np.float32),
        rewards=rng.normal(5, 5, size=300).astype(np.float32),
        costs=(rng.random(300) < 0.4).astype(np.float32),
        terminals=np.zeros(300, bool),
        timeouts=np.arange(1, 301) % 100 == 0,
    )
    return write_dataset(tmp_path / "data.hdf5", dataset, "BallRun")


# --- Help ---


def words(text):
    """Without tyro's boxes and line breaks."""
    return " ".join(re.sub("[─│╭╮╰╯]", " ", text).split())


@pytest.mark.parametrize(
    ("command", "phrases"),
    {
        "tasks": ["List the tasks"],
        "collect": ["Make a dataset from the simulator", "--seeds", "one PPO run each"],
        "fetch": ["Download DSRL's dataset", "DSRL_DATASET_DIR"],
        "train": ["Train an agent", "--threshold", "kappa_2=0.7", "{cpu,cuda}"],
        "evaluate": ["Run a trained agent in the simulator", "--thresholds", "per seed and threshold"],
        "report": ["Make tables and figures from the results' files", "whose table is printed"],
        "study": ["Run a study", "address of a dask scheduler", "--only", "steps=200"],
    }.items(),
)
def test_help_says_what_a_command_does(command, phrases, c2iql):
    status, out, err = c2iql(command, "--help")
    assert (status, err) == (0, "")
    assert f"usage: c2iql {command}" in out
    for phrase in phrases:
        assert phrase in words(out)
    status, out, _ = c2iql("--help")
    assert status == 0 and phrases[0] in words(out) and command in out


def test_every_command_has_help_for_each_of_its_arguments(c2iql):
    overview = words(c2iql("--help")[1])
    for name in re.search(r"\{([\w,]+)\}", overview).group(1).split(","):
        command = getattr(cli, name)
        arguments = inspect.signature(command).parameters
        said = dict(re.findall(r"^    (\w+): (.+)", inspect.getdoc(command), re.M))
        assert list(said) == list(arguments), name
        shown = words(c2iql(name, "--help")[1])
        for argument, text in said.items():
            assert len(text.split()) > 1 and text.split(",")[0] in shown, (name, argument)


def test_it_runs_as_a_module():
    result = subprocess.run(
        [sys.executable, "-m", "tutorial_lib", "tasks"], cwd=ROOT, capture_output=True, text=True
    )
    assert (result.returncode, result.stderr) == (0, "")
    rows = {line.split()[0]: line.split() for line in result.stdout.splitlines()[1:]}
    assert rows.keys() == TASKS.keys()
    assert rows["CarCircle"][1:4] == ["300", "8", "2"]
    assert "(30, 50, 70)" in " ".join(rows["CarCircle"])


# --- Errors ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "BallRum"], "unknown task 'BallRum': did you mean BallRun"),
        (["fetch", "Hopper"], "unknown task 'Hopper'"),
        (["collect", "AntCircl"], "unknown task 'AntCircl': did you mean AntCircle"),
        (["train", "BallRun", "--algorithm", "SAC"], "unknown algorithm 'SAC': the algorithms are IQL"),
        (["train", "BallRun", "--profile", "huge"], "unknown profile 'huge': the profiles are paper, small"),
        (["train", "BallRun", "--option", "kappa=0.7"], "--option kappa=0.7: write NAME=VALUE with one of"),
        (["train", "BallRun", "--option", "kappa_1"], "--option kappa_1: write NAME=VALUE"),
        (["train", "BallRun", "--option", "kappa_1=high"], "--option kappa_1=high: the value must be float"),
        (["train", "BallRun", "--option", "time_limits=off"], "must be Literal['rate', 'bootstrap', 'mask']"),
        (["train", "BallRun", "--option", "shift_rewards=maybe"], "the value must be True or False"),
        (["train", "BallRun", "--option", "kappa_1=1.5"], "kappa_1 is 1.5, and must be between 0 and 1"),
        (["train", "BallRun", "--option", "gamma=1"], "gamma is 1.0, and must be between 0 and 1"),
        (["train", "BallRun", "--option", "steps=-5"], "steps is -5, and must be 1 or more"),
        (["train", "BallRun", "--option", "profile=paper"], "--option profile=paper: write NAME=VALUE"),
        (["train", "BallRun", "--seeds", "-2"], "seeds [-2]: at least one, each 0 or more"),
        (["train", "BallRun", "--seeds"], "seeds []: at least one"),
        (["collect", "BallRun", "--episodes", "0"], "--episodes 0: must be 1 or more"),
        (["evaluate", "nowhere.safetensors", "--workers", "0"], "--workers 0: must be 1 or more"),
        (["evaluate", "nowhere.safetensors", "--out", "."], "--out .: is a folder: name a file"),
        (["study", "ablations", "--workers", "0"], "--workers 0: must be 1 or more"),
        (["train", "BallRun", "--algorithm", "CIQL", "--threshold", "-3"], "must be zero or more, not -3.0"),
        (["train", "BallRun", "--algorithm", "CIQL"], "CIQL is trained for one threshold"),
        (["train", "BallRun", "--threshold", "30"], "C2IQL takes no threshold to train"),
        (["train", "BallRun", "--data", "nowhere.hdf5"], "nowhere.hdf5: no such file"),
        (["study", "ablation"], "unknown study 'ablation': the studies are table1, ablations"),
        (["evaluate", "nowhere.safetensors"], "nowhere.safetensors: no such file: train an agent"),
    ],
)
def test_an_error_is_one_line(arguments, message, c2iql):
    status, out, err = c2iql(*arguments)
    assert status == 1 and out == ""
    assert err.startswith("c2iql: ") and message in err and err.count("\n") == 1


def test_a_machine_without_cuda_says_so(c2iql, monkeypatch):
    monkeypatch.setattr(cli.torch.cuda, "is_available", lambda: False)
    status, _, err = c2iql("train", "BallRun", "--device", "cuda")
    assert status == 1 and err.startswith("c2iql: --device cuda") and err.count("\n") == 1


@pytest.mark.parametrize("arguments", [[], ["learn"], ["train"], ["train", "BallRun", "--colour", "red"]])
def test_what_cannot_be_understood_fails_without_a_traceback(arguments, c2iql):
    status, out, err = c2iql(*arguments)
    assert status == 2 and "Traceback" not in out + err and "--help" in out + err


# --- Options ---


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("kappa_2=0.65", 0.65),
        ("steps=7", 7),
        ("cost_kappa=0.8", 0.8),
        ("cost_kappa=None", None),
        ("shift_rewards=True", True),
        ("normalise_observations=False", False),
        ("crm=linear", "linear"),
        ("value_lr=1e-5", 1e-5),
    ],
)
def test_an_option_changes_its_field_and_no_other(option, value):
    before = cli.get_profile("small")
    after = cli.with_options(before, (option,))
    name = option.split("=")[0]
    assert getattr(after, name) == value and type(getattr(after, name)) is type(value)
    assert dataclasses.replace(after, **{name: getattr(before, name)}) == before


# --- From data to scores ---


def test_train_and_evaluate(c2iql, data, tmp_path):
    run = tmp_path / "run"
    train = ["train", "BallRun", "--data", data, "--out", run, "--seeds", 0, 3, "--option", *TINY, "steps=4"]
    status, out, _ = c2iql(*train, "kappa_2=0.65")
    assert status == 0 and f"{run}/agent.safetensors: trained for 4 updates" in out
    assert {p.name for p in run.iterdir()} == {"agent.safetensors", "checkpoint.safetensors", "metrics.csv"}
    agent = load_agent(run / "agent.safetensors")
    assert (agent.seeds, agent.config.profile, agent.config.kappa_2) == ((0, 3), "small", 0.65)

    status, out, _ = c2iql("evaluate", run / "agent.safetensors", "--episodes", 2, "--workers", 1)
    assert status == 0 and "cost_score" in out and f"{run}/agent-results.csv: 12 episodes" in out
    results = pd.read_csv(run / "agent-results.csv")
    assert sorted(set(results["threshold"])) == [30, 50, 70] and set(results["seed"]) == {0, 3}

    other = tmp_path / "other.csv"
    limits = ["--thresholds", 0, 12.5, "--episodes", 1, "--workers", 1, "--out", other]
    assert c2iql("evaluate", run / "checkpoint.safetensors", *limits)[0] == 0
    assert sorted(set(pd.read_csv(other)["threshold"])) == [0, 12.5]
    status, _, err = c2iql("evaluate", run / "agent.safetensors", "--thresholds", -5, "--workers", 1)
    assert status == 1 and "must be zero or more" in err and err.count("\n") == 1

    status, _, err = c2iql(*train, "kappa_2=0.7")  # the folder is another run's
    assert status == 1 and "is of another run" in err.splitlines()[-1]


def test_train_says_what_the_results_agents_have_that_this_one_has_not(c2iql, data, tmp_path, monkeypatch):
    monkeypatch.setitem(cli.studies.OWN_OPTIONS, "BallRun", {"unsafe_price": 20.0, "time_limits": "mask"})
    train = ["train", "BallRun", "--data", data, "--option", *TINY, "steps=1", "unsafe_price=20"]
    said = "BallRun in the results have options of their own: --option unsafe_price=20.0 time_limits=mask"
    assert said in c2iql(*train, "--out", tmp_path / "without")[1]
    assert "of their own" not in c2iql(*train, "time_limits=mask", "--out", tmp_path / "with")[1]
    assert "of their own" not in c2iql(*train, "--algorithm", "IQL", "--out", tmp_path / "IQL")[1]


@pytest.fixture
def small_study(monkeypatch):
    """A study of the shipped data that takes a second."""
    from tutorial_lib.studies import grids

    grid = grids.Grid(("BallRun",), options=({"kappa_1": 0.6},), seeds=1, limits=(25.0,))
    monkeypatch.setitem(grids.STUDIES, "quick", grids.Study("How quick?", (grid,)))


def test_report_of_a_study_says_that_it_was_not_run(c2iql, monkeypatch):
    from tutorial_lib.studies import report, results

    monkeypatch.setattr(report, "load_results", lambda name: results.load_results("no-such-study"))
    status, out, _ = c2iql("report", "kappas")
    assert status == 0 and "Not run: `c2iql study kappas` makes it." in out and "no figure" in out
    status, _, err = c2iql("report", "kappa")
    assert status == 1 and "unknown study 'kappa': the studies are table1" in err


def test_study(c2iql, tmp_path, small_study):
    """A trial stays out of the committed results, and is found finished the second time."""
    trial = ["study", "quick", "--runs", tmp_path, "--steps", 2, "--workers", 1, "--option", *TINY]
    status, out, _ = c2iql(*trial, "--list")
    waiting = r"waiting BallRun-C2IQL-kappa_1=0.6-\w{8}\n$"
    assert status == 0 and re.search(waiting, out) and not list(tmp_path.iterdir())
    status, out, _ = c2iql(*trial)
    assert status == 0 and f"{tmp_path}/quick.csv: 1 of 1 cells" in out
    results = pd.read_csv(tmp_path / "quick.csv")
    assert set(results["threshold"]) == {25} and set(results["updates"]) == {2}
    assert len(results) == 10 and "kappa_1" not in results  # the cell is called after it, but nothing varies
    status, out, _ = c2iql(*trial, "--list")
    assert status == 0 and "done    BallRun-C2IQL-kappa_1=0.6" in out


def test_a_failed_cell_is_reported_and_the_others_are_kept(c2iql, tmp_path, data, monkeypatch):
    from tutorial_lib.studies import grids

    grid = grids.Grid(("BallRun",), ("BC-All", "BC-Safe"), seeds=1)
    monkeypatch.setitem(grids.STUDIES, "cloning", grids.Study("Who copies whom?", (grid,)))
    monkeypatch.setattr(cluster, "run_cells", lambda chosen, *_: {chosen[0].name: "DatasetError: none"})
    monkeypatch.setattr(cluster, "connect", lambda *_: contextlib.nullcontext())
    out_file = tmp_path / "out.csv"
    arguments = ["study", "cloning", "--data", data, "--runs", tmp_path, "--out", out_file]
    status, out, err = c2iql(*arguments)
    assert status == 1 and "Who copies whom?" in out and "0 of 4 cells" in out
    assert re.search(r"FAILED BallRun-BC-All-\w{8}: DatasetError: none", out)
    assert "1 of 4 cells failed" in err and err.count("\n") == 1 and not out_file.exists()


def test_a_folder_that_cannot_be_written_is_one_line_of_error(c2iql, data, tmp_path):
    (tmp_path / "file").write_text("")
    train = ["train", "BallRun", "--data", data, "--out", tmp_path / "file" / "run"]
    status, _, err = c2iql(*train, "--algorithm", "IQL", "--option", *TINY, "steps=1")
    assert status == 1 and "Traceback" not in err and err.splitlines()[-1].startswith("c2iql: ")


def test_options_that_fit_together_come_in_any_order():
    for options in (("crm=linear", "crm_width=0"), ("crm_width=0", "crm=linear")):
        config = cli.with_options(cli.get_profile("small"), options)
        assert (config.crm, config.crm_width) == ("linear", 0)
