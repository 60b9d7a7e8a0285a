"""The training loop: killed and resumed, several seeds at once, stopped by NaN; its files, and its optimiser.

Run as a script, this file is the process that gets killed.
"""

import contextlib
import csv
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from tutorial_lib import training
from tutorial_lib.agents import ALGORITHMS, get_algorithm
from tutorial_lib.checkpoints import TrainingError, load_agent, save_agent
from tutorial_lib.config import Config
from tutorial_lib.data.dataset import Dataset, sample_batch
from tutorial_lib.matmul import products
from tutorial_lib.tasks import TASKS
from tutorial_lib.training import train

ROOT = Path(__file__).parents[1]
CONFIG = Config(
    profile="test",
    hidden_width=16,
    hidden_layers=1,
    batch_size=16,
    crm_width=8,
    crm_layers=1,
    crm_steps=20,
    steps=60,
    gamma=0.9,
    target_tau=0.05,
    value_lr=2e-3,
    critic_lr=1e-3,
    policy_lr=3e-3,
)
ROWS = 400
EVERY = {"log_every": 5, "checkpoint_every": 20, "progress": False}
KILLS = {  # how: (seeds, the last checkpoint that is whole, the last update in metrics.csv)
    "between updates": ((3,), 40, 40),
    "while writing": ((3, 5), 20, 40),
}


def make_dataset():
    """Random transitions with BallRun's shapes, in episodes of 100 of which the second ends in a terminal."""
    rng = np.random.default_rng(0)
    ends = np.arange(1, ROWS + 1) % 100 == 0
    terminals = np.arange(ROWS) == 199
    return Dataset(
        observations=rng.normal(size=(ROWS, 7)).astype(np.float32),
        next_observations=rng.normal(size=(ROWS, 7)).astype(np.float32),
        actions=rng.uniform(-1, 1, size=(ROWS, 2)).astype(np.float32),
        rewards=rng.normal(5, 5, size=ROWS).astype(np.float32),
        costs=(rng.random(ROWS) < 0.4).astype(np.float32),
        terminals=terminals,
        timeouts=ends & ~terminals,
    )


def make_agent(name="IQL", seeds=(0,), task="BallRun", threshold=40.0, device="cpu", **changes):
    kind = get_algorithm(name)
    fixed = kind.constrained and not kind.conditioned
    config = dataclasses.replace(CONFIG, **changes)
    return kind(TASKS[task], config, seeds, threshold=threshold if fixed else None, device=device)


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


def networks(agent):
    state = agent.state().items()
    return {key: value.clone() for key, value in state if key.startswith(("online.", "target."))}


def tensors_in(path):
    with safe_open(path, "pt") as file:
        return {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  (not a mapping)


def metrics_in(run_dir):
    """The rows of metrics.csv, as text, without the one column that a clock wrote."""
    with open(run_dir / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k != "updates_per_second"} for row in csv.DictReader(file)]


# --- Killed and resumed ---


def train_and_die(how, run_dir):
    """What the killed process does: trains, and sends itself the signal that no process survives."""
    agent, write = make_agent("C2IQL", KILLS[how][0]), training.save_file
    update = agent.update

    def killed_before_update_48(*args):
        if agent.updates == 47:
            os.kill(os.getpid(), signal.SIGKILL)
        return update(*args)

    def killed_when_half_is_written(tensors, path, **options):
        write(tensors, path, **options)
        if agent.updates == 40:
            os.truncate(path, os.path.getsize(path) // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    if how == "between updates":
        agent.update = killed_before_update_48
    else:
        training.save_file = killed_when_half_is_written
    train(agent, make_dataset(), run_dir=run_dir, **EVERY)


@pytest.mark.parametrize("how", KILLS)
def test_a_killed_run_goes_on_as_if_nothing_had_happened(how, dataset, tmp_path):
    seeds, checkpoint, last_row = KILLS[how]
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    command, env = [sys.executable, __file__, how, killed], os.environ | {"PYTHONPATH": str(ROOT)}
    child = subprocess.run(command, env=env, capture_output=True, text=True)
    assert child.returncode == -signal.SIGKILL, child.stderr
    assert load_agent(killed / "checkpoint.safetensors").updates == checkpoint
    assert metrics_in(killed)[-1]["update"] == str(last_row)

    resumed = make_agent("C2IQL", seeds)
    resumed.prepare = None  # what was learned before the first update is in the checkpoint
    updates, update = [], resumed.update
    resumed.update = lambda *args: updates.append(resumed.updates) or update(*args)
    log = train(resumed, dataset, run_dir=killed, **EVERY)
    assert updates == list(range(checkpoint, 60))

    uninterrupted = make_agent("C2IQL", seeds)
    expected = train(uninterrupted, dataset, run_dir=whole, **EVERY)
    for rows in (log, expected):
        for row in rows:
            del row["updates_per_second"]
    assert log == expected and len(log) == 12 * len(seeds)
    assert metrics_in(killed) == metrics_in(whole)
    ours, theirs = (tensors_in(folder / "checkpoint.safetensors") for folder in (killed, whole))
    assert ours.keys() == theirs.keys() and f"generator.{len(seeds) - 1}" in ours
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert sorted(p.name for p in whole.iterdir()) == ["checkpoint.safetensors", "metrics.csv"]


def test_a_finished_run_is_not_trained_again(dataset, tmp_path):
    train(make_agent(), dataset, run_dir=tmp_path, **EVERY)
    again = make_agent()
    again.update = None
    assert train(again, dataset, run_dir=tmp_path, **EVERY)[-1]["update"] == again.updates == 60


@pytest.mark.parametrize(
    "other",
    [
        {"seeds": (0, 1)},
        {"name": "C2IQL w/o CC"},
        {"threshold": 50.0},
        {"task": "CarRun"},
        {"kappa_1": 0.6},
        {"steps": 70},
    ],
    ids=str,
)
def test_a_checkpoint_of_another_run_is_refused(other, dataset, tmp_path):
    mine = {"name": "CIQL", "seeds": (0,)}
    train(make_agent(**mine), dataset, steps=2, run_dir=tmp_path, **EVERY)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(TrainingError, match="another run") as error:
        train(make_agent(**mine | other), dataset, steps=4, run_dir=tmp_path, **EVERY)
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)
    assert before == {path: path.read_bytes() for path in tmp_path.iterdir()}


@pytest.mark.parametrize("damage", ["no metrics", "metrics cut off", "an agent as checkpoint"])
def test_a_folder_that_has_lost_something_is_refused(damage, dataset, tmp_path):
    agent = make_agent()
    train(agent, dataset, steps=10, run_dir=tmp_path, **EVERY)
    if damage == "an agent as checkpoint":  # it has no moments and no generators: it cannot go on
        save_agent(agent, tmp_path / "checkpoint.safetensors")
    elif damage == "no metrics":
        (tmp_path / "metrics.csv").unlink()
    else:
        os.truncate(tmp_path / "metrics.csv", os.path.getsize(tmp_path / "metrics.csv") - 20)
    with pytest.raises(TrainingError) as error:
        train(make_agent(), dataset, run_dir=tmp_path, **EVERY)
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)


# --- The log ---


def test_the_log_has_a_row_for_every_run_every_so_often_and_the_file_is_the_log(dataset, tmp_path):
    saved = []
    log = train(
        make_agent(seeds=(4, 2)),
        dataset,
        steps=17,
        run_dir=tmp_path,
        log_every=5,
        checkpoint_every=8,
        on_checkpoint=lambda agent: saved.append(agent.updates),
        progress=False,
    )
    assert saved == [8, 16, 17]
    assert [(row["update"], row["seed"]) for row in log] == [(u, s) for u in (5, 10, 15, 17) for s in (4, 2)]
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [{k: float(v) for k, v in row.items()} for row in rows] == log
    assert {"value_loss", "critic_loss", "policy_loss"} < log[0].keys()


def test_a_run_does_not_go_on_with_other_data(dataset, tmp_path):
    train(make_agent(), dataset, steps=2, run_dir=tmp_path, progress=False)
    other = dataclasses.replace(dataset, rewards=dataset.rewards + 1)
    with pytest.raises(TrainingError, match="was trained on other data: choose another folder"):
        train(make_agent(), other, run_dir=tmp_path, progress=False)
    agent = load_agent(tmp_path / "checkpoint.safetensors")
    assert agent.data_checksum == dataset.checksum
    save_agent(agent, tmp_path / "agent.safetensors")
    assert load_agent(tmp_path / "agent.safetensors").data_checksum == dataset.checksum


# --- Several seeds at once ---


@pytest.mark.parametrize("name", ALGORITHMS)
def test_seeds_trained_together_equal_seeds_trained_alone(name, dataset):
    seeds, options = (0, 7), {"steps": 20, "log_every": 1, "progress": False}
    together = make_agent(name, seeds)
    log = train(together, dataset, **options)
    state = networks(together)
    for run, seed in enumerate(seeds):
        alone = make_agent(name, (seed,))
        rows = train(alone, dataset, **options)
        for key, value in networks(alone).items():
            torch.testing.assert_close(state[key][run], value[0], rtol=1e-3, atol=2e-4, msg=key)
        for mine, other in zip(log[run::2], rows, strict=True):
            expected = {k: v for k, v in other.items() if k != "updates_per_second"}
            assert {k: mine[k] for k in expected} == pytest.approx(expected, rel=2e-3, abs=2e-3)
    first = next(iter(state.values()))
    assert (first[0] - first[1]).abs().max() > 0.01  # two seeds are two runs


# --- NaN ---


def rows_drawn(seed, updates):
    """The transitions of IQL's first batches, one list for each update."""
    generator = torch.Generator().manual_seed(seed)
    return [torch.randint(ROWS, (CONFIG.batch_size,), generator=generator).tolist() for _ in range(updates)]


def test_nan_in_the_data_stops_the_run_that_meets_it_first(dataset, tmp_path):
    """Only one of two runs draws the bad row, at the update that is named, and no checkpoint has seen it."""
    bad = next(row for row in rows_drawn(5, 8)[7] if row not in sum(rows_drawn(5, 7) + rows_drawn(3, 8), []))
    rewards = dataset.rewards.copy()
    rewards[bad] = np.nan
    poisoned = dataclasses.replace(dataset, rewards=rewards)
    every = {"log_every": 1, "checkpoint_every": 1, "progress": False}
    with pytest.raises(TrainingError) as error:
        train(make_agent(seeds=(3, 5)), poisoned, run_dir=tmp_path, **every)
    assert re.match("critic_loss is nan at update 8 of seed 5:", str(error.value))
    assert "\n" not in str(error.value)
    agent = load_agent(tmp_path / "checkpoint.safetensors")
    trained = {key: value for key, value in agent.state().items() if key != "reward_scale"}  # of all the data
    assert agent.updates == 7 and all(value.isfinite().all() for value in trained.values())
    assert metrics_in(tmp_path)[-1]["update"] == "7"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("log_every", [3, 50])
def test_a_loss_that_is_not_finite_is_named_and_reaches_no_checkpoint(value, log_every, dataset, tmp_path):
    agent = make_agent(seeds=(11, 12))
    update = agent.update

    def diverging(*args):
        scalars = update(*args)
        if agent.updates >= 6:
            scalars["policy_loss"][1] = value
            agent.parameters["policy"]["log_std"].data[1] = value
        return scalars

    agent.update = diverging
    with pytest.raises(TrainingError, match=f"policy_loss is {value} at update 6 of seed 12"):
        train(agent, dataset, run_dir=tmp_path, log_every=log_every, checkpoint_every=2, progress=False)
    saved = load_agent(tmp_path / "checkpoint.safetensors")
    assert saved.updates == 4 and all(tensor.isfinite().all() for tensor in saved.state().values())


# --- Files ---


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_loaded_agent_acts_like_the_saved_one(name, dataset, tmp_path):
    agent, path = make_agent(name, seeds=(1, 2, 3)), tmp_path / "deep" / "agent.safetensors"
    train(agent, dataset, steps=3, progress=False)
    save_agent(agent, path)
    loaded = load_agent(str(path))
    assert (loaded.task, loaded.name, loaded.config) == (agent.task, agent.name, agent.config)
    assert (loaded.seeds, loaded.threshold, loaded.updates) == (agent.seeds, agent.threshold, 3)
    rng = np.random.default_rng(0)
    given = rng.normal(size=(20, 7)), rng.choice([0.0, 30.0, np.inf], size=20)
    for run in range(3):
        np.testing.assert_array_equal(loaded.act(*given, run), agent.act(*given, run))
        expected = agent.predicted_cost(*given, run)
        np.testing.assert_array_equal(loaded.predicted_cost(*given, run), expected)
    assert not np.array_equal(agent.act(*given, 0), agent.act(*given, 1))
    assert not any(key.startswith(("adam.", "target.")) for key in tensors_in(path))


@pytest.fixture(scope="module")
def agent_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("agent") / "agent.safetensors"
    save_agent(make_agent("C2IQL", seeds=(0, 1)), path)
    return path


def rewritten(source, path, header=None, drop="", cut=""):
    """A copy with entries of the header changed, tensors left out, or tensors cut short."""
    with safe_open(source, "pt") as file:
        metadata = file.metadata() | (header or {})
    tensors = tensors_in(source)
    for key, value in list(tensors.items()):
        if cut and key.startswith(cut):
            tensors[key] = value[..., :-1].contiguous()
        if drop and key.startswith(drop):
            del tensors[key]
    save_file(tensors, path, metadata=metadata)


DAMAGE = {
    "missing": lambda source, path: None,
    "empty": lambda source, path: path.write_bytes(b""),
    "half a file": lambda source, path: path.write_bytes(source.read_bytes()[: source.stat().st_size // 2]),
    "half a header": lambda source, path: path.write_bytes(source.read_bytes()[:20]),
    "random bytes": lambda source, path: path.write_bytes(np.random.default_rng(0).bytes(5_000)),
    "text": lambda source, path: path.write_text("seed,update\n1,2\n"),
    "a folder": lambda source, path: path.mkdir(),
    "somebody else's tensors": lambda source, path: save_file({"x": torch.zeros(3)}, path),
    "unknown algorithm": lambda source, path: rewritten(source, path, {"algorithm": "SAC"}),
    "unknown task": lambda source, path: rewritten(source, path, {"task": "Humanoid"}),
    "unknown option": lambda source, path: rewritten(source, path, {"config": json.dumps({"colour": 1})}),
    "options that are no JSON": lambda source, path: rewritten(source, path, {"config": "{"}),
    "no network": lambda source, path: rewritten(source, path, drop="online.policy"),
    "no reconstruction": lambda source, path: rewritten(source, path, drop="reconstruction."),
    "narrow network": lambda source, path: rewritten(source, path, cut="online.policy.net.0.weight"),
    "narrow reconstruction": lambda source, path: rewritten(source, path, cut="reconstruction.net"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_file_that_is_no_agent_is_one_line_of_error(damage, agent_file, tmp_path):
    path = tmp_path / "agent.safetensors"
    DAMAGE[damage](agent_file, path)
    with pytest.raises(TrainingError) as error:
        load_agent(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_an_untouched_copy_is_an_agent(agent_file, tmp_path):
    """The damage above is the damage, not the copying."""
    rewritten(agent_file, tmp_path / "copy.safetensors")
    assert load_agent(tmp_path / "copy.safetensors").seeds == (0, 1)


def test_a_write_for_which_there_is_no_room_leaves_the_old_file(dataset, tmp_path):
    resource = pytest.importorskip("resource", reason="limits the size of files")
    agent, path = make_agent(), tmp_path / "agent.safetensors"
    save_agent(agent, path)
    before = path.read_bytes()
    train(agent, dataset, steps=1, progress=False)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
        with pytest.raises(OSError, match=f"{path}"):
            save_agent(agent, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_actions_at_the_edge_are_moved_a_hair_inside(dataset):
    """The Gaussian's mean is a tanh: it cannot be one, and the likelihood would pull it there for ever."""
    edge = dataclasses.replace(dataset, actions=np.sign(dataset.actions))
    seen = training._training_data(edge, make_agent()).actions
    assert seen.abs().max() < 1 and seen.numpy() == pytest.approx(edge.actions, abs=1e-4)


def test_negative_q_under_the_zero_penalty_is_warned_of(dataset):
    losing = dataclasses.replace(dataset, rewards=dataset.rewards - 50)
    options = {"steps": 40, "critic_lr": 0.1, "value_lr": 0.1}
    with pytest.warns(UserWarning, match="of Q_r are negative: .* shift_rewards=True, or an unsafe_price"):
        train(make_agent("C2IQL", **options), losing, progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(make_agent("C2IQL", **options, shift_rewards=True), losing, progress=False)
        train(make_agent("C2IQL", **options, unsafe_price=1.0), losing, progress=False)
    with pytest.warns(UserWarning, match="try shift_rewards=True$"):  # CPQ knows no price
        train(make_agent("CPQ", **options, unsafe_price=1.0), losing, progress=False)


def test_what_is_learned_before_the_first_update_is_kept(dataset, tmp_path, monkeypatch):
    """A reconstruction model can take longer than all updates: a run killed after it does not begin anew."""
    agent = make_agent("C2IQL")
    monkeypatch.setattr(agent, "update", lambda *args: 1 / 0)  # as good as a kill
    with pytest.raises(ZeroDivisionError):
        train(agent, dataset, run_dir=tmp_path, progress=False)
    again = make_agent("C2IQL")
    monkeypatch.setattr(again, "prepare", lambda *args: pytest.fail("prepared anew"))
    log = train(again, dataset, run_dir=tmp_path, **EVERY)
    whole = make_agent("C2IQL")
    expected = train(whole, dataset, **EVERY)
    assert [row["value_loss"] for row in log] == [row["value_loss"] for row in expected]


def test_without_reconstruction_none_is_saved():
    assert not [name for name in make_agent("C2IQL w/o CR").state() if name.startswith("reconstruction")]


def test_a_folder_is_no_agent(tmp_path):
    with pytest.raises(TrainingError, match="is a folder: name the agent.safetensors in it"):
        load_agent(tmp_path)


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("time_limits", "masked", "is 'masked', and must be one of rate, bootstrap, mask"),
        ("crm", "Linear", "is 'Linear', and must be one of mlp, linear"),
        ("crm_width", 0, "is 0, and must be 1 or more where crm is not 'linear'"),
        ("batch_size", 1, "is 1, and must be 2 or more"),
    ],
)
def test_an_option_that_means_nothing_is_refused(option, value, words):
    with pytest.raises(ValueError, match=f"^{option} {words}"):
        dataclasses.replace(CONFIG, **{option: value})


def test_a_seed_stands_there_once():
    with pytest.raises(ValueError, match=r"seeds \[4, 4\]: at least one, each 0 or more and there once"):
        make_agent("BC-All", (4, 4))


def test_a_file_of_another_number_of_runs_is_refused(dataset, tmp_path):
    """Copied, one run would be repeated for all."""
    three, one = make_agent(seeds=(0, 1, 2)), make_agent()
    with pytest.raises(ValueError, match="shape"):
        three.load_state(one.state())


def test_no_file_of_a_run_is_a_pickle(dataset, tmp_path):
    """Whoever loads a stranger's agent must not run a stranger's code."""
    agent = make_agent("C2IQL")
    train(agent, dataset, run_dir=tmp_path, steps=2, progress=False)
    save_agent(agent, tmp_path / "agent.safetensors")
    names = {"agent.safetensors", "checkpoint.safetensors", "metrics.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names
    for path in tmp_path.glob("*.safetensors"):
        data = path.read_bytes()
        assert not zipfile.is_zipfile(path) and data[:1] != b"\x80"
        size = int.from_bytes(data[:8], "little")  # safetensors: this, as much JSON, and plain numbers
        header = json.loads(data[8 : 8 + size])
        ends = [entry["data_offsets"][1] for key, entry in header.items() if key != "__metadata__"]
        assert len(data) == 8 + size + max(ends)
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert len(lines) == 2 and all(line.isprintable() for line in lines)


# --- The optimiser ---


def random_batches(dataset, agent, count):
    generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
    for _ in range(count):
        yield training.sample_batch(dataset.tensors(), agent.config.batch_size, generators), generators


def learning_rate(before, after, network):
    """Adam's learning rate in one step, by its formula from the parameters around it and its moments."""
    online = [key for key in after if key.startswith("online.")]
    moved = wanted = 0.0
    for index, key in enumerate(online):
        if key.startswith(f"online.{network}."):
            m, v, step = (after[f"adam.{index}.{name}"] for name in ("exp_avg", "exp_avg_sq", "step"))
            direction = m / (1 - 0.9**step) / ((v / (1 - 0.999**step)).sqrt() + 1e-8)
            moved += (before[key] - after[key]).abs().sum().item()
            wanted += direction.abs().sum().item()
    return moved / wanted


def test_the_policys_learning_rate_follows_half_a_cosine_and_no_other_does(dataset):
    agent = make_agent("C2IQL", seeds=(0, 1), steps=12, policy_lr=3e-2)
    constant = {"value": 2e-3, "cost_value": 2e-3, "critics": 1e-3, "cost_critics": 1e-3}
    dummy = torch.optim.Adam([torch.zeros(1)], lr=3e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(dummy, T_max=12)
    for batch, generators in random_batches(dataset, agent, 12):
        before = {key: value.clone() for key, value in agent.state().items()}
        agent.update(batch, generators)
        after = agent.state()
        assert learning_rate(before, after, "policy") == pytest.approx(schedule.get_last_lr()[0], rel=5e-3)
        for network, expected in constant.items():
            assert learning_rate(before, after, network) == pytest.approx(expected, rel=5e-3)
        dummy.step()
        schedule.step()
    for batch, generators in random_batches(dataset, agent, 2):  # past its end the policy stays as it is
        before = agent.state()["online.policy.net.0.weight"].clone()
        agent.update(batch, generators)
        assert torch.equal(agent.state()["online.policy.net.0.weight"], before)


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
def test_an_update_moves_every_network_and_targets_follow_by_polyak(name, seeds, dataset):
    agent = make_agent(name, seeds)
    for batch, generators in random_batches(dataset, agent, 3):
        before = networks(agent)
        agent.update(batch, generators)
        after = networks(agent)
        for key, value in after.items():
            for run in range(len(seeds)):
                assert not torch.equal(value[run], before[key][run]), key
            if key.startswith("target."):
                online = after[key.replace("target.", "online.")]
                torch.testing.assert_close(value, 0.95 * before[key] + 0.05 * online, rtol=1e-5, atol=1e-7)
    targets = {key.split(".")[1] for key in after if key.startswith("target.")}
    expected = {"IQL": {"critics"}, "BC-All": set(), "BC-Safe": set()}
    assert targets == expected.get(name, {"critics", "cost_critics"})


# --- A device that is not the CPU ---


@pytest.fixture
def elsewhere(monkeypatch):
    """The device 'meta' in a GPU's place: it has no numbers to copy, and hardly mixes with the CPU.

    What PyTorch does not offer there is left out: Adam's fused kernel and autocast.
    """
    adam = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda groups, fused=None, **options: adam(groups, **options))
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda device: False)
    return torch.device("meta")


@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_updates_stay_on_their_device_and_never_wait_for_a_number(name, seeds, elsewhere, dataset):
    agent = make_agent(name, seeds, device=elsewhere)
    part = agent.select_episodes(dataset)
    agent.prepare(part, progress=False)
    data = training._training_data(part, agent)
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    for _ in range(3):
        scalars = agent.update(sample_batch(data, 16, generators), generators)
    assert agent.updates == 3
    for key, value in (agent.state() | scalars).items():
        assert key == "updates" or key.endswith(".step") or value.device == elsewhere, key


def test_a_number_that_is_asked_for_or_a_mixed_device_is_noticed(elsewhere, dataset):
    """What the test above would see: the two mistakes, made on purpose."""
    agent = make_agent("C2IQL", device=elsewhere)
    data, generators = training._training_data(dataset, agent), [torch.Generator()]
    encode = agent.network_input

    def asks(observations, limit):
        assert limit.mean().item() > 0
        return encode(observations, limit)

    agent.network_input = asks
    with pytest.raises(RuntimeError, match="item"):
        agent.update(sample_batch(data, 16, generators), generators)
    agent.network_input, agent.gammas = encode, torch.tensor(agent.cost_gammas)
    with pytest.raises(RuntimeError, match="device"):
        agent.update(sample_batch(data, 16, generators), generators)


# --- Precision ---


@pytest.mark.parametrize(("precision", "warned"), [("bfloat16", True), ("float32", False)])
def test_training_where_bfloat16_is_emulated_says_so(precision, warned, dataset, monkeypatch):
    monkeypatch.setattr(products, "bfloat16_time", lambda: 7.0)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        train(make_agent(precision=precision), dataset, steps=1, progress=False)
    assert any("7.0 times as long" in str(warning.message) for warning in found) == warned


@pytest.mark.parametrize("name", ALGORITHMS)
def test_acting_does_not_round(name, dataset):
    agents = [make_agent(name, precision=precision) for precision in ("float32", "bfloat16")]
    observations, limits = dataset.observations[:50], np.full(50, 40.0)
    actions = [agent.act(observations, limits) for agent in agents]
    assert np.array_equal(*actions)


if __name__ == "__main__":
    train_and_die(sys.argv[1], Path(sys.argv[2]))
