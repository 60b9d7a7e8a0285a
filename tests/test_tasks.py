"""The eight tasks against a second copy of the paper's Tables 3 and 5 and of DSRL's constants."""

import dataclasses
import re
import subprocess
import sys

import pytest

from tutorial_lib.tasks import SIMULATORS, TASKS, get_task, make_env
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


def test_the_bullet_tasks_are_the_papers_eight():
    assert {name for name, task in TASKS.items() if task.family == "bullet"} == set(PAPER)


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
    monkeypatch.setitem(SIMULATORS, "chess", (lambda task, **options: (task.name, options), "chess-gym"))
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
