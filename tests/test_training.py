"""The training loop: killed and resumed, several runs at once, stopped by NaN; its log, and its optimiser.

Run as a script, this file is the process that gets killed.
"""

import contextlib
import csv
import dataclasses
import os
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import EVERY, OPTIONS, ROWS, make_agent, make_dataset, metrics_in, tensors_in

from tutorial_lib import checkpoints, matmul
from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.checkpoints import TrainingError, load_agent
from tutorial_lib.training import train

ROOT = Path(__file__).parents[1]
KILLS = {  # how: (seeds, the last checkpoint that is whole, the last update in metrics.csv)
    "between updates": ((3,), 40, 40),
    "while writing": ((3, 5), 20, 40),
}


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


def networks(agent):
    state = agent.state().items()
    return {key: value.clone() for key, value in state if key.startswith(("online.", "target."))}


# --- Killed and resumed ---


def train_and_die(how, run_dir):
    """What the killed process does: trains, and sends itself the signal that no process survives."""
    agent, write = make_agent("C2IQL", KILLS[how][0]), checkpoints.save_file
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
        checkpoints.save_file = killed_when_half_is_written
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


@pytest.mark.parametrize("name", ["CPQ", "BCQ-Lag"])
def test_a_finished_run_with_constant_learning_rates_can_be_trained_on_exactly(name, dataset, tmp_path):
    for updates in (20, 40):
        agent = make_agent(name, updates=updates)
        log = train(agent, dataset, run_dir=tmp_path / "longer", **EVERY)
    expected = train(make_agent(name, updates=40), dataset, run_dir=tmp_path / "whole", **EVERY)
    assert [row["critic_loss"] for row in log] == [row["critic_loss"] for row in expected]
    files = [tmp_path / folder / "checkpoint.safetensors" for folder in ("longer", "whole")]
    assert files[0].read_bytes() == files[1].read_bytes()
    with pytest.raises(TrainingError, match="has made 40 updates already, more than 30"):
        train(make_agent(name, updates=30), dataset, run_dir=tmp_path / "longer", **EVERY)


def test_a_finished_run_whose_learning_rate_decayed_is_not_trained_on(dataset, tmp_path):
    """In the first updates of the longer run the rate would have been another one."""
    train(make_agent("IQL", updates=20), dataset, run_dir=tmp_path, **EVERY)
    with pytest.raises(
        TrainingError, match="learning rate of IQL decays to zero over its 20 updates, and is"
    ):
        train(make_agent("IQL", updates=40), dataset, run_dir=tmp_path, **EVERY)


# --- The log ---


def test_the_log_has_a_row_for_every_run_every_so_often_and_the_file_is_the_log(dataset, tmp_path):
    saved = []
    log = train(
        make_agent(seeds=(4, 2)),
        dataset,
        updates=17,
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


def test_the_log_tells_runs_of_one_seed_apart_by_their_limits(dataset, tmp_path):
    agent = make_agent("BC-Safe", seeds=(4, 4, 2), limits=(40.0, np.inf, 40.0))
    log = train(agent, dataset, updates=5, run_dir=tmp_path, **EVERY)
    assert [(row["seed"], row["limit"]) for row in log] == [(4, 40), (4, np.inf), (2, 40)]
    log = train(make_agent("BC-Safe", agent.seeds, limits=agent.limits), dataset, run_dir=tmp_path, **EVERY)
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [{k: float(v) for k, v in row.items()} for row in rows] == log and len(log) == 3 * 12


# --- Several runs at once ---


@pytest.mark.parametrize("name", ALGORITHMS)
def test_runs_trained_together_equal_runs_trained_alone(name, dataset):
    """They differ in their seed and, where the algorithm is trained for one, in their limit."""
    runs, options = ((0, 40.0), (7, 39.0)), {"updates": 20, "log_every": 1, "progress": False}
    seeds, limits = zip(*runs, strict=True)
    together = make_agent(name, seeds, limits=limits)
    log = train(together, dataset, **options)
    state = networks(together)
    for run, (seed, limit) in enumerate(runs):
        alone = make_agent(name, (seed,), limits=limit)
        rows = train(alone, dataset, **options)
        for key, value in networks(alone).items():
            torch.testing.assert_close(state[key][run], value[0], rtol=1e-3, atol=2e-4, msg=key)
        for mine, other in zip(log[run::2], rows, strict=True):
            expected = {k: v for k, v in other.items() if k != "updates_per_second"}
            assert {k: mine[k] for k in expected} == pytest.approx(expected, rel=2e-3, abs=2e-3)
    first = next(iter(state.values()))
    assert (first[0] - first[1]).abs().max() > 0.01  # two seeds are two runs


@pytest.mark.filterwarnings("ignore:.*of Q_r are negative")
@pytest.mark.parametrize("name", [name for name, kind in ALGORITHMS.items() if kind.needs_limit])
def test_runs_of_one_seed_begin_alike_and_part_by_their_limits(name, dataset):
    limits = (40.0, 45.0) if name == "BC-Safe" else (0.0, 45.0)
    agent = make_agent(name, (3, 3), limits=limits, **({} if name == "BC-Safe" else {"critic_lr": 0.1}))
    before = networks(agent)
    train(agent, dataset, updates=20, progress=False)
    after = networks(agent)
    assert all(torch.equal(value[0], value[1]) for value in before.values())
    policy = [value for key, value in after.items() if key.startswith("online.policy")]
    assert any(not torch.equal(value[0], value[1]) for value in policy)


def test_every_run_learns_from_its_own_episodes_and_equal_limits_share_them(dataset):
    agent, seen = make_agent("BC-Safe", (0, 1, 1), limits=(39.0, 39.0, 45.0)), []
    draw = agent.draw_all
    agent.draw_all = lambda data, generators: seen.append(data) or draw(data, generators)
    train(agent, dataset, updates=1, progress=False)
    (first, second, third), episodes = seen[0], dataset.costs.reshape(4, 100)
    kept = [(episodes.sum(1) <= limit).sum() for limit in (39, 45)]
    assert first is second and 0 < kept[0] < kept[1]
    assert [len(first.costs), len(third.costs)] == [100 * count for count in kept]


# --- NaN ---


def rows_drawn(seed, updates):
    """The transitions of IQL's first batches, one list for each update."""
    generator = torch.Generator().manual_seed(seed)
    return [
        torch.randint(ROWS, (OPTIONS["batch_size"],), generator=generator).tolist() for _ in range(updates)
    ]


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
    saved = tensors_in(tmp_path / "checkpoint.safetensors")
    trained = {key: value for key, value in saved.items() if key != "variable.reward_scale"}  # of all data
    assert saved["updates"] == 7 and all(value.isfinite().all() for value in trained.values())
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


@pytest.mark.parametrize("limits", [(40.0, 50.0), (np.inf, np.inf)])
def test_a_loss_that_is_not_finite_is_told_with_the_limit_of_its_run(limits, dataset):
    agent = make_agent("CIQL", seeds=(11, 12), limits=limits)
    update = agent.update

    def diverging(*args):
        scalars = update(*args)
        if agent.updates == 3:
            scalars["value_loss"][1] = float("nan")
        return scalars

    agent.update = diverging
    words = f"value_loss is nan at update 3 of seed 12 and limit {limits[1]:g}:"
    with pytest.raises(TrainingError, match=words):
        train(agent, dataset, log_every=3, progress=False)


# --- What is learned from, and before ---


@pytest.mark.parametrize("name", ALGORITHMS)
def test_actions_at_the_edge_are_moved_a_hair_inside(name, dataset):
    """The Gaussian's mean is a tanh: it cannot be one, and the likelihood would pull it there for ever."""
    edge, agent, seen = dataclasses.replace(dataset, actions=np.sign(dataset.actions)), make_agent(name), []
    draw = agent.draw_all
    agent.draw_all = lambda data, generators: seen.extend(data) or draw(data, generators)
    train(agent, edge, updates=1, progress=False)
    actions = agent.select(edge, 40.0).actions
    assert np.array_equal(seen[0].actions.numpy(), actions) and np.abs(actions).max() < 1
    recorded = {tuple(row) for row in np.column_stack([edge.observations, edge.actions]).tolist()}
    selected = agent.select(edge, 40.0)
    at_the_edge = np.column_stack([selected.observations, np.sign(actions)]).tolist()
    assert len(actions) and {tuple(row) for row in at_the_edge} <= recorded  # some algorithms leave rows out
    assert actions == pytest.approx(np.sign(actions), abs=1e-4)


def test_negative_q_under_the_zero_penalty_is_warned_of(dataset):
    losing = dataclasses.replace(dataset, rewards=dataset.rewards - 50)
    options = {"updates": 40, "critic_lr": 0.1}
    with pytest.warns(UserWarning, match="of Q_r are negative: .* shift_rewards=True, or an unsafe_price"):
        train(make_agent("C2IQL", value_lr=0.1, **options), losing, progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for remedy in ({"shift_rewards": True}, {"unsafe_price": 1.0}):
            train(make_agent("C2IQL", value_lr=0.1, **options, **remedy), losing, progress=False)
    with pytest.warns(UserWarning, match="try shift_rewards=True$"):  # CPQ knows no price
        train(make_agent("CPQ", **options), losing, progress=False)


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


def test_a_seed_stands_there_once():
    with pytest.raises(ValueError, match=r"seeds \[4, 4\]: at least one, each 0 or more and there once"):
        make_agent("BC-All", (4, 4))


def test_a_seed_stands_there_once_for_each_limit():
    with pytest.raises(ValueError, match=r"seeds \[4, 4\]: .*once per limit"):
        make_agent("BC-Safe", (4, 4), limits=(40.0, 40.0))
    assert make_agent("BC-Safe", (4, 4), limits=(40.0, 50.0)).limits == (40, 50)


# --- The optimiser ---


def random_batches(dataset, agent, count):
    generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
    data = [dataset.tensors(agent.device)] * len(agent.seeds)
    for _ in range(count):
        yield agent.draw_all(data, generators)


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
    agent = make_agent("C2IQL", seeds=(0, 1), updates=12, policy_lr=3e-2)
    constant = {"value": 2e-3, "cost_value": 2e-3, "critics": 1e-3, "cost_critics": 1e-3}
    dummy = torch.optim.Adam([torch.zeros(1)], lr=3e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(dummy, T_max=12)
    for batch in random_batches(dataset, agent, 12):
        before = {key: value.clone() for key, value in agent.state().items()}
        agent.update(batch)
        after = agent.state()
        assert learning_rate(before, after, "policy") == pytest.approx(schedule.get_last_lr()[0], rel=5e-3)
        for network, expected in constant.items():
            assert learning_rate(before, after, network) == pytest.approx(expected, rel=5e-3)
        dummy.step()
        schedule.step()
    for batch in random_batches(dataset, agent, 2):  # past its end the policy stays as it is
        before = agent.state()["online.policy.net.0.weight"].clone()
        agent.update(batch)
        assert torch.equal(agent.state()["online.policy.net.0.weight"], before)


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
def test_an_update_moves_every_network_and_targets_follow_by_polyak(name, seeds, dataset):
    agent = make_agent(name, seeds)
    for batch in random_batches(dataset, agent, 3):
        before = networks(agent)
        agent.update(batch)
        after = networks(agent)
        for key, value in after.items():
            for run in range(len(seeds)) if key.split(".")[1] not in agent.fixed else ():
                assert not torch.equal(value[run], before[key][run]), key
            if key.startswith("target."):
                online = after[key.replace("target.", "online.")]
                torch.testing.assert_close(value, 0.95 * before[key] + 0.05 * online, rtol=1e-5, atol=1e-7)
    targets = {key.split(".")[1] for key in after if key.startswith("target.")}
    by_hand = {"IQL": {"critics"}, "BC-All": set(), "BC-Safe": set(), "C2IQL": {"critics", "cost_critics"}}
    assert targets == by_hand.get(name, set(agent.targets))


# --- A device that is not the CPU ---


@pytest.fixture
def elsewhere(monkeypatch):
    """The device 'meta' in a GPU's place: it has no numbers to copy, and hardly mixes with the CPU.

    What PyTorch does not offer there is left out: Adam's fused kernel and autocast.
    """
    adam = torch.optim.AdamW
    monkeypatch.setattr(torch.optim, "AdamW", lambda groups, fused=None, **options: adam(groups, **options))
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda device: False)
    return torch.device("meta")


@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_updates_stay_on_their_device_and_never_wait_for_a_number(name, seeds, elsewhere, dataset):
    agent = make_agent(name, seeds, device=elsewhere)
    part = agent.select(dataset, 40.0)
    agent.prepare([part] * len(seeds), progress=False)
    for batch in random_batches(part, agent, 3):
        scalars = agent.update(batch)
    assert agent.updates == 3
    for key, value in (agent.state() | scalars).items():
        assert key == "updates" or key.endswith(".step") or value.device == elsewhere, key


def test_a_number_that_is_asked_for_or_a_mixed_device_is_noticed(elsewhere, dataset):
    """What the test above would see: the two mistakes, made on purpose."""
    agent = make_agent("C2IQL", device=elsewhere)
    (batch,) = random_batches(dataset, agent, 1)
    encode = agent.network_input

    def asks(net, observations, limit, timesteps):
        assert limit.mean().item() > 0
        return encode(net, observations, limit, timesteps)

    agent.network_input = asks
    with pytest.raises(RuntimeError, match="item"):
        agent.update(batch)
    agent.network_input, agent.gammas = encode, torch.tensor(agent.cost_gammas)
    with pytest.raises(RuntimeError, match="device"):
        agent.update(batch)


# --- Precision ---


@pytest.mark.parametrize(("precision", "warned"), [("bfloat16", True), ("float32", False)])
def test_training_where_bfloat16_is_emulated_says_so(precision, warned, dataset, monkeypatch):
    monkeypatch.setattr(matmul, "bfloat16_time", lambda: 7.0)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        train(make_agent(precision=precision), dataset, updates=1, progress=False)
    assert any("7.0 times as long" in str(warning.message) for warning in found) == warned


@pytest.mark.parametrize("name", ALGORITHMS)
def test_acting_does_not_round(name, dataset):
    agents = [make_agent(name, precision=precision) for precision in ("float32", "bfloat16")]
    observations, limits = dataset.observations[:50], np.full(50, 40.0)
    actions = [agent.act(observations, limits) for agent in agents]
    assert np.array_equal(*actions)


if __name__ == "__main__":
    train_and_die(sys.argv[1], Path(sys.argv[2]))
