"""Compares a dataset with its task: what training would get wrong, and what may be meant.

Where training would be wrong, a check reports an error. Where the recording may be meant as it is, or where a
file of DSRL's might hold it, the check reports a warning. Each check says in a comment why it is which.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tutorial_lib.data.dataset import KEYS, Dataset
from tutorial_lib.tasks import Task, all_tasks

FLAGS = ("terminals", "timeouts")
LARGEST = 1e6
"""No observation and no reward may be larger. In float32 a value of this size has steps of 0.06, and one such
value among a million rows makes the standard deviation 1,000, so that normalised observations of all other
rows are equal. The shipped datasets have values up to 22, and no angle or length in metres comes near."""
ROUNDING = 1e-5
"""Actions may exceed 1 by this much, which is rounding in float32."""


class Report:
    """The errors and the warnings about one file. Each is one line: file, key, what is wrong, what to do."""

    def __init__(self, path: Path):
        self.path = path
        self.errors: list[str] = []
        self.warnings: list[str] = []

    def error(self, key: str, what: str, remedy: str) -> None:
        """Adds an error. With an empty `key`, the line names only the file."""
        self.errors.append(self._line(key, what, remedy))

    def warning(self, key: str, what: str, remedy: str) -> None:
        """Adds a warning."""
        self.warnings.append(self._line(key, what, remedy))

    def _line(self, key: str, what: str, remedy: str) -> str:
        return ": ".join(part for part in (str(self.path), key, what, remedy) if part)


Say = Callable[[str, str, str], None]
"""`Report.error` or `Report.warning`."""


def _say_rows(say: Say, key: str, bad: np.ndarray, what: str, remedy: str) -> None:
    """Reports the rows where `bad` (N,) or (N, width) is true, if there are any: how many, and the first."""
    rows = np.flatnonzero(_any_in_row(bad))
    if len(rows):
        count = f"{len(rows)} of {len(bad)} rows, the first is row {rows[0]}"
        say(key, f"{what} in {count}", remedy)


def _any_in_row(bad: np.ndarray) -> np.ndarray:
    """`bad.any(axis=1)` of an array (N,) or (N, width), faster where few rows have any."""
    found = np.zeros(len(bad), bool)
    found[np.flatnonzero(bad) // max(bad[:1].size, 1)] = True
    return found


# --- Shapes and types, before anything is read ---


def check_shapes(stored: dict[str, Any], task: Task, report: Report) -> bool:
    """Whether all seven arrays are there, and have the shapes of `task` and numbers. If not, reports it.

    The values of `stored` are arrays or datasets of an open file: only `shape` and `dtype` are looked at.
    """
    if missing := [key for key in KEYS if key not in stored]:
        report.error(", ".join(missing), "missing", f"DSRL's layout has {', '.join(KEYS)}")
        return False
    rows = (stored["observations"].shape or ())[:1]
    if rows == (0,):
        report.error("observations", "0 rows, no transitions", "fetch or collect some")
        return False
    widths = {"observations": task.obs_dim, "next_observations": task.obs_dim, "actions": task.act_dim}
    fits = True
    for key in KEYS:
        values = stored[key]
        wanted = (*rows, widths[key]) if key in widths else rows
        if values.shape != wanted and (key in widths or values.shape != (*rows, 1)):
            what = f"shape {values.shape} should be {wanted} for {task.name}"
            report.error(key, what, "is it another task's, or shorter than observations?")
            fits = False
        elif values.dtype.kind not in "biuf":
            report.error(key, f"{values.dtype} is not a number", "store float32, or bool for flags")
            fits = False
    return fits and bool(rows)


# --- Values that no task has ---


def check_values(stored: dict[str, np.ndarray], report: Report) -> dict[str, np.ndarray]:
    """The arrays as bool for flags and float32 for others, (N, 1) as (N,).

    Reports values that are NaN, infinite or absurdly large, flags that are not 0 or 1, and negative costs.
    """
    checked = {}
    for key in KEYS:
        values = np.asarray(stored[key])
        if key not in ("observations", "next_observations", "actions"):
            values = values.reshape(len(values))
        if key in FLAGS:
            bad = (values != 0) & (values != 1)
            _say_rows(report.error, key, bad, "neither 0 nor 1", "store False or True")
            checked[key] = values.astype(bool)
            continue
        with np.errstate(over="ignore"):  # a value too large for float32 becomes infinite, which is reported
            values = checked[key] = values.astype(np.float32, copy=False)
        finite = np.isfinite(values)
        _say_rows(report.error, key, ~finite, "NaN or infinity", "leave those episodes out")
        if key == "costs":
            _say_rows(report.error, key, values < 0, "negative cost", "make costs 0 or more")
        elif key != "actions":
            # An error: normalised observations, or returns, would then be those of a few rows.
            large = (np.abs(values) > LARGEST) & finite
            _say_rows(report.error, key, large, f"beyond {LARGEST:g}", "leave those episodes out")
    return checked


# --- The task ---


def check_task(attributes: dict, task: Task, report: Report) -> None:
    """Reports where the attribute `task` or the file's name names another task.

    DSRL's files have no such attribute, so that only the name can tell.
    """
    # The shapes cannot tell: BallRun and CarRun have the same.
    of_names = {other.dsrl_file: other.name for other in all_tasks().values()}
    for what, made_for in (
        ("attribute task", str(attributes.get("task", task.name))),
        ("its name", of_names.get(report.path.name, task.name)),
    ):
        if made_for in all_tasks() and made_for != task.name:
            report.error(what, f"{made_for}, not {task.name}", "take another task or file")


def check_dataset(data: Dataset, task: Task, report: Report) -> None:
    """Reports flags, rows and values that contradict the task."""
    _check_lengths(data, task, report)
    _check_flags(data, task, report)
    if (data.observations != data.observations[0]).any():
        _check_order(data, report)
        _check_episode_ends(data, report)
    else:
        # A warning: a task without observations is a bandit, which can be meant.
        what = f"all {len(data)} rows from row 0 are equal"
        report.warning("observations", what, "were they recorded? Nothing can depend on them")
    _check_costs(data, task, report)
    _check_actions(data, report)


def _check_lengths(data: Dataset, task: Task, report: Report) -> None:
    """Episodes that are too long, and time limits before the horizon."""

    def say(say_it: Say, bad: np.ndarray, what: str) -> None:
        if bad.any():
            count = f"{bad.sum()} of {len(bad)} episodes, the first ends in row {data.ends[bad][0] - 1}"
            fits = _tasks_of(set(data.episode_lengths[bad].tolist()), task)
            say_it("timeouts", f"{what} in {count}", f"is it {fits}, or were rows lost?")

    longest = data.episode_lengths.max()
    # An error: the costs of such an episode do not compare with the task's limits.
    what = f"an episode of {longest} steps, but {task.name} has {task.horizon}"
    say(report.error, data.episode_lengths > task.horizon, what)
    limited = data.timeouts[data.ends - 1] & ~data.terminals[data.ends - 1]
    # A warning: a recording may have been stopped. Its cost is that of a part of an episode.
    what = f"time limits before {task.name}'s horizon of {task.horizon} steps"
    say(report.warning, limited & (data.episode_lengths < task.horizon), what)


def _tasks_of(lengths: set[int], task: Task) -> str:
    """In words: the tasks with the shapes of `task` whose horizon is the only one of `lengths`."""
    dims = (task.obs_dim, task.act_dim)
    fits = [t for t in all_tasks().values() if {t.horizon} == lengths and (t.obs_dim, t.act_dim) == dims]
    return " or ".join(f"{t.name}'s, which has {t.horizon}" for t in fits) or "another task's"


def _check_flags(data: Dataset, task: Task, report: Report) -> None:
    """Terminals of a robot that cannot fall, both flags on a row, and time limits stored as terminals."""
    fell, limited = data.terminals[data.ends - 1], data.timeouts[data.ends - 1]
    if not task.terminates:
        # An error: the cost after a time limit would be taken as 0, and the limits' estimates be too low.
        what = f"terminals, but {task.name}'s robot cannot fall,"
        _say_rows(report.error, "terminals", data.terminals, what, "store time limits as timeouts")
    elif (
        (at_end := data.episode_lengths == task.horizon).any()
        and fell[at_end].all()
        and not (limited & ~fell).any()
    ):
        # A warning: every robot that reached the horizon may have fallen just there, but hardly.
        bad = np.isin(np.arange(len(data)), data.ends[at_end] - 1)
        what = f"terminals at the horizon of {task.horizon} steps, and no time limits at all,"
        _say_rows(report.warning, "terminals", bad, what, "store time limits as timeouts")
    # A warning: a robot may fall in the last step, and gymnasium then sets both. Training sees a fall.
    both = data.terminals & data.timeouts
    remedy = "is the end of every episode in both? Training takes such a row as a fall"
    _say_rows(report.warning, "terminals, timeouts", both, "both flags", remedy)


def _check_order(data: Dataset, report: Report) -> None:
    """Rows of an episode that do not follow each other."""
    inner = ~(data.terminals | data.timeouts)[:-1]
    following, states = data.next_observations[:-1], data.observations[1:]
    differs = np.append(_any_in_row(following != states) & inner, False)
    if not differs.any():
        return
    if (data.next_observations == data.observations).all():
        # An error: no action would change anything.
        every = np.ones(len(data), bool)
        what = "equal to observations"
        _say_rows(report.error, "next_observations", every, what, "store the state after each step")
        return
    gaps = (following[inner].astype(np.float64) - states[inner]) ** 2
    spread = (states[inner] - states[inner].mean(axis=0, dtype=np.float64)) ** 2
    what = f"not the next row's observations (by up to {np.sqrt(gaps.max()):.3g})"
    if differs.sum() > inner.sum() / 2 and gaps.sum() > spread.sum():
        # An error: the mean state is nearer to the next row than what is stored, so that the order is wrong.
        remedy = "store rows in the order in which they were recorded"
        _say_rows(report.error, "next_observations", differs, what, remedy)
    else:
        # A warning: dsrl adds noise to both on request. Otherwise, two recordings may have been joined.
        remedy = "if a recording was cut there, set timeouts in the row or leave the episode out"
        _say_rows(report.warning, "next_observations", differs, what, remedy)


def _check_episode_ends(data: Dataset, report: Report) -> None:
    """Last states that are another episode's, or the state before. Nothing bootstraps from terminals."""
    limited = data.timeouts & ~data.terminals
    following, states = data.next_observations, data.observations
    if (following == states).all():
        return  # reported already
    ends = np.flatnonzero(limited)
    shifted, repeated = np.zeros(len(data), bool), np.zeros(len(data), bool)
    repeated[ends] = (following[ends] == states[ends]).all(axis=1)
    ends = ends[ends < len(data) - 1]  # nothing begins after the last episode
    shifted[ends] = (following[ends] == states[ends + 1]).all(axis=1)
    # Warnings: only the last row of an episode is wrong, and an environment may start where another ended, or
    # a robot may stand still.
    remedy = "store the state after the last step: training bootstraps from it"
    what = "the next episode's first observation at a time limit"
    _say_rows(report.warning, "next_observations", shifted, what, remedy)
    what = "the same state as before the step at a time limit"
    _say_rows(report.warning, "next_observations", repeated, what, remedy)


def _check_costs(data: Dataset, task: Task, report: Report) -> None:
    """Costs that the task does not have. Its costs are whole numbers from 0 to `max_step_cost`."""
    costs, largest = data.costs, task.max_step_cost
    fractions = costs != np.rint(costs)
    inner = ~(data.terminals | data.timeouts)[:-1]
    if (costs > largest).any():
        # An error: limits are for sums of steps, and an agent could not pay so much in an episode.
        total = (np.diff(costs)[inner] >= 0).all()
        remedy = (
            "are they running totals? Store each step's own" if total else "store them in the task's unit"
        )
        _say_rows(report.error, "costs", costs > largest, f"more than {largest:g} a step", remedy)
    elif fractions.any() and len(units := np.unique(costs[costs > 0])) == 1:
        # An error: an unsafe step has another price than the one that the task's limits count.
        remedy = f"divide them by {units[0]:g}: the limits count unsafe steps as 1"
        _say_rows(report.error, "costs", costs > 0, f"{units[0]:g} for every unsafe step", remedy)
    else:
        # A warning: costs between 0 and 1 may be meant, where the user also chooses the limits.
        remedy = "the task's own limits count whole steps"
        _say_rows(report.warning, "costs", fractions, "no whole number", remedy)


def _check_actions(data: Dataset, report: Report) -> None:
    """Actions beyond [-1, 1]."""
    beyond = np.abs(data.actions) > 1 + ROUNDING
    share = beyond.mean()
    # An error where most would be clamped, for then they are in another unit. Else a warning: the sampled
    # actions of a Gaussian policy, which the environment clips, are stored so by some libraries.
    say = report.error if share > 0.5 else report.warning
    what = f"beyond [-1, 1] (training would clamp {max(share, 0.0001):.2%} of the entries)"
    _say_rows(say, "actions", beyond, what, "divide them by the largest action, or store them clipped")
