"""The simulator's tasks against hand-written rules: costs, falls, pictures, and no trace of other episodes.

What every task promises, whoever simulates it, is tested in tests/contract/test_task_contract.py.
"""

import gymnasium
import numpy as np
import pytest
from episodes import assert_same, play, reference, shared_env

from tutorial_lib.tasks import TASKS, make_env

NAMES = [task.name for task in TASKS.values() if task.family == "bullet"]
CIRCLE_NAMES = [name for name in NAMES if TASKS[name].scene.name == "Circle"]
every_task = pytest.mark.parametrize("name", NAMES)


# --- Many simulators in one process ---


def test_environments_side_by_side_do_not_disturb_each_other():
    envs = [shared_env(name) for name in NAMES]
    rngs = [np.random.default_rng(0) for _ in NAMES]
    for env in envs:
        env.reset(seed=3)
    for t in range(1, 13):
        if t % 5 == 1:
            actions = [rng.uniform(-1, 1, env.task.act_dim) for rng, env in zip(rngs, envs, strict=True)]
        for env, action in zip(envs, actions, strict=True):
            observation = env.step(action)[0]
            np.testing.assert_array_equal(observation, reference(env.task.name).observations[t])


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
    x, y = position
    if name in CIRCLE_NAMES:
        return {"outside"} if abs(x) > 6 else set()
    part, unit, limit = VELOCITY[TASKS[name].robot]
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
        assert env.task.scene.is_outside(env.position) == ("outside" in why)
        reasons.add(frozenset(why))
    assert len(reasons) == (2 if name in CIRCLE_NAMES else 4)  # each reason alone, both, and none


@every_task
def test_the_speed_limit_is_the_robots(name):
    assert shared_env(name).speed_limit == VELOCITY[TASKS[name].robot][2]


@every_task
def test_the_cost_keeps_its_meaning_through_an_episode(name):
    episode = reference(name)
    for t in range(1, len(episode) + 1):
        why = why_unsafe(name, episode.observations[t], episode.positions[t])
        assert episode.costs[t] == bool(why)


@pytest.mark.parametrize("name", ["BallRun", "BallCircle"])
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


# --- Ends ---


def has_fallen(name, observation):
    """An ant's body below 0.26 m, or a drone upside down: the third entry of its rotated up vector."""
    if TASKS[name].robot == "Ant":
        return 10 * observation[2] <= 0.26
    if TASKS[name].robot == "Drone":
        x, y = observation[6:8]  # of the quaternion (x, y, z, w)
        return 1 - 2 * (x * x + y * y) < 0
    return False


@every_task
def test_an_episode_terminates_where_the_robot_falls(name):
    ends = []
    for seed in (1, 2):
        episode = play(shared_env(name), seed, actions_seed=seed)
        fallen = [has_fallen(name, observation) for observation in episode.observations]
        assert not any(fallen[:-1]) and fallen[-1] == episode.terminated[-1]
        ends.append(episode.terminated[-1])
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
    assert env._sim.observation_space.shape == (task.obs_dim,)
    assert env._sim.action_space.shape == (task.act_dim,)


# --- Pictures ---


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
        put(env, *((6.5, 0) if name in CIRCLE_NAMES else (0, 2.5)), 0, 0)
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
    assert_same(play(env, seed=3, steps=20), reference("BallCircle").first(20))


def test_pictures_are_320_by_240_unless_another_size_is_asked_for():
    env = make_env("BallRun", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (240, 320, 3)
