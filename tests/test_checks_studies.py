"""The checkers of notebooks 13 and 14: right answers pass, each likely mistake is named; figures; sliders."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tutorial_lib.course import checks, figures, widgets


def paired_interval(first, second):
    d = first - second
    half = stats.t.ppf(0.975, len(d) - 1) * np.sqrt(((d - d.mean()) ** 2).sum() / (len(d) - 1) / len(d))
    return np.array([d.mean() - half, d.mean() + half])


def by_scipys_interval(first, second):
    d = first - second
    return stats.t.interval(0.95, len(d) - 1, d.mean(), stats.sem(d))


def by_scipys_test(first, second):
    found = stats.ttest_rel(first, second).confidence_interval()
    return found.low, found.high


def half_width(d, factor, ddof=1):
    return [d.mean() - factor * d.std(ddof=ddof), d.mean() + factor * d.std(ddof=ddof)]


def at_equal_cost(cost, earned, costs, earnings):
    """By a loop over the pieces of the line."""
    points = sorted(zip(costs, earnings, strict=True))
    for (left, low), (right, high) in zip(points, points[1:], strict=False):
        if left <= cost <= right:
            return earned - (low + (high - low) * (cost - left) / (right - left))
    return float("nan")


def extended(cost, earned, costs, earnings):
    order = np.argsort(costs)
    return earned - np.interp(cost, costs[order], earnings[order])


def best_safe(rewards, costs):
    safe = np.flatnonzero(costs <= 1)
    return int(safe[rewards[safe].argmax()]) if len(safe) else -1


def seed_spread(scores):
    by_limit = scores.groupby(["seed", "threshold"])["score"].mean()
    return by_limit.groupby("seed").mean().std()


def share_kept(costs, limits):
    return float(np.mean(costs <= limits))


def iqm(scores):
    """By a sorted list."""
    numbers = sorted(float(score) for row in scores for score in row)
    middle = numbers[len(numbers) // 4 : -(len(numbers) // 4)]
    return sum(middle) / len(middle)


def undominated(earned, paid):
    """By two loops."""
    stay = []
    for mine, price in zip(earned, paid, strict=True):
        better = [
            e >= mine and p <= price and (e > mine or p < price) for e, p in zip(earned, paid, strict=True)
        ]
        stay.append(not any(better))
    return stay


def matrix_undominated(earned, paid):
    weakly = (earned[:, None] >= earned) & (paid[:, None] <= paid)
    strictly = (earned[:, None] > earned) | (paid[:, None] < paid)
    return ~(weakly & strictly).any(axis=0)


RIGHT = [
    (checks.check_paired_interval, paired_interval),
    (checks.check_paired_interval, by_scipys_interval),
    (checks.check_paired_interval, by_scipys_test),
    (checks.check_at_equal_cost, at_equal_cost),
    (checks.check_at_equal_cost, lambda c, e, cs, es: np.array(at_equal_cost(c, e, cs, es))),
    (checks.check_best_safe, best_safe),
    (checks.check_seed_spread, seed_spread),
    (checks.check_share_kept, share_kept),
    (checks.check_share_kept, lambda c, limits: (c / limits <= 1).mean()),
    (checks.check_iqm, iqm),
    (checks.check_iqm, lambda x: stats.trim_mean(x, 0.25, axis=None)),
    (checks.check_iqm, lambda x: np.sort(np.ravel(x))[x.size // 4 : 3 * x.size // 4].mean()),
    (checks.check_undominated, undominated),
    (checks.check_undominated, matrix_undominated),
]


@pytest.mark.parametrize(("checker", "right"), RIGHT)
def test_every_right_form_passes(checker, right, capsys):
    checker(right)
    said = capsys.readouterr().out
    assert said.startswith("OK  ") and said.count("\n") == 1


WRONG = [  # checker, wrong answer, a part of its hint
    (checks.check_paired_interval, lambda x, y: half_width(x - y, 1.96 / len(x) ** 0.5), "1.96 is for many"),
    (
        checks.check_paired_interval,
        lambda x, y: half_width(x - y, stats.t.ppf(0.975, len(x) - 1) / len(x) ** 0.5, ddof=0),
        "divides by n - 1",
    ),
    (
        checks.check_paired_interval,
        lambda x, y: half_width(x - y, stats.t.ppf(0.95, len(x) - 1) / len(x) ** 0.5),
        "2.5% on each side",
    ),
    (
        checks.check_paired_interval,
        lambda x, y: half_width(x - y, stats.t.ppf(0.975, len(x) - 1)),
        "divide by sqrt(n)",
    ),
    (checks.check_paired_interval, lambda x, y: paired_interval(y, x), "in this order"),
    (
        checks.check_paired_interval,
        lambda x, y: stats.ttest_ind(x, y).confidence_interval(),
        "seed by seed",
    ),
    (checks.check_paired_interval, lambda x, y: x.mean() - y.mean(), "the pair (mean - half"),
    (checks.check_at_equal_cost, extended, "never paid this cost"),
    (checks.check_at_equal_cost, lambda c, e, cs, es: e - np.interp(c, cs, es), "sort the other"),
    (checks.check_at_equal_cost, lambda *x: -at_equal_cost(*x), "minus what the other one earned"),
    (
        checks.check_at_equal_cost,
        lambda c, e, cs, es: e - es[np.abs(cs - c).argmin()],
        "interpolate between",
    ),
    (checks.check_at_equal_cost, lambda c, e, cs, es: e - es.mean(), "halfway between"),
    (checks.check_best_safe, lambda r, c: int(r.argmax()), "does not count"),
    (checks.check_best_safe, lambda r, c: int(np.where(c < 1, r, -9).argmax()), "exactly 1"),
    (
        checks.check_best_safe,
        lambda r, c: int((r * (c <= 1)).argmax()) if (c <= 1).any() else -1,
        "not a zero",
    ),
    (checks.check_seed_spread, lambda s: s["score"].std(), "means 1 and 3"),
    (checks.check_seed_spread, lambda s: s.groupby("seed")["score"].mean().std(ddof=0), "n - 1"),
    (checks.check_seed_spread, lambda s: s.groupby("seed")["score"].mean().std(), "more episodes"),
    (checks.check_share_kept, lambda c, limits: float((c / limits).mean() <= 1), "limit 30 is broken"),
    (checks.check_share_kept, lambda c, limits: float(np.mean(c < limits)), "itself is kept"),
    (checks.check_share_kept, lambda c, limits: float(np.mean((c <= limits).all(1))), "limit 30 is broken"),
    (checks.check_iqm, np.mean, "this is the mean"),
    (checks.check_iqm, lambda x: np.median(x), "median"),
    (checks.check_iqm, lambda x: stats.trim_mean(x, 0.25, axis=1).mean(), "not task by task"),
    (checks.check_iqm, lambda x: stats.trim_mean(x, 0.1, axis=None), "this is the mean"),
    (checks.check_iqm, lambda x: np.sort(x, axis=None)[x.size // 4 :].mean(), "upper end"),
    (checks.check_iqm, lambda x: np.ravel(x)[x.size // 4 : 3 * x.size // 4].mean(), "*sorted*"),
    (
        checks.check_undominated,
        lambda e, p: (p <= 1) & (e == e[p <= 1].max(initial=-np.inf)),
        "pays less may earn less",
    ),
    (
        checks.check_undominated,
        lambda e, p: ~((e[:, None] > e) & (p[:, None] < p)).any(0),
        "better in the other",
    ),
    (
        checks.check_undominated,
        lambda e, p: ~((e[:, None] >= e) & (p[:, None] <= p) & ~np.eye(len(e), dtype=bool)).any(0),
        "do not drop each other",
    ),
    (checks.check_undominated, lambda e, p: p <= 1, "earns more than the third"),
    (checks.check_undominated, lambda e, p: ~matrix_undominated(e, p), "earns more than the third"),
]
CHECKERS = dict.fromkeys(checker for checker, _ in RIGHT)


@pytest.mark.parametrize(("checker", "wrong", "hint"), WRONG)
def test_every_likely_mistake_is_named(checker, wrong, hint, capsys):
    checker(wrong)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


@pytest.mark.parametrize("checker", CHECKERS)
@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda *args: ..., "NOT YET"),
        (lambda *args: None, "returns nothing"),
        (lambda *args: 1 / 0, "raised ZeroDivisionError"),
        (lambda *args: "much", "NOT YET"),
    ],
)
def test_what_is_no_answer_is_no_error(checker, answer, said, capsys):
    checker(answer)
    out = capsys.readouterr().out
    assert out.startswith("NOT YET  ") and said in out


HIDDEN = [[0.60, -0.10], [0.62, -0.12], [0.58, -0.08]]


@pytest.mark.parametrize("table", [HIDDEN, np.array(HIDDEN), [row[::-1] for row in HIDDEN] + [[-0.11, 0.6]]])
def test_a_mean_that_hides_a_contradiction_passes(table, capsys):
    checks.check_hidden_by_the_mean(table)
    assert capsys.readouterr().out.startswith("OK  the mean agrees")


@pytest.mark.parametrize(
    ("table", "hint"),
    [
        ([[0.1, 0.2], [0.1, 0.3], [0.2, 0.2]], "no limit contradicts"),
        ([[0.1, -0.4], [0.1, -0.5], [0.2, -0.6]], "the mean over limits contradicts"),
        ([[0.3, -0.2], [-0.1, -0.3], [0.9, -0.2]], "the mean over limits is undecided"),
        (HIDDEN[:2], "three seeds"),
        ([[0.1], [0.1], [0.1]], "column per limit"),
        (..., "write a table"),
        ([[0.1, np.nan]] * 3, "write a table"),
        ("mean", "write a table"),
    ],
)
def test_a_mean_that_hides_nothing_gets_its_hint(table, hint, capsys):
    checks.check_hidden_by_the_mean(table)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said


def test_the_sliders_draw_what_they_say():
    control = widgets.seeds_slider(seeds=3, spread=0.0)
    assert repr(control) == "(Run the notebook for sliders: seeds and spread.)"
    assert control.result.axes[1].get_title().startswith("unit: the seed.")
    control = widgets.checkpoint_slider(checkpoints=7, episodes=4)
    checkpoints, _ = control.kwargs_widgets
    assert len(control.result.axes[0].lines[0].get_xdata()) == 7
    checkpoints.value = 12
    assert len(control.result.axes[0].lines[0].get_xdata()) == 12


# --- The figures of the two notebooks ---


def episodes(names=("C2IQL", "Later"), paid=(0.5, 0.9), task="CarCircle"):
    """Two seeds, two limits and one episode each: system n pays `paid[n]` limits and returns 100 n more."""
    rows = [
        {"task": task, "algorithm": name, "seed": seed, "threshold": limit, "episode": 0}
        | {"return": 200.0 + 100 * n + limit, "cost": paid[n] * limit + seed, "profile": "small"}
        | {"length": 300, "predicted_cost": 1.0, "updates": 1}
        for n, name in enumerate(names)
        for seed in (0, 2)
        for limit in (30, 70)
    ]
    return pd.DataFrame(rows)


def labelled(ax, label):
    return [line for line in ax.lines if line.get_label() == label]


def test_paid_and_earned_has_the_paid_cost_on_its_axis():
    (ax,) = figures.paid_and_earned(episodes()).axes
    (line,) = labelled(ax, "Later")
    assert list(line.get_xdata()) == pytest.approx([0.9 * 30 + 1, 0.9 * 70 + 1])
    assert len(labelled(ax, "a limit")) == 2
    assert figures.paid_and_earned(episodes()).alt_text().startswith("Normalised return over the cost paid")


def test_differences_are_filled_where_their_interval_excludes_zero():
    row = {"task": "CarCircle", "pair": "A - B"}
    scores = {"reward_score": 0.2, "reward_score_low": 0.1, "reward_score_high": 0.3}
    scores |= {"cost_score": -0.1, "cost_score_low": -0.3, "cost_score_high": 0.1}
    rows = pd.DataFrame([row | {"limit": limit} | scores for limit in (30, 70, "mean")])
    left, right = figures.differences(rows).axes
    for ax, style in ((left, "full"), (right, "none")):
        marks = labelled(ax, "limit 30") + labelled(ax, "limit 70") + labelled(ax, "mean over limits")
        assert [mark.get_fillstyle() for mark in marks] == [style] * 3
    assert labelled(left, "limit 70")[0].get_xdata() == [0.2]


def test_spread_ratios_has_a_mark_for_each_task_and_limit():
    index = pd.MultiIndex.from_product([["BallRun", "CarRun"], [10, 20]], names=["task", "threshold"])
    (ax,) = figures.spread_ratios(pd.Series([1.0, 2.0, 4.0, np.nan], index)).axes
    assert [mark.get_ydata()[0] for mark in labelled(ax, "small limit")] == [1.0, 4.0]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["BallRun", "CarRun"]


def test_aggregates_mark_systems_that_lack_tasks():
    rows = [
        {"system": name, "limit": limit, "value": 0.5, "low": 0.4, "high": 0.6, "tasks": tasks}
        for name, tasks in (("C2IQL", 8), ("Later", 7))
        for limit in ("small limit", "high limit")
    ]
    figure = figures.aggregates(pd.DataFrame(rows))
    assert [ax.get_title() for ax in figure.axes] == ["small limit", "high limit"]
    assert [line.get_fillstyle() for line in figure.axes[0].lines[1::2]] == ["full", "none"]


def test_profiles_draw_a_line_for_each_system():
    grid = np.linspace(0, 1, 5)
    curves = {"kept": ("cost", grid, {"C2IQL": grid, "Later": 1 - grid})}
    figure = figures.profiles(episodes(), curves)
    (ax,) = figure.axes
    assert list(labelled(ax, "Later")[0].get_ydata()) == list(1 - grid)
    (legend,) = figure.legends
    assert [entry.get_text() for entry in legend.get_texts()] == ["C2IQL", "Later"]


@pytest.mark.parametrize(
    "draw", [figures.paid_and_earned, figures.differences, figures.spread_ratios, figures.aggregates]
)
def test_without_rows_a_figure_says_that_nothing_was_run(draw):
    (ax,) = draw(pd.DataFrame(columns=["task"])).axes
    assert ax.texts[0].get_text() == "not run: no results to draw"
