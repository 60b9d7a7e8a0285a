"""The records of the tasks against a second copy of the paper's Tables 3 and 5 and of DSRL's constants."""

import dataclasses
import re
import subprocess
import sys

import pytest

from tutorial_lib.tasks import (
    DSRL_FRONTIER,
    MUJOCO_TASKS,
    SIMULATORS,
    TASKS,
    all_tasks,
    check_installed,
    get_task,
    make_env,
)
from tutorial_lib.tasks.recipes import RECIPES
from tutorial_lib.tasks.scene import CIRCLE, RUN

PAPER = {  # Table 3: T, action and state dimension, cost range. Table 5: the gammas; small, middle, high
    "AntRun": (200, 8, 33, 150, (0.985, 0.99, 0.993), (30, 70, 110)),
    "BallRun": (100, 2, 7, 80, (0.95, 0.96, 0.97), (30, 50, 70)),
    "CarRun": (200, 2, 7, 40, (0.985, 0.99, 0.993), (10, 20, 40)),
    "DroneRun": (200, 4, 17, 140, (0.985, 0.99, 0.993), (30, 70, 110)),
    "AntCircle": (500, 8, 34, 200, (0.99, 0.993, 0.995), (40, 100, 160)),
    "BallCircle": (200, 2, 8, 80, (0.985, 0.99, 0.993), (30, 50, 70)),
    "CarCircle": (300, 2, 8, 100, (0.99, 0.993, 0.995), (30, 50, 70)),
    "DroneCircle": (300, 4, 18, 100, (0.99, 0.993, 0.995), (30, 50, 70)),
}
DSRL = {  # its file, and the returns that its scores divide by
    "AntRun": ("SafetyAntRun-v0-150-1816.hdf5", 0.00177, 955.4819),
    "BallRun": ("SafetyBallRun-v0-80-940.hdf5", 26.3398, 1327.4456),
    "CarRun": ("SafetyCarRun-v0-40-651.hdf5", 204.2873, 574.6533),
    "DroneRun": ("SafetyDroneRun-v0-140-1990.hdf5", 10.5570, 682.8330),
    "AntCircle": ("SafetyAntCircle-v0-200-5728.hdf5", 0.01770, 460.7092),
    "BallCircle": ("SafetyBallCircle-v0-80-886.hdf5", 0.38312, 881.4634),
    "CarCircle": ("SafetyCarCircle-v0-100-1450.hdf5", 3.48442, 534.3061),
    "DroneCircle": ("SafetyDroneCircle-v0-100-1923.hdf5", 207.7942, 996.3892),
}


# Table 6's tasks: the id of the environment, T, state and action dimension, DSRL's C max, its number of
# episodes, R min and R max.
TABLE6 = {
    "PointCircle1": ("SafetyPointCircle1-v0", 500, 28, 2, 200, 1098, 20.067626953125, 61.72819519042969),
    "PointGoal1": ("SafetyPointGoal1-v0", 1000, 60, 2, 100, 2022, 0.01196012764197707, 30.071114857340543),
    "PointPush1": ("SafetyPointPush1-v0", 1000, 76, 2, 150, 2379, 0.0014001545292344209, 16.518654299293367),
    "PointButton1": (
        "SafetyPointButton1-v0", 1000, 76, 2, 200, 2268, 0.008822109034937853, 41.19301568767707
    ),
    "HalfCheetahVelocity": (
        "SafetyHalfCheetahVelocity-v1", 1000, 17, 6, 250, 2495, 5.7509765625, 2806.93310546875
    ),
    "HopperVelocity": (
        "SafetyHopperVelocity-v1", 1000, 11, 3, 250, 2240, 37.05154800415039, 1911.396728515625
    ),
    "AntVelocity": ("SafetyAntVelocity-v1", 1000, 27, 8, 250, 2249, 6.1519012451171875, 2976.276611328125),
}  # fmt: skip


def test_the_tasks_are_the_papers_eight_and_the_seven_of_its_table_6():
    assert TASKS.keys() == PAPER.keys() and {task.family for task in TASKS.values()} == {"bullet"}
    assert MUJOCO_TASKS.keys() == TABLE6.keys()
    assert {task.family for task in MUJOCO_TASKS.values()} == {"mujoco"}
    assert all_tasks() == TASKS | MUJOCO_TASKS and len(all_tasks()) == 15
    assert DSRL_FRONTIER.keys() == RECIPES.keys() == all_tasks().keys()


@pytest.mark.parametrize("name", TABLE6)
def test_matches_safety_gymnasium_and_dsrl(name):
    task, (env_id, *numbers) = MUJOCO_TASKS[name], TABLE6[name]
    ours = task.horizon, task.obs_dim, task.act_dim, task.cost_range
    assert [task.env_id, *ours, task.min_return, task.max_return] == [env_id, *numbers[:4], *numbers[5:]]
    simulator, version = env_id.split("-")
    assert task.dsrl_file == f"{simulator}Gymnasium-{version}-{task.cost_range}-{numbers[4]}.hdf5"
    assert task.terminates == (task.robot in ("Hopper", "Ant"))


@pytest.mark.parametrize("name", TABLE6)
def test_what_the_paper_leaves_open_follows_the_field_and_the_papers_rule(name):
    """The thresholds are OSRL's. Appendix B.2 wants discount factors with gamma^T of 0.05, 0.1 and 0.2."""
    task = MUJOCO_TASKS[name]
    assert task.thresholds == (20, 40, 80)
    assert [gamma**task.horizon for gamma in task.gammas] == pytest.approx([0.05, 0.1, 0.2], rel=0.02)


@pytest.mark.parametrize("name", PAPER)
def test_matches_the_papers_tables_3_and_5(name):
    task = TASKS[name]
    ours = task.horizon, task.act_dim, task.obs_dim, task.cost_range, task.gammas, task.thresholds
    assert ours == PAPER[name]


@pytest.mark.parametrize("name", DSRL)
def test_matches_dsrl(name):
    task = TASKS[name]
    assert (task.dsrl_file, task.min_return, task.max_return) == DSRL[name]


@pytest.mark.parametrize("name", PAPER)
def test_a_dsrl_file_is_named_by_environment_largest_cost_and_number_of_trajectories(name):
    parts = re.fullmatch(r"(Safety\w+-v0)-(\d+)-(\d+)\.hdf5", TASKS[name].dsrl_file)
    assert parts, TASKS[name].dsrl_file
    assert parts[1] == TASKS[name].env_id == f"Safety{name}-v0"
    assert int(parts[2]) == PAPER[name][3]


def test_only_ants_and_drones_can_fall():
    fall = {name for name in PAPER if TASKS[name].terminates}
    assert fall == {"AntRun", "AntCircle", "DroneRun", "DroneCircle"}


def test_a_task_takes_place_in_the_scene_that_its_name_ends_with():
    scenes = {name: (RUN, CIRCLE)["Circle" in name] for name in PAPER}
    assert {name: TASKS[name].scene for name in PAPER} == scenes


def test_thresholds_bear_the_papers_words_and_the_middle_one_is_typical():
    assert TASKS["CarRun"].cost_limit_names == {10: "small", 20: "middle", 40: "high"}
    assert TASKS["CarRun"].typical_limit == 20


@pytest.mark.parametrize(
    ("thresholds", "typical"), [((5,), 5), ((5, 7), 5), ((5, 7, 9, 11), 7), ((5, 7, 9, 11, 12), 9)]
)
def test_a_task_can_have_any_number_of_limits(thresholds, typical):
    names = tuple(f"limit {place}" for place in range(len(thresholds)))
    task = dataclasses.replace(TASKS["CarRun"], thresholds=thresholds, limit_names=names)
    assert task.typical_limit == typical
    assert list(task.cost_limit_names) == list(thresholds)


def test_as_many_limits_as_names():
    with pytest.raises(ValueError, match="CarRun has 2 thresholds and 3 limit_names: give one name for each"):
        dataclasses.replace(TASKS["CarRun"], thresholds=(10, 20))


def test_the_tasks_are_quick_to_import():
    slow = "{'gymnasium', 'matplotlib', 'pybullet', 'torch'}"
    program = f"import sys, tutorial_lib.tasks; print(sorted({slow} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True).stdout.strip() == b"[]"


# --- Who simulates a task ---


def test_an_environment_of_a_name_is_the_one_of_its_record():
    assert make_env("BallRun").task is make_env(TASKS["BallRun"]).task is TASKS["BallRun"]


def test_an_unknown_family_is_an_error_that_lists_the_families():
    odd = dataclasses.replace(TASKS["BallRun"], family="chess")
    with pytest.raises(ValueError, match="BallRun: unknown family 'chess': the families are bullet"):
        make_env(odd)


def test_another_family_needs_one_entry(monkeypatch):
    chess = SIMULATORS["bullet"]._replace(make=lambda task, **options: (task.name, options), modules=())
    monkeypatch.setitem(SIMULATORS, "chess", chess)
    assert make_env(dataclasses.replace(TASKS["BallRun"], family="chess"), size=8) == ("BallRun", {"size": 8})


@pytest.mark.parametrize("module", ["pybullet", "bullet_safety_gym"])
def test_a_simulator_that_is_not_installed_is_an_error_that_says_what_to_install(module):
    """In a process of its own: this one may have imported the simulator."""
    program = (
        f"import sys; sys.modules['{module}'] = None\n"
        "from tutorial_lib.tasks import make_env\n"
        "try: make_env('BallRun')\n"
        "except ValueError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert f"BallRun is simulated by bullet-safety-gym, and module '{module}' is not installed" in done.stdout
    assert "pip install" in done.stdout


def test_nothing_is_imported_to_see_whether_a_simulator_is_installed():
    program = (
        "import sys\n"
        "from tutorial_lib.tasks import all_tasks, simulator_of\n"
        "found = [simulator_of(task).missing() for task in all_tasks().values()]\n"
        "print(sorted({'gymnasium', 'pybullet', 'mujoco', 'safety_gymnasium'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True).stdout.strip() == b"[]"


def test_an_extra_that_is_not_installed_is_an_error_that_names_its_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "safety_gymnasium", None)
    check_installed(TASKS["BallRun"])
    for use in (check_installed, make_env):
        with pytest.raises(ValueError, match="PointPush1 is simulated by safety-gymnasium, .*make mujoco"):
            use(MUJOCO_TASKS["PointPush1"])


# --- Names ---


@pytest.mark.parametrize(
    ("typed", "meant"), [("BalCircle", "BallCircle"), ("antrun", "AntRun"), ("DroneCirlce", "DroneCircle")]
)
def test_an_unknown_name_is_answered_with_the_nearest(typed, meant):
    with pytest.raises(ValueError, match=f"'{typed}': did you mean [^?]*{meant}"):
        get_task(typed)
    with pytest.raises(ValueError, match=f"did you mean [^?]*{meant}"):
        make_env(typed)


def test_a_name_that_is_near_to_none_is_answered_with_all():
    with pytest.raises(ValueError) as error:
        get_task("xyz")
    assert "did you mean" not in str(error.value)
    assert all(name in str(error.value) for name in PAPER)
