"""This module checks the answers to the exercises of notebook 2."""

import functools
from collections.abc import Callable

import numpy as np

from tutorial_lib.course.checks.checker import text, try_answer

RECORDING_FAULTS = ("costs", "flags", "order")
"""The faults that a recording can have in the exercise, as the answer names them."""


def check_episode_sums(answer: Callable) -> None:
    """Checks an exercise of notebook 2.

    `answer(values, terminals, timeouts)` returns the undiscounted sum of each complete episode.
    """
    off = np.zeros(5, bool)
    values = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    ends = [np.isin(np.arange(5), rows) for rows in ([1, 4], [4], [1], [3])]
    try_answer(
        answer,
        [
            ((values, off, ends[0]), np.array([3.0, 28.0]), "an episode ends with the row that is flagged"),
            ((values, ends[0], off), np.array([3.0, 28.0]), "a terminal ends an episode too"),
            ((values, ends[2], ends[1]), np.array([3.0, 28.0]), "either flag ends an episode"),
            ((values, ends[2], ends[0]), np.array([3.0, 28.0]), "a row with both flags ends one episode"),
            ((values, off, ends[3]), np.array([15.0]), "an unfinished tail belongs to no episode"),
        ],
    )


def check_backup_target(answer: Callable) -> None:
    """Checks an exercise of notebook 2.

    `answer(reward, gamma, next_value, terminal, timeout, bootstrap)` returns the target of a backup.
    """
    # r = 2, gamma = 1/2 and V = 10, so that r + gamma V = 7 equals none of r, V, r V, r + V and gamma V.
    row = (2.0, 0.5, 10.0)
    try_answer(
        answer,
        [
            ((*row, False, False, True), 7.0, "in mid-episode the target is r + gamma V(s')"),
            ((*row, True, False, True), 2.0, "after a terminal nothing follows"),
            ((*row, False, True, True), 7.0, "bootstrap=True looks through a time limit"),
            ((*row, False, True, False), 2.0, "bootstrap=False stops at a time limit"),
            ((*row, True, True, True), 2.0, "a fall in the last step is still a fall"),
            ((*row, False, False, False), 7.0, "bootstrap=False stops at time limits only"),
            ((*row, True, False, False), 2.0, "after a terminal nothing follows, either way"),
            (
                (-3.0, 0.9, 20.0, False, False, True),
                15.0,
                "r + gamma V(s'), whatever their signs",
            ),
        ],
    )


def check_frontier(answer: Callable) -> None:
    """Checks an exercise of notebook 2.

    `answer(costs, returns)` returns the points (cost, return) on the frontier of these episodes, as pairs or
    as an array (k, 2), in any order.
    """
    cases = [
        ([0, 2, 4], [4, 6, 12], [(0, 4), (2, 6), (4, 12)],
         "keep (2, 6): under the limit 2 it is the best *episode*, although a mixture earns more"),
        ([0, 1, 2], [4, 2, 6], [(0, 4), (2, 6)], "(1, 2) costs more than (0, 4) and earns less"),
        ([6, 0, 4, 2], [11, 4, 12, 6], [(0, 4), (2, 6), (4, 12)], "the episodes come in any order"),
        ([3, 3, 1], [5, 8, 2], [(1, 2), (3, 8)], "of episodes with the same cost only the best counts"),
        ([1, 5], [7, 7], [(1, 7)], "whoever pays more for the same return is not on the frontier"),
        ([2, 2], [7, 7], [(2, 7)], "name equal episodes once"),
        ([0, 9], [-5, -2], [(0, -5), (9, -2)], "returns can be negative: do not start from 0"),
        ([3], [1], [(3, 1)], "a single episode is on the frontier, whatever it costs"),
    ]  # fmt: skip
    try_answer(
        _sorted_rows(answer),
        [
            ((np.array(costs, float), np.array(returns, float)), np.array(points, float), hint)
            for costs, returns, points, hint in cases
        ],
    )


def _sorted_rows(answer: Callable) -> Callable:
    """Returns `answer` with its points (k, 2) in the order of their costs. Other values stay as they are."""

    @functools.wraps(answer)
    def in_order(*arguments):
        got = answer(*arguments)
        try:
            rows = np.array([list(point) for point in got], float)
        except (TypeError, ValueError):  # it is no list of points
            return got
        return rows[np.lexsort(rows.T[::-1])] if rows.ndim == 2 and rows.shape[1] == 2 else got

    return in_order


# --- Three faults in a recording ---


def small_recording(unsafe: tuple[int, ...] = (12, 7), horizon: int = 200) -> dict[str, np.ndarray]:
    """Returns the seven arrays of a made-up recording of BallCircle, with one episode for each of `unsafe`.

    `unsafe` holds the cost of each episode. A ball moves along the x axis, beyond the wall at 6 m for so many
    steps, and back. No step ends within 0.3 m of the wall. Observations are (N, 8), and actions are (N, 2).
    """
    parts = []
    for number, cost in enumerate(unsafe):
        step = np.arange(horizon + 1)
        first = 60 + 10 * number  # the first unsafe step ends here
        outside = (step >= first) & (step < first + cost)
        x = np.where(outside, 6.5 + 0.001 * step, 0.02 * step + 0.1 * number)
        x = np.where(step >= first + cost, 5.0 - 0.001 * step, x) * (-1.0) ** number
        states = np.zeros((horizon + 1, 8), np.float32)
        states[:, 0], states[:, 2] = x / 10, np.gradient(x)
        parts.append((states, outside))
    last = np.arange(horizon) == horizon - 1
    arrays = {
        "observations": np.concatenate([states[:-1] for states, _ in parts]),
        "next_observations": np.concatenate([states[1:] for states, _ in parts]),
        "costs": np.concatenate([outside[1:] for _, outside in parts]).astype(np.float32),
        "timeouts": np.tile(last, len(parts)),
    }
    return arrays | {
        "actions": np.full((len(arrays["costs"]), 2), 0.1, np.float32),
        "rewards": np.ones(len(arrays["costs"]), np.float32),
        "terminals": np.zeros(len(arrays["costs"]), bool),
    }


def spoiled(rows: dict[str, np.ndarray], *faults: str) -> dict[str, np.ndarray]:
    """Returns a copy of a recording's arrays with some of `RECORDING_FAULTS`.

    - flags: the time limits are stored as terminals.
    - order: states and actions stand one row too late.
    - costs: the cost of a row is the sum since the beginning of its episode.
    """
    rows = {key: values.copy() for key, values in rows.items()}
    if "costs" in faults:
        ends = np.flatnonzero(rows["terminals"] | rows["timeouts"]) + 1
        parts = np.split(rows["costs"], ends[:-1])
        rows["costs"] = np.concatenate([np.cumsum(part) for part in parts]).astype(np.float32)
    if "order" in faults:
        rows |= {key: np.roll(rows[key], 1, axis=0) for key in ("observations", "actions")}
    if "flags" in faults:
        rows |= {"terminals": rows["timeouts"], "timeouts": rows["terminals"]}
    return rows


def check_find_faults(answer: Callable) -> None:
    """Checks an exercise of notebook 2.

    `answer(rows)` gets the seven arrays of a recording of BallCircle, by their names. It returns the names of
    its faults (see `RECORDING_FAULTS`), in any order, as a set, a list or a tuple.
    """
    good, once, both = small_recording(), small_recording((1, 0)), small_recording()
    both["terminals"] = both["timeouts"].copy()
    cases = [
        (good, (), "it is right. The row after the last row of an episode belongs to another episode"),
        (spoiled(good, "flags"), ("flags",), "a ball cannot fall: look at `terminals`"),
        (spoiled(good, "order"), ("order",), "within an episode the s' of a row is the s of the next row"),
        (spoiled(good, "costs"), ("costs",), "compare the costs with the places where the steps end"),
        (spoiled(once, "costs"), ("costs",), "its running total is never above 1: look at the places"),
        (once, (), "it is right, and its second episode costs nothing"),
        (both, ("flags",), "a ball cannot fall, and every one of its terminals is wrong"),
        (spoiled(good, "flags", "order"), ("flags", "order"), "an episode can end with either flag"),
        (spoiled(good, *RECORDING_FAULTS), RECORDING_FAULTS, "one recording can have several faults"),
    ]  # fmt: skip
    for number, (rows, expected, hint) in enumerate(cases, 1):
        try:
            got = answer({key: values.copy() for key, values in rows.items()})
        except Exception as error:  # the reader's code can raise any error
            print(f"NOT YET  recording {number}: {type(error).__name__}: {error}")
            return
        if got is None or got is ...:
            print(f"NOT YET  {answer.__name__} returns nothing: without a fault, return an empty set")
            return
        if problem := _not_the_faults(got, expected):
            print(f"NOT YET  recording {number}: {problem}: {hint}")
            return
    print(f"OK  {answer.__name__} is right about {len(cases)} recordings")


def _not_the_faults(got, expected: tuple[str, ...]) -> str:
    """Returns why `got` does not name the faults `expected`, or an empty text where it does."""
    try:
        found = {got} if isinstance(got, str) else {str(name) for name in got}
    except TypeError:
        return f"{text(got)} is no set of names"
    if unknown := sorted(found - set(RECORDING_FAULTS)):
        return f"{', '.join(unknown)}: the names are {', '.join(RECORDING_FAULTS)}"
    if found == set(expected):
        return ""
    return f"found {', '.join(sorted(found)) or 'no fault'}, expected {', '.join(expected) or 'no fault'}"
