"""Collection: thinning by brute force, charges and the multiplier by hand, runs that are killed and resumed.

Run as a script, this file is the process that gets killed.
"""

import functools
import hashlib
import json
import math
import os
import signal
import subprocess
import sys
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from tutorial_lib.data import collect as collecting
from tutorial_lib.data import ppo
from tutorial_lib.data.behaviour import KINDS, LagrangianCost, PricedCost, RecordedTask, along_own_axes
from tutorial_lib.data.collect import SOURCES, read_source
from tutorial_lib.data.dataset import KEYS, DatasetError
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.data.ppo import load_ppo, make_ppo, run_ppo, save_ppo
from tutorial_lib.data.schedule import Schedule
from tutorial_lib.tasks import TASKS, all_tasks
from tutorial_lib.tasks.recipes import RECIPES, Recipe

# PPO says so because 1616 is no multiple of 512.
pytestmark = pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
ROOT = Path(__file__).parents[1]
BALL, ANT = TASKS["BallRun"], TASKS["AntRun"]  # T = 100, cost range 80
BATCH = 1616  # an episode of 100 steps in each of the 16 environments, and one step of the next
SLICE = 2 * BATCH  # the multiplier looks at the episodes of the first batch
RECIPE = Recipe(
    episodes=20,
    steps=2 * SLICE,
    batch_steps=BATCH,
    ramp=(0.25, 0.75),
    learning_rate=(1e-3, 2e-4),
    limit_falls=(0.0, 0.01),
)


# --- What agents are charged, and what they observe ---


class Scripted(gymnasium.Env):
    """Stands in for the simulator: every reward is 2, and the costs are given."""

    def __init__(self, costs):
        self.costs, self.t = costs, 0

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(7, np.float32), {"cost": 0.0}

    def step(self, action):
        self.t += 1
        last = self.t == len(self.costs)
        return np.full(7, self.t, np.float32), 2.0, False, last, {"cost": self.costs[self.t - 1]}


def scripted(kind, costs, recipe, seed=0, price_scale=1.0):
    env = KINDS[kind](BALL, recipe, np.random.default_rng(seed), episodes := [])
    env.env.close()
    env.env, env.price_scale = Scripted(costs), price_scale
    return env, episodes


def rewards_of(env):
    observation, _ = env.reset()
    seen, rewards, done = [observation], [], False
    while not done:
        observation, reward, _, done, _ = env.step(np.zeros(2, np.float32))
        seen.append(observation)
        rewards.append(reward)
    return seen, rewards


def test_an_unsafe_step_costs_its_price_once_the_allowance_is_used_up():
    """BallRun's best return is 1327.4456 in 100 steps: a reward of 2 is worth 200 / 1327.4456."""
    two_free = Recipe(episodes=1, prices=(0.1, 0.5), allowance_share=1.0, allowances=(2 / 80, 2 / 80))
    env, episodes = scripted("priced", [1, 0, 1, 1, 0, 1], two_free, price_scale=0.6)
    seen, rewards = rewards_of(env)
    r = 200 / 1327.4456
    assert rewards == pytest.approx([r, r, r, r - 0.3, r, r - 0.3])  # 0.3 = 0.5 * 0.6
    assert [x[-2] for x in seen] == pytest.approx([math.log(0.5)] * 7)  # the policy sees the price ...
    assert [x[-1] * 80 / 2 for x in seen] == pytest.approx([2, 1, 1, 0, 0, 0, 0])  # ... and what is left
    # The record is the simulator's: neither price nor allowance is in it.
    (episode,) = episodes
    assert episode["rewards"].tolist() == [2.0] * 6 and episode["costs"].tolist() == [1, 0, 1, 1, 0, 1]
    assert episode["observations"][:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert episode["next_observations"][:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert episode["observations"].shape == (6, 7)
    assert episode["timeouts"].tolist() == [False] * 5 + [True] and not episode["terminals"].any()


def test_prices_and_allowances_are_drawn_from_their_ranges():
    recipe = Recipe(episodes=1, prices=(0.1, 10.0), allowance_share=0.25, allowances=(-0.5, 1.0))
    env, _ = scripted("priced", [1.0], recipe)
    draws = [(math.exp(x[-2]), x[-1] * 80 / 2) for x in (env.reset()[0] for _ in range(3_000))]
    prices = np.array([price for price, _ in draws])
    free = np.array([allowance for _, allowance in draws])
    with_allowance = np.isclose(prices, 10.0, rtol=1e-5)  # at the highest price
    assert with_allowance.mean() == pytest.approx(0.25, abs=0.03)
    assert not free[~with_allowance].any()
    logs = np.log10(prices[~with_allowance])  # uniform over -1 .. 1
    assert logs.min() >= -1.001 and logs.mean() == pytest.approx(0, abs=0.06)
    assert logs.std() == pytest.approx(2 / math.sqrt(12), rel=0.05)
    assert (free[with_allowance] == 0).mean() == pytest.approx(1 / 3, abs=0.06)  # below zero is zero
    assert free.max() == pytest.approx(80, rel=0.02)


def test_while_unsafe_steps_are_free_nothing_is_charged():
    env, _ = scripted("priced", [1, 1], Recipe(episodes=1, allowance_share=0.0), price_scale=0.0)
    assert rewards_of(env)[1] == pytest.approx([200 / 1327.4456] * 2)


def test_a_lagrangian_agent_pays_the_multiplier_for_the_cost_and_does_not_observe_it():
    env, episodes = scripted("lagrangian", [1, 0, 1, 0.5], Recipe(episodes=1), price_scale=0.7)
    assert isinstance(env, LagrangianCost) and env.observation_space.shape == (7,)
    seen, rewards = rewards_of(env)
    r = 200 / 1327.4456
    assert rewards == pytest.approx([r - 0.7, r, r - 0.7, r - 0.35])
    assert [x.tolist() for x in seen] == [[t] * 7 for t in range(5)]  # nothing is appended
    (episode,) = episodes
    assert episode["rewards"].tolist() == [2.0] * 4 and episode["costs"].tolist() == [1, 0, 1, 0.5]


# --- The robot's own axes ---


def body_axes(attitude):
    """The body's axes in the world, as columns, by the textbook's formula for a quaternion (x, y, z, w)."""
    x, y, z, w = attitude
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize("seed", range(5))
def test_own_axes_are_the_bodys(seed):
    observation = np.random.default_rng(seed).normal(size=34)
    observation[6:10] /= np.linalg.norm(observation[6:10])
    axes, seen = body_axes(observation[6:10]), along_own_axes(observation)
    x, y = observation[:2]
    vectors = [observation[3:6], observation[10:13], np.array([0, 0, 1]), np.array([x, y, 0])]
    expected = [vector @ axis for vector in vectors for axis in axes.T]
    np.testing.assert_allclose(seen, [*observation[:3], *expected, *observation[13:]], atol=1e-12)


def test_an_ant_that_starts_along_the_circle_has_the_centre_on_its_right():
    recipe = replace(RECIPES["AntCircle"], allowance_share=0.0)
    env = PricedCost(TASKS["AntCircle"], recipe, np.random.default_rng(0), [])
    for _ in range(3):
        seen, _ = env.reset()
        assert env.observation_space.contains(seen)
        distance = math.hypot(*env.env.position)
        assert 2 <= distance <= 4
        assert seen[9:12] == pytest.approx([0, 0, 1], abs=0.01)  # upwards is upwards
        assert seen[12:15] == pytest.approx([0, distance / 10, 0], abs=0.01)  # the centre of the circle
        assert seen.shape == (34 + 2 + 2,) and env.observation.shape == (34,)  # which is what is recorded
    env.close()


# --- The schedule ---


def at(schedule, steps):
    """The price scale that the schedule sets before the batch that begins after so many steps of a slice."""
    scales = []
    env = SimpleNamespace(set_attr=lambda name, value: scales.append((name, value)))
    schedule.model = SimpleNamespace(num_timesteps=steps, get_env=lambda: env)
    schedule.on_rollout_start()
    ((name, value),) = scales
    assert name == "price_scale"
    return value


def episode_of(cost, steps=100):
    return {"costs": np.array([1.0] * cost + [0.0] * (steps - cost))}


def test_the_multiplier_follows_costs_above_the_limit_by_hand():
    """Cost range 80, limit 80 until half of the run and 0 from then on, integral of at most 0.15."""
    recipe = Recipe(episodes=1, steps=1_000, limit_falls=(0.5, 0.5001), prices=(0.1, 0.15))
    schedule = Schedule(BALL, recipe, "lagrangian", episodes := [])
    assert at(schedule, 0) == 0  # no episode yet
    episodes += [episode_of(30), episode_of(50)]
    assert at(schedule, 100) == 0  # v = (40 - 80) / 80: nothing is below zero
    episodes += [episode_of(40)]
    assert at(schedule, 600) == pytest.approx(1.1)  # v = 1/2: integral 0.2 v = 0.1, and 2 v = 1
    assert at(schedule, 700) == pytest.approx(1.1)  # no new episode: as it was
    episodes += [episode_of(0), episode_of(0)]
    assert at(schedule, 800) == pytest.approx(0.1)  # v = 0: the integral stays
    episodes += [episode_of(80)]
    assert at(schedule, 900) == pytest.approx(2.15)  # v = 1: 0.1 + 0.2 is more than 0.15


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("task", ["BallRun", "AntCircle"])
def test_the_multiplier_is_that_of_a_slow_loop(task, seed):
    task, rng = TASKS[task], np.random.default_rng(seed)
    recipe = Recipe(episodes=1, steps=10_000, limit_falls=(0.3, 0.8), prices=(0.1, 0.8))
    schedule = Schedule(task, recipe, "lagrangian", episodes := [], first_step=2_000)
    integral = price = 0.0
    prices, integrals = [], []
    for step in range(0, 9_000, 250):  # 1,000 steps more than the run has
        costs = [int(cost) for cost in rng.integers(0, task.cost_range + 1, rng.integers(0, 4))]
        share = (2_000 + step) / 10_000
        if share <= 0.3:
            limit = task.cost_range
        elif share >= 0.8:
            limit = 0
        else:
            limit = task.cost_range * (0.8 - share) / 0.5
        if costs:
            violation = (sum(costs) / len(costs) - limit) / task.cost_range
            integral += violation / 5
            integral = 0.0 if integral < 0 else 0.8 if integral > 0.8 else integral
            price = integral + violation + violation
            price = 0.0 if price < 0 else price
        episodes += [episode_of(cost, task.horizon) for cost in costs]
        assert at(schedule, step) == pytest.approx(price)
        assert schedule.multiplier.integral == pytest.approx(integral)
        prices.append(price), integrals.append(integral)
    assert min(prices) == min(integrals) == 0 and max(integrals) == 0.8  # all that is cut off was cut off


def test_without_a_ramp_prices_are_full_from_the_first_step():
    assert at(Schedule(BALL, replace(RECIPE, ramp=None), "priced", []), 0) == 1


# --- A run of two slices ---


def note(monkeypatch):
    """Notes of what `run_ppo` does: scales and learning rates of the batches, states around the slices."""
    notes, make = SimpleNamespace(scales=[], rates=[], starts=[], ends=[], closed=[]), ppo.make_ppo
    close = RecordedTask.close
    monkeypatch.setattr(RecordedTask, "close", lambda self: (notes.closed.append(id(self)), close(self)))

    def state(model, schedule):
        weights = {key: value.numpy().copy() for key, value in model.policy.state_dict().items()}
        moments = {"mean": model.env.obs_rms.mean.copy(), "var": np.array(model.env.ret_rms.var)}
        return weights | moments | {"multiplier": np.array(schedule.multiplier.value)}

    def make_and_note(*arguments):
        model, schedule = make(*arguments)
        train, learn = model.train, model.learn

        def train_and_note():
            train()
            notes.scales.append(model.env.get_attr("price_scale")[0])
            notes.rates.append(model.policy.optimizer.param_groups[0]["lr"])

        def learn_and_note(steps, callback):
            notes.starts.append(state(model, schedule))
            learn(steps, callback)
            notes.ends.append(state(model, schedule))

        model.train, model.learn = train_and_note, learn_and_note
        return model, schedule

    monkeypatch.setattr(ppo, "make_ppo", make_and_note)
    return notes


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The folder of a run of each kind that nothing interrupted, and notes of each."""
    folder, notes = tmp_path_factory.mktemp("uninterrupted"), {}
    for kind in KINDS:
        with pytest.MonkeyPatch.context() as monkeypatch:
            notes[kind] = note(monkeypatch)
            run_ppo(BALL, RECIPE, kind, 0, folder / "BallRun" / f"{kind}-0", slice_steps=SLICE)
    return SimpleNamespace(folder=folder, notes=notes)


def test_every_simulator_of_a_slice_is_closed_after_it(uninterrupted):
    for kind in KINDS:  # 16 of CarCircle's hold 1.4 GB
        assert len(set(uninterrupted.notes[kind].closed)) == len(uninterrupted.notes[kind].closed) == 32


def test_prices_rise_and_the_learning_rate_falls_along_a_run(uninterrupted):
    assert uninterrupted.notes["priced"].scales == pytest.approx([0, 0, 0.5, 1])
    for kind in KINDS:
        assert uninterrupted.notes[kind].rates == pytest.approx([1e-3, 8e-4, 6e-4, 4e-4])


def test_the_multiplier_looks_at_the_episodes_of_the_batch_before(uninterrupted):
    scales = uninterrupted.notes["lagrangian"].scales
    first, second = (
        load_file(path)["costs"].reshape(-1, 100).sum(axis=1)[:16].mean() / 80  # of its first batch
        for path in sorted(uninterrupted.folder.glob("BallRun/lagrangian-0/episodes-*"))
    )
    assert first > 0  # and the limit is 0 when the multiplier first looks
    assert scales == pytest.approx([0, 2.2 * first, 2.2 * first, 0.2 * (first + second) + 2 * second])


@pytest.mark.parametrize("kind", KINDS)
def test_a_slice_begins_with_what_the_one_before_it_left(kind, uninterrupted):
    notes = uninterrupted.notes[kind]
    assert len(notes.starts) == len(notes.ends) == 2
    for key, value in notes.ends[0].items():
        np.testing.assert_array_equal(value, notes.starts[1][key], err_msg=key)
        if kind == "lagrangian" or key != "multiplier":
            assert (value != notes.starts[0][key]).any()


# --- Killed and resumed ---


def run_and_die(when, kind, folder):
    """What the killed process does: slices, until it has begun the second one, or played it."""
    save, step, steps = ppo.save_arrays, RecordedTask.step, []

    def save_or_die(arrays, path, *rest):
        if path.name == "episodes-001.safetensors":
            os.kill(os.getpid(), signal.SIGKILL)
        save(arrays, path, *rest)

    def step_or_die(self, action):
        steps.append(1)
        if len(steps) == SLICE + BATCH + 1:  # one update of PPO is lost
            os.kill(os.getpid(), signal.SIGKILL)
        return step(self, action)

    if when == "between the two files":
        ppo.save_arrays = save_or_die
    else:
        RecordedTask.step = step_or_die
    run_ppo(BALL, RECIPE, kind, 0, folder, slice_steps=SLICE)


def killed(when, kind, folder):
    """The names of the files, but its lock's, that a run has after it was started (again) and killed."""
    command, env = [sys.executable, __file__, when, kind, folder], os.environ | {"PYTHONPATH": str(ROOT)}
    child = subprocess.run(command, env=env, capture_output=True, text=True)
    assert child.returncode == -signal.SIGKILL, child.stderr
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith(".lock"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_that_is_killed_twice_continues_to_the_bytes_of_one_that_was_not(kind, uninterrupted, tmp_path):
    left = ["episodes-000.safetensors", "state-001.safetensors"]
    assert killed("in the second slice", kind, tmp_path) == left
    first = (tmp_path / left[0]).read_bytes()
    assert killed("between the two files", kind, tmp_path) == [*left, "state-002.safetensors"]
    assert (tmp_path / left[0]).read_bytes() == first  # it is not played again
    run_ppo(BALL, RECIPE, kind, 0, tmp_path, slice_steps=SLICE)

    whole = uninterrupted.folder / "BallRun" / f"{kind}-0"
    names = ["episodes-000.safetensors", "episodes-001.safetensors", "state-002.safetensors"]
    for folder in (tmp_path, whole):  # nothing half-written, and no pickle
        assert sorted(path.name for path in folder.iterdir()) == names
    for name in names[:2]:
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()
    ours, theirs = (load_file(folder / names[2]) for folder in (tmp_path, whole))
    assert ours.keys() == theirs.keys()
    for key in ours.keys() - {"seconds"}:
        np.testing.assert_array_equal(ours[key], theirs[key], err_msg=key)
    assert (ours["multiplier.value"] > 0) == (kind == "lagrangian")


def test_the_slices_and_the_kinds_play_other_episodes(uninterrupted):
    slices = [load_file(path) for path in sorted(uninterrupted.folder.glob("BallRun/*/episodes-*"))]
    assert [len(arrays["rewards"]) for arrays in slices] == [3_200] * 4
    starts = np.concatenate([arrays["observations"][::100] for arrays in slices])
    assert len(np.unique(starts, axis=0)) == 128


def test_a_state_names_its_recipe_without_what_only_thinning_reads(uninterrupted):
    with safe_open(uninterrupted.folder / "BallRun" / "priced-0" / "state-002.safetensors", "np") as file:
        metadata = file.metadata()
    played = {
        "steps": 6464,
        "prices": [0.02, 4.0],
        "allowance_share": 0.5,
        "allowances": [0.0, 1.0],
        "ramp": [0.25, 0.75],
        "learning_rate": [0.001, 0.0002],
        "calm": None,
        "target_kl": None,
        "batch_steps": 1616,
        "width": 64,
        "limit_falls": [0.0, 0.01],
        "own_axes": False,
    }
    assert metadata == {"recipe": json.dumps(played), "slice_steps": "3232"}


@pytest.mark.parametrize("kind", ["", "Priced", "priced-0"])
def test_a_run_of_an_unknown_kind_is_refused(kind, tmp_path):
    with pytest.raises(ValueError, match=f"^unknown kind of source '{kind}': .* priced, lagrangian$"):
        run_ppo(BALL, RECIPE, kind, 0, tmp_path / "run")
    assert not (tmp_path / "run").exists()


# --- From runs to a dataset ---


def test_collected_episodes_become_a_dataset(uninterrupted, tmp_path, monkeypatch):
    monkeypatch.setattr(collecting, "run_ppo", functools.partial(run_ppo, slice_steps=SLICE))
    monkeypatch.setattr(ppo, "make_ppo", None)  # all episodes are there: nothing is run again
    folder, out = uninterrupted.folder, tmp_path / "data.hdf5"
    made = collecting.collect(BALL, SOURCES, RECIPE, folder, out, workers=1)
    data = read_dataset(out, BALL)
    assert made.checksum == data.checksum and made.attributes == data.attributes
    attributes = data.attributes
    assert attributes["task"] == "BallRun" and attributes["made_by"] == "c2iql collect BallRun"
    assert attributes["collected_episodes"] == 128 and attributes["recipe"] == str(asdict(RECIPE))
    assert attributes["collected_steps"] == 2 * RECIPE.steps
    assert "CC BY" in attributes["licence"] and "seeds" not in attributes
    for package in ("stable-baselines3", "pybullet", "bullet-safety-gym", "torch"):
        assert package in attributes["versions"]

    assert data.num_episodes == 20
    assert (data.episode_lengths == 100).all() and data.timeouts.sum() == data.num_episodes
    assert np.isin(data.costs, (0, 1)).all() and np.abs(data.actions).max() <= 1
    follows = np.flatnonzero(~data.timeouts)
    np.testing.assert_array_equal(data.next_observations[follows], data.observations[follows + 1])
    assert data.rewards.std() > 0.1 and len(np.unique(data.episode_returns)) == data.num_episodes

    # Each episode is one of its source's, counted in the files.
    starts_of = {
        source: np.concatenate([load_file(p)["observations"][::100] for p in sorted(run.glob("episodes-*"))])
        for source, run in ((source, folder / "BallRun" / source) for source in SOURCES)
    }
    found = [
        (source, int(np.flatnonzero(np.isclose(starts, row, rtol=3.1e-5, atol=0).all(axis=1))[0]))
        for row in data.observations[data.starts]
        for source, starts in starts_of.items()
        if np.isclose(starts, row, rtol=3.1e-5, atol=0).all(axis=1).any()
    ]
    assert len(found) == data.num_episodes
    assert found == sorted(found, key=lambda f: (SOURCES.index(f[0]), f[1]))
    counts = Counter(source for source, _ in found)
    assert json.loads(attributes["episodes_by_source"]) == counts and len(counts) == 2

    collecting.collect(BALL, SOURCES, RECIPE, folder, tmp_path / "again.hdf5", workers=1)
    assert (tmp_path / "again.hdf5").read_bytes() == out.read_bytes()
    run = folder / "BallRun" / "priced-0"
    for change in ({"prices": (5.0, 50.0)}, {"limit_falls": (0.0, 0.5)}, {"width": 65}):
        with pytest.raises(ValueError, match=f"^{run}: was begun with another recipe"):
            collecting.collect(BALL, SOURCES, replace(RECIPE, **change), folder, out, workers=1)
    fewer = replace(RECIPE, episodes=5, return_bins=1)  # only thinned in another way
    assert collecting.collect(BALL, SOURCES, fewer, folder, out, workers=1).num_episodes == 5


def write_run(folder, slices, first_tag):
    """A finished run by hand: in each slice, episodes of these (cost, terminal); tags count its episodes."""
    folder.mkdir(parents=True)
    tag, total = first_tag, 0
    for index, episodes in enumerate(slices):
        rows = {key: [] for key in KEYS}
        for cost, terminal in episodes:
            steps = max(3, cost) if terminal else ANT.horizon
            for step in range(steps):
                last = step == steps - 1
                rows["observations"].append([tag + step / 10] * 33)
                rows["next_observations"].append([tag + (step + 1) / 10] * 33)
                rows["actions"].append([0.1, -0.1] * 4), rows["rewards"].append(tag / 1000)
                rows["costs"].append(float(step < cost))
                rows["terminals"].append(last and terminal), rows["timeouts"].append(last and not terminal)
            tag, total = tag + 1, total + 1
        arrays = {key: np.array(values) for key, values in rows.items()}
        arrays = {key: v.astype(np.float32) if v.dtype == float else v for key, v in arrays.items()}
        save_file(arrays, folder / f"episodes-{index:03d}.safetensors")
    save_file({"seconds": np.array(10.0)}, folder / f"state-{len(slices):03d}.safetensors")


@pytest.mark.parametrize(
    "sources", [("priced-0", "lagrangian-7", "priced-2"), ("priced-2", "lagrangian-7", "priced-0")]
)
def test_the_episodes_of_a_source_stand_together_in_the_order_of_sources(sources, tmp_path, monkeypatch):
    """Every episode carries a tag: hundreds for the source, and its place in the run."""
    runs = tmp_path / "AntRun"
    write_run(
        runs / "priced-0", [[(0, True), (5, False), (190, False)], [(7, False), (181, True), (3, True)]], 100
    )
    write_run(runs / "lagrangian-7", [[(185, False), (199, False)]], 200)  # all cost more than 150
    write_run(runs / "priced-2", [[(2, False)], [(190, True)], [(1, True), (4, False)]], 300)
    asked = []
    monkeypatch.setattr(collecting, "run_ppo", lambda *arguments: asked.append(arguments))
    made = collecting.collect(ANT, sources, RECIPE, tmp_path, tmp_path / "out.hdf5", workers=1)

    tags = {"priced-0": [100, 101, 103, 105], "lagrangian-7": [], "priced-2": [300, 302, 303]}
    assert made.observations[made.starts, 0].tolist() == [tag for source in sources for tag in tags[source]]
    last = made.observations[made.ends - 1, 0] - (made.episode_lengths - 1) / 10
    assert last == pytest.approx(made.observations[made.starts, 0], abs=0.02)  # rounded
    assert json.loads(made.attributes["episodes_by_source"]) == {s: len(tags[s]) for s in sources}
    assert list(json.loads(made.attributes["episodes_by_source"])) == list(sources)
    assert made.attributes["collected_episodes"] == 12
    costs = {100: 0, 101: 5, 103: 7, 105: 3, 300: 2, 302: 1, 303: 4}
    assert made.episode_costs.tolist() == [costs[tag] for source in sources for tag in tags[source]]
    assert [(kind, seed, run) for _, _, kind, seed, run in asked] == [
        (*source.split("-")[:1], int(source.split("-")[1]), runs / source) for source in sources
    ]


def test_a_source_is_added_to_a_dataset_whose_runs_are_gone(tmp_path, monkeypatch):
    """What is left of the first runs is in their file; the second collection reads that and one more run."""
    runs, first, both = tmp_path / "AntRun", tmp_path / "first.hdf5", tmp_path / "both.hdf5"
    write_run(runs / "priced-0", [[(0, True), (5, False), (190, False)], [(7, False)]], 100)
    write_run(runs / "lagrangian-7", [[(2, False), (199, False)]], 200)
    write_run(runs / "priced-2", [[(4, False)], [(1, True)]], 300)
    monkeypatch.setattr(collecting, "run_ppo", lambda *arguments: None)
    collecting.collect(ANT, ("priced-0", "lagrangian-7"), RECIPE, tmp_path, first, workers=1)
    for name in ("priced-0", "lagrangian-7"):
        for file in (runs / name).iterdir():
            file.unlink()
    made = collecting.collect(ANT, (str(first), "priced-2"), RECIPE, tmp_path, both, workers=1)
    assert made.observations[made.starts, 0].tolist() == [100, 101, 103, 200, 300, 301]
    attributes = made.attributes
    assert json.loads(attributes["episodes_by_source"]) == {"priced-0": 3, "lagrangian-7": 1, "priced-2": 2}
    assert (attributes["collected_episodes"], attributes["collected_steps"]) == (8, 3 * RECIPE.steps)
    digest = hashlib.sha256(first.read_bytes()).hexdigest()
    assert attributes["made_from"] == f"first.hdf5 (SHA-256 {digest}), priced-2"
    before = both.read_bytes()
    collecting.collect(ANT, (str(first), "priced-2"), RECIPE, tmp_path, both, workers=1)
    assert both.read_bytes() == before
    with pytest.raises(ValueError, match="each of them once"):
        collecting.collect(ANT, (str(both), "priced-2"), RECIPE, tmp_path, first, workers=1)
    silent = write_dataset(tmp_path / "silent.hdf5", replace(made, attributes={}), ANT)
    with pytest.raises(DatasetError, match=f"^{silent}: does not say which episodes are from which source"):
        collecting.collect(ANT, (str(silent), "priced-2"), RECIPE, tmp_path, first, workers=1)


@pytest.mark.parametrize(
    "sources, message",
    [
        ((), r"^sources \[\]: give at least one, and each of them once$"),
        (("priced-0", "priced-0"), r"^sources \['priced-0', 'priced-0'\]: .* each of them once$"),
        (("priced",), "^source 'priced': write KIND-SEED, e.g. priced-0; the kinds are priced, lagrangian$"),
        (("x-0",), "^source 'x-0': write KIND-SEED"),
        (("priced-x",), "^source 'priced-x': write KIND-SEED"),
        (("priced-",), "^source 'priced-': write KIND-SEED"),
        (("priced--1",), "^source 'priced--1': write KIND-SEED"),
        (("priced-0", "priced-00"), "^source 'priced-00': write KIND-SEED"),  # the same run again
        (("priced-0", "lagrangian_0"), "^source 'lagrangian_0': write KIND-SEED"),
    ],
)
def test_other_sources_are_refused_in_one_line_before_anything_is_run(
    sources, message, tmp_path, monkeypatch
):
    monkeypatch.setattr(collecting, "run_ppo", lambda *arguments: pytest.fail("it was run"))
    with pytest.raises(ValueError, match=message) as caught:
        collecting.collect(BALL, sources, RECIPE, tmp_path, tmp_path / "out.hdf5", workers=1)
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_a_source_is_a_kind_and_a_seed():
    assert read_source("priced-0") == ("priced", 0) and read_source("lagrangian-12") == ("lagrangian", 12)
    assert [read_source(source)[0] for source in SOURCES] == list(KINDS)


# --- PPO ---


@pytest.mark.parametrize("kind", KINDS)
def test_ppo_and_its_schedule_are_saved_and_loaded_whole(kind, tmp_path):
    (model, schedule), (other, loaded) = (make_ppo(BALL, RECIPE, kind, seed, []) for seed in (0, 7))
    model.learn(BATCH, callback=schedule)
    schedule.multiplier.integral, schedule.multiplier.value = 0.1 + 0.2, 1 / 3
    save_ppo(model, schedule, tmp_path / "state.safetensors", 12.5, {"recipe": "this"})
    assert load_ppo(other, loaded, tmp_path / "state.safetensors") == 12.5
    with safe_open(tmp_path / "state.safetensors", "np") as file:
        assert file.metadata() == {"recipe": "this"}
    width = 9 if kind == "priced" else 7
    observations = np.random.default_rng(0).normal(size=(5, width)).astype(np.float32)
    chosen = [m.predict(observations, deterministic=True)[0] for m in (model, other)]
    np.testing.assert_array_equal(*chosen)
    ours, theirs = (m.policy.optimizer.state_dict()["state"] for m in (model, other))
    assert ours.keys() == theirs.keys() and len(ours) > 5
    for index, moments in ours.items():
        assert moments.keys() == {"step", "exp_avg", "exp_avg_sq"}
        for name, value in moments.items():
            np.testing.assert_array_equal(value, theirs[index][name])
            assert value.shape == theirs[index][name].shape
    np.testing.assert_array_equal(*(m.env.normalize_obs(observations) for m in (model, other)))
    np.testing.assert_array_equal(*(m.env.normalize_reward(np.ones(3)) for m in (model, other)))
    assert (loaded.multiplier.integral, loaded.multiplier.value) == (0.1 + 0.2, 1 / 3)  # exactly
    scales = []
    train = other.train
    other.train = lambda: (scales.append(other.env.get_attr("price_scale")[0]), train())
    other.learn(BATCH, callback=loaded)  # it can go on, at the loaded multiplier
    assert scales == [1 / 3 if kind == "lagrangian" else 0]


def test_the_seed_and_the_kind_seed_the_environments():
    """Runs in progress depend on these numbers."""
    for place, kind in enumerate(("priced", "lagrangian")):
        model, _ = make_ppo(BALL, RECIPE, kind, 3, [])
        ours, expected = model.env.get_attr("rng"), np.random.default_rng([3, place]).spawn(16)
        assert [rng.bit_generator.state for rng in ours] == [rng.bit_generator.state for rng in expected]
        assert model.seed == 3
        model.env.close()


def test_target_kl_stops_the_epochs_early():
    """PPO goes over a batch ten times, here in four parts; a policy that may not move is stopped at once."""

    def steps(target_kl):
        model, schedule = make_ppo(BALL, replace(RECIPE, target_kl=target_kl), "priced", 0, [])
        model.learn(BATCH, callback=schedule)
        return {int(moments["step"]) for moments in model.policy.optimizer.state_dict()["state"].values()}

    assert steps(None) == {10 * math.ceil(BATCH / 512)}
    (stopped,) = steps(1e-9)
    assert stopped <= 2


def test_a_calm_run_ends_with_little_noise(tmp_path):
    """Two slices, calm from the second on; an untrained policy's mean actions are near zero."""
    recipe = replace(RECIPE, calm=(0.5, 0.1), steps=2 * BATCH)
    run_ppo(BALL, recipe, "priced", 0, tmp_path, slice_steps=BATCH)
    slices = [load_file(path)["actions"] for path in sorted(tmp_path.glob("episodes-*"))]
    early, late = (actions.std() for actions in slices)
    assert early == pytest.approx(math.exp(-0.5), abs=0.1) and 0.09 < late < 0.45
    log_std = load_file(tmp_path / "state-002.safetensors")["policy.log_std"]
    assert (log_std < math.log(0.1) + 0.05).all()


def test_every_task_has_a_recipe():
    assert RECIPES.keys() == all_tasks().keys()


def test_the_data_and_the_command_line_start_without_stable_baselines3():
    """It takes seconds to import."""
    code = (
        "import sys, tutorial_lib.data, tutorial_lib.__main__, tutorial_lib.tasks.recipes\n"
        "print([name for name in sys.modules if name.startswith('stable_baselines3')])"
    )
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    child = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert child.stdout == "[]\n", child.stderr


if __name__ == "__main__":
    run_and_die(*sys.argv[1:3], Path(sys.argv[3]))
