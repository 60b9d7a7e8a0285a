"""The shortcut's figures and the tasks' pictures show what they are given."""

from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib.patches import Circle, Rectangle

from tutorial_lib.course import figures, tabular, widgets
from tutorial_lib.tasks import get_task


@pytest.fixture(autouse=True)
def without_a_screen():
    matplotlib.use("Agg")


def arrows(ax):
    """Lengths of the arrows, by the point where they start."""
    found = {}
    for text in ax.texts:
        if getattr(text, "arrow_patch", None) is not None:
            start, end = np.array(text.xyann), np.array(text.xy)
            found.setdefault(tuple(np.round(start).astype(int)), []).append((end - start).round(3).tolist())
    return found


def labelled(ax, label):
    (found,) = [line for line in ax.lines if line.get_label() == label]
    return found.get_xydata()


def test_all_eight_tasks_are_shown_with_a_ring_around_the_small_robots():
    figure = figures.all_tasks(size=(64, 48))
    assert len(figure.axes) == 8 and all(len(ax.images) == 1 for ax in figure.axes)
    pictures = [ax.images[0].get_array().tobytes() for ax in figure.axes]
    assert len(set(pictures)) == 8
    assert [ax.get_title() for ax in figure.axes] == ["Ball", "Car", "Drone", "Ant"] + [""] * 4
    assert [ax.get_ylabel() for ax in figure.axes] == ["Run", "", "", "", "Circle", "", "", ""]
    rings = [[patch for patch in ax.patches if isinstance(patch, Circle)] for ax in figure.axes]
    assert [len(ring) for ring in rings] == [0] * 4 + [1] * 4
    assert all(0 < x < 64 and 0 < y < 48 for (ring,) in rings[4:] for x, y in [ring.center])


def test_a_family_without_scenes_has_no_pictures():
    with pytest.raises(ValueError, match="no task of the family 'chess' has a scene"):
        figures.all_tasks(family="chess")


@pytest.mark.parametrize("name", ["BallCircle", "BallRun"])
def test_drives_show_each_way_and_its_unsafe_steps(name):
    way = np.stack([np.linspace(0, 9, 10), np.linspace(0, 3, 10)], 1)
    costs = np.abs(way[:, 0]) > 6 if name == "BallCircle" else np.arange(10) % 3 == 0
    drive = SimpleNamespace(positions=way, costs=costs.astype(float), rewards=np.ones(10))
    figure = figures.drives(get_task(name), {"one": drive, "two": drive})
    join = ": " if name == "BallRun" else "\n"  # a panel of a Circle is narrow
    titles = [f"{title}{join}cost {costs.sum()}, return 10" for title in ("one", "two")]
    assert [ax.get_title() for ax in figure.axes] == titles
    for ax in figure.axes:
        assert labelled(ax, "the robot's way") == pytest.approx(way)
        unsafe = [line.get_xydata() for line in ax.lines if line.get_label().startswith("unsafe")]
        assert sorted(np.vstack(unsafe)[:, 0]) == pytest.approx(way[costs, 0])


def test_the_trade_off_labels_its_dots():
    (ax,) = figures.trade_off([0, 5, 9], [1.0, 4.0, 2.0], ["a", "b", "c"], "title").axes
    assert ax.lines[0].get_xydata().tolist() == [[0, 1], [5, 4], [9, 2]]
    assert [(text.get_text(), *text.xy) for text in ax.texts] == [("a", 0, 1), ("b", 5, 4), ("c", 9, 2)]


def test_the_map_counts_steps_and_hazards():
    (ax,) = figures.shortcut_map().axes
    labels = [line.get_label() for line in ax.lines]
    assert labels == [
        "straight on: 4 steps, 3 on hazards",
        "over: 6 steps, 1 on hazards",
        "around: 8 steps, 0 on hazards",
    ]
    hazards = [patch for patch in ax.patches if isinstance(patch, Rectangle) and patch.get_hatch()]
    assert sorted((round(p.get_x() + 0.46), round(p.get_y() + 0.46)) for p in hazards) == [
        (1, 0), (2, 0), (2, 1), (3, 0),
    ]  # fmt: skip


def test_the_frontier_holds_the_limits_own_solution():
    found = tabular.solve(tabular.shortcut(), 1.4)
    figure = widgets.shortcut(1.4)
    left, right = figure.axes
    curve = labelled(left, "the best reward under each limit")
    assert np.interp(1.4, *curve.T) == pytest.approx(found.reward, abs=0.01)
    assert labelled(left, "limit")[0, 0] == 1.4
    assert left.get_title() == f"limit 1.4: reward {found.reward:.2f}, cost 1.40"
    start = arrows(right)[0, 0]
    assert len(start) == 2  # up or right
    assert start[0][1] == pytest.approx(0.1 + 0.34 * found.policy[10, 0], abs=1e-3)


def test_a_limit_that_no_policy_keeps_is_told():
    left, right = widgets.shortcut(0.0).axes
    assert left.get_title() == "limit 0: no policy keeps it"
    assert right.get_title() == f"the most timid one costs {tabular.least_cost(tabular.shortcut()):.3f}"
    assert arrows(right) == {}


def test_the_limits_slider_draws_anew(monkeypatch):
    shown = []
    monkeypatch.setattr("ipywidgets.widgets.interaction.display", shown.append)
    control = widgets.shortcut_slider(limit=1.0)
    control.kwargs_widgets[0].value = 0.0
    titles = [figure.axes[0].get_title().split(":")[0] for figure in shown]
    assert titles == ["limit 1", "limit 0"]
    assert repr(control) == "(Run the notebook for sliders: limit.)"


def test_bars_are_shares_split_at_the_limit():
    figure = figures.episode_costs({"one": np.array([0, 1, 1, 3]), "two": np.array([2, 2, 2, 2])}, 2)
    for ax, heights, mean in zip(figure.axes, ([0.25, 0.5, 0, 0.25], [0, 0, 1, 0]), (1.25, 2), strict=True):
        bars = sorted((bar.get_x() + bar.get_width() / 2, bar.get_height()) for bar in ax.patches)
        assert [height for _, height in bars] == heights
        assert len({bar.get_facecolor() for bar in ax.patches}) == 2
        assert labelled(ax, "mean cost")[0, 0] == mean


def test_the_paid_part_of_the_velocity_goes_clockwise_along_the_circle():
    figure = figures.circle_reward()
    (ax,) = figure.axes
    ((place, parts),) = arrows(ax).items()
    place, parts = np.array(place) / 1.0, sorted(map(np.array, parts), key=np.linalg.norm)
    (ball,) = [line.get_xydata()[0] for line in ax.lines if line.get_marker() == "o"]
    assert place == pytest.approx(ball, abs=0.5)
    other, paid, velocity = parts
    assert velocity == pytest.approx(other + paid, abs=0.01)
    assert paid @ ball == pytest.approx(0, abs=0.02)
    assert ball[1] * paid[0] - ball[0] * paid[1] > 0  # clockwise: what the reward pays for
    assert other @ ball == pytest.approx(np.linalg.norm(other) * np.linalg.norm(ball), rel=1e-3)
    assert "clockwise" in figure.alt_text()


def test_mixed_ways_join_neighbours_and_mark_the_mix():
    ways = {"dear": (3.0, 9.0), "free": (0.0, 1.0), "between": (1.0, 5.0)}
    (ax,) = figures.mixed_ways(ways, 2.0, (2.0, 7.0)).axes
    assert labelled(ax, "mixes of two neighbours").tolist() == [[0, 1], [1, 5], [3, 9]]
    assert labelled(ax, "the best mix that keeps the limit").tolist() == [[2, 7]]
    assert labelled(ax, "limit")[0, 0] == 2
    assert {text.get_text(): text.xy for text in ax.texts} == ways


@pytest.mark.parametrize("price", [0.2, 0.733, 1.5])
def test_a_price_is_the_slope_of_a_line_that_touches_the_frontier(price):
    figure = widgets.price(1.0, price)
    left, right = figure.axes
    line, frontier = labelled(left, "slope: the price"), labelled(left, "the best reward under each limit")
    (x0, y0), (x1, y1) = line
    assert (y1 - y0) / (x1 - x0) == pytest.approx(price)
    above = y0 + price * (frontier[:, 0] - x0) - frontier[:, 1]
    assert above.min() == pytest.approx(0, abs=2e-3)
    curve = labelled(right, "g(price)")
    assert np.interp(price, *curve.T) == pytest.approx(y0 + price * (1.0 - x0), abs=2e-3)
    best = tabular.solve(tabular.shortcut(), 1.0)
    assert curve[:, 1].min() == pytest.approx(best.reward)
    assert curve[curve[:, 1].argmin(), 0] == pytest.approx(best.price)


def test_limits_kept_tells_the_episodes_above_from_the_others():
    figure = figures.limits_kept((5, 30), [[4, 5, 9], [20, 31, 33]])
    (ax,) = figure.axes
    dots = {label: [] for label in ("episode that kept the limit", "episode that cost more", "mean")}
    for line in ax.lines:
        dots[line.get_label()] += line.get_ydata().tolist()
    assert dots == {
        "episode that kept the limit": [4, 5, 20],
        "episode that cost more": [9, 31, 33],
        "mean": [6, 28],
    }
    dashes = [segment[0, 1] for lines in ax.collections for segment in lines.get_segments()]
    assert dashes == [5, 30] and [tick.get_text() for tick in ax.get_xticklabels()] == ["5", "30"]
    assert "limit 5: mean 6.0, 1 above it; limit 30: mean 28.0, 2 above it" in figure.alt_text()
