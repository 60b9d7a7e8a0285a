"""The checkers of notebooks 13 and 14: right answers pass, each likely mistake is told apart; the sliders."""

import numpy as np
import pytest
from scipy import stats

from tutorial_lib.course import checks, widgets


def paired_interval(first, second):
    d = first - second
    half = stats.t.ppf(0.975, len(d) - 1) * np.sqrt(((d - d.mean()) ** 2).sum() / (len(d) - 1) / len(d))
    return np.array([d.mean() - half, d.mean() + half])


def normal_interval(first, second):
    d = first - second
    return np.array(
        [d.mean() - 1.96 * d.std(ddof=1) / len(d) ** 0.5, d.mean() + 1.96 * d.std() / len(d) ** 0.5]
    )


def best_safe(rewards, costs):
    safe = np.flatnonzero(costs <= 1)
    return int(safe[rewards[safe].argmax()]) if len(safe) else -1


def seed_spread(scores):
    by_limit = scores.groupby(["seed", "threshold"])["score"].mean()
    return by_limit.groupby("seed").mean().std()


def share_kept(costs, limits):
    return float(np.mean(costs <= limits))


CASES = [  # checker, right answer, wrong answers
    (checks.check_paired_interval, paired_interval, (normal_interval,)),
    (
        checks.check_best_safe,
        best_safe,
        (
            lambda r, c: int(r.argmax()),
            lambda r, c: int(np.where(c < 1, r, -9).argmax()),
            lambda r, c: int((r * (c <= 1)).argmax()) if (c <= 1).any() else -1,
        ),
    ),
    (
        checks.check_seed_spread,
        seed_spread,
        (
            lambda s: s["score"].std(),
            lambda s: s.groupby("seed")["score"].mean().std(ddof=0),
            lambda s: s.groupby("seed")["score"].mean().std(),
        ),
    ),
    (
        checks.check_share_kept,
        share_kept,
        (lambda c, limits: float((c / limits).mean() <= 1), lambda c, limits: float(np.mean(c < limits))),
    ),
]


@pytest.mark.parametrize(("checker", "right", "wrong"), CASES)
def test_a_checker_knows_right_from_wrong(checker, right, wrong, capsys):
    checker(right)
    assert capsys.readouterr().out.startswith("OK  ")
    for answer in (*wrong, lambda *args: ...):
        checker(answer)
        assert capsys.readouterr().out.startswith("NOT YET  ")


def test_the_sliders_draw_what_they_say():
    control = widgets.seeds_slider(seeds=3, spread=0.0)
    assert repr(control) == "(Run the notebook for sliders: seeds and spread.)"
    assert control.result.axes[1].get_title().startswith("unit: the seed.")
    control = widgets.checkpoint_slider(checkpoints=7, episodes=4)
    checkpoints, _ = control.kwargs_widgets
    assert len(control.result.axes[0].lines[0].get_xdata()) == 7
    checkpoints.value = 12
    assert len(control.result.axes[0].lines[0].get_xdata()) == 12
