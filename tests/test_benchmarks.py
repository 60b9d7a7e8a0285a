"""The benchmarks: the plain version against the library's updates, what is timed, the tables, the command."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pytest
import torch

import benchmarks
from benchmarks import __main__ as command
from benchmarks import cases, pages, peers, tables, updates
from benchmarks.eager import EagerC2IQL
from benchmarks.figure import speed
from benchmarks.simulation import play, play_rollouts, policy_actions
from benchmarks.updates import EAGER, PARTS, PRODUCT, Case, OurUpdates, random_transitions
from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.agents.c2iql import C2IQL
from tutorial_lib.data.dataset import Batch
from tutorial_lib.matmul import products
from tutorial_lib.tasks import TASKS, make_env

ROOT = Path(__file__).parents[1]
SMALL = {
    "hidden_width": 24,
    "batch_size": 64,
    "crm_width": 16,
    "crm_layers": 2,
    "updates": 50,
    "target_tau": 0.1,
}


@pytest.fixture(autouse=True)
def seeded():
    """An untrained reconstruction model and the plain version draw weights from the global generator."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


# --- The plain version ---


def same_networks(eager, agent):
    """Give the plain version every number that the agent has."""
    state = agent.state()
    for kind, networks in (("online", eager.nets), ("target", eager.targets)):
        for name, members in networks.items():
            for k, member in enumerate(members):
                layers = [layer for layer in member if isinstance(layer, torch.nn.Linear)]
                for i, layer in enumerate(layers):
                    if "critics" in name:  # of one product for all members, (k, in, out)
                        weight, bias = (
                            state[f"{kind}.{name}.layers.{i}.{x}"][0, k] for x in ("weight", "bias")
                        )
                        weight, bias = weight.T, bias[0]
                    else:
                        weight, bias = (
                            state[f"{kind}.{name}.net.{2 * i}.{x}"][0] for x in ("weight", "bias")
                        )
                    layer.weight.data.copy_(weight)
                    layer.bias.data.copy_(bias)
    model = agent.networks().reconstruction
    eager.crm.load_state_dict(
        {key.removeprefix("net."): x[0] for key, x in agent.parameters["reconstruction"].items()}
    )
    eager.crm_mean, eager.crm_whiten = model.mean, model.whiten
    eager.mean, eager.std = (agent.variables[f"observation_{name}"][0] for name in ("mean", "std"))


@pytest.mark.parametrize("critics", [1, 2, 3])
@pytest.mark.parametrize("reward_limits", ["mask", "bootstrap"])
def test_updates_are_those_of_a_plain_version(critics, reward_limits):
    """Ten updates in a row, as they run in training: losses and, at last, every parameter."""
    task = TASKS["CarCircle"]
    options = SMALL | {"cost_critics": critics, "reward_time_limits": reward_limits}
    config = C2IQL.configure("paper", **options)
    agent, eager = C2IQL(task, config), EagerC2IQL(task, config)
    generator = torch.Generator().manual_seed(0)
    agent.buffers["reconstruction"]["whiten"].copy_(0.1 * torch.randn(3, 3, generator=generator))
    agent.variables["observation_mean"].fill_(0.5)
    same_networks(eager, agent)
    data = random_transitions(task, 500)
    flags = (torch.rand(2, 500, generator=generator) < 0.1).float()
    data = data._replace(terminals=flags[0], timeouts=flags[1])
    with torch.no_grad():  # limits on either side of what the actions seem to cost
        sa = torch.cat([eager.network_input(data.observations, torch.full((500,), 50.0)), data.actions], 1)
        q_costs = [eager.cost_scale * (1 + critic(sa)) for critic in eager.targets["cost_critics"]]
        costs = torch.stack([eager.reconstruct(q_cost) for q_cost in q_costs]).amax(0)
    safe = []
    with products():
        for _ in range(10):
            batch = Batch(*(x[torch.randint(500, (64,), generator=generator)] for x in data))
            limits = costs.mean() + 5 * costs.std() * torch.randn(64, generator=generator)
            limits[:8] = torch.inf
            drawn = batch._asdict() | {"limit": limits}
            found = agent.update({name: x[None] for name, x in drawn.items()})
            expected = eager.update(batch, limits)
            safe.append(found["safe_fraction"].item())
            for name, loss in expected.items():
                key = f"{name.removesuffix('s')}_loss"
                assert found[key].item() == pytest.approx(loss, rel=1e-4), name
    assert 0.2 < np.mean(safe) < 0.9  # or nothing was penalised, or everything
    other = EagerC2IQL(task, config)
    same_networks(other, agent)
    for networks, theirs in ((eager.nets, other.nets), (eager.targets, other.targets)):
        for name in networks:
            for mine, own in zip(networks[name].parameters(), theirs[name].parameters(), strict=True):
                torch.testing.assert_close(mine, own, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(eager.log_std, agent.parameters["policy"]["log_std"][0], rtol=1e-3, atol=1e-4)


def test_the_plain_version_refuses_what_it_does_not_know():
    with pytest.raises(ValueError, match="zero penalty"):
        EagerC2IQL(TASKS["CarCircle"], C2IQL.configure("small"))


# --- Timing ---


def test_time_is_charged_to_the_part_that_took_it(monkeypatch):
    """A clock that only the parts move: one second for each kind of work."""
    seconds = [0.0]
    monkeypatch.setattr(updates, "clock", lambda device="cpu": lambda: seconds[0])
    watch = OurUpdates(Case("C2IQL", "CarCircle", runs=2))
    durations = {"sampling": 1.0, "reconstruction": 2.0, "networks": 4.0, "backward": 8.0, "optimiser": 16.0}

    def taking(part, function):
        def slow(*args, **kwargs):
            seconds[0] += durations[part]
            return function(*args, **kwargs)

        return slow

    agent = watch.agent
    agent.draw = taking("sampling", agent.draw)  # once a run
    model = agent._borrowers["reconstruction"].module.net
    model.forward = taking("reconstruction", model.forward)
    agent.network_input = taking("networks", agent.network_input)  # at s and at s'
    weight = agent.parameters["value"]["net.0.weight"]
    weight.register_hook(taking("backward", lambda gradient: None))  # once, when its gradient is known
    agent.tau = taking("optimiser", agent.tau)  # of the two networks that have targets
    found = watch.measure(0)
    calls = {"sampling": 2, "reconstruction": 1, "networks": 2, "backward": 1, "optimiser": 2}
    assert found == {"seconds": 52.0} | {part: calls[part] * durations[part] for part in PARTS}


def test_every_algorithm_is_timed_as_it_trains():
    """The same numbers as the agent's own `draw_all` and `update`: the laps change nothing."""
    for name, kind in ALGORITHMS.items():
        watch = OurUpdates(Case(name, "CarCircle", "small", runs=2, batch=16, rows=50))
        agent = watch.agent
        assert type(agent) is kind and agent.updates == 1  # one update to count its arithmetic
        found = watch.measure(0)
        assert agent.updates == 2 and found["seconds"] == pytest.approx(sum(found[part] for part in PARTS))
        same = kind(agent.task, agent.config, agent.seeds, agent.limits)
        generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
        with products():
            for _ in range(2):
                same.update(same.draw_all(watch.data, generators))
        for key, value in same.state().items():
            # FISOR's policy has no gradient where no action is feasible, and Adam takes rounding for one.
            # Elsewhere, a number can be off by rounding of the largest numbers that it is a sum of.
            largest = max(1.0, value.abs().max().item())
            close = {"rtol": 1e-4, "atol": 1e-3 if key.startswith("online.policy.blocks") else 1e-5 * largest}
            torch.testing.assert_close(agent.state()[key], value, msg=f"{name}: {key}", **close)


def test_on_a_gpu_the_whole_is_timed_without_waiting_within_an_update(monkeypatch):
    """A clock that only waiting moves, by a second: laps wait five times an update, the whole at its ends."""
    seconds, updates_made = [0.0], [0]
    watch = OurUpdates(Case("C2IQL", "CarCircle", "small"))
    watch.device, watch.now = torch.device("cuda"), lambda: seconds[0]

    def wait(device):
        seconds[0] += 1

    def update():
        updates_made[0] += 1
        return made()

    made, watch._update = watch._update, update
    monkeypatch.setattr(updates, "_wait_for", wait)
    monkeypatch.setattr(updates, "clock", lambda device: lambda: seconds[0])
    found = watch.measure(0)
    assert updates_made == [2] and sum(found[part] for part in PARTS) > 5
    assert found["seconds"] == 1
    assert watch.measure(0) == found  # laps are taken again


def test_arithmetic_is_counted_by_hand():
    """A forward product of (B, in) by (in, out) is 2 B in out; its two gradients are as many each."""
    b, width, obs, act, m = 512, 256, 8 + 1, 2, 3
    assert updates.Steps(Case(PRODUCT, "CarCircle")).flop == 2 * 1024**3
    heads = {"value": (obs, 1, 1), "cost_value": (obs, m, 1), "critics": (obs + act, 1, 2)}
    heads |= {"cost_critics": (obs + act, m, 2), "policy": (obs, act, 1)}
    forward = {n: k * 2 * b * (i * width + width * width + width * o) for n, (i, o, k) in heads.items()}
    inputs = {n: k * 2 * b * i * width for n, (i, o, k) in heads.items()}  # whose gradient nobody asks for
    total = sum(3 * forward[n] - inputs[n] for n in heads)  # trained
    total += sum(forward[n] for n in ("value", "cost_value", "critics", "cost_critics"))  # at s', and targets
    total += 2 * 2 * b * (m * 512 + 4 * 512 * 512 + 512 + m * m)  # the reconstruction, for two critics
    for case in (Case("C2IQL", "CarCircle"), Case("C2IQL", "CarCircle", runs=2)):
        assert OurUpdates(case).flop == pytest.approx(case.runs * total, rel=1e-3)
    assert updates.Steps(Case(EAGER, "CarCircle")).flop == pytest.approx(total, rel=1e-3)


def test_cases_take_turns_and_the_first_turn_is_not_counted(monkeypatch):
    asked = []

    class Watch:
        flop = 6.0

        def __init__(self, case, device):
            if case.what == "absent":
                raise ValueError("absent: not measured")
            self.what = case.what

        def measure(self, seconds):
            asked.append((self.what, seconds))
            return {"seconds": float(len(asked))}

    monkeypatch.setattr(cases, "stopwatch", Watch)
    reasons = []
    found = cases.measure(
        [Case(x, "CarCircle") for x in ("a", "absent", "b")], rounds=2, seconds=0.5, missing=reasons.append
    )
    assert reasons == ["absent: not measured"]
    assert asked == [("b", 0), ("a", 0), ("a", 0.5), ("b", 0.5), ("b", 0.5), ("a", 0.5)]
    assert found[["what", "round", "seconds"]].to_numpy().tolist() == [
        ["a", 1, 3.0],
        ["b", 1, 4.0],
        ["b", 2, 5.0],
        ["a", 2, 6.0],
    ]
    assert set(found["batch"]) == {512} and set(found["flop"]) == {6.0}


def test_every_part_of_an_update_takes_time():
    kinds = ({}, {"runs": 2}, {"products": "bfloat16"})
    table = benchmarks.training(
        [Case("C2IQL", "BallRun", "small", **kind) for kind in kinds], rounds=1, seconds=0.02
    )
    assert table[["runs", "precision"]].to_numpy().tolist() == [
        [1, "float32"],
        [2, "float32"],
        [1, "bfloat16"],
    ]
    shares = table[list(PARTS)].to_numpy()
    assert (shares > 0).all() and shares.sum(1) == pytest.approx(1)
    assert table["of_product"].between(0.001, 2).all()
    hours = table["hours"] * table["updates_per_second"] * 3600
    assert hours.tolist() == pytest.approx([C2IQL.configure("small").updates] * 3)


def test_a_case_has_the_options_of_its_algorithm():
    for precision in ("float32", "bfloat16", "default"):
        watch = OurUpdates(Case("BC-All", "BallRun", "small", products=precision))
        assert watch.agent.config.precision == ("bfloat16" if precision == "bfloat16" else "float32")
    sizes = Case("C2IQL", "BallRun", crm="3 x 128", batch=64).config
    assert (sizes.crm_layers, sizes.crm_width, sizes.batch_size) == (3, 128, 64)
    for name, kind in ALGORITHMS.items():
        for profile in ("paper", "small"):
            assert Case(name, "BallRun", profile).config == kind.configure(profile)
    assert Case("OSRL's CPQ", "BallRun").config == Case(EAGER, "BallRun").config == C2IQL.configure("paper")


# --- Peers ---

FAKE = """
class CPQ:
    def __init__(self, obs, act, most, a_hidden_sizes, num_q, device, **options):
        assert (obs, act, most, a_hidden_sizes, num_q, device) == (8, 2, 1.0, [256, 256], 2, "cpu")

class CPQTrainer:
    def __init__(self, model, env, logger, device):
        self.logger = logger

    def train_one_step(self, s, s_next, a, r, c, done):
        print("a peer may print")
        self.logger.store(loss=(s @ s.T).sum())
        assert s.shape == (512, 8) and a.shape == (512, 2) and done.shape == (512,)
"""


def test_a_peer_is_timed_in_a_process_of_its_own(tmp_path):
    (tmp_path / "osrl").mkdir()
    (tmp_path / "osrl" / "__init__.py").touch()
    (tmp_path / "osrl" / "algorithms.py").write_text(FAKE)
    peer = peers.Peer(Case("OSRL's CPQ", "CarCircle"), folder=tmp_path)
    assert peer.flop == 2 * 512 * 8 * 512
    assert 0 < peer.measure(0.01)["seconds"] < 1
    with pytest.raises(ValueError, match="BCQ-Lag: not measured .*BCQL.*--peers"):
        peers.Peer(Case("OSRL's BCQ-Lag", "CarCircle"), folder=tmp_path)
    assert peer.measure(0)["seconds"] > 0  # the other's failure has not ended the process
    peer.process.kill()
    peer.process.wait()
    with pytest.raises(ValueError, match="its process died"):
        peer.measure(0)


def test_peers_that_are_not_installed_are_left_out_with_a_word(tmp_path, monkeypatch):
    monkeypatch.setattr(peers.Peer.__init__, "__defaults__", ("cpu", tmp_path))
    reasons = []
    chosen = [Case(PRODUCT, "CarCircle"), *(Case(name, "CarCircle") for name in peers.PEERS)]
    found = cases.measure(chosen, rounds=1, seconds=0, missing=reasons.append)
    assert set(found["what"]) == {PRODUCT}
    assert [reason.split(":")[0] for reason in reasons] == list(peers.PEERS)
    assert all("No module named" in reason and "--peers" in reason for reason in reasons)


def test_pips_complaint_is_one_line(tmp_path, monkeypatch):
    asked = []

    def fail(command, **options):
        asked.append(command)
        return subprocess.CompletedProcess(
            command, 1, "", "WARNING: something\nERROR: No matching distribution"
        )

    monkeypatch.setattr(peers.subprocess, "run", fail)
    with pytest.raises(ValueError, match="^the peers cannot be installed: ERROR: No matching distribution$"):
        peers.install(tmp_path)
    assert asked[0][-len(peers.PACKAGES) - 2 :] == ["--target", tmp_path, *peers.PACKAGES]


# --- Files, tables, figure ---


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """What `full` writes, of made-up times: the cases take 1, 2, 3 ... milliseconds, group after group."""
    times = iter(range(1, 10_000))

    class Watch:
        def __init__(self, case, device):
            self.flop, self.case, self.milliseconds = 1e9 * case.runs, case, next(times)

        def measure(self, seconds):
            found = self.milliseconds / 1e3
            return {"seconds": found} | (
                {} if self.case.what in (PRODUCT, EAGER) else {p: found / 5 for p in PARTS}
            )

    one = pd.DataFrame(
        {"what": ["bare simulator"], "processes": 1, "steps_per_second": 1000.0, "of_bare": 1.0}
    )
    monkeypatch.setattr(cases, "stopwatch", Watch)
    monkeypatch.setattr(benchmarks, "simulation", lambda *_: one)
    monkeypatch.setattr(psutil, "cpu_percent", lambda interval: 30.0)
    said = []
    benchmarks.full(tmp_path, workers=2, rounds=2, missing=said.append)
    assert said == ["2 processes at once: not measured, others take 30% of the cores"]
    return tmp_path


def test_tables_by_hand(folder):
    found = tables.load("updates", folder)
    rows = tables.yardsticks(found).set_index("profile `paper`")
    everything = cases.groups()
    chosen = everything["yardsticks AntCircle"]
    place = {(c.what, c.products, c.crm): i + 1 for i, c in enumerate(chosen)}  # milliseconds
    ours, plain = (place[tables.NAMES[name]] for name in ("C2IQL", EAGER))
    row = rows.loc["C2IQL"]
    assert row["AntCircle: updates/s"] == f"{1000 / ours:.1f}"
    assert row["AntCircle: x plain"] == f"{plain / ours:.2f}"
    assert (
        row["AntCircle: share"] == f"{1 / ours:.0%}"
    )  # the product took 1 ms, and all do the same arithmetic
    assert rows.loc["d3rlpy's IQL", "GFLOP"] == "1.0"

    marks = tables.marks(found).set_index("mark")
    alike = "{0:.2f} ({0:.2f} to {0:.2f})".format  # all rounds took the same time
    assert marks.loc["x plain eager, with the same model", "AntCircle"] == alike(plain / ours)
    assert marks.loc["two processes on two cores, x one", "AntCircle"] == "not measured"
    before = {name: sum(map(len, list(everything.values())[:i])) for i, name in enumerate(everything)}
    first = before["seeds"]
    five = [c for c in everything["seeds"] if c.profile == "paper"].index(Case("C2IQL", "AntCircle", runs=5))
    expected = (first + five + 1) / (first + 1)
    assert marks.loc["cost of five seeds together, x one, profile `paper`", "AntCircle"] == alike(expected)

    assert tables.by_algorithm(found).shape == (len(ALGORITHMS), 5)
    assert set(tables.by_part(found)["sampling"]) == {"20%"}
    precisions, begin = tables.by_precision(found), before["precision"] + 1
    assert precisions["x float32"].tolist() == [
        alike(i / (i + 1)) for i in range(begin, begin + 2 * len(precisions), 2)
    ]
    assert precisions["float32"].iloc[0] == f"{1000 / begin:.1f}"
    grown = tables.growth(found)
    sizes, tasks = (grown[(grown["what grows"] == "tasks") == which] for which in (False, True))
    assert sizes["growth"].str.startswith(("10 x as many", "8 x", "100 x")).all()
    last = before["tasks"] + 8  # AntCircle's milliseconds, the eighth of them
    assert tasks["growth"].iloc[0] == f"all 8 cost {sum(range(last - 7, last + 1)) / last:.2f} x AntCircle"
    assert tables.rollouts(tables.load("simulation", folder))["s per episode"].tolist() == ["0.500", "0.300"]
    assert "busy before the start 30%" in tables.circumstances(tables.load("machine", folder))


def test_two_processes_are_compared_by_the_clock(monkeypatch):
    here = os.getpid()
    rate = lambda case, seconds: 4.0 if os.getpid() != here else np.nan  # noqa: E731 (sent by value)
    monkeypatch.setattr(cases, "_rate", rate)
    found = cases.side_by_side(Case("C2IQL", "AntCircle"), 2, rounds=1).assign(group="processes")
    assert found[["processes", "seconds"]].to_numpy().tolist() == [[1, 0.25], [2, 0.125]]
    assert tables.ratios(found, {"processes": 1}, {"processes": 2}).tolist() == [2]


def test_what_was_not_measured_is_left_out(folder):
    path = folder / tables.FILES["updates"]
    found = tables.load("updates", folder)
    found[~found["what"].isin(peers.PEERS)].to_csv(path, index=False)
    found = tables.load("updates", folder)
    rows = tables.yardsticks(found).set_index("profile `paper`")
    assert rows.loc["OSRL's CPQ", "AntCircle: updates/s"] == "not measured"
    marks = tables.marks(found).set_index("mark")
    assert set(marks.filter(like="OSRL", axis=0)["AntCircle"]) == {"not measured"}
    labels = [label.get_text() for label in speed(found).axes[0].get_yticklabels()]
    assert "C2IQL" in labels and "OSRL's CPQ" not in labels


def test_the_pages_show_the_files_or_say_that_there_are_none(folder, monkeypatch):
    monkeypatch.setattr(tables, "FOLDER", folder)
    assert pages.write_speed() == folder / "speed.png"
    figure = speed(tables.load("updates", folder))
    bars = [bar.get_width() for bar in figure.axes[0].patches]
    assert len(bars) == len(tables.NAMES) and max(bars) == pytest.approx(1000 / 3)
    assert "| C2IQL | " in pages.speed_text() and "cost of five seeds" in pages.speed_front()
    monkeypatch.setattr(tables, "FOLDER", folder / "nowhere")
    assert pages.speed_text() == pages.speed_front() == tables.NOT_RUN and pages.write_speed() is None


def test_the_pages_are_up_to_date():
    assert [path.relative_to(ROOT) for path in pages.pages()] == [Path("README.md"), Path("data/README.md")]
    for path, text in pages.pages().items():
        assert path.read_text() == text, f"{path} is out of date: run `python -m benchmarks --report`"


# --- The command ---


def benchmarks_command(*words):
    """What `python -m benchmarks` prints, typed in the project's folder."""
    line = [sys.executable, "-m", "benchmarks", *words]
    return subprocess.run(line, cwd=ROOT, capture_output=True, text=True)


def test_help_says_what_is_measured():
    done = benchmarks_command("--help")
    assert (done.returncode, done.stderr) == (0, "") and "usage: python -m benchmarks" in done.stdout
    for word in ("how fast this machine trains", "--workers", "--full", "--peers", "--report"):
        assert word in done.stdout


def test_an_error_is_one_line():
    done = benchmarks_command("--task", "Ball")
    assert done.returncode == 1 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith("benchmarks: unknown task 'Ball'")
    with pytest.raises(ValueError, match="--rounds 0: must be 1 or more"):
        command.main(rounds=0)


def test_a_machine_without_cuda_says_so(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="^--device cuda: "):
        command.main(device="cuda")


def test_it_prints_both_tables(monkeypatch, capsys):
    tiny = C2IQL.configure("small", hidden_width=8, hidden_layers=1, batch_size=8, crm_width=8, crm_layers=1)
    monkeypatch.setattr(benchmarks, "SIZES", ("small",))
    monkeypatch.setattr(C2IQL, "configure", lambda profile: tiny)
    command.main("BallRun", workers=1, rounds=1)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = [line for line in lines if line[:1] == ["small"]]
    assert [row[1:3] for row in rows] == [["1", "float32"], ["3", "float32"], ["1", "bfloat16"]]
    for row in rows:
        shares = [int(cell.rstrip("%")) for cell in row[6:]]
        assert len(shares) == len(PARTS) and 98 <= sum(shares) <= 102
        assert float(row[3]) > 1
    assert ["bare", "simulator", "1"] in [line[:3] for line in lines]
    assert any(line[:2] == ["rollouts", "1"] and 0 < int(line[3].rstrip("%")) < 200 for line in lines)


def test_the_same_actions_are_played_in_every_way():
    agent = C2IQL(TASKS["BallRun"], C2IQL.configure("small", hidden_width=8))
    actions = policy_actions(agent)
    assert actions.shape == (100, 10, 2)
    first = make_env("BallRun").reset(seed=3)[0]
    player = agent.player(agent.task.thresholds[:1], [3])
    assert actions[0, 3] == pytest.approx(player.act(first[None])[0])  # episode 3, step 0
    assert (
        play_rollouts(agent, 1)
        == play("ours", "BallRun", actions)
        == play("bare", "BallRun", actions)
        == 1000
    )
