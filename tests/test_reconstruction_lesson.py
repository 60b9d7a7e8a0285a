"""The exercises of notebooks 6 and 7 and the figures of reconstruction: do they say what is the case?"""

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


def one_sum_bounds(head, gamma, horizon):
    """By linear programmes, where the checker fills the steps."""
    return undiscounting.cost_bounds([head], [gamma], horizon)


def steady_head(rate, gamma, horizon, step, treatment):
    steps = {"bootstrap": np.inf, "rate": horizon, "mask": horizon - step}[treatment]
    return rate * (1 - gamma**steps) / (1 - gamma)


ANSWERS = {
    checks.check_flat_weights: flat_weights,
    checks.check_error_in_cost: error_in_cost,
    checks.check_one_sum_bounds: one_sum_bounds,
    checks.check_steady_head: steady_head,
}


@pytest.mark.parametrize(("checker", "answer"), ANSWERS.items())
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
        (checks.check_error_in_cost, lambda w, e: (e * w, 1.0, 2.0), "3 parts with different shapes"),
        (checks.check_flat_weights, lambda g, T: lstsq(g, T), "4 parts with different shapes"),
        (checks.check_flat_weights, lambda g, T: flat_weights(g, T)[:, None], "an array of shape (1, 1)"),
        (checks.check_one_sum_bounds, lambda *case: one_sum_bounds(*case)[::-1], "takes the rest"),
        (checks.check_one_sum_bounds, lambda *case: tuple(np.ceil(one_sum_bounds(*case))), "takes the rest"),
        (checks.check_one_sum_bounds, lambda head, g, T: (head, head / g ** (T - 1)), "from the end"),
        (checks.check_steady_head, lambda r, g, T, t, kind: steady_head(r, g, T, t, "rate"), "= 2"),
        (
            checks.check_steady_head,
            lambda r, g, T, t, kind: steady_head(r, g, T, 0, kind),
            "one step is left",
        ),
        (checks.check_steady_head, lambda r, g, T, t, kind: r / (1 - g), "first two steps alone"),
        (checks.check_steady_head, lambda *case: 1 / 0, "raised ZeroDivisionError"),
    ],
)
def test_a_mistake_gets_its_hint(checker, mistake, hint, capsys):
    checker(mistake)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def lstsq(gammas, horizon):
    return np.linalg.lstsq(np.power.outer(gammas, np.arange(horizon)).T, np.ones(horizon))


@pytest.mark.parametrize("form", [list, tuple, lambda w: torch.tensor(w, requires_grad=True)])
def test_weights_may_be_a_list_a_tuple_or_a_tensor(form, capsys):
    checks.check_flat_weights(lambda gammas, horizon: form(flat_weights(gammas, horizon)))
    assert capsys.readouterr().out.startswith("OK  ")


@pytest.mark.parametrize("letters", ["CEF", "c, e, f", ["C", "E", "F"], {"F", "E", "C"}])
def test_the_situations_that_fail(letters, capsys):
    """Each heads' weighted sum by hand: only C, E and F are off by more than 6."""
    steady, weights = np.array([19.018, 25.102, 31.108]), np.array([8.267, -21.074, 13.875])
    assert abs(weights @ (steady * 1.05) - 60) < 6 < abs(weights @ (steady * (1, 1.05, 1)) - 60)
    assert abs(weights @ (0.2 / np.array([0.01, 0.007, 0.005])) - 60) > 6
    checks.check_linear_failures(letters)
    assert capsys.readouterr().out == "OK  all 8 situations are judged right\n"


@pytest.mark.parametrize(
    ("letters", "hint"),
    [
        ("", "C fails"), ("CEFH", "H does not fail: the weighted sum of a mean"), ("ACEF", "A does not fail"),
        ("CEFD", "D does not fail"), ("CEFG", "G does not fail"), ("CE", "F fails: each head is nearly"),
        (..., "no letters"), (None, "no letters"), ("CEX", "X is none of"), (True, "True is none of"),
    ],
)  # fmt: skip
def test_a_wrong_situation_is_told_with_its_reason(letters, hint, capsys):
    checks.check_linear_failures(letters)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


ALGORITHM_1 = """
def algorithm_1(net, gammas, recorded, draw, steps, noise):
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-3)
    x, y = sums(recorded, gammas)
    for _ in range(steps):
        rows = torch.randint(len(x), (64,))
        x_drawn, y_drawn = sums(draw(64), gammas)
        inputs, truth = torch.cat([x[rows], x_drawn]), torch.cat([y[rows], y_drawn])
        noisy = inputs + noise * torch.randn_like(inputs)
        loss = (net(noisy) - truth).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
"""


def sums(costs, gammas):
    heads = [sum(gamma**t * costs[:, t] for t in range(costs.shape[1])) for gamma in gammas]
    return torch.tensor(np.stack(heads, 1)).float(), torch.tensor(costs.sum(1)).float()


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("", "", "OK  algorithm_1 trains on recordings and random sequences, with noise on its inputs"),
        (".square().mean()", ".square().sum() / 9", "OK  "),
        ("inputs + noise * torch.randn_like(inputs)", "inputs", "add the noise to the inputs"),
        ("torch.cat([x[rows], x_drawn]), torch.cat([y[rows], y_drawn])", "x[rows], y[rows]", "random"),
        (
            "torch.cat([x[rows], x_drawn]), torch.cat([y[rows], y_drawn])",
            "x_drawn, y_drawn",
            "the recordings",
        ),
        (
            "        x_drawn, y_drawn = sums(draw(64), gammas)",
            "        x_drawn, y_drawn = x, y",
            "never draws",
        ),
        ("        optimiser.step()", "", "leaves the network as it was"),
        ("net(noisy) - truth", "net(noisy)[:, None] - truth", "has not learnt"),
        ("optimiser.zero_grad()", "1 / 0", "raised ZeroDivisionError"),
    ],
)
def test_algorithm_1_is_told_what_it_lacks(right, wrong, said, capsys):
    names = {"torch": torch, "sums": sums}
    assert right in ALGORITHM_1
    exec(ALGORITHM_1.replace(right, wrong) if right else ALGORITHM_1, names)
    checks.check_algorithm_1(names["algorithm_1"])
    printed = capsys.readouterr().out
    assert said in printed and printed.count("\n") == 1
    assert printed.startswith("OK") == said.startswith("OK")


# --- Figures ---


def test_the_flat_curve_is_the_sum_of_its_parts():
    parts, whole = figures.flat_curve(WEIGHTS.numpy(), TASK.gammas, 30).axes
    curves = [line.get_ydata() for line in parts.lines if len(line.get_ydata()) == 90]
    assert len(curves) == 3
    assert curves[0][:2] == pytest.approx([WEIGHTS[0].item(), WEIGHTS[0].item() * 0.8])
    np.testing.assert_allclose(labelled(whole, "their sum").get_ydata(), np.sum(curves, 0), atol=1e-9)


def test_weight_curves_have_a_line_per_name_and_mark_what_lies_beyond_the_limit():
    figure = figures.weight_curves({"a": np.linspace(2, 0, 40), "b": np.ones(40)}, horizon=30)
    (ax,) = figure.axes
    assert list(labelled(ax, "a").get_ydata()) == list(np.linspace(2, 0, 40))
    (band,) = ax.patches
    assert (band.get_x(), band.get_width()) == (30, 10)
    assert "b: from 1.00 to 1.00" in figure.alt_text()
    assert not figures.weight_curves({"a": np.ones(30)}, horizon=30).axes[0].patches


def test_table_2_draws_its_curves_over_the_noise():
    (ax,) = figures.table2([0.0, 0.1, 4.0], {"paper": [1, 2, 3], "ours": [4, 5, 6]}).axes
    assert [list(line.get_ydata()) for line in ax.lines] == [[1, 2, 3], [4, 5, 6]]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["0", "0.1", "4"]


def test_met_by_critics_has_a_panel_per_model_with_every_state_in_it():
    answers = {"far": np.array([-500.0, 10, 20]), "near": np.array([50.0, 50, 60])}
    far, near = figures.met_by_critics(answers, truth=55).axes
    for ax, mean in ((far, "-157"), (near, "53")):
        assert sum(bar.get_height() for bar in ax.patches) == 3
        assert set(ax.lines[0].get_xdata()) == {55} and f"mean {mean}" in ax.get_title()


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
        assert list(labelled(ax, "trained on clean").get_ydata()) == pytest.approx([1 + offset, 2 + offset])
        assert list(labelled(ax, "trained on noisy").get_ydata()) == pytest.approx([2 + offset, 3 + offset])


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
