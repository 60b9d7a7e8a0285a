"""What every task of the registry promises, whoever simulates it: its record, its environment, its scene."""

import dataclasses
import functools
import os
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import matplotlib
import numpy as np
import pytest
from episodes import Episode, assert_same, needs_simulator, play, reference, shared_env
from gymnasium.utils.env_checker import check_env
from matplotlib.figure import Figure

from tutorial_lib.tasks import SIMULATORS, all_tasks, get_task, make_env, scene_of

ROOT = Path(__file__).parents[2]
TASKS = all_tasks()
FIRST_OF_FAMILY = [next(t for t in TASKS.values() if t.family == family) for family in SIMULATORS]
every_record = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


def played(tasks):
    return pytest.mark.parametrize(
        "task", [pytest.param(task, id=task.name, marks=needs_simulator(task)) for task in tasks]
    )


every_task = played(TASKS.values())
first_of_every_family = played(FIRST_OF_FAMILY)


@pytest.fixture(autouse=True)
def without_a_screen():
    matplotlib.use("Agg")


@functools.cache
def other(name) -> Episode:
    """A second whole episode, in the shared environment. One action throughout takes most robots outside."""
    return play(shared_env(name), seed=5, actions_seed=3, hold=TASKS[name].horizon)


def rise(values) -> bool:
    return all(low < high for low, high in zip(values, values[1:], strict=False))


# --- The record ---


@every_record
def test_a_task_is_found_by_its_name_and_by_its_environments(task):
    assert TASKS[task.name] is get_task(task.name) is get_task(task.env_id) is task
    assert task.name.startswith(task.robot) and task.family in SIMULATORS
    assert sum(other.env_id == task.env_id for other in TASKS.values()) == 1


@every_record
def test_the_limits_rise_and_each_has_a_name(task):
    assert task.thresholds and task.thresholds[0] > 0 and rise(task.thresholds)
    assert len(set(task.limit_names)) == len(task.limit_names) == len(task.thresholds)
    assert list(task.cost_limit_names.items()) == list(zip(task.thresholds, task.limit_names, strict=True))
    assert task.typical_limit in task.thresholds
    with pytest.raises(ValueError, match=f"{task.name} .*one name for each"):
        dataclasses.replace(task, limit_names=(*task.limit_names, "more"))


@every_record
def test_the_constants_are_in_order(task):
    assert task.gammas and rise((0.0, *task.gammas, 1.0))
    assert task.min_return < task.max_return
    assert task.max_step_cost > 0
    assert max(task.thresholds) <= task.cost_range <= task.horizon * task.max_step_cost


@every_record
def test_records_compare_by_value(task):
    copy = dataclasses.replace(task)
    assert copy == task and hash(copy) == hash(task)
    assert dataclasses.replace(task, horizon=task.horizon + 1) != task
    with pytest.raises(dataclasses.FrozenInstanceError):
        task.horizon = 1


# --- The environment ---


@every_task
def test_spaces_observations_and_steps_have_the_recorded_sizes_and_types(task):
    env = shared_env(task.name)
    for space, size in ((env.observation_space, task.obs_dim), (env.action_space, task.act_dim)):
        assert isinstance(space, gymnasium.spaces.Box)
        assert space.shape == (size,) and space.dtype == np.float32
    assert env.action_space.low.tolist() == [-1] * task.act_dim
    assert env.action_space.high.tolist() == [1] * task.act_dim
    observation, _ = env.reset(seed=0)
    assert observation.dtype == np.float32 and env.observation_space.contains(observation)
    for action in np.random.default_rng(0).uniform(-1, 1, (5, task.act_dim)):
        observation, reward, terminated, truncated, info = env.step(action)
        assert observation.dtype == np.float32 and env.observation_space.contains(observation)
        assert [type(x) for x in (reward, info["cost"], terminated, truncated)] == [float, float, bool, bool]


@every_task
def test_every_step_costs_between_zero_and_the_recorded_maximum(task):
    for episode in (reference(task.name), other(task.name)):
        assert np.isfinite(episode.observations).all() and np.isfinite(episode.rewards).all()
        assert episode.costs.min() >= 0 and episode.costs.max() <= task.max_step_cost


@first_of_every_family
def test_the_recorded_maximum_is_paid_for_some_step(task):
    assert max(reference(task.name).costs.max(), other(task.name).costs.max()) == task.max_step_cost


@every_task
def test_an_episode_terminates_or_is_truncated_at_the_horizon_and_never_both(task):
    for episode in (reference(task.name), other(task.name)):
        assert not episode.terminated[:-1].any() and not episode.truncated[:-1].any()
        assert episode.terminated[-1] != episode.truncated[-1]
        assert len(episode) == task.horizon if episode.truncated[-1] else len(episode) <= task.horizon


@every_task
def test_a_robot_that_cannot_fall_never_terminates(task):
    ends = [episode.terminated[-1] for episode in (reference(task.name), other(task.name))]
    assert task.terminates or not any(ends)


@every_task
def test_a_seed_repeats_an_episode_whatever_was_played_before(task):
    """A whole episode, and episodes that broke off near their start, in motion and touching the ground."""
    env = shared_env(task.name)
    other(task.name)
    assert_same(play(env, seed=3), reference(task.name))
    for steps in range(1, 13):
        play(env, 3, steps, actions_seed=steps)
        assert_same(play(env, seed=3, steps=8), reference(task.name).first(8))


@first_of_every_family
def test_a_seed_repeats_an_episode_in_another_process(task, tmp_path):
    path = tmp_path / "episode.npz"
    program = "import sys, numpy as np, episodes; np.savez(sys.argv[1], *episodes.reference(sys.argv[2]))"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests")))}
    subprocess.run([sys.executable, "-c", program, path, task.name], env=environment, check=True)
    with np.load(path) as theirs:
        assert_same(Episode(*theirs.values()), reference(task.name))


@every_task
def test_seeds_differ_and_without_one_the_last_seeds_sequence_goes_on(task):
    env = shared_env(task.name)
    first = [env.reset(seed=seed)[0] for seed in range(5)]
    assert len({observation.tobytes() for observation in first}) == 5
    continued = [env.reset()[0] for _ in range(3)]
    assert len({observation.tobytes() for observation in [first[4], *continued]}) == 4
    env.reset(seed=4)
    np.testing.assert_array_equal([env.reset()[0] for _ in range(3)], continued)


@every_task
def test_numpys_global_random_state_is_neither_used_nor_touched(task):
    expected = np.random.RandomState(11).random_sample(3)
    np.random.seed(11)
    env = make_env(task)
    assert_same(play(env, seed=3, steps=20), reference(task.name).first(20))
    env.reset()
    np.testing.assert_array_equal(np.random.random(3), expected)


@every_task
def test_an_action_changes_the_episode(task):
    one, two = (play(shared_env(task.name), 0, steps=5, actions_seed=seed) for seed in (0, 1))
    assert (one.observations[0] == two.observations[0]).all()
    assert (one.observations[2] != two.observations[2]).any()


@every_task
def test_an_action_of_the_wrong_shape_is_an_error_that_says_which_is_right(task):
    env, right = shared_env(task.name), task.act_dim
    env.reset(seed=0)
    for shape in [(), (right - 1,), (right + 1,), (1, right), (right, 1)]:
        with pytest.raises(ValueError, match=rf"{task.name} takes actions of shape \({right},\)"):
            env.step(np.zeros(shape))


@every_task
def test_gymnasiums_check_passes_without_a_warning(task):
    """Through a registered name: without one, the check leaves out determinism, render modes and closing.
    The last two build the environment anew, and are the same code for every task of a family.
    """
    few = dict.fromkeys(("skip_render_check", "skip_close_check"), task not in FIRST_OF_FAMILY)
    env_id, options = f"Checked{task.name}-v0", {"task": task, "image_size": (16, 12)}
    gymnasium.register(env_id, entry_point=make_env, kwargs=options)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(gymnasium.make(env_id, disable_env_checker=True).unwrapped, **few)
    finally:
        del gymnasium.registry[env_id]


# --- Pictures ---


@every_task
def test_pictures_need_no_display_and_show_the_robot_move(task, monkeypatch):
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    env = make_env(task, render_mode="rgb_array", image_size=(160, 120))
    env.reset(seed=3)
    first = env.render()
    assert first.shape == (120, 160, 3) and first.dtype == np.uint8
    assert first.std() > 10  # not one colour
    np.testing.assert_array_equal(env.render(), first)
    for _ in range(40):
        env.step(np.ones(task.act_dim))
    assert (env.render() != first).any()
    env.close()


@every_task
def test_pictures_are_drawn_only_on_request_and_only_as_arrays(task):
    shared_env(task.name).reset(seed=0)
    assert shared_env(task.name).render() is None
    with pytest.raises(ValueError, match="'human'"):
        make_env(task, render_mode="human")


# --- The scene ---

every_scene = played([task for task in TASKS.values() if task.scene is not None])


@every_task
def test_an_environment_has_a_position_exactly_where_the_task_has_a_scene(task):
    assert hasattr(shared_env(task.name), "position") == (task.scene is not None)
    flat = dataclasses.replace(task, scene=None)
    assert not hasattr(make_env(flat), "position")
    with pytest.raises(ValueError, match=f"{task.name} has no scene"):
        scene_of(flat)


@every_scene
def test_positions_are_the_environments_and_the_observations(task):
    episode = reference(task.name)
    seen = task.scene.positions(episode.observations)
    assert seen.shape == episode.positions.shape == (len(episode) + 1, 2)
    np.testing.assert_allclose(seen, episode.positions, atol=1e-5)
    np.testing.assert_array_equal(task.scene.positions(episode.observations[7]), seen[7])
    assert np.ptp(episode.positions, axis=0).max() > 0.01  # it moved


@every_scene
def test_every_unsafe_step_has_one_reason_and_outside_is_unsafe(task):
    for episode in (reference(task.name), other(task.name)):
        positions, unsafe = episode.positions[1:], episode.costs[1:] > 0
        reasons = task.scene.reasons(positions)
        assert (sum(where.astype(int) for where in reasons.values())[unsafe] == 1).all()
        assert unsafe[task.scene.is_outside(positions)].all()


@every_scene
def test_a_scene_shades_where_a_position_is_unsafe_and_shows_the_whole_way(task):
    way = reference(task.name).positions
    for farthest in (0.1, 30):  # metres: the walls are shown around a short way, too
        path = way * farthest / np.abs(way).max()
        ax = Figure().subplots()
        task.scene.draw(ax, path)
        ax.plot(*path.T)
        for values, limits in zip(path.T, (ax.get_xlim(), ax.get_ylim()), strict=True):
            assert limits[0] <= values.min() and values.max() <= limits[1]
        x, y = (np.linspace(*limits, 24)[1:-1] for limits in (ax.get_xlim(), ax.get_ylim()))
        points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        pixels = ax.transData.transform(points)
        shaded = [any(patch.contains_point(pixel) for patch in ax.patches) for pixel in pixels]
        assert 0 < sum(shaded) < len(points)
        np.testing.assert_array_equal(shaded, task.scene.is_outside(points))


@every_scene
def test_a_scenes_walls_stand_where_the_cost_zone_begins(task):
    ax = Figure().subplots()
    ax.set(xlim=(-20, 20), ylim=(-20, 20))
    task.scene.draw_walls(ax)
    assert ax.lines
    for wall in ax.lines:
        in_pixels = wall.get_transform().transform(wall.get_xydata()).mean(0)
        middle = ax.transData.inverted().transform(in_pixels)  # one coordinate is zero, the other the wall's
        assert task.scene.is_outside(np.array([0.999 * middle, 1.001 * middle])).tolist() == [False, True]


@every_scene
def test_a_layout_has_a_place_for_each_panel(task):
    for count in (1, 3):
        (rows, columns), (width, height) = task.scene.layout(count)
        assert rows * columns == count and width > 0 and height > 0
