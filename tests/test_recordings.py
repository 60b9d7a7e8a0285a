"""What is counted in recordings, against slow loops and a linear programme."""

import dataclasses
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from scipy.optimize import linprog

from tutorial_lib.course import checks, figures, widgets
from tutorial_lib.course.checks import recordings as exercises
from tutorial_lib.data import recordings
from tutorial_lib.data.checks import Report, check_dataset
from tutorial_lib.data.dataset import KEYS, Dataset, returns_to_go
from tutorial_lib.tasks import DSRL_FRONTIER, TASKS, get_task


@pytest.fixture(autouse=True)
def without_a_screen():
    matplotlib.use("Agg")


def random_recordings(rng, episodes=30, terminals=True):
    """Random episodes of 1 to 9 steps; some end by a fall."""
    lengths = rng.integers(1, 10, episodes)
    rows = lengths.sum()
    ends = np.zeros(rows, bool)
    ends[np.cumsum(lengths) - 1] = True
    fell = ends & (rng.random(rows) < 0.5 * terminals)
    observations = rng.normal(size=(rows, 8)).astype(np.float32)
    costs = (rng.random(rows) < 0.4).astype(np.float32)
    rewards = rng.normal(1, 2, rows).astype(np.float32)
    return Dataset(observations, observations + 1, observations[:, :2], rewards, costs, fell, ends & ~fell)


def of_points(points):
    """A dataset whose episodes, of one step, have these costs and returns."""
    costs, returns = np.array(points, np.float32).T
    rows, zeros = np.ones(len(points), bool), np.zeros((len(points), 8), np.float32)
    return Dataset(zeros, zeros, zeros[:, :2], returns, costs, ~rows, rows)


def test_best_left_against_a_filter_for_each_limit():
    data = random_recordings(np.random.default_rng(0))
    limits = [0, 1, 2.5, 9]
    shares, best = recordings.best_left(data, limits)
    for limit, share, top in zip(limits, shares, best, strict=True):
        kept = [r for r, c in zip(data.episode_returns, data.episode_costs, strict=True) if c <= limit]
        assert (share, top) == (len(kept) / 30, max(kept))


def test_nothing_left_is_no_return():
    shares, best = recordings.best_left(of_points([(5, 1), (7, 2)]), [4, 5])
    assert shares.tolist() == [0, 0.5]
    assert np.isnan(best[0]) and best[1] == 1


@pytest.mark.parametrize("seed", range(12))
def test_best_mixture_is_the_linear_programmes(seed):
    rng = np.random.default_rng(seed)
    points = np.stack([rng.integers(0, 12, 25), rng.normal(0, 10, 25).round(seed % 3)], 1)
    data = of_points(points)
    limits = np.linspace(0, 14, 9)
    for limit, found in zip(limits, recordings.best_mixture(data, limits), strict=True):
        best = linprog(
            -data.episode_returns, A_ub=data.episode_costs[None], b_ub=[limit],
            A_eq=np.ones((1, 25)), b_eq=[1],
        )  # fmt: skip
        if best.status == 2:  # nothing is that cheap
            assert np.isnan(found)
        else:
            assert found == pytest.approx(-best.fun, abs=1e-6)


def test_near_best_counts_only_what_keeps_the_limit():
    data = of_points([(0, 100), (0, 91), (0, 89), (10, 95), (30, 500)])
    assert recordings.near_best(data, 0) == 2
    assert recordings.near_best(data, 10) == 3
    assert recordings.near_best(data, 40) == 1
    assert recordings.near_best(of_points([(5, 1)]), 4) == 0


def test_returns_to_go_against_a_double_loop():
    data = random_recordings(np.random.default_rng(1))
    tails = np.arange(30.0)
    found = returns_to_go(data, 0.9, tails)
    for e, (start, end) in enumerate(zip(data.starts, data.ends, strict=True)):
        for row in range(start, end):
            expected = sum(0.9 ** (k - row) * data.rewards[k] for k in range(row, end))
            expected += 0 if data.terminals[end - 1] else 0.9 ** (end - row) * tails[e]
            assert found[row] == pytest.approx(expected, abs=1e-5)


def test_their_mean_over_all_states_against_a_loop_over_episodes():
    rewards = np.array([1, -2, 3, 4, 5, 6, -7], np.float32)  # episodes of 3, 1 and 3 steps
    ends, zeros = np.isin(np.arange(7), (2, 3, 6)), np.zeros((7, 1), np.float32)
    dataset = Dataset(zeros, zeros, zeros, rewards, rewards * 0, ends & False, ends)
    to_go = [sum(0.9**k * r for k, r in enumerate(episode[t:]))
             for episode in ([1, -2, 3], [4], [5, 6, -7]) for t in range(len(episode))]  # fmt: skip
    assert returns_to_go(dataset, 0.9).mean() == pytest.approx(np.mean(to_go), rel=1e-6)


def test_within_looks_ahead_and_not_into_the_next_episode():
    data = random_recordings(np.random.default_rng(2))
    for steps in (1, 3):
        found = recordings.within(data, steps)
        for row in range(len(data)):
            last = min(row + steps, data.ends[data.episode_index[row]])
            assert found[row] == any(data.costs[row:last])


# --- Figures, slider, exercises ---


@pytest.fixture
def three():
    """Three episodes of one step at (cost, return) = (0, 10), (40, 50), (60, 20), for two tasks."""
    data = of_points([(0, 10), (40, 50), (60, 20)])
    return {"BallCircle": data, "BallRun": data}


def labelled(ax, label):
    (found, *_) = [line for line in ax.lines if line.get_label() == label]
    return found.get_xydata()


def test_planes_show_every_episode_threshold_and_frontier(three):
    figure = figures.planes(three, frontier=True)
    assert [ax.get_title() for ax in figure.axes] == ["BallCircle", "BallRun"]
    for ax in figure.axes:
        assert labelled(ax, "episode").tolist() == [[0, 10], [40, 50], [60, 20]]
        assert [line.get_xdata()[0] for line in ax.lines if line.get_label() == "threshold"] == [30, 50, 70]
        stairs = dict(labelled(ax, "best episode left"))
        assert (stairs[0], stairs[20], stairs[40], stairs[80]) == (10, 10, 50, 50)
        assert dict(labelled(ax, "best mixture"))[20] == pytest.approx(30)
        assert len(labelled(ax, "DSRL's frontier, read off its plots")) > 2


def test_filtered_says_how_many_pass_and_how_good_the_best_is(three):
    figure = figures.filtered(three["BallCircle"], get_task("BallCircle"), 45)
    plane = figure.axes[0]
    assert plane.get_title() == "limit 45: 2 of 3 episodes pass, best 50"
    assert labelled(plane, "passes").tolist() == [[0, 10], [40, 50]]
    assert labelled(plane, "filtered out").tolist() == [[60, 20]]


def test_filtered_can_leave_nothing():
    figure = figures.filtered(of_points([(5, 1), (9, 2)]), get_task("BallCircle"), 3)
    assert figure.axes[0].get_title() == "limit 3: 0 of 2 episodes pass"


def test_visited_counts_every_step_and_marks_the_cost_zone():
    data = random_recordings(np.random.default_rng(3))
    figure = figures.visited({"CarCircle": data, "CarRun": data})
    after = 10 * data.next_observations[:, :2]  # metres, where the step's cost is decided
    for ax in figure.axes[:2]:
        assert ax.collections[0].get_array().sum() == len(data)
        assert ax.get_xlim() == pytest.approx((after[:, 0].min(), after[:, 0].max()))
    assert [line.get_xdata()[0] for line in figure.axes[0].lines] == [-6, 6]
    assert [line.get_ydata()[0] for line in figure.axes[1].lines] == [-2, 2]


def test_examples_left_has_a_bar_for_all_and_one_for_the_good(three):
    (ax,) = figures.examples_left({"BallCircle": three["BallCircle"]}).axes
    assert [bar.get_height() for bar in ax.patches] == [1, 2, 3, 1, 1, 1]


def test_figures_have_a_place_for_each_limit_of_a_task(three, monkeypatch):
    two = dataclasses.replace(get_task("BallCircle"), thresholds=(20, 45), limit_names=("low", "high"))
    monkeypatch.setitem(TASKS, "BallCircle", two)
    (ax,) = figures.examples_left({"BallCircle": three["BallCircle"]}).axes
    assert [bar.get_height() for bar in ax.patches] == [1, 2, 1, 1]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["20", "45"]
    (ax,) = figures.planes({"BallCircle": three["BallCircle"]}).axes
    assert [line.get_xdata()[0] for line in ax.lines if line.get_label() == "threshold"] == [20, 45]


def test_planes_of_a_task_without_a_frontier_leave_it_out(three, monkeypatch):
    monkeypatch.delitem(DSRL_FRONTIER, "BallCircle")
    (ax,) = figures.planes({"BallCircle": three["BallCircle"]}, frontier=True).axes
    assert not [line for line in ax.lines if line.get_label().startswith("DSRL")]
    assert dict(labelled(ax, "best episode left"))[40] == 50


def test_at_the_wall_counts_and_averages_per_bin():
    left, right = figures.at_the_wall(np.array([-1, -0.9, 0.2, 1.0]), np.array([0, 1, 1, 1]), bins=2).axes
    assert [bar.get_height() for bar in left.patches] == [2, 2]
    assert [bar.get_height() for bar in right.patches] == [0.5, 1]


def test_to_go_draws_both_lines():
    (ax,) = figures.to_go(np.arange(3), np.array([3, 2, 1]), np.array([4, 4, 4]), np.array([2, 2, 1])).axes
    assert labelled(ax, "the end: nothing follows")[:, 1].tolist() == [3, 2, 1]
    assert labelled(ax, "the end, as a fit without a clock sees it")[:, 1].tolist() == [2, 2, 1]
    assert labelled(ax, "a cut: the robot goes on at its rate")[:, 1].tolist() == [4, 4, 4]


def test_the_plane_by_hand_draws_the_staircase_and_the_mixtures():
    points = {"A": (0, 4), "B": (1, 2), "C": (2, 6), "E": (4, 12), "F": (6, 11)}
    (ax,) = figures.plane_by_hand(points, limit=3).axes
    stairs = dict(labelled(ax, "frontier: best episode within a limit"))
    mixed = dict(labelled(ax, "best mixture"))
    assert (stairs[1], stairs[2], stairs[3], stairs[5]) == (4, 6, 6, 12)
    assert (mixed[0], mixed[2], mixed[3], mixed[7]) == (4, 8, 10, 12)
    assert {text.get_text() for text in ax.texts} == set(points)


def test_by_source_has_a_panel_for_each_with_its_own_episodes(three):
    counts = {"priced-0": 1, "lagrangian-0": 2}
    left, right = figures.by_source(three["BallCircle"], counts, get_task("BallCircle")).axes
    assert left.lines[1].get_xydata().tolist() == [[0, 10]]
    assert right.lines[1].get_xydata().tolist() == [[40, 50], [60, 20]]
    assert right.get_title() == "lagrangian-0: 2 episodes"


def test_frontier_left_spans_the_draws_and_draws_the_computed_mean():
    left = {"at random": np.array([[0.2, 0.4], [0.8, 1.0]]), "evenly": np.array([0.9, 1.0])}
    (ax,) = figures.frontier_left(np.array([10, 100]), left, np.array([0.35, 0.9])).axes
    drawn, even = ax.containers
    assert drawn[0].get_xydata() == pytest.approx(np.array([[10, 0.3], [100, 0.9]]))
    assert even[0].get_ydata().tolist() == [0.9, 1.0]
    assert labelled(ax, "mean at random, computed")[:, 1].tolist() == [0.35, 0.9]


def test_every_figure_says_what_it_shows(three):
    data, task = three["BallCircle"], get_task("BallCircle")
    shown = [figures.planes(three, frontier=True), figures.filtered(data, task, 45), figures.visited(three)]
    shown += [figures.examples_left(three), figures.by_source(data, {"a": 3}, task)]
    shown += [figures.at_the_wall(np.array([-1, 1]), np.array([0, 1]))]
    assert all(figure.description for figure in shown)
    assert "2 of 3 episodes pass" in shown[1].description


def test_moving_the_slider_filters_anew(three, capsys):
    control = widgets.filter_slider(three["BallCircle"], get_task("BallCircle"), limit=30)
    (limit,) = control.kwargs_widgets
    assert control.result.axes[0].get_title() == "limit 30: 1 of 3 episodes pass, best 10"
    limit.value = 60
    assert control.result.axes[0].get_title() == "limit 60: 3 of 3 episodes pass, best 50"
    assert (limit.min, limit.max) == (0, 80)


def sums(values, terminals, timeouts):
    totals, total = [], 0.0
    for value, *flags in zip(values, terminals, timeouts, strict=True):
        total += value
        if any(flags):
            totals, total = [*totals, total], 0.0
    return np.array(totals)


def once(values, ends):
    return np.diff(np.cumsum(values)[ends], prepend=0.0)


def corners(costs, returns):
    """The frontier, by comparing every episode with every other one."""
    points = list(zip(costs, returns, strict=True))
    best = [(c, r) for c, r in points if not any(d <= c and s >= r and (d, s) != (c, r) for d, s in points)]
    return sorted(set(best))


def running_best(costs, returns, first=-np.inf):
    points, best = [], first
    for c, r in sorted(zip(costs, returns, strict=True), key=lambda point: (point[0], -point[1])):
        if r > best:
            points, best = [*points, (c, r)], r
    return points


def envelope(costs, returns):
    """The corners that some price chooses: not the whole frontier."""
    prices = np.linspace(0, 50, 2001)
    return {(costs[i], returns[i]) for i in (np.argmax(returns - price * costs) for price in prices)}


def faults(rows, tell_apart=True, flags=True, places=True):
    found = set()
    if flags and rows["terminals"].any():
        found |= {"flags"}
    ends = rows["terminals"] | rows["timeouts"] if tell_apart == "either" else rows["timeouts"]
    inner = np.flatnonzero(~ends[:-1]) if tell_apart else np.arange(len(ends) - 1)
    if any((rows["next_observations"][i] != rows["observations"][i + 1]).any() for i in inner):
        found |= {"order"}
    unsafe = np.abs(10 * rows["next_observations"][:, 0]) > 6
    if (rows["costs"] != unsafe).any() if places else (rows["costs"] > 1).any():
        found |= {"costs"}
    return found


def all_faults(rows):
    return faults(rows, "either")


def target(reward, gamma, next_value, terminal, timeout, bootstrap):
    return reward + gamma * next_value * (not terminal) * (bootstrap or not timeout)


@pytest.mark.parametrize(
    "checker, answer, said",
    [
        (checks.check_episode_sums, sums, "OK  sums is right"),
        (checks.check_episode_sums, lambda v, a, b: sums(v, a & b, a | b), "OK"),
        (checks.check_episode_sums, lambda v, a, b: sums(v, a, a), "row that is flagged"),
        (checks.check_episode_sums, lambda v, a, b: sums(v, b, b), "terminal ends"),
        (checks.check_episode_sums, lambda v, a, b: np.add.reduceat(v, [0, *np.flatnonzero(a | b)[:-1] + 1]),
         "unfinished tail"),
        (checks.check_episode_sums, lambda v, a, b: once(v, np.sort([*a.nonzero()[0], *b.nonzero()[0]])),
         "both flags ends one"),
        (checks.check_episode_sums, lambda v, a, b: once(v, np.flatnonzero(a + b)), "OK"),
        (checks.check_backup_target, target, "OK  target is right"),
        (checks.check_backup_target, lambda r, g, v, a, b, c: r if a or (b and not c) else r + g * v, "OK"),
        (checks.check_backup_target, lambda r, g, v, *flags: v, "r + gamma V"),
        (checks.check_backup_target, lambda r, g, v, *flags: max(r, v), "r + gamma V"),
        (checks.check_backup_target, lambda r, g, v, *flags: r * v, "r + gamma V"),
        (checks.check_backup_target, lambda r, g, v, *flags: r + v, "r + gamma V"),
        (checks.check_backup_target, lambda r, g, v, *flags: (1 - g) * r + g * v, "r + gamma V"),
        (checks.check_backup_target, lambda r, g, v, *flags: r + g * v, "after a terminal"),
        (checks.check_backup_target, lambda r, g, v, a, b, c: target(r, g, v, a, b, True), "stops at"),
        (checks.check_backup_target, lambda r, g, v, a, b, c: target(r, g, v, a or b, b, c), "looks through"),
        (checks.check_backup_target, lambda r, g, v, a, b, c: target(r, g, v, a and not b, b, c), "a fall"),
        (checks.check_backup_target, lambda *arguments: None, "returns nothing"),
        (checks.check_frontier, corners, "OK  corners is right"),
        (checks.check_frontier, running_best, "OK  running_best is right"),
        (checks.check_frontier, lambda c, r: np.array(corners(c, r))[::-1], "OK"),
        (checks.check_frontier, lambda c, r: set(corners(c, r)), "OK"),
        (checks.check_frontier, lambda c, r: [np.array(point) for point in corners(c, r)], "OK"),
        (checks.check_frontier, envelope, "although a mixture earns more"),
        (checks.check_frontier, lambda c, r: list(zip(c, r, strict=True)), "earns less"),
        (checks.check_frontier, lambda c, r: running_best(c, r, 0.0), "can be negative"),
        (checks.check_frontier, lambda c, r: [(c[i], r[i]) for i in range(len(c)) if all(r[i] > r[:i])],
         "any order"),
        (checks.check_frontier, lambda c, r: [(k, r[c <= k].max()) for k in np.unique(c)], "earns less"),
        (checks.check_frontier, lambda c, r: np.array(corners(c, r)).T, "expected"),
        (checks.check_frontier, lambda c, r: len(corners(c, r)), "expected"),
        (checks.check_frontier, lambda c, r: None, "returns nothing"),
        (checks.check_frontier, lambda c, r: c[99], "IndexError"),
        (checks.check_find_faults, all_faults, "OK  all_faults is right"),
        (checks.check_find_faults, lambda rows: sorted(all_faults(rows)), "OK"),
        (checks.check_find_faults, lambda rows: tuple(all_faults(rows)), "OK"),
        (checks.check_find_faults, lambda rows: faults(rows, False), "another episode"),
        (checks.check_find_faults, lambda rows: faults(rows, "either", flags=False), "cannot fall"),
        (checks.check_find_faults, lambda rows: faults(rows, "either", places=False), "look at the places"),
        (checks.check_find_faults, lambda rows: faults(rows), "found flags, order, expected flags"),
        (checks.check_find_faults, lambda rows: {"time limits"}, "the names are"),
        (checks.check_find_faults, lambda rows: "order", "recording 1: found order, expected no fault"),
        (checks.check_find_faults, lambda rows: 7, "no set of names"),
        (checks.check_find_faults, lambda rows: None, "empty set"),
        (checks.check_find_faults, lambda rows: rows["speed"], "KeyError"),
    ],
)  # fmt: skip
def test_exercises_tell_the_right_answer_from_each_mistake(checker, answer, said, capsys):
    checker(answer)
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("unsafe", [(12, 7), (1, 0)])
def test_the_recordings_of_the_exercise_are_what_the_reader_accepts_or_not(unsafe):
    """`c2iql data check` finds their faults; but no running total that is never above 1."""
    found = {}
    for fault in ((), ("flags",), ("order",), ("costs",)):
        rows = exercises.spoiled(exercises.small_recording(unsafe), *fault)
        report = Report(Path("recording.hdf5"))
        check_dataset(Dataset(**rows), get_task("BallCircle"), report)
        found[fault] = " ".join(report.errors + report.warnings)
    assert found[()] == ""
    assert "robot cannot fall" in found[("flags",)]
    assert "not the next row's observations" in found[("order",)]
    assert ("running totals" in found[("costs",)]) == (max(unsafe) > 1)


def test_a_spoiled_recording_leaves_the_good_one_as_it_is():
    good = exercises.small_recording()
    before = {key: values.copy() for key, values in good.items()}
    bad = exercises.spoiled(good, *exercises.RECORDING_FAULTS)
    assert all(np.array_equal(good[key], before[key]) for key in KEYS)
    assert bad["costs"].max() == 12 and bad["costs"][200] == 0  # the total begins anew in every episode
