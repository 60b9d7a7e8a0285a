"""The checkers and figures of notebook 12: right forms pass, and every likely mistake is told apart."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tutorial_lib.course import checks, figures


def in_a_loop(limit, bold, safe):
    spent = 0
    for fast, slow in zip(bold, safe, strict=True):
        spent += fast if spent < limit else slow
    return spent


def by_sums(limit, bold, safe):
    """The bold costs up to the step at which the limit is paid, and the safe ones from there on."""
    bold, safe = np.array(bold), np.array(safe)
    before = np.concatenate([[0], np.cumsum(bold)])[: len(bold)]
    fast = before < limit
    return np.where(fast, bold, safe).sum()


def by_recursion(limit, bold, safe):
    if not bold:
        return 0.0
    if limit > 0:
        return bold[0] + by_recursion(limit - bold[0], bold[1:], safe[1:])
    return float(sum(safe))


@pytest.mark.parametrize("answer", [in_a_loop, by_sums, by_recursion])
def test_every_form_of_the_switch_passes(answer, capsys):
    checks.check_switch(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is right in 8 cases\n"


def switch_if(asks, safe_pays=True):
    def answer(limit, bold, safe):
        spent = 0
        for t, (fast, slow) in enumerate(zip(bold, safe, strict=True)):
            spent += fast if asks(spent, limit, fast, t, len(bold)) else slow * safe_pays
        return spent

    return answer


@pytest.mark.parametrize(
    "answer, hint",
    [
        (switch_if(lambda spent, limit, fast, t, n: spent <= limit), "spent < limit"),
        (switch_if(lambda spent, limit, fast, t, n: spent + fast <= limit), "after a cost was paid"),
        (switch_if(lambda spent, limit, fast, t, n: spent < limit * (t + 1) / n), "does not spread"),
        (switch_if(lambda spent, limit, fast, t, n: spent < limit, safe_pays=False), "can also pay"),
        (lambda limit, bold, safe: min(in_a_loop(limit, bold, safe), limit), "can exceed the limit"),
        (lambda limit, bold, safe: sum(bold), "play it step by step"),
        (lambda limit, bold, safe: None, "returns nothing"),
        (lambda limit, bold, safe: "two", "raised ValueError"),
        (lambda limit, bold, safe: bold[9], "raised IndexError"),
    ],
)
def test_a_wrong_switch_gets_its_hint(answer, hint, capsys):
    checks.check_switch(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def test_the_rank_correlation_is_scipys():
    rng = np.random.default_rng(0)
    for size in (2, 3, 7, 30):
        for values in (4, 1000):  # with and without equal values
            told, paid = rng.integers(0, values, (2, size)).astype(float)
            told[0], told[1], paid[0], paid[1] = math.inf, 0, 1, 2
            expected = stats.spearmanr(told, paid).statistic
            assert checks.rank_correlation(told, paid) == pytest.approx(expected)
    assert math.isnan(checks.rank_correlation([0, 10, 25], [5, 5, 5]))


def by_pandas(told, paid):
    return pd.Series(told).corr(pd.Series(paid), method="spearman")


def by_ranks(told, paid):
    return np.corrcoef(stats.rankdata(told), stats.rankdata(paid))[0, 1]


@pytest.mark.parametrize("answer", [stats.spearmanr, by_pandas, by_ranks])
def test_every_form_of_the_rank_correlation_passes(answer, capsys):
    checks.check_obedience(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is right in 5 cases\n"


@pytest.mark.parametrize(
    "answer, hint",
    [
        (lambda told, paid: np.corrcoef(np.minimum(told, 120), paid)[0, 1], ": "),
        (lambda told, paid: np.mean(paid <= told), "how often the limit is kept"),
        (lambda told, paid: float(np.all(np.diff(paid) > 0)), "backwards"),
        (
            lambda told, paid: by_ranks(np.argsort(np.argsort(told)), np.argsort(np.argsort(paid))),
            "equal values",
        ),
        (lambda told, paid: stats.kendalltau(told, paid), ": "),
        (lambda told, paid: abs(by_ranks(told, paid)), "backwards"),
        (lambda told, paid: None, "returns nothing"),
        (lambda told, paid: told.missing, "raised AttributeError"),
    ],
)
def test_a_wrong_rank_correlation_gets_its_hint(answer, hint, capsys):
    checks.check_obedience(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


RIGHT = {"P": "network", "Q": "rule", "R": "neither", "S": "cannot say", "T": "not needed", "U": "rule"}


def test_the_verdicts_follow_from_the_reports():
    """By words of its own: kept means at most 10, 25 and 40."""

    def kept(paid):
        return all(cost <= limit for cost, limit in zip(paid, (10, 25, 40), strict=True))

    for name, report in checks.REPORTS.items():
        if not kept(report.ruled):
            verdict = "neither"
        elif report.throughout is None:
            verdict = "cannot say"
        elif report.infinity <= 10:
            verdict = "not needed"
        else:
            verdict = "network" if kept(report.throughout) else "rule"
        assert verdict == RIGHT[name]
    assert set(RIGHT.values()) == set(checks.VERDICTS)


@pytest.mark.parametrize("written", [str, str.upper, lambda word: f" {word} "])
def test_the_right_verdicts_pass(written, capsys):
    checks.check_verdicts({name: written(word) for name, word in RIGHT.items()})
    assert capsys.readouterr().out == "OK  all 6 verdicts\n"


@pytest.mark.parametrize(
    "name, wrong, hint",
    [
        ("P", "rule", "already keeps all three"),
        ("Q", "network", "whatever it is told"),
        ("R", "rule", "broken with the rule"),
        ("S", "rule", "control is missing"),
        ("T", "network", "told infinity it pays 5"),
        ("U", "network", "obeys backwards"),
        ("U", ..., "in place of the `...`"),
        ("U", None, "obeys backwards"),
    ],
)
def test_a_wrong_verdict_gets_its_hint(name, wrong, hint, capsys):
    checks.check_verdicts(RIGHT | {name: wrong})
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  {name}: ") and hint in said and said.count("\n") == 1


def test_no_dictionary_is_no_error(capsys):
    checks.check_verdicts(["rule"])
    checks.check_pairs(None)
    assert capsys.readouterr().out.count("NOT YET") == 2


PAIRS = {
    "what counting adds to the network": ("one limit throughout", "budget rule"),
    "what the covered rule adds": ("budget rule", "budget rule, covered"),
    "what the limits between 0 and infinity add to counting": ("switch", "budget rule"),
    "what C2IQL's training adds to cloning, if both count": ("cloning, budget rule", "budget rule"),
}


def test_every_question_has_one_pair():
    found = {question: [set(pair) for pair in pairs] for question, pairs in checks.right_pairs().items()}
    assert found == {question: [set(pair)] for question, pair in PAIRS.items()}


@pytest.mark.parametrize("form", [tuple, list, set, lambda pair: pair[::-1]])
def test_the_right_pairs_pass_in_every_order(form, capsys):
    checks.check_pairs({question: form(pair) for question, pair in PAIRS.items()})
    assert capsys.readouterr().out == "OK  all 4 pairs differ in one cause\n"


def test_every_other_pair_is_wrong(capsys):
    for question, right in PAIRS.items():
        for pair in itertools.combinations(checks.CONTROLS, 2):
            checks.check_pairs(PAIRS | {question: pair})
            said = capsys.readouterr().out
            assert said.startswith(
                "OK" if set(pair) == set(right) else f"NOT YET  {question}: these two differ"
            )


@pytest.mark.parametrize(
    "wrong, hint",
    [
        (("one limit throughout", "budget rule, covered"), "'counts' and 'covered'"),
        (("cloning", "budget rule"), "'network' and 'between 0 and infinity' and 'counts'"),
        (("budget rule", "budget rule"), "differ in nothing"),
        (("budget rule", "the rule"), "is no pair"),
        (("budget rule",), "is no pair"),
        (7, "is no pair"),
        ((..., ...), "in place of the `...`"),
        (..., "in place of the `...`"),
    ],
)
def test_a_wrong_pair_gets_its_hint(wrong, hint, capsys):
    question = "what counting adds to the network"
    checks.check_pairs(PAIRS | {question: wrong})
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  {question}: ") and hint in said and said.count("\n") == 1


def drawn(ax, name):
    (line,) = [line for line in ax.lines if line.get_label() == name]
    return line


def test_the_cost_so_far_has_every_agent_in_every_panel():
    figure = figures.cost_so_far(
        {"one": {"A": np.arange(4.0)}, "two": {"A": np.ones(4), "B": np.zeros(4)}}, 2
    )
    one, two = figure.axes
    assert drawn(one, "A").get_ydata().tolist() == [0, 1, 2, 3]
    assert drawn(one, "A").get_color() == drawn(two, "A").get_color() != drawn(two, "B").get_color()
    assert "one: A ends at 3.0" in figure.alt_text() and "limit 2" in figure.alt_text()


def test_paid_when_told_draws_a_dash_at_each_finite_limit():
    figure = figures.paid_when_told({"task": ((0, 30, np.inf), {"rule": np.array([1.0, 29, 60])})})
    (ax,) = figure.axes
    assert drawn(ax, "rule").get_ydata().tolist() == [1, 29, 60]
    (dashes,) = ax.collections
    assert [segment[0, 1] for segment in dashes.get_segments()] == [0, 30]
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["0", "30", "∞"]


def test_return_at_paid_is_sorted_by_what_was_paid():
    lines = {"backwards": (np.array([5.0, 1, 3]), np.array([50.0, 10, 30]))}
    figure = figures.return_at_paid({"task": lines}, best=([0, 6], [20, 60]))
    (ax,) = figure.axes
    assert drawn(ax, "backwards").get_xydata().tolist() == [[1, 10], [3, 30], [5, 50]]
    assert drawn(ax, "optimum at this cost").get_xydata().tolist() == [[0, 20], [6, 60]]
