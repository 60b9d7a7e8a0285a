"""The checkers and figures of notebook 8: every right form passes, and every likely mistake is told apart."""

import numpy as np
import pytest
import torch

from tutorial_lib.course import checks, figures, widgets


def priced_q(q_reward, q_cost, v_cost, limit, price):
    return q_reward - price * (np.maximum(q_cost - limit, 0) - np.maximum(v_cost[..., None] - limit, 0))


def by_loop(q_reward, q_cost, v_cost, limit, price):
    return [
        [r - price * (max(c - limit, 0) - max(v - limit, 0)) for r, c in zip(*rows, strict=True)]
        for *rows, v in zip(q_reward, q_cost, v_cost, strict=True)
    ]


def by_torch(*arguments):
    q_r, q_c, v_c = map(torch.tensor, arguments[:3])
    excess = (q_c - arguments[3]).clamp(min=0) - (v_c[:, None] - arguments[3]).clamp(min=0)
    return q_r - arguments[4] * excess


@pytest.mark.parametrize("answer", [priced_q, by_loop, by_torch])
def test_every_form_of_the_priced_value_passes(answer, capsys):
    checks.check_priced_q(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is right in 5 cases\n"


@pytest.mark.parametrize(
    "answer, hint",
    [
        (lambda r, c, v, L, p: np.where(c <= L, r, 0), "it keeps its Q_r"),
        (lambda r, c, v, L, p: r - p * (c - L), "nothing is paid"),
        (lambda r, c, v, L, p: r - p * np.maximum(c - L, 0), "what the state pays in any case"),
        (lambda r, c, v, L, p: r + p * np.maximum(c - L, 0), "it keeps its Q_r"),
        (lambda r, c, v, L, p: r - p * (np.maximum(c - L, 0) - np.maximum(v.mean() - L, 0)), "V_c is (S,)"),
        (lambda r, c, v, L, p: None, "returns nothing"),
        (lambda r, c, v, L, p: 1 / 0, "raised ZeroDivisionError"),
    ],
)
def test_a_wrong_priced_value_gets_its_hint(answer, hint, capsys):
    checks.check_priced_q(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


@pytest.mark.parametrize(
    "trap",
    [
        ([-5, -9], [10, 90], 30),
        ((-1.0, -2.0, -3.0), (0.0, 50.0, 20.0), 25.0),
        (np.array([-5, -9]), np.array([30, 31]), np.array(30)),
        (torch.tensor([-5.0, -9.0]), torch.tensor([10.0, 90.0]), torch.tensor(30.0)),
    ],
    ids=str,
)
def test_every_sign_trap_passes(trap, capsys):
    checks.check_sign_trap(*trap)
    assert capsys.readouterr().out.startswith("OK  eq. 11 prefers an unsafe action")


def test_a_sign_trap_is_told_what_it_costs(capsys):
    """With mu even and kappa 0.9, the better of two actions has 0.9 of the implicit policy."""
    checks.check_sign_trap([-5, -9], [10, 90], 30)
    assert "mu even: 50; cost of pi_imp with kappa 0.9: 82" in capsys.readouterr().out


@pytest.mark.parametrize(
    "answer, hint",
    [
        ((..., ..., ...), "in place of the `...`"),
        (([-5, -9], [10, 90], ...), "in place of the `...`"),
        (([5, 1], [10, 90], 30), "Q_r > 0"),
        (([0, -1], [10, 90], 30), "Q_r = 0"),
        (([-9, -5], [10, 90], 30), "even without a penalty"),
        (([-5, -9], [10, 20], 30), "nothing is penalised"),
        (([-5, -9], [40, 90], 30), "another trap"),
        (([-5], [10], 30), "two actions"),
        (([-5, -9], [10], 30), "a number per action"),
        (([-5, -9], [-10, 90], 30), "not negative"),
        (([-5, np.nan], [10, 90], 30), "finite"),
        (("ab", "cd", 30), "lists of numbers"),
        ((None, [1, 2], 30), "a number per action"),
    ],
    ids=str,
)
def test_what_is_no_sign_trap_gets_its_hint(answer, hint, capsys):
    checks.check_sign_trap(*answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def test_flips_are_coloured_by_the_verdict():
    figure = figures.flips({"one": [4.0, 6.0, 4.5], "two": [5.0, 5.1, 7.0]}, limit=5)
    marks = {line.get_label(): list(line.get_ydata()) for line in figure.axes[0].lines}
    assert marks["called safe"] == [4, 4.5] and marks["called unsafe"] == [6]
    marks = {line.get_label(): list(line.get_ydata()) for line in figure.axes[1].lines}
    assert marks["called safe"] == [5] and marks["called unsafe"] == [5.1, 7]


def test_a_priced_state_ranks_its_unsafe_actions():
    """Beyond the limit 50, 10 and 20 unsafe steps at a price of 2: Q of 8, 2 - 20 and -6 - 40."""
    figure = figures.penalised_state([8, 2, -6], [5, 60, 70], [1 / 3] * 3, limit=50, kappa=0.5, price=2.0)
    dashes = [line for line in figure.axes[1].lines if line.get_marker() == "_"]
    assert [y for line in dashes for y in line.get_ydata()] == [-18, -46]
    assert "the limit 50" in figure.alt_text()


def test_the_price_slider_draws_another_price():
    control = widgets.charge_sliders(limit=20, price=2.0)
    limit, price = control.kwargs_widgets
    before = control.result.axes[2].get_title()
    price.value = 5.0
    assert control.result.axes[2].get_title() != before
    limit.value = 60  # all seven actions keep it, so the price does not matter
    loose = control.result.axes[2].get_title()
    price.value = 0.0
    assert control.result.axes[2].get_title() == loose
    assert repr(control) == "(Run the notebook for sliders: limit and price.)"
