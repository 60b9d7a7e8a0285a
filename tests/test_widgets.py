"""A slider's callback is a plain function: another limit, another picture. Code shown is the library's."""

import io

import matplotlib
import numpy as np
import pytest

from tutorial_lib.agents import C2IQL
from tutorial_lib.course import widgets
from tutorial_lib.tasks import get_task


@pytest.fixture(scope="module")
def agent():
    matplotlib.use("Agg")
    config = C2IQL.configure(hidden_width=8, crm_width=8, crm_layers=1)
    return C2IQL(get_task("BallCircle"), config)


def pixels(figure):
    file = io.BytesIO()
    figure.savefig(file, format="rgba")
    return np.frombuffer(file.getvalue(), np.uint8)


def test_play_draws_the_episode_under_the_limit(agent):
    figure = widgets.play(agent, 40, 3)
    assert figure.axes[0].get_title().startswith("limit 40: cost ")


def test_the_same_numbers_give_the_same_picture_and_others_another(agent):
    first = pixels(widgets.play(agent, 40, 3))
    assert np.array_equal(pixels(widgets.play(agent, 40, 3)), first)
    assert not np.array_equal(pixels(widgets.play(agent, 60, 3)), first)
    assert not np.array_equal(pixels(widgets.play(agent, 40, 4)), first)


def test_moving_the_slider_draws_anew(agent, capsys):
    control = widgets.limit_slider(agent, limit=40, seed=3)
    limit, start = control.kwargs_widgets
    assert control.result.axes[0].get_title().startswith("limit 40:")
    limit.value = 60
    assert control.result.axes[0].get_title().startswith("limit 60:")
    assert (limit.min, limit.max, start.value) == (0, 80, 3)


def test_the_picture_is_displayed_and_not_only_made(agent, monkeypatch):
    shown = []
    monkeypatch.setattr("ipywidgets.widgets.interaction.display", shown.append)
    control = widgets.limit_slider(agent, limit=40, seed=3)
    control.kwargs_widgets[0].value = 60
    assert [figure.axes[0].get_title().split(":")[0] for figure in shown] == ["limit 40", "limit 60"]


def test_a_reader_without_a_kernel_is_told_what_is_missing(agent, capsys):
    assert repr(widgets.limit_slider(agent)) == "(Run the notebook for sliders: limit and start.)"


@pytest.mark.parametrize("lines", [(6, 8), (9, 10), (11, 12), (13, 14), (15, 16), (17, 18), (19, 20)])
def test_every_part_of_algorithm_2_can_be_shown(lines, capsys):
    widgets.print_lines(C2IQL.losses, *lines)
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith(f"# Lines {lines[0]}-{lines[1]}:")
    source = [line.strip() for line in widgets.inspect.getsource(C2IQL.losses).splitlines()]
    assert len(shown) > 1 and shown[-1] == "" and all(line.strip() in source for line in shown)
    assert not [line for line in shown[1:] if line.startswith("# Line")]


def test_penalty_sliders_draw_a_limit_and_an_expectile():
    control = widgets.penalty_sliders(limit=40, kappa=0.7)
    costs, worth, policy = control.result.axes
    assert set(costs.lines[0].get_ydata()) == {40}
    before = policy.get_title()
    limit, kappa = control.kwargs_widgets
    kappa.value = 0.95
    assert control.result.axes[2].get_title() != before
    limit.value = 6
    assert set(control.result.axes[0].lines[0].get_ydata()) == {6}
    assert repr(control) == "(Run the notebook for sliders: limit and kappa.)"


def test_lines_that_no_comment_names_are_an_error():
    with pytest.raises(ValueError, match="Lines 1-2"):
        widgets.print_lines(C2IQL.losses, 1, 2)


def test_sums_slider_draws_another_cost_and_number_of_sums():
    control = widgets.sums_slider(get_task("CarCircle"), cost=60, known=1)
    cost, known = control.kwargs_widgets

    def rows():
        return [label.get_text() for label in control.result.axes[0].get_yticklabels()]

    assert rows() == ["steady: 60", "1 sum, least: 21.0", "1 sum, most: 157.7"]
    known.value = 3
    assert rows() == ["steady: 60", "3 sums, least: 58.1", "3 sums, most: 62.3"]
    cost.value = 30
    assert rows()[0] == "steady: 30" and (known.min, known.max) == (1, 3)
    assert repr(control) == "(Run the notebook for sliders: unsafe steps and known sums.)"


def test_the_price_slider_draws_another_price_under_the_same_limit():
    control = widgets.price_slider(limit=1.0, start=0.2)
    bound = control.result.axes[1].get_title()
    assert control.result.axes[0].get_title() == "price 0.20" and bound.startswith("g(0.20) = ")
    control.kwargs_widgets[0].value = 1.5
    left, right = control.result.axes
    assert left.get_title() == "price 1.50" and right.get_title().split(", ")[1] == bound.split(", ")[1]
    assert repr(control) == "(Run the notebook for sliders: price.)"


def test_moving_kappa_moves_the_expectile():
    control = widgets.expectile_slider([0.1, 0.2, 0.3, 0.4], [0.0, 0.0, 0.0, 10.0], kappa=0.9)
    (kappa,) = control.kwargs_widgets
    assert control.result.axes[0].get_title() == "kappa = 0.9: V = 7.50"
    kappa.value = 0.5
    assert control.result.axes[0].get_title() == "kappa = 0.5: V = 2.50"
