"""What the reader says of recordings that contradict their task: errors, warnings, and nothing at all."""

import dataclasses
import warnings

import h5py
import numpy as np
import pytest
from five_episodes import refused

from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.hdf5 import examine, read_dataset, write_dataset
from tutorial_lib.tasks import TASKS

BALL, CAR, ANT = TASKS["BallRun"], TASKS["CarRun"], TASKS["AntRun"]


def record(task, lengths, seed=0):
    """Episodes of a slow random walk, as a simulator would be recorded. Short ones end in a fall."""
    rng = np.random.default_rng(seed)
    rows = {key: [] for key in ("observations", "next_observations", "terminals", "timeouts")}
    for length in lengths:
        start = rng.normal(size=task.obs_dim)
        steps = np.cumsum(rng.normal(scale=0.05, size=(length + 1, task.obs_dim)), axis=0)
        states, end = (start + steps).astype(np.float32), np.arange(length) == length - 1
        rows["observations"].append(states[:-1])
        rows["next_observations"].append(states[1:])
        rows["terminals"].append(end & (length < task.horizon))
        rows["timeouts"].append(end & (length == task.horizon))
    total = sum(lengths)
    return {key: np.concatenate(parts) for key, parts in rows.items()} | {
        "actions": rng.uniform(-1, 1, size=(total, task.act_dim)).astype(np.float32),
        "rewards": rng.normal(2, 1, size=total).astype(np.float32),
        "costs": (rng.random(total) < 0.2).astype(np.float32),
    }


def walks(task=CAR):
    """Three episodes: whole ones, and falls of a robot that can fall."""
    return record(task, [task.horizon, 60 if task.terminates else task.horizon, task.horizon])


def save(path, arrays, **attributes):
    with h5py.File(path, "w") as file:
        file.update(arrays)
        file.attrs.update(attributes)
    return path


def said(folder, arrays, task=CAR):
    """(errors, warnings) about these arrays, without the path. The two ways of reading must agree."""
    path = save(folder / "a.hdf5", arrays)
    dataset, report = examine(path, task)
    for line in report.errors + report.warnings:
        assert line.startswith(f"{path}: ") and "\n" not in line and line.count(": ") >= 2
    if report.errors:
        with refused("^/"), warnings.catch_warnings(action="error"):
            read_dataset(path, task)
    else:
        with warnings.catch_warnings(record=True, action="always") as caught:
            assert read_dataset(path, task).checksum == dataset.checksum
        assert [str(warning.message) for warning in caught] == report.warnings
    short = [[line.removeprefix(f"{path}: ") for line in lines] for lines in (report.errors, report.warnings)]
    return tuple(short)


def only(lines, start, *parts):
    """Expects one line, which starts so and has these parts."""
    (line,) = lines
    assert line.startswith(start), line
    for part in parts:
        assert part in line, line


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_good_recordings_pass_without_a_word(tmp_path, task):
    assert said(tmp_path, walks(task), task) == ([], [])


# --- Flags ---


def test_a_terminal_of_a_robot_that_cannot_fall_is_refused(tmp_path):
    arrays = walks()
    arrays["terminals"], arrays["timeouts"] = arrays["timeouts"], arrays["terminals"]
    errors, warned = said(tmp_path, arrays)
    only(errors, "terminals: ", "CarRun's robot cannot fall", "in 3 of 600 rows, the first is row 199: ")
    assert warned == []


def test_terminals_only_at_the_horizon_are_warned_of_where_a_robot_can_fall(tmp_path):
    arrays = walks(ANT)
    arrays["terminals"] |= arrays["timeouts"]
    arrays["timeouts"][:] = False
    errors, warned = said(tmp_path, arrays, ANT)
    assert errors == []
    only(warned, "terminals: ", "no time limits at all", "in 2 of 460 rows, the first is row 199: ")


def test_one_fall_in_the_last_step_is_nothing(tmp_path):
    arrays = walks(ANT)
    arrays["terminals"][199], arrays["timeouts"][199] = True, False
    assert said(tmp_path, arrays, ANT) == ([], [])


def test_both_flags_on_a_row_are_warned_of(tmp_path):
    arrays = walks(ANT)
    arrays["terminals"][199] = True
    errors, warned = said(tmp_path, arrays, ANT)
    assert errors == []
    only(warned, "terminals, timeouts: both flags in 1 of 460 rows, the first is row 199: ")


def test_time_limits_before_the_horizon_are_warned_of(tmp_path):
    arrays = {key: np.delete(values, [199, 399], axis=0) for key, values in walks().items()}
    arrays["timeouts"][[198, 397]] = True
    errors, warned = said(tmp_path, arrays)
    assert errors == []
    only(warned, "timeouts: time limits before CarRun's horizon of 200", "in 2 of 3 episodes", "row 198: ")


def test_the_task_whose_horizon_fits_is_named(tmp_path):
    errors, warned = said(tmp_path, walks(BALL), CAR)
    assert errors == []
    only(
        warned, "timeouts: time limits before", "in 3 of 3 episodes", "row 99: is it BallRun's, which has 100"
    )
    errors, _ = said(tmp_path, walks(CAR), BALL)
    only(errors, "timeouts: an episode of 200 steps, but BallRun has 100", "is it CarRun's, which has 200")


# --- Rows that follow each other ---


def test_a_joined_recording_is_warned_of(tmp_path):
    """The first file was cut after 50 of its steps, before the next one."""
    arrays = record(ANT, [60, 50, 80, 70])
    arrays["terminals"][109] = False
    errors, warned = said(tmp_path, arrays, ANT)
    assert errors == []
    only(warned, "next_observations: not the next row's", "in 1 of 260 rows, the first is row 109: ")


def test_noise_on_both_states_may_be_meant(tmp_path):
    arrays = walks()
    for seed, key in enumerate(("observations", "next_observations")):
        noise = np.random.default_rng(seed).normal(scale=0.1 * arrays[key].std(), size=(600, 7))
        arrays[key] = (arrays[key] + noise).astype(np.float32)
    errors, warned = said(tmp_path, arrays)
    assert errors == []
    only(warned, "next_observations: not the next row's", "in 597 of 600 rows, the first is row 0: ")


def test_rows_in_another_order_are_refused(tmp_path):
    arrays = walks()
    arrays["next_observations"] = arrays["next_observations"][::-1]
    errors, _ = said(tmp_path, arrays)
    only(errors, "next_observations: not the next row's", "rows, the first is row 0: store rows in the order")


def test_states_twice_are_refused(tmp_path):
    arrays = walks()
    arrays["next_observations"] = arrays["observations"]
    errors, warned = said(tmp_path, arrays)
    only(errors, "next_observations: equal to observations in 600 of 600 rows, the first is row 0: ")
    assert warned == []


def test_the_next_episodes_start_as_a_last_state_is_warned_of(tmp_path):
    arrays = walks()
    arrays["next_observations"] = np.roll(arrays["observations"], -1, axis=0)
    errors, warned = said(tmp_path, arrays)
    assert errors == []
    only(warned, "next_observations: the next episode's first", "in 2 of 600 rows, the first is row 199: ")


def test_after_a_fall_the_last_state_does_not_matter(tmp_path):
    arrays = walks(ANT)
    arrays["next_observations"][259] = arrays["observations"][260]  # the fall is in row 259
    assert said(tmp_path, arrays, ANT) == ([], [])


def test_a_repeated_last_state_is_warned_of(tmp_path):
    arrays = walks()
    arrays["next_observations"][[199, 599]] = arrays["observations"][[199, 599]]
    errors, warned = said(tmp_path, arrays)
    assert errors == []
    only(warned, "next_observations: the same state", "in 2 of 600 rows, the first is row 199: ")


def test_constant_observations_are_warned_of(tmp_path):
    arrays = walks()
    for key in ("observations", "next_observations"):
        arrays[key] = np.ones_like(arrays[key])
    errors, warned = said(tmp_path, arrays)
    assert errors == []
    only(warned, "observations: all 600 rows from row 0 are equal")
    arrays = walks()
    for key in ("observations", "next_observations"):
        arrays[key][:, :6] = 0  # a sensor that saw nothing is not an error
    assert said(tmp_path, arrays) == ([], [])


# --- Values ---


def test_costs_in_another_unit_are_refused(tmp_path):
    arrays = walks()
    arrays["costs"] *= np.float32(0.01)
    errors, _ = said(tmp_path, arrays)
    unsafe = np.flatnonzero(arrays["costs"])
    count = f"in {len(unsafe)} of 600 rows, the first is row {unsafe[0]}: "
    only(errors, "costs: 0.01 for every unsafe step", count, "divide them by 0.01")


def test_running_totals_of_costs_are_refused(tmp_path):
    arrays = walks()
    arrays["costs"] = np.concatenate([np.cumsum(part) for part in arrays["costs"].reshape(3, 200)])
    errors, _ = said(tmp_path, arrays)
    first = np.flatnonzero(arrays["costs"] > 1)[0]
    only(errors, "costs: more than 1 a step", f"the first is row {first}: ", "running totals")


def test_large_costs_are_refused_unless_the_task_has_them(tmp_path):
    arrays = walks()
    arrays["costs"] *= 2
    errors, _ = said(tmp_path, arrays)
    only(errors, "costs: more than 1 a step", "in the task's unit")
    assert said(tmp_path, arrays, dataclasses.replace(CAR, max_step_cost=2.0)) == ([], [])


def test_different_costs_between_0_and_1_may_be_meant(tmp_path):
    arrays = walks()
    arrays["costs"][[5, 8]] = 0.25, 0.5
    errors, warned = said(tmp_path, arrays)
    assert errors == []
    only(warned, "costs: no whole number in 2 of 600 rows, the first is row 5: ")


@pytest.mark.parametrize("factor, refuses", [(5, True), (1.2, False)])
def test_actions_beyond_the_range_are_named_with_their_share(tmp_path, factor, refuses):
    arrays = walks()
    arrays["actions"] *= np.float32(factor)
    beyond = np.abs(arrays["actions"]) > 1
    lines = said(tmp_path, arrays)
    assert lines[refuses] == []
    rows = np.flatnonzero(beyond[:, 0] | beyond[:, 1])
    share, count = f"clamp {beyond.mean():.2%} of", f"in {len(rows)} of 600 rows, the first is row {rows[0]}"
    only(lines[not refuses], "actions: beyond [-1, 1]", share, count)


def test_rounding_of_actions_is_nothing(tmp_path):
    arrays = walks()
    arrays["actions"][:9] = np.nextafter(np.float32(1), np.float32(2))
    assert said(tmp_path, arrays) == ([], [])


@pytest.mark.parametrize("key", ["observations", "next_observations", "rewards"])
def test_absurd_magnitudes_are_refused(tmp_path, key):
    arrays = walks()
    arrays[key].reshape(600, -1)[[7, 9], 0] = -1e38, 2e6
    errors, _ = said(tmp_path, arrays)
    only(errors, f"{key}: beyond 1e+06 in 2 of 600 rows, the first is row 7: ")


# --- Several faults, and writing ---


def test_all_faults_are_listed_and_the_first_is_raised(tmp_path):
    arrays = walks()
    arrays["terminals"] = arrays["timeouts"].copy()
    arrays["costs"] *= 3
    arrays["actions"][0] = 7
    errors, warned = said(tmp_path, arrays)
    assert [line.split(":")[0] for line in errors] == ["terminals", "costs"]
    assert [line.split(":")[0] for line in warned] == ["terminals, timeouts", "actions"]
    with refused(r"terminals: .* \(and 1 more: `c2iql data check` lists them\)$"):
        read_dataset(tmp_path / "a.hdf5", CAR)


def test_all_shapes_that_are_wrong_are_listed(tmp_path):
    arrays = walks()
    arrays |= {"rewards": arrays["rewards"][1:], "costs": arrays["costs"].astype("S3")}
    errors, _ = said(tmp_path, arrays)
    assert [line.split(":")[0] for line in errors] == ["rewards", "costs"]


def test_what_would_be_refused_is_not_written(tmp_path):
    arrays = walks()
    arrays["costs"] *= 3
    with refused(f"^{tmp_path}/a.hdf5: costs: more than 1"):
        write_dataset(tmp_path / "a.hdf5", Dataset(**arrays), CAR)
    assert not list(tmp_path.iterdir())


def test_a_recording_like_dsrls_passes_with_one_warning(tmp_path):
    """(N, 1) columns, flags as numbers, float64, further keys, and a tail that no flag ends."""
    arrays = record(ANT, [200, 60, 200, 200])
    for key in ("rewards", "costs", "terminals", "timeouts"):
        arrays[key] = arrays[key][:, None].astype(np.float64)
    arrays = {key: values[:500] for key, values in arrays.items()} | {"infos": np.zeros(4)}
    errors, warned = said(tmp_path, arrays, ANT)
    assert errors == []
    only(warned, "unfinished tail: dropped 40 of 500 transitions")
