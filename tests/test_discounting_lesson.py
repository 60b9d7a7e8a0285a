"""The figures, sliders and exercises of notebooks 5 and 6 on discounted sums."""

import dataclasses
import itertools
import math

import matplotlib
import numpy as np
import pytest

from tutorial_lib.course import checks, figures, widgets
from tutorial_lib.tasks import TASKS


@pytest.fixture(autouse=True)
def without_a_screen():
    matplotlib.use("Agg")


# --- Exercises ---

STEADY = sum(0.8**t * 0.3 for t in range(10))
"""L~ of 3 in 10 steps at gamma = 0.8."""


def verdict(checker, costs, capsys):
    checker(costs)
    said = capsys.readouterr().out
    assert said.count("\n") == 1
    return said


def test_every_sequence_of_ten_steps_gets_its_verdict(capsys):
    found = {"positive": 0, "negative": 0}
    for costs in itertools.product((0, 1), repeat=10):
        rejected = sum(0.8**t for t, c in enumerate(costs) if c) > STEADY
        positive, negative = sum(costs) <= 3 and rejected, sum(costs) > 3 and not rejected
        assert verdict(checks.check_false_positive, costs, capsys).startswith("OK") == positive
        assert verdict(checks.check_false_negative, list(costs), capsys).startswith("OK") == negative
        found["positive"] += positive
        found["negative"] += negative
    assert min(found.values()) > 5


@pytest.mark.parametrize(
    ("checker", "costs", "hint"),
    [
        (checks.check_false_positive, [1, 1, 1, 1, 0, 0, 0, 0, 0, 0], "more than the limit"),
        (checks.check_false_positive, [0, 0, 0, 0, 0, 0, 0, 1, 1, 1], "fall earlier"),
        (checks.check_false_negative, [0, 0, 0, 0, 0, 0, 0, 1, 1, 1], "within the limit"),
        (checks.check_false_negative, [1, 1, 1, 1, 0, 0, 0, 0, 0, 0], "fall later"),
        (checks.check_false_negative, ..., "no costs"),
        (checks.check_false_positive, None, "no costs"),
        (checks.check_false_positive, [1, 1], "there are 10 steps"),
        (checks.check_false_positive, [2] + [0] * 9, "0 or 1"),
        (checks.check_false_negative, "early", "no sequence"),
    ],
)
def test_a_wrong_sequence_gets_its_hint(checker, costs, hint, capsys):
    said = verdict(checker, costs, capsys)
    assert said.startswith("NOT YET  ") and hint in said


def extremes(horizon, gamma, limit):
    mark = sum(gamma**t * limit / horizon for t in range(horizon))
    fewest = next(k for k in range(horizon + 1) if sum(gamma**t for t in range(k)) > mark)
    late = [sum(gamma**t for t in range(horizon - k, horizon)) <= mark for k in range(horizon + 1)]
    return fewest, max(k for k, accepted in enumerate(late) if accepted)


def test_the_extremes(capsys):
    checks.check_extremes(extremes)
    assert capsys.readouterr().out == "OK  extremes is right in 4 cases\n"
    assert extremes(301, 0.99, 50) == (18, 144)  # which notebook 5 says


@pytest.mark.parametrize(
    "mistake",
    [
        lambda T, gamma, limit: extremes(T, gamma, limit)[::-1],
        lambda T, gamma, limit: (extremes(T, gamma, limit)[0] - 1, extremes(T, gamma, limit)[1]),
        lambda T, gamma, limit: (extremes(T, gamma, limit)[0], extremes(T, gamma, limit)[1] + 1),
        lambda T, gamma, limit: (limit, limit),
        lambda T, gamma, limit: None,
        lambda T, gamma, limit: 1 / 0,
    ],
)
def test_wrong_extremes_are_told(mistake, capsys):
    checks.check_extremes(mistake)
    assert capsys.readouterr().out.startswith("NOT YET  ")


def updates(gamma, tau, share):
    """By a loop, where the checker has a formula."""
    error, n = 1.0, 0
    while error > 1 - share + 1e-12:
        error, n = error - tau * (error - gamma * error), n + 1
    return n


@pytest.mark.parametrize("answer", [updates, lambda *case: float(updates(*case)),
    lambda gamma, tau, share: math.log(1 - share) / math.log(1 - tau * (1 - gamma))])  # fmt: skip
def test_every_form_of_the_number_of_updates_is_accepted(answer, capsys):
    checks.check_updates_until(answer)
    assert capsys.readouterr().out.endswith(" is right in 5 cases\n")


@pytest.mark.parametrize(
    ("mistake", "hint"),
    [
        (lambda gamma, tau, share: -math.log(1 - share) / (tau * (1 - gamma)), "the error halves"),
        (lambda gamma, tau, share: math.log(share) / math.log(1 - tau * (1 - gamma)), "the error halves"),
        (lambda gamma, tau, share: math.log(1 - share) / math.log(gamma), "= 0.99 at every update"),
        (lambda gamma, tau, share: math.log10(1 - share) / math.log(1 - tau * (1 - gamma)), "halves"),
        (lambda gamma, tau, share: None, "returns nothing"),
        (lambda gamma, tau, share: [1, 2], "[1, 2], expected 2"),
        (lambda gamma, tau, share: 1 / 0, "raised ZeroDivisionError"),
    ],
)
def test_a_wrong_number_of_updates_gets_its_hint(mistake, hint, capsys):
    checks.check_updates_until(mistake)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


# --- Figures ---


def test_timelines_show_every_unsafe_step_and_both_ratios():
    costs = np.array([[1, 0, 1, 0], [0, 0, 0, 1.0]])
    steps, bars = figures.timelines(costs, gamma=0.5, limit=1).axes[:2]
    drawn = [patch for patch in steps.patches if patch.get_width() == 1]
    assert [patch.get_x() for patch in drawn] == [0, 2, 3]
    assert drawn[0].get_facecolor()[3] > drawn[1].get_facecolor()[3] > drawn[2].get_facecolor()[3]
    widths = [patch.get_width() for patch in bars.patches]
    assert widths == pytest.approx([2, 1, 1.25 / 0.46875, 0.125 / 0.46875])


@pytest.mark.parametrize("gamma", [0.9, 0.99])
def test_falling_cost_marks_the_starts_at_which_the_discounted_limit_is_wrong(gamma):
    axes = figures.falling_cost(gamma, 30).axes
    lines = {line.get_label(): line for line in axes[1].lines}
    mark = sum(gamma**t * 50 / 301 for t in range(301))
    for length, label in ((40, figures.FALSE_POSITIVE), (60, figures.FALSE_NEGATIVE)):
        wrong = np.isfinite(lines[label].get_ydata())
        for start in range(0, 301 - length + 1, 7):
            rejected = sum(gamma**t for t in range(start, start + length)) > mark
            assert wrong[start] == (rejected == (length <= 50))


def test_mismatch_counts_and_colours_what_it_misjudges():
    cost, estimate = np.array([1, 4, 6, 9.0]), np.array([1, 5, 2, 9.0])
    figure = figures.mismatch({"first": (cost, estimate, 5, 4), "second": (cost, cost, 5, 5)})
    first, second = figure.axes
    assert [text.get_text() for text in first.texts] == ["25.0%", "25.0%"]
    assert [text.get_text() for text in second.texts] == ["0.0%", "0.0%"]
    at = {line.get_color(): line.get_xdata() for line in first.lines if len(line.get_xdata()) == 1}
    assert at[figures.REWARD] == [4] and at[figures.COST] == [6]


def test_misjudged_shares_stand_side_by_side_in_percent():
    counts = {"BallRun": {30: (0.1, 0.2), 50: (0.0, 0.3)}, "CarRun": {10: (0.4, 0.5)}}
    ball, car = figures.misjudged_shares(counts).axes
    assert [patch.get_height() for patch in ball.patches] == pytest.approx([10, 0, 20, 30])
    assert [patch.get_height() for patch in car.patches] == pytest.approx([40, 50])
    assert [label.get_text() for label in ball.get_xticklabels()] == ["30", "50"]


def test_eight_tasks_have_two_lines_of_panels():
    figure = figures.misjudged_shares({f"task {i}": {30: (0.1, 0.2)} for i in range(5)})
    assert len(figure.axes) == 8 and sum(ax.get_visible() for ax in figure.axes) == 5


def test_long_memory_has_a_line_per_name_and_a_dot_per_mark():
    gammas = np.array([0.9, 0.99, 0.999])
    figure = figures.long_memory(gammas, {"a": [0.3, 0.2, 0.1]}, [1e3, 1e4, 1e5], marked=(0.99,))
    left, right = figure.axes
    np.testing.assert_allclose(left.lines[0].get_ydata(), [30, 20, 10])
    np.testing.assert_allclose(left.lines[0].get_xdata(), [10, 100, 1000])
    assert right.lines[-1].get_xydata().ravel() == pytest.approx([100, 1e4])


def test_two_steps_end_at_the_least_and_the_largest_sum():
    figure = figures.two_steps(head=0.8, gamma=0.5)
    (ax,) = figure.axes
    dots = [tuple(line.get_xydata()[0]) for line in ax.lines if len(line.get_xdata()) == 1]
    assert dots == [pytest.approx((0.8, 0.0)), pytest.approx((0.3, 1.0))]
    assert "0.8 and 1.3" in figure.alt_text()


def test_extremal_sequences_are_drawn_with_their_costs():
    """On sums of one head, whose extremes are blocks at either end."""
    task = dataclasses.replace(TASKS["BallRun"], horizon=30, gammas=(0.8, 0.85, 0.9))
    (ax,) = figures.extremal_sequences(task, 12, [(0,)]).axes
    names = [label.get_text() for label in ax.get_yticklabels()]
    heights = -np.array([bar.get_height() for bar in ax.patches if bar.get_width() == 1]).reshape(3, 30) / 0.7
    assert names[0] == "steady: 12" and heights[0] == pytest.approx(np.full(30, 0.4))
    for row, word in ((1, "least"), (2, "most")):
        assert names[row] == f"1 sum, {word}: {heights[row].sum():.1f}"
        discounted = [sum(0.8**t * c for t, c in enumerate(costs)) for costs in (heights[0], heights[row])]
        assert discounted[0] == pytest.approx(discounted[1], abs=1e-6)
    assert heights[1].sum() < 12 < heights[2].sum() and heights[1][0] == heights[2][-1] == pytest.approx(1)


# --- The sliders ---


def test_the_sliders_draw_another_picture():
    control = widgets.when_it_falls(gamma=0.99, start=0)
    gamma, start = control.kwargs_widgets
    assert control.result.axes[0].get_title() == r"$\gamma$ = 0.99, both blocks start at step 0"
    gamma.value, start.value = 0.9, 120
    assert control.result.axes[0].get_title() == r"$\gamma$ = 0.9, both blocks start at step 120"
    assert repr(control) == "(Run the notebook for sliders: gamma and first unsafe step.)"
