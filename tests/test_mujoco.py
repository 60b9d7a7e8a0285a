"""The tasks of the extra `mujoco` against hand-written rules, and what is said where it is not installed.

What every task promises, whoever simulates it, is tested in tests/contract/test_task_contract.py.
"""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from episodes import assert_same, needs_simulator, play, reference, shared_env
from tiny import make_config

from tutorial_lib.agents import get_algorithm
from tutorial_lib.checkpoints import save_agent
from tutorial_lib.data import DatasetError, load_dataset
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.hdf5 import write_dataset
from tutorial_lib.tasks import MUJOCO_TASKS, make_env

ROOT = Path(__file__).parents[1]
POINTS = [name for name in MUJOCO_TASKS if name.startswith("Point")]
SPEED_LIMITS = {"HalfCheetahVelocity": 3.2096, "HopperVelocity": 0.7402, "AntVelocity": 2.6222}  # m/s


def each(names):
    return pytest.mark.parametrize(
        "name", [pytest.param(name, marks=needs_simulator(MUJOCO_TASKS[name])) for name in names]
    )


every_task = each(MUJOCO_TASKS)


# --- Where the simulator is not installed ---


def run_without(module, *arguments, folder=ROOT):
    """Types a command in a process in which a module cannot be imported."""
    program = (
        f"import sys; sys.modules[{module!r}] = None; sys.argv = ['c2iql', *{list(arguments)}]\n"
        "from tutorial_lib.__main__ import main; main()"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.mark.parametrize("module", ["safety_gymnasium", "mujoco"])
def test_the_tasks_are_listed_with_the_command_that_installs_them(module):
    done = run_without(module, "tasks")
    rows = {line.split()[0]: line for line in done.stdout.splitlines()[1:]}
    assert (done.returncode, done.stderr, len(rows)) == (0, "", 15)
    for name, row in rows.items():
        remedy = "not installed: run `make mujoco`" if name in MUJOCO_TASKS else " installed"
        assert row.endswith(f" {remedy}"), row


def test_collecting_is_one_line_that_says_what_to_do_and_leaves_nothing(tmp_path):
    done = run_without("safety_gymnasium", "collect", "PointGoal1", folder=tmp_path)
    assert done.returncode == 2 and done.stdout == "" and not list(tmp_path.iterdir())
    assert done.stderr == (
        "c2iql: PointGoal1 is simulated by safety-gymnasium, and module 'safety_gymnasium' is not installed: "
        "run `make mujoco`\n"
    )


def test_evaluating_is_one_line_that_says_what_to_do(tmp_path):
    agent = get_algorithm("BC-All")(MUJOCO_TASKS["HopperVelocity"], make_config("BC-All"), seeds=(0,))
    save_agent(agent, tmp_path / "agent.safetensors")
    done = run_without("mujoco", "evaluate", str(tmp_path / "agent.safetensors"), "--workers", "1")
    assert done.returncode == 2 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1 and done.stderr.endswith(
        "is not installed: run `make mujoco`\n"
    )


def test_the_other_tasks_do_not_notice():
    program = (
        "import sys; sys.modules['safety_gymnasium'] = sys.modules['mujoco'] = None\n"
        "import tutorial_lib.course.figures as figures\n"
        "from tutorial_lib.tasks import make_env\n"
        "make_env('BallRun').reset(seed=0); figures.all_tasks(size=(16, 12)); print('fine')"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.stdout == "fine\n", done.stderr


@pytest.mark.parametrize("task", MUJOCO_TASKS.values(), ids=MUJOCO_TASKS)
def test_dsrls_file_is_read_by_its_name_without_the_simulator(task, tmp_path, monkeypatch):
    n, rng = task.horizon, np.random.default_rng(0)
    draw = lambda *shape: rng.uniform(-1, 1, shape).astype(np.float32)  # noqa: E731
    seen = draw(n + 1, task.obs_dim)
    dataset = Dataset(
        observations=seen[:-1], next_observations=seen[1:], actions=draw(n, task.act_dim), rewards=draw(n),
        costs=np.float32(draw(n) > 0.9),
        terminals=np.zeros(n, bool), timeouts=np.arange(n) == n - 1,
    )  # fmt: skip
    monkeypatch.setenv("DSRL_DATASET_DIR", str(tmp_path))
    with pytest.raises(DatasetError, match=f"{task.dsrl_file}: no such file: `c2iql fetch {task.name}`"):
        load_dataset(task.name, "dsrl")
    path = write_dataset(tmp_path / task.dsrl_file, dataset, task)
    assert len(load_dataset(task.name, "dsrl")) == n
    with pytest.raises(DatasetError, match=f"{task.name}, not Twin"):
        load_dataset(dataclasses.replace(task, name="Twin"), path)


# --- Seeds ---


def layout(env):
    """Where everything stands, (n, 3) in metres."""
    return env._sim.data.xpos.copy() if hasattr(env._sim, "data") else env._sim.task.data.xpos.copy()


@every_task
def test_a_seed_repeats_the_layout_and_the_episode_in_another_process(name, tmp_path):
    path = tmp_path / "episode.npz"
    program = (
        "import sys, numpy as np, episodes, test_mujoco\n"
        "env = episodes.make_env(sys.argv[2]); env.reset(seed=8); env.reset(seed=3)\n"
        "places = test_mujoco.layout(env)\n"
        "np.savez(sys.argv[1], places, *episodes.play(env, seed=3, steps=60))"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests")))}
    subprocess.run([sys.executable, "-c", program, path, name], env=environment, check=True)
    env = shared_env(name)
    env.reset(seed=3)
    with np.load(path) as theirs:
        places, *episode = theirs.values()
    np.testing.assert_array_equal(layout(env), places)
    assert_same(type(reference(name))(*episode), reference(name).first(60))


@each(POINTS)
def test_another_seed_is_another_layout(name):
    env = shared_env(name)
    places = []
    for seed in (0, 1):
        env.reset(seed=seed)
        places.append(layout(env))
    assert np.abs(places[0] - places[1])[:, :2].max() > 0.1


@every_task
def test_environments_side_by_side_do_not_disturb_each_other(name):
    env, beside, rng = shared_env(name), make_env(name), np.random.default_rng(0)
    np.testing.assert_array_equal(env.reset(seed=3)[0], reference(name).observations[0])
    for t in range(1, min(41, len(reference(name)))):
        if t % 5 == 1:
            action = rng.uniform(-1, 1, env.task.act_dim)
            beside.reset(seed=t)
        beside.step(-action)
        np.testing.assert_array_equal(env.step(action)[0], reference(name).observations[t])


# --- Costs and ends ---


@each(SPEED_LIMITS)
def test_the_cost_of_a_velocity_task_is_one_above_the_speed_limit_and_else_zero(name):
    """The speed is the distance from the torso's last place, over the duration of a step."""
    env, costs = shared_env(name), set()
    planar = slice(0, 2 if name == "AntVelocity" else 1)
    for seed, push in [(seed, push) for seed in range(5) for push in (0, 0.5, 0.9, 1.1, 2)]:
        env.reset(seed=seed)
        env._sim.data.qvel[0] = push * SPEED_LIMITS[name]
        for _ in range(3):
            before = env._sim.data.qpos[planar].copy()
            *_, info = env.step(np.zeros(env.task.act_dim))
            speed = np.linalg.norm(env._sim.data.qpos[planar] - before) / env._sim.dt
            moves_on = name == "AntVelocity" or env._sim.data.qpos[0] > before[0]
            assert info == {"cost": float(speed > SPEED_LIMITS[name] and moves_on)}, (seed, push, speed)
            costs.add(info["cost"])
    assert costs == {0.0, 1.0}


@each(["PointCircle1"])
def test_the_cost_of_the_circle_is_one_outside_the_walls_and_else_zero(name):
    env, costs = shared_env(name), []
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(env.task.horizon):
            *_, info = env.step([1.0, 0.05])
            costs.append(info["cost"])
            assert info["cost"] == (abs(env._sim.task.agent.pos[0]) > 1.125)
    assert set(costs) == {0.0, 1.0}


@each(["PointGoal1"])
def test_a_step_in_a_hazard_costs_one(name):
    env, costs = shared_env(name), []
    for seed in range(3):
        env.reset(seed=seed)
        for action in np.random.default_rng(seed).uniform((0, -1), 1, (300, 2)):
            *_, info = env.step(action)
            agent, hazards = env._sim.task.agent.pos[:2], np.array(env._sim.task.hazards.pos)[:, :2]
            inside = (np.linalg.norm(hazards - agent, axis=1) <= env._sim.task.hazards.size).any()
            costs.append(info["cost"])
            assert info["cost"] == inside
    assert set(costs) == {0.0, 1.0}


@each(SPEED_LIMITS)
def test_hopper_and_ant_fall_and_the_cheetah_does_not(name):
    episode = play(shared_env(name), seed=1)
    if name == "HalfCheetahVelocity":
        assert len(episode) == 1000 and episode.truncated[-1]
    else:
        assert len(episode) < 1000 and episode.terminated[-1]


@each(["AntVelocity"])
def test_the_ants_first_quaternion_has_length_one(name):
    lengths = [np.linalg.norm(shared_env(name).reset(seed=seed)[0][1:5]) for seed in range(10)]
    np.testing.assert_allclose(lengths, 1, atol=1e-6)


# --- Pictures ---


def redness(env):
    red, green, blue = np.moveaxis(env.render().astype(int), -1, 0)
    return float(np.mean((red > 60) & (green < red / 2) & (blue < red / 2)))


@each(["HopperVelocity", "PointCircle1"])
def test_a_red_sphere_marks_a_robot_whose_last_step_was_unsafe(name):
    env = make_env(name, render_mode="rgb_array", image_size=(160, 120))
    seen = {0.0: [], 1.0: []}
    env.reset(seed=0)
    while len(seen[1.0]) < 3:  # the point soon leaves the picture
        if name == "HopperVelocity":
            env._sim.data.qvel[0] = 2.0 * (len(seen[0.0]) > len(seen[1.0]))
        *_, info = env.step([1.0, 0.05] if name == "PointCircle1" else np.zeros(3))
        seen[info["cost"]].append(redness(env))
    env.close()
    assert seen[0.0] and seen[1.0] and max(seen[0.0]) + 0.002 < min(seen[1.0]), seen


@each(["HopperVelocity", "PointGoal1"])
def test_rendering_does_not_disturb_the_episode(name):
    env = make_env(name, render_mode="rgb_array", image_size=(16, 12))
    step, env.step = env.step, lambda action: (env.render(), step(action))[1]
    assert_same(play(env, seed=3, steps=20), reference(name).first(20))
    env.close()


@each(["PointGoal1"])
def test_where_nothing_can_draw_it_is_an_error_that_says_what_to_install(name):
    program = (
        "from tutorial_lib.tasks import make_env\n"
        f"make_env({name!r})  # plays without pictures\n"
        f"try: make_env({name!r}, render_mode='rgb_array')\n"
        "except RuntimeError as error: print(error)"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "99"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.stdout.startswith("MuJoCo cannot draw pictures with MUJOCO_GL=egl"), done.stderr
    assert "apt install libegl1" in done.stdout


@each(["HalfCheetahVelocity"])
def test_making_an_environment_prints_nothing_and_writes_no_file(name, tmp_path):
    program = f"from tutorial_lib.tasks import make_env; make_env({name!r}).reset(seed=0)"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "") and not list(tmp_path.iterdir())
