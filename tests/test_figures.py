"""Do the figures show what they are given: as many lines, dots and pictures, and limits at their height?"""

import dataclasses
import io

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from tutorial_lib import style
from tutorial_lib.agents import C2IQL
from tutorial_lib.course import figures
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.playing import Rollout
from tutorial_lib.tasks import get_task

LIMITS = (30, 50, 70)


@pytest.fixture(autouse=True)
def without_a_screen():
    matplotlib.use("Agg")


@pytest.fixture(scope="module")
def agent():
    """Untrained: these tests look at pictures, not at skill."""
    return C2IQL(get_task("BallCircle"), C2IQL.configure(hidden_width=8, crm_width=8, crm_layers=1))


def played(task_name="BallCircle", episodes=3, cost_from=100):
    """Episodes that go once around a circle of radius 8 (Circle) or drift off to y = 4 (Run)."""
    task = get_task(task_name)
    time = np.linspace(0, 1, task.horizon)
    angle = 2 * np.pi * time
    way = (np.stack([20 * time, 4 * time], 1) if task.scene.is_wide
           else 8 * np.stack([np.cos(angle), np.sin(angle)], 1))  # fmt: skip
    shape = (task.horizon, episodes)
    costs = np.zeros(shape)
    costs[cost_from:] = 1
    lengths = np.full(episodes, task.horizon)
    positions = np.repeat(way[:, None], episodes, axis=1)
    return Rollout(np.ones(shape), costs, np.full(shape, 30.0), positions, lengths, np.zeros(episodes))


def results():
    return pd.DataFrame(
        {
            "task": "BallCircle", "algorithm": "C2IQL", "profile": "small", "seed": 0,
            "threshold": np.repeat(LIMITS, 4), "episode": np.tile(range(4), 3),
            "return": np.arange(12) * 50.0, "cost": np.repeat(LIMITS, 4) - 5.0,
            "predicted_cost": np.repeat(LIMITS, 4) - 3.0,
        }
    )  # fmt: skip


def labelled(ax, label):
    (found,) = [line for line in ax.lines if line.get_label() == label]
    return found


def test_a_figure_is_returned_closed_and_in_the_course_style_alone():
    before = dict(matplotlib.rcParams)
    figure = figures.paths(played(), get_task("BallCircle"), LIMITS)
    assert plt.get_fignums() == []
    assert dict(matplotlib.rcParams) == before
    assert figure.axes[0].xaxis.get_ticklabels()[0].get_fontsize() == style.STYLE["font.size"]


@pytest.mark.parametrize(
    "reader",
    ["dark_background", {"savefig.transparent": True}, {"savefig.dpi": 300}, {"text.usetex": True}],
    ids=str,
)
def test_a_figure_is_the_same_whatever_the_readers_style(reader):
    task, backend = get_task("BallCircle"), matplotlib.get_backend()
    expected = figures.budget(played(), task, LIMITS).small_png()
    with matplotlib.style.context(reader):
        drawn = figures.budget(played(), task, LIMITS).small_png()
        assert matplotlib.get_backend() == backend
    assert drawn == expected


def test_a_notebook_stores_a_figure_small_and_true():
    figure = figures.budget(played(), get_task("BallCircle"), LIMITS)
    whole = io.BytesIO()
    figure.savefig(whole, format="png", bbox_inches="tight")
    stored = figure.small_png()
    assert len(stored) < len(whole.getvalue()) / 2
    before, after = (
        np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), int) for png in (whole.getvalue(), stored)
    )
    assert before.shape == after.shape and np.abs(before - after).mean() < 1


def test_paths_has_a_panel_per_episode_and_marks_the_unsafe_steps():
    figure = figures.paths(played(cost_from=150), get_task("BallCircle"), LIMITS)
    assert [ax.get_title().split(":")[0] for ax in figure.axes] == ["limit 30", "limit 50", "limit 70"]
    for ax in figure.axes:
        assert "cost 50, return 200" in ax.get_title()
        unsafe = labelled(ax, "unsafe: outside").get_xydata()
        assert 0 < len(unsafe) < 50 and np.all(np.abs(unsafe[:, 0]) > 6)
        assert np.hypot(*labelled(ax, "where the reward is highest").get_xydata().T) == pytest.approx(7)
        assert sorted(patch.get_x() for patch in ax.patches) == [-6, 6]


def test_paths_of_a_run_tell_outside_from_too_fast():
    figure = figures.paths(played("BallRun", cost_from=20), get_task("BallRun"), LIMITS)
    outside = labelled(figure.axes[0], "unsafe: outside").get_xydata()
    too_fast = labelled(figure.axes[0], "unsafe: too fast").get_xydata()
    assert len(outside) + len(too_fast) == 80
    assert np.all(outside[:, 1] > 2) and np.all(too_fast[:, 1] <= 2)


def test_panels_of_a_wide_scene_stand_below_each_other_and_others_beside_each_other():
    places = {
        name: figures.paths(played(name), get_task(name), LIMITS).axes for name in ("CarRun", "CarCircle")
    }
    rows = {name: len({ax.get_subplotspec().rowspan.start for ax in axes}) for name, axes in places.items()}
    assert rows == {"CarRun": 3, "CarCircle": 1}
    assert [ax.get_aspect() for axes in places.values() for ax in axes] == ["auto"] * 3 + [1] * 3


def test_axes_from_above_hold_the_walls_and_the_farthest_of_all_panels():
    for name, least in (("BallRun", 3), ("BallCircle", 9)):
        near, far = (played(name, episodes=2) for _ in range(2))
        near.positions[:] *= 0.1
        far.positions[:, 0] *= 5
        assert figures.paths(near, get_task(name), (30, 50)).axes[0].get_ylim() == pytest.approx(
            (-least, least)
        )
        farthest = 1.1 * np.abs(far.positions[:, 0, 1:] if name == "BallRun" else far.positions[:, 0]).max()
        for ax in figures.paths(far, get_task(name), (30, 50)).axes:
            assert ax.get_ylim() == pytest.approx((-farthest, farthest))


def test_a_task_without_a_scene_has_no_picture_from_above():
    flat = dataclasses.replace(get_task("BallCircle"), scene=None)
    for draw in (figures.paths, figures.episode):
        with pytest.raises(ValueError, match="BallCircle has no scene"):
            draw(played(), flat, LIMITS if draw is figures.paths else 30)


def test_an_episode_that_ends_early_is_drawn_to_its_end():
    short = played()._replace(lengths=np.array([40, 200, 200]))
    figure = figures.paths(short, get_task("BallCircle"), LIMITS)
    ways = [labelled(ax, "the robot's way").get_xydata() for ax in figure.axes]
    assert [len(way) for way in ways] == [40, 200, 200]


def test_budget_draws_cost_limit_and_conditions():
    figure = figures.budget(played(), get_task("BallCircle"), LIMITS)
    assert len(figure.axes) == 6
    for ax, limit in zip(figure.axes[:3], LIMITS, strict=True):
        assert set(labelled(ax, "limit").get_ydata()) == {limit}
        spent = labelled(ax, "cost so far").get_ydata()
        assert (spent[0], spent[100], spent[-1]) == (0, 0, 100)
    for ax, limit in zip(figure.axes[3:], LIMITS, strict=True):
        assert set(labelled(ax, "threshold given").get_ydata()) == {30}
        wish = labelled(ax, "eq. 23: budget left, rescaled").get_ydata()
        assert wish[0] == limit and wish[50] == pytest.approx(limit * 200 / 150)  # 50 steps without a cost


def test_an_infinite_condition_has_a_place_and_a_name():
    told = np.full((200, 1), np.inf)
    figure = figures.budget(played(episodes=1)._replace(told=told), get_task("BallCircle"), [70])
    ax = figure.axes[1]
    assert set(labelled(ax, "threshold given").get_ydata()) == {120}
    assert ax.get_yticklabels()[-1].get_text() == "∞"


def test_episode_draws_the_one_asked_for():
    short = played()._replace(lengths=np.array([200, 60, 200]))
    figure = figures.episode(short, get_task("BallCircle"), 50, e=1)
    assert len(labelled(figure.axes[0], "the robot's way").get_xydata()) == 60
    assert set(labelled(figure.axes[1], "limit").get_ydata()) == {50}


def test_film_takes_a_picture_at_every_step_asked_for_and_counts_the_cost(agent):
    frames, costs = figures.film(agent, 30, seed=1, steps=[0, 3, 6], image_size=(64, 48))
    assert frames.shape == (3, 48, 64, 3) and frames.dtype == np.uint8
    assert costs.tolist() == [0, 0, 0]  # it starts on the inside
    assert not np.array_equal(frames[0], frames[2])


def test_film_shows_no_red_sphere_before_the_first_unsafe_step(agent):
    frames, _ = figures.film(agent, 30, seed=1, steps=[0, 5], image_size=(160, 120))
    red = (frames[..., 0] > 180) & (frames[..., 1] < 60) & (frames[..., 2] < 60)
    assert not red.any()


def test_multiple_exposure_keeps_the_scene_and_adds_every_frame():
    frames = np.full((5, 8, 8, 3), 200, np.uint8)
    for i in range(5):
        frames[i, i, 2] = 0
    picture = figures.multiple_exposure(frames)
    assert picture[7, 7].tolist() == [200] * 3
    shades = picture[range(5), 2, 0]
    assert shades[-1] == 0 and np.all(np.diff(shades.astype(int)) < 0)  # the older, the paler


def test_robot_at_limits_has_a_picture_per_limit(agent):
    figure = figures.robot_at_limits(agent, (30, 70), seed=1)
    assert [len(ax.images) for ax in figure.axes] == [1, 1]
    assert [ax.get_title() for ax in figure.axes] == ["at most 30 unsafe steps", "at most 70 unsafe steps"]


def test_frames_strip_says_step_and_cost():
    figure = figures.frames_strip(np.zeros((2, 6, 8, 3), np.uint8), [0.0, 7.0], [10, 90], 30)
    assert [ax.get_title() for ax in figure.axes] == ["step 10", "step 90"]
    assert figure.axes[1].get_xlabel() == "cost 7 of 30"


def test_learning_curves_draw_a_line_per_seed_from_log_or_file(tmp_path):
    log = [{"seed": s, "update": u, "policy_loss": 1.0 / u + s} for u in (10, 20, 30) for s in (0, 1)]
    path = tmp_path / "metrics.csv"
    pd.DataFrame(log).to_csv(path, index=False)
    for source in (log, path, str(path)):
        figure = figures.learning_curves(source, ["policy_loss"])
        (ax,) = figure.axes
        assert len(ax.lines) == 2
        assert ax.lines[1].get_xydata() == pytest.approx(np.array([[10, 1.1], [20, 1.05], [30, 1 + 1 / 30]]))


def test_learning_curves_hide_the_panels_that_are_left():
    log = [{"seed": 0, "update": 1, "a": 1.0, "b": 2.0, "c": 3.0, "d": 4.0}]
    figure = figures.learning_curves(log, ["a", "b", "c", "d"])
    assert [ax.get_visible() for ax in figure.axes] == [True] * 4 + [False] * 2


def test_cost_return_plane_has_a_dot_per_episode_and_a_line_per_threshold():
    task = get_task("BallCircle")
    zeros = np.zeros((6, 8), np.float32)
    ends = np.array([0, 0, 1, 0, 0, 1], bool)
    costs, rewards = np.array([1, 1, 0, 0, 0, 1], np.float32), np.arange(6, dtype=np.float32)
    dataset = Dataset(zeros, zeros, zeros[:, :2], rewards, costs, np.zeros(6, bool), ends)
    dots, *limits = figures.cost_return_plane(dataset, task).axes[0].lines
    assert dots.get_xydata().tolist() == [[2, 3], [1, 12]]
    assert [line.get_xdata()[0] for line in limits] == [30, 50, 70]


def test_outside_data_counts_the_critics_that_call_an_action_safe():
    grid = np.linspace(-1, 1, 5)
    estimates = np.array([[0, 0, 0, 9, 9.0], [0, 0, 0, 0, 9.0]])
    figure = figures.outside_data(grid, estimates, [0, 0, 5, 9, 9], [-0.5, 0.25], limit=4)
    left, right = figure.axes
    assert right.lines[0].get_ydata().tolist() == [1, 1, 1, 0.5, 0]
    assert right.lines[1].get_ydata().tolist() == [1, 1, 0, 0, 0]
    assert left.patches[0].get_x() == -0.5 and left.patches[0].get_width() == 0.75
    assert set(labelled(left, "limit").get_ydata()) == {4}


def test_ood_detector_marks_the_upper_quarter():
    known, random = np.geomspace(0.001, 0.1, 300), np.geomspace(0.01, 1, 100)
    figure = figures.ood_detector({"BallRun": (known, random)})
    line = labelled(figure.axes[0], "upper quarter: 'outside'").get_xdata()[0]
    assert ((known > line).sum() + (random > line).sum()) == 100


def test_values_are_drawn_where_they_are():
    figure = figures.against_truth([1.0, 2.0], {"a": [1.0, 2.0], "b": [0.5, 0.1]})
    assert labelled(figure.axes[0], "b").get_xydata().tolist() == [[1, 0.5], [2, 0.1]]
    figure = figures.values_by_state({"a": np.array([1.0, 5.0]), "b": np.array([2.0, 2.0])})
    assert figure.axes[0].lines[0].get_xydata().tolist() == [[0, 1], [1, 5]]
    assert figure.axes[0].get_ylim()[1] > 5.3
    figure = figures.cost_of_limits(np.array([1.0, 2.0]), {"a": [0.5, np.nan], "b": [4.0, 3.0]})
    assert labelled(figure.axes[0], "b").get_xydata().tolist() == [[1, 4], [2, 3]]
    assert figure.axes[0].get_ylim() == pytest.approx((0, 4.4))


def test_penalised_state_shows_a_mean_under_the_implicit_policy():
    """Three actions as frequent; at kappa 0.75 the safe good one weighs three times each of the others."""
    q, cost = [8.0, 2.0, -6.0], [5.0, 40.0, 60.0]
    figure = figures.penalised_state(q, cost, [1 / 3] * 3, limit=50, kappa=0.75)
    costs, worth, policy = figure.axes
    assert "= 5.2" in worth.get_title()  # (3 * 8 + 2 + 0) / 5: the unsafe one is lifted to zero
    bars = sorted((bar.get_x() + 0.25, bar.get_height()) for bar in policy.patches if bar.get_width() == 0.5)
    assert [height for _, height in bars] == pytest.approx([0.6, 0.2, 0.2])
    assert "$V_c$ = 23.0" in policy.get_title() and "35.0" in policy.get_title()
    everything = figures.penalised_state(q, cost, [1 / 3] * 3, limit=1, kappa=0.75)
    assert "$V_c$ = 35.0" in everything.axes[2].get_title()
    with pytest.raises(ValueError, match="kappa"):
        figures.penalised_state(q, cost, [1 / 3] * 3, limit=1, kappa=1.0)


def test_the_method_map_lights_the_parts_that_it_is_told():
    """A lit box has a coloured edge; the limit stands on the map twice, and the robot is never lit."""
    grey = figures.method_map().axes[0].patches
    edges = {box.get_edgecolor() for box in grey}
    assert len(grey) == 12 and len(edges) == 1
    for part, boxes in {"limit": 2, "value": 2, "heads": 1, "budget": 1}.items():
        lit = [box for box in figures.method_map(part).axes[0].patches if box.get_edgecolor() not in edges]
        assert len(lit) == boxes, part
    parts = "data critics value heads reconstruction penalty limit policy budget".split()
    everything = figures.method_map(*parts).axes[0].patches
    assert [box.get_edgecolor() in edges for box in everything] == [False] * 11 + [True]


def test_the_method_map_says_in_words_what_is_lit():
    assert figures.method_map("heads", "penalty").alt_text().endswith("Lit: heads, penalty.")
    assert figures.method_map().alt_text().endswith("Lit: no part.")
    with pytest.raises(ValueError, match=r"no part 'head'.*data, critics.*heads.*budget"):
        figures.method_map("head")


def test_no_letters_of_the_method_map_leave_their_box():
    ax = figures.method_map("data").axes[0]
    ax.figure.draw_without_rendering()
    shapes = {tuple(box.get_window_extent().get_points().mean(0).round()): box for box in ax.patches}
    inside = 0
    for text in ax.texts:
        here = text.get_window_extent()
        for box in shapes.values():
            frame = box.get_window_extent()
            if frame.contains(*here.get_points().mean(0)):
                inside += 1
                assert frame.x0 < here.x0 and here.x1 < frame.x1, text.get_text()
                assert frame.y0 < here.y0 and here.y1 < frame.y1, text.get_text()
    assert inside == len(ax.patches)


def test_a_figure_without_a_description_is_described_by_its_labels():
    figure, axes = style.subplots(1, 2)
    axes[0].plot([1], label="cost")
    axes[0].set(title="Left", xlabel="step", ylabel="cost so far")
    axes[1].set(xlabel="limit")
    assert figure.alt_text() == "Figure. Left; cost so far over step; cost. limit."
    assert style.described(figure, "A line\n  that rises.") is figure
    assert figure.alt_text() == "A line that rises."
    with pytest.raises(ValueError, match="empty"):
        style.described(figure, " ")
    plt.close(figure)


def test_a_notebook_stores_what_a_figure_shows(monkeypatch):
    shown = {}
    monkeypatch.setattr(style, "display", lambda data, **options: shown.update(options, data=data))
    figures.method_map("data")._ipython_display_()
    assert shown["metadata"]["image/png"]["alt"].endswith("Lit: data.")
    assert shown["data"].keys() == {"image/png", "text/plain"} and shown["raw"]


def test_among_many_systems_the_first_is_drawn_thick_and_all_are_named():
    parts = [results().assign(algorithm=f"system {n}") for n in range(14)]
    figure = figures.per_limit(pd.concat(parts))
    widths = [labelled(ax, f"system {n}").get_linewidth() for ax in figure.axes for n in range(14)]
    assert min(widths[0], widths[14]) > max(widths[1:14] + widths[15:])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()][:14] == [f"system {n}" for n in range(14)]
    assert "cost equals the limit" in figure.alt_text() and "system 13" in figure.alt_text()


def test_a_figure_of_a_study_that_was_not_run_says_so_in_words():
    empty = results()[:0]
    for draw in (figures.variants, figures.per_limit, figures.paid_and_earned, figures.against_paper):
        assert draw(empty).alt_text() == "Nothing is drawn, because the study was not run."
