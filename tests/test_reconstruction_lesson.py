"""Notebook 6's figures, slider and exercises: do they show and say what is the case?"""

import dataclasses

import matplotlib
import numpy as np
import pandas as pd
import pytest
import torch

from tutorial_lib.course import checks, figures, undiscounting, widgets
from tutorial_lib.tasks import TASKS

TASK = dataclasses.replace(TASKS["BallRun"], horizon=30, gammas=(0.8, 0.85, 0.9))
WEIGHTS = torch.tensor(undiscounting.flat_weights(TASK.gammas, 30), dtype=torch.float32)
MODELS = {"weighted": lambda x: x @ WEIGHTS, "nothing": lambda x: torch.zeros(len(x))}


@pytest.fixture(autouse=True)
def without_a_screen():
    matplotlib.use("Agg")


def labelled(ax, label):
    (found,) = [line for line in ax.lines if line.get_label() == label]
    return found


# --- Exercises ---


def flat_weights(gammas, horizon):
    return np.linalg.pinv(np.array(gammas)[None, :] ** np.arange(horizon)[:, None]) @ np.ones(horizon)


def error_in_cost(weights, error):
    independent = np.sqrt(sum((w * error) ** 2 for w in weights))
    return independent, sum(abs(w) * error for w in weights), abs(sum(w * error for w in weights))


@pytest.mark.parametrize(
    ("checker", "answer"),
    [(checks.check_flat_weights, flat_weights), (checks.check_error_in_cost, error_in_cost)],
)
def test_the_right_answer_passes_and_a_placeholder_does_not(checker, answer, capsys):
    checker(answer)
    assert capsys.readouterr().out.startswith(f"OK  {answer.__name__} is right in ")
    checker(lambda *arguments: None)
    assert "returns nothing" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("checker", "mistake", "hint"),
    [
        (checks.check_flat_weights, lambda g, T: np.ones(len(g)) / len(g), "exact"),
        (checks.check_flat_weights, lambda g, T: flat_weights(g, T + 1), "a weight of 1"),
        (checks.check_flat_weights, lambda g, T: flat_weights(g, min(T, 100)), "CarCircle: minimise"),
        (checks.check_error_in_cost, lambda w, e: error_in_cost(w, e)[::-1], "squares, sizes, values"),
        (checks.check_error_in_cost, lambda w, e: (e * 5, e * abs(w).sum(), e * abs(w.sum())), "the same"),
        (checks.check_error_in_cost, lambda w, e: (*error_in_cost(w, e)[:2], w.sum() * e), "values"),
    ],
)
def test_a_mistake_gets_its_hint(checker, mistake, hint, capsys):
    checker(mistake)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said


# --- Figures ---


def test_the_flat_curve_is_the_sum_of_its_parts():
    parts, whole = figures.flat_curve(WEIGHTS.numpy(), TASK.gammas, 30).axes
    curves = [line.get_ydata() for line in parts.lines if len(line.get_ydata()) == 90]
    assert len(curves) == 3
    assert curves[0][:2] == pytest.approx([WEIGHTS[0].item(), WEIGHTS[0].item() * 0.8])
    np.testing.assert_allclose(labelled(whole, "their sum").get_ydata(), np.sum(curves, 0), atol=1e-9)


def test_model_sizes_pick_the_rows_of_their_panel_and_line():
    rows = [
        {"size": size, "noise": a, "noise_rate": b, "test_noise": c, "test_noise_rate": d,
         "rmse_random": 1 + i + 10 * a + 100 * b + 1000 * c + 10_000 * d}
        for i, size in enumerate(("linear", "2 x 64"))
        for a, b in ((0.0, 0.0), (0.1, 0.0))
        for c, d in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.01))
    ]  # fmt: skip
    figure = figures.model_sizes(pd.DataFrame(rows), {"clean": (0.0, 0.0), "noisy": (0.1, 0.0)})
    for ax, offset in zip(figure.axes, (0, 100, 100), strict=True):
        assert list(labelled(ax, "clean").get_ydata()) == pytest.approx([1 + offset, 2 + offset])
        assert list(labelled(ax, "noisy").get_ydata()) == pytest.approx([2 + offset, 3 + offset])


def test_time_limits_have_a_bar_for_every_treatment_of_every_task():
    (ax,) = figures.time_limits({"A": {"x": 1.0, "y": 2.0}, "B": {"x": 3.0, "y": 4.0}}).axes
    assert [patch.get_height() for patch in ax.patches] == [1, 3, 2, 4]
    left = [patch.get_x() + patch.get_width() / 2 for patch in ax.patches]
    assert np.round(left) == pytest.approx([0, 1, 0, 1])


def test_settling_draws_each_model_and_the_truth():
    (ax,) = figures.settling([0, 10], {"a": [0, 5], "b": [0, 6]}, truth=7).axes
    assert [list(line.get_ydata()) for line in ax.lines] == [[0, 5], [0, 6], [7, 7]]


@pytest.mark.parametrize(("head", "error"), [(1, 0.3), (2, -0.2), (3, 1.0)])
def test_head_error_shows_what_models_answer_and_what_sequences_allow(head, error):
    cost = 12.0
    figure = figures.head_error(MODELS, TASK, head, error, cost)
    bars, answers = figure.axes
    heights = [patch.get_height() for patch in bars.patches]
    assert heights[head + 2] - heights[head - 1] == pytest.approx(error)
    right = np.array([sum(g**t * cost / 30 for t in range(30)) for g in TASK.gammas])
    line = labelled(answers, "weighted")
    at = dict(zip(line.get_xdata().round(3), line.get_ydata(), strict=True))
    expected = right @ WEIGHTS.numpy() + WEIGHTS[head - 1].item() * error
    assert at[error] == pytest.approx(expected, abs=1e-3)
    assert set(labelled(answers, "nothing").get_ydata()) == {0}
    (band,) = answers.patches
    low, width = band.get_x(), band.get_width()
    assert low < 0 < low + width
    assert (len(answers.collections) > 0) == (low < error < low + width)  # the bar of possible costs


def test_the_sliders_draw_another_picture():
    control = widgets.head_error_slider(MODELS, TASK, head=2, error=0.0)
    head, error = control.kwargs_widgets
    assert (head.min, head.max) == (1, 3)
    assert control.result.axes[0].get_title() == "head 2 off by +0.00"
    head.value, error.value = 3, -0.5
    assert control.result.axes[0].get_title() == "head 3 off by -0.50"
    assert repr(control) == "(Run the notebook for sliders: head and error.)"
