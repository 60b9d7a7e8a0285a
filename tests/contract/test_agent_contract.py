"""What every algorithm promises: gradients, runs together and alone, files, acting, randomness, devices.

The tests run for all of `ALGORITHMS`, for the template that newcomers copy, and for an odd algorithm that
uses everything that the interface allows. `pytest tests/contract -k NAME` runs them for one.
"""

import contextlib
import dataclasses
import json
import math
import pickle

import numpy as np
import pytest
import torch
from plain import Plain
from randoms import ACT, OBS, of_run, randomise
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from toys import DATA, TEMPLATE, UPDATES, T, every_algorithm, make_agent, registered, runs_of, start

from tutorial_lib.checkpoints import TrainingError, load_agent, save_agent
from tutorial_lib.training import train

QUIET = {"log_every": 1, "progress": False}
__all__ = ["registered"]  # a fixture for every test here


def without_speed(log):
    return [{key: value for key, value in row.items() if key != "updates_per_second"} for row in log]


def assert_states_close(agent, run, other):
    """Every tensor of one run, but for Adam's, is what `other` has under the same name."""
    state = agent.state()
    for key, value in other.items():
        if key.startswith(("online.", "target.", "buffer.", "variable.")):
            torch.testing.assert_close(state[key][run], value, rtol=1e-3, atol=5e-5, msg=key)


# --- Gradients ---


def networks_reached(agent, updates=8):
    """By loss, the parameters that have some gradient of it, over random states: (network, parameter)."""
    data, generators = start(agent)
    reached: dict[str, set[tuple[str, str]]] = {}
    for seed in range(updates):
        randomise(agent, seed)
        plain = Plain(agent)
        nets = plain.online | {f"target_{name}": net for name, net in plain.targets.items()}
        leaves = {(name, key): p for name, net in nets.items() for key, p in net.named_parameters()}
        losses, _ = plain.losses(of_run(agent.draw_all(data, generators), 0))
        for loss, value in losses.items():
            assert value.shape == ()
            options = {"allow_unused": True, "retain_graph": True}
            gradients = torch.autograd.grad(value, list(leaves.values()), **options)
            found = {place for place, g in zip(leaves, gradients, strict=True) if g is not None and g.any()}
            reached.setdefault(loss, set()).update(found)
    return reached


@every_algorithm
def test_every_network_is_trained_by_one_loss_and_no_loss_reaches_anything_else(kind):
    agent = make_agent(kind, runs_of(kind)[:1])
    reached = networks_reached(agent)
    of_loss = {loss: {network for network, _ in places} for loss, places in reached.items()}
    assert all(of_loss.values()), of_loss
    trained = [network for networks in of_loss.values() for network in networks]
    modules = {name: net for name, net in agent.modules.items() if name not in agent.fixed}
    assert sorted(trained) == sorted(modules), of_loss  # each once; no target network
    everything = {(name, key) for name, net in modules.items() for key, _ in net.named_parameters()}
    assert set().union(*reached.values()) == everything  # no parameter is idle


# --- Several runs at once ---


@every_algorithm
def test_runs_that_differ_in_seed_and_limit_are_trained_together_as_alone(kind):
    together = make_agent(kind)
    log = train(together, DATA, updates=5, **QUIET)
    for run, pair in enumerate(runs_of(kind)):
        alone = make_agent(kind, [pair])
        rows = train(alone, DATA, updates=5, **QUIET)
        assert_states_close(together, run, {key: x[0] for key, x in alone.state().items() if x.ndim})
        for mine, other in zip(without_speed(log[run::3]), without_speed(rows), strict=True):
            assert mine == pytest.approx(other, rel=1e-3, abs=1e-3)
    moved = [x for key, x in together.state().items() if key.startswith("online.")]
    for one, other in ((0, 1), (1, 2)):  # the limit changes the result, and so does the seed
        assert max((x[one] - x[other]).abs().max() for x in moved) > 5e-4


@every_algorithm
def test_an_update_of_several_runs_is_plain_pytorch_on_each(kind):
    """The same draws for modules with tensors of their own, torch's AdamW and clipping, and a loop."""
    agent = make_agent(kind)
    data, generators = start(agent)
    plains = [Plain(agent, run) for run in range(3)]
    for _ in range(5):
        batch = agent.draw_all(data, generators)
        scalars = agent.update(batch)
        for run, plain in enumerate(plains):
            expected = plain.update(of_run(batch, run))
            assert scalars.keys() == expected.keys()
            for name, value in expected.items():
                torch.testing.assert_close(scalars[name][run], value, rtol=1e-3, atol=1e-4, msg=name)
    for run, plain in enumerate(plains):
        state = plain.state()
        assert state.keys() | {"updates"} == {
            key for key in agent.state() if not key.startswith(("adam.", "reconstruction."))
        }
        assert_states_close(agent, run, state)


@every_algorithm
def test_networks_and_actions_move_and_an_update_leaves_nothing_behind_but_numbers(kind):
    """A graph that the targets or variables kept would grow with every update."""
    agent = make_agent(kind)
    data, generators = start(agent)
    before = {key: value.clone() for key, value in agent.state().items()}
    actions = [agent.act(*some_episodes(), run) for run in range(3)]
    for _ in range(3):
        scalars = agent.update(agent.draw_all(data, generators))
    kept = [*scalars.values(), *agent.variables.values()]
    kept += [x for part in agent.target_parameters.values() for x in part.values()]
    assert not any(x.requires_grad for x in kept)
    assert all(x.shape == (3,) and x.isfinite().all() for x in scalars.values())
    for key, value in agent.state().items():
        if key.startswith(("online.", "target.")) and key.split(".")[1] not in agent.fixed:
            assert all((value[run] != before[key][run]).any() for run in range(3)), key
    assert all((agent.act(*some_episodes(), run) != actions[run]).any() for run in range(3))


# --- Checkpoints and files ---


@every_algorithm
def test_a_resumed_training_is_the_uninterrupted_one_bit_for_bit(kind, tmp_path):
    runs = runs_of(kind)[1:]
    whole, killed, resumed = (make_agent(kind, runs) for _ in range(3))
    expected = train(whole, DATA, **QUIET)
    train(killed, DATA, updates=6, run_dir=tmp_path, **QUIET)
    log = train(resumed, DATA, run_dir=tmp_path, **QUIET)
    assert resumed.updates == UPDATES and without_speed(log) == without_speed(expected)
    state = resumed.state()
    assert state.keys() == whole.state().keys() and any(key.startswith("adam.") for key in state)
    for key, value in whole.state().items():
        assert torch.equal(state[key], value), key


def some_episodes(count=7):
    """Observations (E, obs) and limits (E,), among them none and infinitely high ones."""
    rng = np.random.default_rng(1)
    limits = rng.choice([0.0, 1.0, 2.5, 6.0, 40.0, math.inf], count)
    return rng.normal(3, 2, size=(count, OBS)).astype(np.float32), limits


@pytest.fixture
def trained(kind):
    agent = make_agent(kind)
    train(agent, DATA, updates=3, progress=False)
    return agent


@every_algorithm
def test_a_loaded_agent_acts_as_the_saved_one(kind, trained, tmp_path):
    path = tmp_path / "agent.safetensors"
    save_agent(trained, path)
    agent = load_agent(path)
    same = ("task", "name", "config", "seeds", "limits", "updates", "data_checksum")
    assert [getattr(agent, name) for name in same] == [getattr(trained, name) for name in same]
    for run in range(3):
        for method in ("act", "predicted_cost"):
            mine, other = (getattr(x, method)(*some_episodes(), run) for x in (agent, trained))
            np.testing.assert_array_equal(mine, other)
    kept = {key for key in trained.state() if not key.startswith(("adam.", "target."))}
    assert load_file(path).keys() == kept


@every_algorithm
def test_a_file_names_every_option_and_a_wrong_one_is_an_error_that_names_it(kind, trained, tmp_path):
    path = tmp_path / "agent.safetensors"
    save_agent(trained, path)
    with safe_open(path, "pt") as file:
        header = file.metadata()
    options = json.loads(header["config"])
    assert options == dataclasses.asdict(trained.config)
    for wrong, words in (({"colour": 1}, "'colour'"), ({"batch_size": 1}, "batch_size is 1, and must be")):
        save_file(load_file(path), path, metadata=header | {"config": json.dumps(options | wrong)})
        with pytest.raises(TrainingError, match=words) as error:
            load_agent(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)


@every_algorithm
def test_a_pickled_agent_acts_as_before_and_carries_no_optimiser(kind, trained):
    """So it is sent to worker processes. Adam's moments are twice the networks' size."""
    sent = pickle.loads(pickle.dumps(trained))
    for run in range(3):
        np.testing.assert_array_equal(sent.act(*some_episodes(), run), trained.act(*some_episodes(), run))
    ours, theirs = (play(agent, run=2) for agent in (trained, sent))
    assert all(np.array_equal(*pair, equal_nan=True) for pair in zip(ours, theirs, strict=True))
    assert not any(isinstance(part, torch.optim.Optimizer) for part in vars(sent).values())


# --- Acting and playing ---


@every_algorithm
def test_actions_lie_in_the_box_and_do_not_depend_on_the_other_episodes(kind, trained):
    observations, limits = some_episodes()
    for run in range(3):
        actions = trained.act(observations, limits, run)
        assert actions.shape == (7, ACT) and actions.dtype == np.float32
        assert np.abs(actions).max() <= 1
        alone = [trained.act(observations[e : e + 1], limits[e : e + 1], run)[0] for e in range(7)]
        np.testing.assert_allclose(actions, alone, atol=1e-5)
        far = trained.act(1e6 * observations, limits, run)
        assert np.abs(far).max() <= 1
    assert not np.array_equal(trained.act(observations, limits, 0), trained.act(observations, limits, 2))
    cost = trained.predicted_cost(observations, limits)
    assert cost.shape == (7,) and (np.isnan(cost).all() or np.isfinite(cost).all())


def play(agent, episodes=range(4), cost=0.7, run=0, steps=T):
    """What a player says in episodes of made-up observations and costs: told (T, E), actions (T, E, act)."""
    limits, seeds = np.array([1.0, 3.0, 6.0, math.inf])[list(episodes)], [10 + e for e in episodes]
    player = agent.player(limits, seeds, run)
    told, actions = [], []
    for t in range(steps):
        rows = [np.random.default_rng((e, t)) for e in episodes]
        observations = np.stack([rng.normal(3, 2, OBS) for rng in rows])
        costs = np.array([rng.random() < cost for rng in rows], float)
        told.append(player.told.copy())
        actions.append(player.act(observations))
        predicted = player.predicted_cost(observations)
        assert predicted.shape == (len(rows),)
        player.see(np.ones(len(rows)), costs)
    return np.array(told), np.array(actions)


@every_algorithm
def test_a_player_says_what_it_is_told_and_equal_seeds_play_equally(kind, trained):
    told, actions = play(trained)
    assert told.shape == (T, 4) and (np.isnan(told) | (told >= 0)).all()
    assert actions.shape == (T, 4, ACT) and actions.dtype == np.float32 and np.abs(actions).max() <= 1
    again_told, again = play(trained)
    np.testing.assert_array_equal(told, again_told)
    np.testing.assert_array_equal(actions, again)


@every_algorithm
def test_an_episode_is_played_alone_as_among_others(kind, trained):
    told, actions = play(trained)
    for e in range(4):
        own_told, own = play(trained, [e])
        np.testing.assert_array_equal(own_told[:, 0], told[:, e])
        np.testing.assert_allclose(own[:, 0], actions[:, e], atol=1e-5)


@every_algorithm
def test_two_players_share_no_memory(kind, trained):
    """One that hears of nothing but costs changes nothing for another that began before it."""
    limits, seeds = [3.0, 6.0], [1, 2]
    observations = np.random.default_rng(2).normal(3, 2, size=(2, OBS))

    def course(beside):
        player, other = trained.player(limits, seeds), trained.player(limits, seeds)
        seen = []
        for _ in range(4):
            if beside:
                other.act(observations + 1)
                other.see(np.full(2, -3.0), np.full(2, 2.0))
            seen += [player.told.copy(), player.act(observations)]
            player.see(np.ones(2), np.ones(2))
        return seen

    for alone, beside in zip(course(False), course(True), strict=True):
        np.testing.assert_array_equal(alone, beside)


# --- Randomness ---


@every_algorithm
def test_equal_generators_draw_equally_and_nothing_else_is_random(kind):
    """PyTorch's and NumPy's global states are neither used nor touched, from construction to acting."""
    states = []
    with torch.random.fork_rng(devices=[]):
        for elsewhere in (1, 2):
            torch.manual_seed(elsewhere)
            np.random.seed(elsewhere)
            before = torch.get_rng_state(), np.random.get_state()
            agent = make_agent(kind)
            data, generators = start(agent)
            once, again = (agent.draw(data[0], torch.Generator().manual_seed(5), 3.0) for _ in range(2))
            assert once.keys() == again.keys() and all(torch.equal(once[key], again[key]) for key in once)
            agent.update(agent.draw_all(data, generators))
            agent.act(*some_episodes())
            play(agent, steps=2)
            assert torch.equal(torch.get_rng_state(), before[0])
            now = np.random.get_state()
            assert now[2] == before[1][2] and np.array_equal(now[1], before[1][1])
            states.append(agent.state())
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])


# --- Devices and precision ---


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


@pytest.mark.parametrize("runs", [1, 3])
@every_algorithm
def test_updates_stay_on_their_device_and_never_wait_for_a_number(kind, runs, elsewhere):
    agent = make_agent(kind, runs_of(kind)[:runs], device=elsewhere)
    data, generators = start(agent)
    for _ in range(2):
        batch = agent.draw_all(data, generators)
        scalars = agent.update(batch)
    assert agent.updates == 2
    for key, value in (agent.state() | scalars | batch).items():
        assert key == "updates" or key.endswith(".step") or value.device == elsewhere, key


def test_a_number_that_is_asked_for_or_a_mixed_device_is_noticed(elsewhere):
    """What the test above would see: the two mistakes, made on purpose."""
    mistakes = {"item": lambda x: x * x.mean().item(), "device": lambda x: x + torch.ones(OBS)}
    for words, mistake in mistakes.items():
        agent = make_agent(TEMPLATE, device=elsewhere)
        data, generators = start(agent)
        agent.network_input = lambda net, observations, limit, mistake=mistake: mistake(observations)
        with pytest.raises(RuntimeError, match=words):
            agent.update(agent.draw_all(data, generators))


@pytest.mark.parametrize("runs", [1, 2])
@every_algorithm
def test_in_bfloat16_an_update_is_about_the_same_and_leaves_float32(kind, runs):
    found = []
    for precision in ("float32", "bfloat16"):
        agent = make_agent(kind, runs_of(kind)[:runs], precision=precision)
        data, generators = start(agent)
        scalars = agent.update(agent.draw_all(data, generators))
        parameters = [p for group in agent.adam.param_groups for p in group["params"]]
        gradients = [p.grad for p in parameters if p.grad is not None]
        kept = [*gradients, *agent.state().values()]
        assert all(x.dtype == torch.float32 for x in kept if x.is_floating_point())
        found.append((scalars, torch.cat([x.flatten() for x in gradients])))
    (exact, gradient), (rounded, rounded_gradient) = found
    for key, value in exact.items():
        if key.endswith("_loss"):
            torch.testing.assert_close(rounded[key].float(), value, rtol=0.05, atol=0.02, msg=key)
    assert 1e-4 < (rounded_gradient - gradient).norm() / gradient.norm() < 0.1


@every_algorithm
def test_acting_does_not_round(kind):
    agents = [make_agent(kind, precision=precision) for precision in ("float32", "bfloat16")]
    assert np.array_equal(*(agent.act(*some_episodes()) for agent in agents))
