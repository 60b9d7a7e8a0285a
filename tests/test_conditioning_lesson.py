"""The checkers and figures of notebook 9: every right form passes, and every likely mistake is told apart."""

import numpy as np
import pytest
import torch

from tutorial_lib import losses
from tutorial_lib.course import checks, figures

RIGHT = {"tie at the start": 30, "last step": 70, "overspent": 30, "limit zero": 30, "no limit": 70}


@pytest.mark.parametrize(
    "encode",
    [
        lambda threshold, scale: 1.5 if np.isinf(threshold) else threshold / scale,
        lambda threshold, scale: np.array([2.0 if threshold == np.inf else threshold / scale])[0],
        lambda threshold, scale: torch.tensor(min(threshold / scale, 1.25)),
        lambda threshold, scale: 2 * threshold / scale - 1 if threshold < np.inf else 3,
    ],
)
def test_every_code_of_order_one_passes(encode, capsys):
    checks.check_encoding(encode)
    assert capsys.readouterr().out.startswith("OK  ")


@pytest.mark.parametrize(
    "encode, hint",
    [
        (lambda threshold, scale: threshold / scale, "finite and of order one"),
        (lambda threshold, scale: 1000 if np.isinf(threshold) else threshold / scale, "order one"),
        (lambda threshold, scale: threshold, "order one"),
        (lambda threshold, scale: 1.0 if np.isinf(threshold) else threshold / scale, "infinity must be"),
        (lambda threshold, scale: 0.0 if np.isinf(threshold) else threshold / scale, "infinity must be"),
        (lambda threshold, scale: -1.5 if np.isinf(threshold) else -threshold / scale, "must rise"),
        (lambda threshold, scale: float("nan"), "finite"),
        (lambda threshold, scale: None, "returns nothing"),
        (lambda threshold, scale: "thirty", "raised ValueError"),
        (lambda threshold, scale: 1 / 0, "raised ZeroDivisionError"),
    ],
)
def test_a_code_that_networks_cannot_use_gets_its_hint(encode, hint, capsys):
    checks.check_encoding(encode)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


@pytest.mark.parametrize("number", [int, float, np.float32, lambda x: np.array(x), torch.tensor])
def test_the_right_corners_pass(number, capsys):
    checks.check_corners({corner: number(told) for corner, told in RIGHT.items()})
    assert capsys.readouterr().out == "OK  all 5 corners\n"


@pytest.mark.parametrize(
    "corner, wrong, hint",
    [
        ("tie at the start", 50, "equally near"),
        ("tie at the start", 40, "equally near"),
        ("last step", np.inf, "largest finite"),
        ("last step", 1000, "budget of 1000"),
        ("overspent", 0, "which is not 0"),
        ("overspent", -20, "nearest element is the smallest"),
        ("limit zero", 0, "no 0"),
        ("no limit", np.inf, "closest value is finite"),
        ("no limit", ..., "in place of the `...`"),
        ("no limit", "all", "closest value is finite"),
        ("no limit", None, "closest value is finite"),
    ],
)
def test_a_wrong_corner_gets_its_hint(corner, wrong, hint, capsys):
    checks.check_corners(RIGHT | {corner: wrong})
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  {corner}: ") and hint in said and said.count("\n") == 1


def test_no_dictionary_of_corners_is_no_error(capsys):
    checks.check_corners([30, 70])
    assert "NOT YET  tie at the start" in capsys.readouterr().out


def five(x, kappa_1, kappa_2, gamma, gammas):
    """By the library's losses, which the checker does not use."""
    q = losses.penalised_q(x.q_reward_target, x.episode_cost, x.limit)
    weight = losses.expectile_weight(q - x.v_reward, kappa_1)
    mask = torch.ones_like(x.reward)
    target = losses.td_target(x.reward, gamma, x.v_reward_next, mask)
    cost_target = losses.td_target(x.cost[:, None], gammas, x.v_cost_next, mask[:, None])
    return (
        losses.expectile_loss(q, x.v_reward, kappa_1),
        losses.cost_value_loss(weight, x.q_cost_target, x.v_cost),
        losses.td_loss(target, x.q_reward[None]),
        losses.td_loss(cost_target, x.q_cost[None]),
        losses.policy_loss(losses.expectile_weight(q - x.v_reward, kappa_2), x.log_prob),
    )


def summed_heads(*arguments):
    value, cost_value, critic, cost_critic, policy = five(*arguments)
    return [value, 3 * cost_value, critic, 3 * cost_critic, policy]


def as_numbers(*arguments):
    return np.array([float(loss) for loss in five(*arguments)])


def by_name(*arguments):
    return dict(zip("abcde", five(*arguments), strict=True))


@pytest.mark.parametrize("answer", [five, summed_heads, as_numbers, by_name])
def test_every_form_of_the_five_losses_passes(answer, capsys):
    checks.check_five_losses(answer)
    assert capsys.readouterr().out == "OK  all five losses of Algorithm 2\n"


def changed(**fields):
    """An answer that reads other fields of the batch than it should: {field: the field read in its place}."""

    def answer(x, *rest):
        y = type(x)(**vars(x))
        for name, other in fields.items():
            setattr(y, name, getattr(x, other))
        return five(y, *rest)

    return answer


def replaced(n, function):
    def answer(*arguments):
        found = list(five(*arguments))
        found[n] = function(*arguments, found[n])
        return found

    return answer


@pytest.mark.parametrize(
    "answer, hint",
    [
        (lambda x, k1, k2, g, gs: five(x, k2, k2, g, gs), "the other kappa"),
        (lambda x, k1, k2, g, gs: five(x, k1, k1, g, gs), "the other kappa"),
        (lambda x, k1, k2, g, gs: five(x, k1, k2, g, torch.full_like(gs, g)), "its own discount factor"),
        (changed(v_reward_next="v_reward"), "the value of the next state"),
        (changed(v_cost_next="v_cost"), "the value of the next state"),
        (lambda x, *rest: five(type(x)(**vars(x) | {"limit": x.limit * torch.inf}), *rest), "the penalty"),
        (replaced(1, lambda x, *rest: ((x.q_cost_target - x.v_cost) ** 2).mean()), "the weight M is missing"),
        (replaced(4, lambda *arguments: -arguments[-1]), "the minus is missing"),
        (replaced(2, lambda *arguments: 2 * arguments[-1]), "compare with its line"),
        (lambda *arguments: five(*arguments)[:4], "five numbers"),
        (lambda x, *rest: [x.reward] * 5, "five numbers"),
        (lambda *arguments: None, "returns nothing"),
        (lambda *arguments: 1 / 0, "raised ZeroDivisionError"),
        (lambda *arguments: 3.0, "raised TypeError"),
        (lambda *arguments: "five", "raised ValueError"),
    ],
)
def test_a_wrong_loss_gets_its_hint(answer, hint, capsys):
    checks.check_five_losses(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def test_no_losses_at_all_are_no_error(capsys):
    checks.check_five_losses(lambda *arguments: ())
    assert "five numbers" in capsys.readouterr().out


def test_best_moves_are_coloured_by_the_move():
    moves = np.array([[0, 1, 1], [0, 0, 3]])  # two steps, three budgets
    figure = figures.best_moves({"one": moves, "two": np.zeros((2, 3), int)}, (2,))
    colours = figure.axes[0].collections[0].get_array()
    assert np.asarray(colours).reshape(3, 2).tolist() == [[0, 0], [1, 0], [1, 2]]
    (line,) = figure.axes[0].lines
    assert line.get_xydata().tolist() == [[0, 2], [2, 0]]
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words == ["eq. 23 says the same limit", "best move ↑", "best move →", "best move ←"]


def test_recorded_budgets_show_the_median():
    figure = figures.recorded_budgets({"Task": np.array([[1.0, 2.0], [1.0, 0.0], [1.0, 1.5]])})
    (median,) = [line for line in figure.axes[0].lines if line.get_label() == "median"]
    assert median.get_ydata().tolist() == [1, 1.5]


def test_a_third_row_of_a_curve_is_a_third_panel():
    line = np.arange(3.0)
    figure = figures.against_optimum(line, {"a": (line, line, line / 4), "b": (line, line, line / 2)})
    share = figure.axes[2]
    assert share.get_title() == "share above the limit"
    assert [row.get_ydata().tolist() for row in share.lines] == [[0, 0.25, 0.5], [0, 0.5, 1]]
