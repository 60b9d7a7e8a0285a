"""The checkers and figures of notebook 10: right forms pass, and every likely mistake is told apart."""

import numpy as np
import pytest
import torch

from tutorial_lib.course import checks, figures
from tutorial_lib.course.figures import from_scratch


def mended(x, gammas):
    return ((x.cost[:, None] + gammas * x.v_c_next - x.q_c) ** 2).mean()


def summed(x, gammas):
    return (x.q_c - x.cost.unsqueeze(1) - gammas * x.v_c_next).square().sum(-1).mean()


def by_loop(x, gammas):
    heads = zip(gammas.tolist(), x.v_c_next.T, x.q_c.T, strict=True)
    return sum(((x.cost + g * follows - q) ** 2).mean() for g, follows, q in heads).item()


@pytest.mark.parametrize("answer", [mended, summed, by_loop])
def test_every_form_of_the_mended_loss_passes(answer, capsys):
    checks.check_mended_loss(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is the loss of line 18\n"


def error(x, gammas, follows=None, q=None):
    return (x.cost[:, None] + gammas * (x.v_c_next if follows is None else follows)) - (
        x.q_c if q is None else q
    )


@pytest.mark.parametrize(
    "answer, hint",
    [
        (lambda x, g: (x.weight[:, None] * error(x, g, x.v_c) ** 2).mean(), "two mistakes"),
        (lambda x, g: (error(x, g, x.v_c) ** 2).mean(), "the next state"),
        (lambda x, g: (error(x, g[1]) ** 2).mean(), "a discount factor of its own"),
        (lambda x, g: (error(x, g, q=x.q_c_target) ** 2).mean(), "target network"),
        (lambda x, g: (x.weight[:, None] * error(x, g) ** 2).mean(), "the weight M belongs to line 14"),
        (lambda x, g: (error(x, 1.0) ** 2).mean(), "the discount factors are missing"),
        (lambda x, g: error(x, g) ** 2, "a loss is one number"),
        (lambda x, g: error(x, g).abs().mean(), "it is not c + gamma_i V_c(s') - Q_c yet"),
        (lambda x, g: None, "returns nothing"),
        (lambda x, g: x.missing, "raised AttributeError"),
    ],
)
def test_a_wrong_loss_gets_its_hint(answer, hint, capsys):
    checks.check_mended_loss(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def weights(q_r, cost, limit, v_r, kappa):
    return np.where(np.where(cost <= limit, q_r, 0) < v_r, 1 - kappa, kappa)


def as_a_list(q_r, cost, limit, v_r, kappa):
    q = [r if c <= limit else 0 for r, c in zip(q_r, cost, strict=True)]
    return [abs(kappa - (x - v_r < 0)) for x in q]


def as_a_tensor(q_r, cost, limit, v_r, kappa):
    q = torch.tensor(q_r) * torch.tensor(cost <= limit)
    return abs(kappa - (q < v_r).double())


@pytest.mark.parametrize("answer", [weights, as_a_list, as_a_tensor])
def test_every_form_of_the_weights_passes(answer, capsys):
    checks.check_policy_weights(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is right in 6 cases\n"


@pytest.mark.parametrize(
    "answer, hint",
    [
        (lambda q, c, L, v, k: np.where(q < v, k, 1 - k), "kappa at and above V_r"),
        (lambda q, c, L, v, k: np.where(q < v, 1 - k, k), "it is worth 0"),
        (lambda q, c, L, v, k: weights(q, c, L - 1e-9, v, k), "exactly the limit"),
        (lambda q, c, L, v, k: weights(q, c, L, v, k) * (c <= L), "it is worth 0"),
        (
            lambda q, c, L, v, k: np.where((c <= L) & (q >= v), k, 1 - k),
            "there the unsafe action gets kappa",
        ),
        (lambda q, c, L, v, k: weights(q, c, L, v + 1e-9, k), "u = 0 counts as not below"),
        (lambda q, c, L, v, k: weights(q, c, L, v, k) / weights(q, c, L, v, k).sum(), "kappa at and above"),
        (lambda q, c, L, v, k: None, "returns nothing"),
    ],
)
def test_a_wrong_weight_gets_its_hint(answer, hint, capsys):
    checks.check_policy_weights(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def test_the_live_plot_is_drawn_in_the_place_of_the_last_one(monkeypatch):
    shown = []
    monkeypatch.setattr(from_scratch, "clear_output", lambda wait: shown.append(wait))
    monkeypatch.setattr(from_scratch, "display", shown.append)
    plot = figures.LivePlot((10, 30), updates=200)
    plot.add(100, [5, 6], [40, 41], [30, 31])
    plot.add(200, [7, 8], [20, 35], [25, 33])
    assert shown[0] is shown[2] is True and len(shown) == 4
    lines = [line for ax in shown[3].axes for line in ax.get_lines() if len(line.get_xdata()) == 2]
    drawn = [list(line.get_ydata()) for line in lines if list(line.get_xdata()) == [100, 200]]
    assert drawn == [[5, 7], [6, 8], [40, 20], [41, 35], [30, 25], [31, 33]]
    assert "limit 10: return 7, paid 20, predicted 25" in shown[3].alt_text()


def test_the_live_plot_refuses_what_it_cannot_draw():
    with pytest.raises(ValueError, match="at most 4"):
        figures.LivePlot(range(5), updates=10)
    with pytest.raises(ValueError, match="one number per limit"):
        figures.LivePlot((10, 30), updates=10).add(1, [1], [2], [3])


def test_the_broken_parts_are_marks_for_two_limits():
    measured = {"whole": [[500, 600], [10, 40]], "cloning": [[300, 300], [30, 30]]}
    figure = figures.broken_parts(measured, strict=10, loose=np.inf)
    marks = [
        line.get_xdata()[0] for ax in figure.axes for line in ax.get_lines() if line.get_marker() in "o^"
    ]
    assert marks == [500, 600, 300, 300, 10, 40, 30, 30]
    assert "cloning: return 300 and 300, paid 30 and 30" in figure.alt_text()
