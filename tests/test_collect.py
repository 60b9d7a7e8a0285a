"""Collection: the thinning by brute force, the priced reward by hand, a run killed and resumed.

Run as a script, this file is the process that gets killed.
"""

import functools
import math
import os
import signal
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from safetensors.numpy import load_file

from tutorial_lib.data import collect as collecting
from tutorial_lib.data.collect import RECIPES, PricedCost, Recipe, along_own_axes, run_ppo, thin
from tutorial_lib.data.hdf5 import read_dataset
from tutorial_lib.tasks import TASKS

ROOT = Path(__file__).parents[1]
BALL = TASKS["BallRun"]  # T = 100
SLICE = 2048  # an episode of 100 steps in each of the 16 environments, and a piece of the next
RECIPE = Recipe(episodes=20, steps=2 * SLICE, batch_steps=SLICE)


# --- Thinning ---


def plane(seed, count=3_000):
    """Episodes crowded at low cost, as training leaves them, some of them out of bounds."""
    rng = np.random.default_rng(seed)
    costs = np.minimum(rng.exponential(25, count), 100).round()
    return costs, rng.normal(500, 250, count) + 4 * costs


def cells(costs, returns, kept, max_cost, low, high):
    """How many of some episodes lie in each (column, row) of the grid, counted one by one."""
    counts = Counter()
    for i in kept:
        column = min(int(costs[i] / max_cost * 20), 19)
        row = min(int((returns[i] - low) / (high - low) * 20), 19)
        counts[column, row] += 1
    return counts


@pytest.mark.parametrize("n", [1, 50, 500, 1_000, 100_000])
@pytest.mark.parametrize("seed", range(3))
def test_thinning_is_even_over_cost_and_within_a_cost_over_return(seed, n):
    costs, returns = plane(seed)
    kept = thin(costs, returns, n, max_cost=80, max_return=1_000)
    assert len(set(kept)) == len(kept) and list(kept) == sorted(kept)
    allowed = [i for i in range(len(costs)) if costs[i] <= 80 and returns[i] <= 1_000]
    assert set(kept) <= set(allowed) and len(allowed) < len(costs)

    low, high = min(returns[allowed]), max(returns[allowed])
    there = cells(costs, returns, allowed, 80, low, high)
    taken = cells(costs, returns, kept, 80, low, high)
    columns = Counter()
    for (column, _), count in there.items():
        columns[column] += count
    for k in range(1, len(costs)):  # the smallest number per column that gives n in all
        if sum(min(k, count) for count in columns.values()) >= min(n, len(allowed)):
            break
    for column, count in columns.items():
        rows = [row for c, row in there if c == column]
        assert sum(taken[column, row] for row in rows) == min(k, count)
        most = max(taken[column, row] for row in rows)
        for row in rows:  # a cell gives less than another only where it has no more, or at the last turn
            assert taken[column, row] in (there[column, row], most, most - 1)
    assert min(n, len(allowed)) <= len(kept) < min(n, len(allowed)) + len(columns)


@pytest.mark.parametrize("seed", range(3))
def test_thinning_keeps_the_cheapest_episode_of_the_frontier_in_every_cell_it_takes_from(seed):
    rng = np.random.default_rng(seed)
    costs = rng.integers(0, 81, 600)
    returns = 5 * costs + rng.uniform(0, 100, 600)  # what is spent earns, so nearly every cost has its best
    kept = set(thin(costs, returns, 200, max_cost=80, max_return=1_000).tolist())
    everyone, low, high = range(600), returns.min(), returns.max()
    frontier = [
        i for i in everyone if not any(costs[j] <= costs[i] and returns[j] > returns[i] for j in everyone)
    ]

    def cell(i):
        return min(int(costs[i] / 4), 19), min(int((returns[i] - low) / (high - low) * 20), 19)

    first = {}
    for i in sorted(frontier, key=lambda i: costs[i]):
        first.setdefault(cell(i), i)
    taken = {cell(i) for i in kept}
    assert sum(place in taken for place in first) > 20
    assert all(i in kept for place, i in first.items() if place in taken)


def test_thinning_draws_at_random_within_a_cell_and_alike_every_time():
    costs, returns = np.zeros(1_000), np.full(1_000, 7.0)  # all in one cell
    kept = thin(costs, returns, 100, 80, 1_000, seed=1)
    assert len(kept) == 100 and 300 < kept.mean() < 700
    assert kept.tolist() == thin(costs, returns, 100, 80, 1_000, seed=1).tolist()
    assert kept.tolist() != thin(costs, returns, 100, 80, 1_000, seed=2).tolist()


def test_to_keep_no_episode_is_refused():
    with pytest.raises(ValueError, match="at least one episode, not 0"):
        thin(np.zeros(5), np.zeros(5), 0, 10, 10)


def test_the_bounds_themselves_are_within():
    assert thin(np.array([80.0, 80.5, 10.0]), np.array([5.0, 5.0, 1_000.0]), 9, 80, 1_000).tolist() == [0, 2]


# --- The priced reward ---


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


def priced(costs, recipe, seed=0, price_scale=1.0):
    env = PricedCost(BALL, recipe, np.random.default_rng(seed), episodes := [])
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
    env, episodes = priced([1, 0, 1, 1, 0, 1], two_free, price_scale=0.6)
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
    env, _ = priced([1.0], recipe)
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
    env, _ = priced([1, 1], Recipe(episodes=1, allowance_share=0.0), price_scale=0.0)
    assert rewards_of(env)[1] == pytest.approx([200 / 1327.4456] * 2)


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
        assert seen[9:12] == pytest.approx([0, 0, 1], abs=0.01)  # the sky is above
        assert seen[12:15] == pytest.approx([0, distance / 10, 0], abs=0.01)  # the centre is opposite
        assert seen.shape == (34 + 2 + 2,) and env.observation.shape == (34,)  # which is what is recorded
    env.close()


# --- Killed and resumed ---


def run_and_die(when, folder):
    """What the killed process does: the first slice, and less than the second."""
    save, steps = collecting._save, []

    def killed_before_the_episodes(arrays, path, *rest):
        if path.name == "episodes-001.safetensors":
            os.kill(os.getpid(), signal.SIGKILL)
        save(arrays, path, *rest)

    def killed_in_the_middle(self, action, step=PricedCost.step):
        steps.append(1)
        if len(steps) == SLICE + SLICE // 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(self, action)

    if when == "between the two files":
        collecting._save = killed_before_the_episodes
    else:
        PricedCost.step = killed_in_the_middle
    run_ppo(BALL, RECIPE, 0, folder / "BallRun" / "seed-0", slice_steps=SLICE)


@pytest.mark.parametrize("when", ["between the two files", "in the middle"])
def test_a_killed_collection_goes_on_and_makes_a_dataset(when, tmp_path, monkeypatch):
    command, env = [sys.executable, __file__, when, tmp_path], os.environ | {"PYTHONPATH": str(ROOT)}
    child = subprocess.run(command, env=env, capture_output=True, text=True)
    assert child.returncode == -signal.SIGKILL, child.stderr
    run, out = tmp_path / "BallRun" / "seed-0", tmp_path / "data.hdf5"
    assert [path.name for path in sorted(run.glob("episodes-*"))] == ["episodes-000.safetensors"]
    first = (run / "episodes-000.safetensors").read_bytes()

    monkeypatch.setattr(collecting, "run_ppo", functools.partial(run_ppo, slice_steps=SLICE))
    made = collecting.collect(BALL, (0,), RECIPE, tmp_path, out, workers=1)
    assert (run / "episodes-000.safetensors").read_bytes() == first
    assert {p.suffix for p in run.iterdir()} == {".safetensors"}  # nothing half-written, and no pickle
    slices = [load_file(path)["observations"] for path in sorted(run.glob("episodes-*"))]
    assert [len(rows) for rows in slices] == [1_600, 1_600]
    starts = np.concatenate([rows[::100] for rows in slices])
    assert len(np.unique(starts, axis=0)) == 32  # the second slice is no repetition of the first

    data = read_dataset(out, BALL)
    attributes = data.attributes
    assert (attributes["task"], attributes["seeds"]) == ("BallRun", "[0]")
    assert attributes["collected_episodes"] == 32
    assert attributes["recipe"] == str(vars(RECIPE)) and attributes["made_by"] == "c2iql collect BallRun"
    assert attributes["wall_seconds"] >= 0 and "CC BY" in attributes["licence"]
    for package in ("stable-baselines3", "pybullet", "bullet-safety-gym", "torch"):
        assert f"{package} " in attributes["versions"]

    assert 20 <= data.num_episodes == made.num_episodes <= 32
    assert (data.episode_lengths == 100).all() and data.timeouts.sum() == data.num_episodes
    assert np.isin(data.costs, (0, 1)).all() and np.abs(data.actions).max() <= 1
    follows = np.flatnonzero(~data.timeouts)
    np.testing.assert_array_equal(data.next_observations[follows], data.observations[follows + 1])
    assert data.rewards.std() > 0.1 and len(np.unique(data.episode_returns)) == data.num_episodes

    monkeypatch.setattr(collecting, "_make_ppo", None)  # all is there: nothing is run again
    collecting.collect(BALL, (0,), RECIPE, tmp_path, tmp_path / "again.hdf5", workers=1)
    assert (tmp_path / "again.hdf5").read_bytes() == out.read_bytes()
    with pytest.raises(ValueError, match=f"{run}: was begun with another recipe"):
        collecting.collect(BALL, (0,), replace(RECIPE, prices=(5.0, 50.0)), tmp_path, out, workers=1)


def test_prices_rise_and_the_learning_rate_falls_along_a_run(tmp_path, monkeypatch):
    scales, rates, make = [], [], collecting._make_ppo

    def noting(*arguments):
        model = make(*arguments)
        train = model.train

        def noted():
            train()
            scales.append(model.env.get_attr("price_scale")[0])
            rates.append(model.policy.optimizer.param_groups[0]["lr"])

        model.train = noted
        return model

    monkeypatch.setattr(collecting, "_make_ppo", noting)
    recipe = replace(RECIPE, ramp=(0.25, 0.75), learning_rate=(1e-3, 2e-4), steps=4 * SLICE)
    run_ppo(BALL, recipe, 0, tmp_path, slice_steps=SLICE)
    assert scales == pytest.approx([0, 0, 0.5, 1]) and rates == pytest.approx([1e-3, 8e-4, 6e-4, 4e-4])


def test_ppo_is_saved_and_loaded_whole(tmp_path):
    def make(seed):
        return collecting._make_ppo(BALL, RECIPE, seed, [], {"progress": 0.0})

    model, other = make(0), make(7)
    model.learn(SLICE)
    collecting._save_ppo(model, tmp_path / "state.safetensors", 12.5, {})
    collecting._load_ppo(other, tmp_path / "state.safetensors")
    observations = np.random.default_rng(0).normal(size=(5, 9)).astype(np.float32)
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
    assert other.num_timesteps == model.num_timesteps == SLICE
    other.learn(SLICE, reset_num_timesteps=False)  # it can go on
    collecting._save_ppo(other, tmp_path / "state.safetensors", 2.5, {})
    again = load_file(tmp_path / "state.safetensors")
    assert (again["seconds"], again["steps"]) == (15.0, 2 * SLICE)


def test_target_kl_stops_the_epochs_early():
    """PPO goes over a batch ten times, here in four parts; a policy that may not move is stopped at once."""

    def steps(target_kl):
        model = collecting._make_ppo(BALL, replace(RECIPE, target_kl=target_kl), 0, [], {"progress": 0.0})
        model.learn(SLICE)
        return {int(moments["step"]) for moments in model.policy.optimizer.state_dict()["state"].values()}

    assert steps(None) == {10 * SLICE // 512}
    (stopped,) = steps(1e-9)
    assert stopped <= 2


def test_a_calm_run_ends_with_little_noise(tmp_path):
    """Two slices, calm from the second on; an untrained policy's mean actions are near zero."""
    run_ppo(BALL, replace(RECIPE, calm=(0.5, 0.1)), 0, tmp_path, slice_steps=SLICE)
    slices = [load_file(path)["actions"] for path in sorted(tmp_path.glob("episodes-*"))]
    early, late = (actions.std() for actions in slices)
    assert early == pytest.approx(math.exp(-0.5), abs=0.1) and 0.09 < late < 0.45
    log_std = load_file(tmp_path / "state.safetensors")["policy.log_std"]
    assert (log_std < math.log(0.1) + 0.05).all()


def test_every_task_has_a_recipe():
    assert RECIPES.keys() == TASKS.keys()


if __name__ == "__main__":
    run_and_die(sys.argv[1], Path(sys.argv[2]))
