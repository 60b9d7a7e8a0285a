"""The eight tasks in the simulator: seeds, costs, ends of episodes, pictures, and gymnasium's own check."""

import functools
import os
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tutorial_lib.tasks import TASKS, make_env
from tutorial_lib.tasks.bullet import BulletTask

ROOT = Path(__file__).parents[1]
BALLS = ("BallRun", "BallCircle")
every_task = pytest.mark.parametrize("name", TASKS)


@functools.cache
def shared_env(name):
    """One environment per task, used by all tests: what a test leaves behind must not matter to the next."""
    return make_env(name)


def play(env, seed, steps=None, actions_seed=0):
    """An episode, or its first steps, with random actions held for five steps each: its rows and its end."""
    rng = np.random.default_rng(actions_seed)
    observation, info = env.reset(seed=seed)
    rows = [[*observation, 0.0, info["cost"], *env.position]]
    terminated = truncated = False
    while not (terminated or truncated) and len(rows) - 1 != steps:
        if len(rows) % 5 == 1:
            action = rng.uniform(-1, 1, env.task.act_dim)
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append([*observation, reward, info["cost"], *env.position])
    return np.array(rows), (terminated, truncated)


@functools.cache
def reference(name):
    """The episode of seed 3, up to 100 steps of it, in an environment that has played nothing before."""
    return play(make_env(name), seed=3, steps=100)[0]


# --- Seeds ---


@every_task
def test_a_seed_names_an_episode_whatever_whole_episode_ran_before_it(name):
    env = shared_env(name)
    play(env, seed=5, actions_seed=5)
    np.testing.assert_array_equal(play(env, seed=3, steps=100)[0], reference(name))


@every_task
def test_a_seed_names_an_episode_also_after_one_that_broke_off(name):
    """Near its start, in motion and in touch with the ground: what the simulator would keep of it is felt."""
    env = shared_env(name)
    for steps in range(1, 13):
        play(env, 3, steps, actions_seed=steps)
        np.testing.assert_array_equal(play(env, seed=3, steps=8)[0], reference(name)[:9])


@every_task
def test_numpys_global_random_state_is_neither_used_nor_touched(name):
    expected = np.random.RandomState(11).random_sample(3)
    np.random.seed(11)
    env = make_env(name)
    np.testing.assert_array_equal(play(env, seed=3, steps=100)[0], reference(name))
    env.reset()
    np.testing.assert_array_equal(np.random.random(3), expected)


def test_a_seed_names_an_episode_in_another_process(tmp_path):
    program = (
        "import sys, numpy as np; from test_envs import TASKS, reference;"
        "np.savez(sys.argv[1], **{name: reference(name) for name in TASKS})"
    )
    path = tmp_path / "episodes.npz"
    folders = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    environment = os.environ | {"PYTHONPATH": folders}
    subprocess.run([sys.executable, "-c", program, path], env=environment, check=True)
    with np.load(path) as theirs:
        for name in TASKS:
            np.testing.assert_array_equal(theirs[name], reference(name), err_msg=name)


def test_environments_side_by_side_do_not_disturb_each_other():
    envs = [shared_env(name) for name in TASKS]
    rngs = [np.random.default_rng(0) for _ in TASKS]
    for env in envs:
        env.reset(seed=3)
    for t in range(1, 13):
        if t % 5 == 1:
            actions = [rng.uniform(-1, 1, env.task.act_dim) for rng, env in zip(rngs, envs, strict=True)]
        for env, action in zip(envs, actions, strict=True):
            observation = env.step(action)[0]
            np.testing.assert_array_equal(observation, reference(env.task.name)[t, : env.task.obs_dim])


@every_task
def test_seeds_differ_and_without_one_the_last_seeds_sequence_goes_on(name):
    env = shared_env(name)
    first = [env.reset(seed=seed)[0] for seed in range(5)]
    assert len({observation.tobytes() for observation in first}) == 5
    continued = [env.reset()[0] for _ in range(3)]
    assert len({observation.tobytes() for observation in [first[4], *continued]}) == 4
    env.reset(seed=4)
    np.testing.assert_array_equal([env.reset()[0] for _ in range(3)], continued)


# --- Costs ---

# Where the observation holds the planar velocity, in what unit, and the robot's speed limit (m/s).
VELOCITY = {
    "Ball": (slice(2, 4), 0.2, 2.5),
    "Car": (slice(2, 4), 1.0, 1.5),
    "Drone": (slice(3, 5), 0.2, 1.5),
    "Ant": (slice(3, 5), 0.3, 1.5),
}


def why_unsafe(name, observation, position):
    """The reasons for a cost, from the observation and the position alone."""
    robot, kind = next((robot, name.removeprefix(robot)) for robot in VELOCITY if name.startswith(robot))
    x, y = position
    if kind == "Circle":
        return {"outside"} if abs(x) > 6 else set()
    part, unit, limit = VELOCITY[robot]
    speed = np.hypot(*(observation[part].astype(float) / unit))
    return ({"outside"} if abs(y) > 2 else set()) | ({"fast"} if speed > limit else set())


def put(env, x, y, vx, vy):
    """Place the robot somewhere in the air, at a given speed: it rarely gets there by chance."""
    agent = env._sim.agent
    agent.set_position((x, y, 1.0))
    env._sim.bc.resetBaseVelocity(agent.body_id, [vx, vy, 0], [0, 0, 0])


PLACES = [(x, y) for x in (0, 5.8, 6.2, -5.8, -6.2) for y in (0, 1.9, 2.1, -1.9, -2.1)]
SPEEDS = [(0, 0), (1.2, 0), (1.2, -1.2), (0, 3.4), (-3, 0), (2.2, 2.2)]


@every_task
def test_the_cost_is_one_outside_the_lines_or_above_the_speed_limit_and_else_zero(name):
    env, reasons = shared_env(name), set()
    for place, speed in [(place, speed) for place in PLACES for speed in SPEEDS]:
        env.reset(seed=0)
        put(env, *place, *speed)
        observation, *_, info = env.step(np.zeros(env.task.act_dim))
        why = why_unsafe(name, observation, env.position)
        assert info == {"cost": 1.0 if why else 0.0} and type(info["cost"]) is float, (place, speed, why)
        reasons.add(frozenset(why))
    assert len(reasons) == (2 if name.endswith("Circle") else 4)  # each reason alone, both, and none


@every_task
def test_the_speed_limit_is_the_robots(name):
    assert shared_env(name).speed_limit == next(
        v[2] for robot, v in VELOCITY.items() if name.startswith(robot)
    )


@every_task
def test_the_cost_keeps_its_meaning_through_an_episode(name):
    obs_dim = TASKS[name].obs_dim
    for row in reference(name)[1:]:
        assert row[obs_dim + 1] == bool(why_unsafe(name, row[:obs_dim].astype(np.float32), row[-2:]))


@pytest.mark.parametrize("name", BALLS)
def test_a_ball_that_is_driven_ahead_becomes_unsafe_at_some_step(name):
    env = shared_env(name)
    observation, info = env.reset(seed=0)
    assert info == {"cost": 0.0} and not why_unsafe(name, observation, env.position)
    costs = []
    for _ in range(60):
        observation, *_, info = env.step([1.0, 0.0])
        costs.append(info["cost"])
        assert info["cost"] == bool(why_unsafe(name, observation, env.position))
    assert costs[0] == 0 and costs[-1] == 1


@every_task
def test_the_position_is_the_one_that_is_observed(name):
    """Every robot observes a tenth of its position first."""
    rows = reference(name)
    np.testing.assert_allclose(rows[:, -2:], 10 * rows[:, :2], atol=1e-5)
    assert np.ptp(rows[:, -2:], axis=0).max() > 0.01


# --- Ends ---


def has_fallen(name, observation):
    """An ant's body below 0.26 m, or a drone upside down: the third entry of its rotated up vector."""
    if name.startswith("Ant"):
        return 10 * observation[2] <= 0.26
    if name.startswith("Drone"):
        x, y = observation[6:8]  # of the quaternion (x, y, z, w)
        return 1 - 2 * (x * x + y * y) < 0
    return False


@every_task
def test_an_episode_ends_at_the_horizon_or_where_the_robot_falls(name):
    task, env, ends = TASKS[name], shared_env(name), []
    for seed in (1, 2):
        rows, (terminated, truncated) = play(env, seed, actions_seed=seed)
        fallen = [bool(has_fallen(name, row)) for row in rows]
        assert not any(fallen[:-1]) and fallen[-1] == terminated
        assert truncated == (not terminated)
        assert len(rows) - 1 == task.horizon or (terminated and len(rows) - 1 < task.horizon)
        assert type(terminated) is bool and type(truncated) is bool
        ends.append(terminated)
    # With random actions drones tip over and ants fall in Circle; in Run, with its smaller steps, they last.
    assert ends == [name in ("DroneCircle", "AntCircle")] * 2


@pytest.mark.parametrize("name", ["DroneRun", "AntRun"])
def test_a_robot_that_falls_at_the_horizon_has_fallen_and_not_run_out_of_time(name):
    env = shared_env(name)
    env.reset(seed=0)
    for step in range(env.task.horizon):
        if step == env.task.horizon - 1:
            env._sim.agent.set_position((0, 0, 1.0 if name == "DroneRun" else 0.25))
            env._sim.agent.set_orientation((1, 0, 0, 0))  # on its back
        _, _, terminated, truncated, _ = env.step(np.zeros(env.task.act_dim))
    assert terminated and not truncated


@every_task
def test_the_simulator_agrees_on_horizon_and_shapes(name):
    task, env = TASKS[name], shared_env(name)
    assert gymnasium.spec(task.env_id).max_episode_steps == task.horizon
    assert env._sim.observation_space.shape == (task.obs_dim,) == env.observation_space.shape
    assert env._sim.action_space.shape == (task.act_dim,) == env.action_space.shape


# --- Actions, pictures, API ---


@every_task
def test_an_action_of_the_wrong_shape_is_an_error_that_says_which_is_right(name):
    env, right = shared_env(name), TASKS[name].act_dim
    env.reset(seed=0)
    for shape in [(), (1,), (right + 1,), (1, right), (right, 1)]:
        with pytest.raises(ValueError, match=rf"{name} takes actions of shape \({right},\)"):
            env.step(np.zeros(shape))


def test_an_action_changes_the_episode():
    for name in TASKS:
        one, other = (play(shared_env(name), 0, steps=5, actions_seed=seed)[0] for seed in (0, 1))
        assert (one[0] == other[0]).all() and (one[2] != other[2]).any()


@every_task
def test_render_shows_the_robot_move(name):
    env = make_env(name, render_mode="rgb_array", image_size=(64, 48))
    play(env, seed=3, steps=1)
    first = env.render()
    assert first.shape == (48, 64, 3) and first.dtype == np.uint8
    assert first.std() > 10
    np.testing.assert_array_equal(env.render(), first)
    if name.endswith("Circle"):
        put(env, 3.0, -6.0, 0, 0)
    else:
        put(env, 0.0, 2.5, 0, 0)  # sideways: the camera runs ahead with the robot
    assert (env.render() != first).any()


def redness(env):
    """The share of the picture that is red: the sphere, and a little of the car."""
    red, green, blue = np.moveaxis(env.render().astype(int), -1, 0)
    return float(np.mean((red > 100) & (green < 60) & (blue < 60)))


@every_task
def test_a_red_sphere_surrounds_the_robot_exactly_while_it_is_unsafe(name):
    env = make_env(name, render_mode="rgb_array", image_size=(160, 120))
    still = np.zeros(env.task.act_dim)
    for _ in range(2):  # an episode that ends unsafe leaves no sphere to the next
        env.reset(seed=0)
        assert redness(env) < 0.002
        env.step(still)
        assert redness(env) < 0.002
        put(env, *((6.5, 0) if name.endswith("Circle") else (0, 2.5)), 0, 0)
        assert env.step(still)[-1]["cost"] == 1
        assert redness(env) > 0.003
    env.step(still)
    put(env, 0, 0, 0, 0)
    assert env.step(still)[-1]["cost"] == 0
    assert redness(env) < 0.002


@every_task
def test_the_pixel_is_where_the_picture_changes_when_the_robot_vanishes(name):
    env = make_env(name, render_mode="rgb_array", image_size=(320, 240))
    env.reset(seed=1)
    with_robot, (column, row) = env.render().astype(int), env.pixel
    env._sim.agent.set_position((0, 0, -50))  # below the floor
    rows, columns = np.nonzero(np.abs(env.render() - with_robot).sum(-1) > 30)
    assert len(rows) > 5
    assert abs(columns.mean() - column) < 5 and abs(rows.mean() - row) < 5


def test_rendering_does_not_disturb_the_episode():
    env = make_env("BallCircle", render_mode="rgb_array", image_size=(16, 12))
    step, env.step = env.step, lambda action: (env.render(), step(action))[1]
    np.testing.assert_array_equal(play(env, seed=3, steps=20)[0], reference("BallCircle")[:21])


def test_pictures_are_320_by_240_and_only_on_request():
    env = make_env("BallRun", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (240, 320, 3)
    assert shared_env("BallRun").render() is None
    with pytest.raises(ValueError, match="'human'"):
        make_env("BallRun", render_mode="human")


def test_an_unknown_task_is_an_error():
    with pytest.raises(ValueError, match="did you mean BallCircle"):
        make_env("BalCircle")


@every_task
def test_gymnasiums_check_passes_without_a_warning(name):
    """Through a registered name: without one, the check leaves out determinism, render modes and closing.
    The last two build the environment anew, and are the same code for every task.
    """
    few = {"skip_render_check": name not in BALLS, "skip_close_check": name not in BALLS}
    env_id = f"Checked{name}-v0"
    gymnasium.register(env_id, entry_point=BulletTask, kwargs={"task": name, "image_size": (16, 12)})
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(gymnasium.make(env_id, disable_env_checker=True).unwrapped, **few)
    finally:
        del gymnasium.registry[env_id]
