"""Checks print what they found and fail loudly where it is wrong; checkers of exercises say what is wrong."""

import configparser
import importlib
import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
import torch

from tutorial_lib.course import checks
from tutorial_lib.tasks import get_task

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def test_check_prints_what_was_found_with_one_digit_more_than_the_tolerance(capsys):
    checks.check("mismatch rate", 0.23713, 0.23, 0.02)
    assert capsys.readouterr().out == "OK  mismatch rate: found 0.237, expected 0.23 +/- 0.02\n"
    checks.check("steps", 1234.5, 1200, 50)
    assert capsys.readouterr().out == "OK  steps: found 1234, expected 1200 +/- 50\n"


def test_the_comparison_of_outputs_passes_over_what_was_found(capsys):
    rules = configparser.ConfigParser(interpolation=None)
    rules.read(Path(__file__).with_name("sanitize.cfg"))
    rule = rules["the value that a check found"]
    for found in (0.2371, 0.2412):
        checks.check("mismatch rate", found, 0.23, 0.02)
    checks.check("mismatch rate", 0.2371, 0.23, 0.03)
    one, other, stricter = (
        re.sub(rule["regex"], rule["replace"], line) for line in capsys.readouterr().out.splitlines()
    )
    assert one == other != stricter


def test_check_prints_no_tolerance_where_there_is_none(capsys):
    checks.check("heads", 3, 3)
    assert capsys.readouterr().out == "OK  heads = 3\n"


def test_check_takes_arrays(capsys):
    checks.check("weights", np.array([0.1, 0.9]), [0.1, 0.9], 1e-6)
    assert capsys.readouterr().out == (
        "OK  weights: found [0.1000000, 0.9000000], expected [0.1, 0.9] +/- 1e-06\n"
    )
    checks.check("all equal", np.array([2.0, 2.01]), 2, 0.02)


@pytest.mark.parametrize("value", [0.26, 0.2, np.nan, np.inf])
def test_check_fails_with_the_value(value):
    with pytest.raises(AssertionError, match=r"FAILED  rate = .*expected 0.23 \+/- 0.02"):
        checks.check("rate", value, 0.23, 0.02)


def test_one_wrong_element_fails():
    with pytest.raises(AssertionError):
        checks.check("weights", [0.1, 0.9, 0.5], [0.1, 0.9, 0.6], 0.01)


def test_an_array_does_not_broadcast_against_what_is_expected():
    with pytest.raises(AssertionError, match="shape"):
        checks.check("values", np.ones((2, 1)), np.ones(2))


def test_check_at_most(capsys):
    checks.check_at_most("cost", 28.4, 30)
    assert capsys.readouterr().out == "OK  cost: found 28, expected at most 30\n"
    for value in (30.1, np.nan):
        with pytest.raises(AssertionError, match="at most 30"):
            checks.check_at_most("cost", value, 30)


def test_check_that(capsys):
    checks.check_that("it holds", [True, True])
    checks.check_that("it holds", torch.tensor(True))
    assert capsys.readouterr().out == "OK  it holds\n" * 2
    with pytest.raises(AssertionError, match="1 of 3 cases"):
        checks.check_that("it holds", np.array([True, False, True]))
    with pytest.raises(AssertionError, match="FAILED  it holds: it does not$"):
        checks.check_that("it holds", False)


def test_the_set_up_is_checked(capsys):
    checks.check_setup()
    assert capsys.readouterr().out.count("OK  ") == 3


def test_a_missing_package_is_found(monkeypatch):
    monkeypatch.setattr(checks.start, "PACKAGES", ("numpy", "no-such-package"))
    with pytest.raises(AssertionError, match="all packages are installed"):
        checks.check_setup()


# --- Exercises: the right answer passes, and every likely mistake is told apart ---


def keeps_limit(costs, limit):
    return np.mean(costs) <= limit


def normalised_return(total, task):
    return (total - task.min_return) / (task.max_return - task.min_return)


def run_cost(y, speed, speed_limit):
    return float(abs(y) > 2 or speed > speed_limit)


def least_cost(cmdp):
    """By value iteration, where the checker uses a linear programme."""
    v = np.zeros(len(cmdp.initial))
    for _ in range(600):
        v = (cmdp.costs + cmdp.gamma * cmdp.transitions @ v).min(axis=1)
    return cmdp.initial @ v


def best_for_price(cmdp, price):
    """By value iteration."""
    v = np.zeros(len(cmdp.initial))
    for _ in range(600):
        v = (cmdp.rewards - price * cmdp.costs + cmdp.gamma * cmdp.transitions @ v).max(axis=1)
    return cmdp.initial @ v


def without_start(cmdp, sweeps=300):
    """One value for each state."""
    v = np.zeros(len(cmdp.initial))
    for _ in range(sweeps):
        v = (cmdp.costs + cmdp.gamma * cmdp.transitions @ v).min(axis=1)
    return v


def implicit_policy(mu, q, v, slope):
    u = np.where(q == v, 1e-6, q - v)
    return mu * np.abs(slope(u) / u) / (mu * np.abs(slope(u) / u)).sum(-1, keepdims=True)


def batched_loss(weight, q_cost, value):
    return torch.mean(weight * torch.square(q_cost.squeeze(-1) - value))


def one_sum_for_all(mu, q, v, slope):
    u = np.where(q == v, 1e-6, q - v)
    return mu * np.abs(slope(u) / u) / (mu * np.abs(slope(u) / u)).sum()


def unnormalised(mu, q, v, slope):
    return mu * slope(q - v) / (q - v)


def at_zero(mu, q, v, slope):
    with np.errstate(invalid="ignore"):
        ratio = np.nan_to_num(slope(q - v) / (q - v))
    return mu * ratio / (mu * ratio).sum()


def rescaled_budget(limit, spent, t, horizon):
    return (limit - spent) / (1 - t / horizon)


def budget_backup(cmdp, then, dearest=0):
    """As a loop over everything."""
    now = np.zeros_like(then)
    for b, s in np.ndindex(now.shape):
        found = []
        for a, cost in enumerate(cmdp.costs[s].astype(int)):
            if cost <= b:
                after = then[max(b - cost, 0)] if not dearest else then[b]
                found.append(cmdp.rewards[s, a] + cmdp.transitions[s, a] @ after)
        now[b, s] = max(found, default=0)
    return now


ANSWERS = {
    checks.check_run_cost: run_cost,
    checks.check_least_cost: least_cost,
    checks.check_best_for_price: best_for_price,
    checks.check_implicit_policy: implicit_policy,
    checks.check_batched_loss: batched_loss,
    checks.check_rescaled_budget: rescaled_budget,
    checks.check_budget_backup: budget_backup,
    checks.check_keeps_limit: keeps_limit,
    checks.check_normalised_return: normalised_return,
}
MISTAKES = [
    (checks.check_run_cost, lambda y, speed, limit: float(y > 2 or speed > limit), "two walls"),
    (checks.check_run_cost, lambda y, speed, limit: float(abs(y) > 2) + float(speed > limit), "1 at most"),
    (checks.check_run_cost, lambda y, speed, limit: float(abs(y) >= 2 or speed >= limit), "still safe"),
    (checks.check_run_cost, lambda y, speed, limit: float(abs(y) > 2 or speed > 2.5), "speed_limit"),
    (checks.check_least_cost, lambda cmdp: cmdp.initial @ cmdp.costs.min(1), "at every step"),
    (checks.check_least_cost, lambda cmdp: cmdp.initial @ cmdp.costs.min(1) / (1 - cmdp.gamma), "look ahead"),
    (checks.check_least_cost, lambda cmdp: least_cost(cmdp) / cmdp.initial.max(), "cmdp.initial"),
    (checks.check_least_cost, without_start, "it returns 2 numbers: average V over the start"),
    (checks.check_least_cost, lambda cmdp: without_start(cmdp).min(), "cmdp.initial"),
    (checks.check_least_cost, lambda cmdp: cmdp.initial @ without_start(cmdp, 40), "Iterate longer"),
    (checks.check_best_for_price, lambda cmdp, price: best_for_price(cmdp, 0), "worth 2 - 0.5 * 1"),
    (checks.check_best_for_price, lambda cmdp, price: best_for_price(cmdp, -price), "worth 2 - 0.5 * 1"),
    (checks.check_best_for_price, lambda cmdp, price: max(best_for_price(cmdp, price), 0), "negative"),
    (checks.check_best_for_price, lambda cmdp, price: best_for_price(cmdp, price) / cmdp.initial.max(),
     "cmdp.initial"),
    (checks.check_implicit_policy, unnormalised, "divide by the sum"),
    (checks.check_implicit_policy, lambda mu, q, v, f: mu * abs(f(q - v)), "so pi_imp is mu"),
    (checks.check_implicit_policy, at_zero, "take the limit"),
    (checks.check_implicit_policy, one_sum_for_all, "a sum of its own"),
    (checks.check_batched_loss, lambda w, q, v: (w * (q - v) ** 2).mean(), "two errors, not four"),
    (checks.check_batched_loss, lambda w, q, v: (w * (q - v[:, None]) ** 2).mean(), "its own weight"),
    (checks.check_batched_loss, lambda w, q, v: (w * (q[:, 0] - v) ** 2).sum(), "a mean over"),
    (checks.check_rescaled_budget, lambda L, spent, t, T: (L - spent) * (T - t) / T, "on schedule"),
    (checks.check_rescaled_budget, lambda L, spent, t, T: L * T / (T - t), "on schedule"),
    (checks.check_rescaled_budget, lambda L, spent, t, T: max(L - spent, 0) * T / (T - t), "overspent"),
    (checks.check_budget_backup, lambda cmdp, then: budget_backup(cmdp, then, 1), "then[b - c]"),
    (checks.check_budget_backup, lambda cmdp, then: budget_backup(cmdp, then).clip(min=0), "can be negative"),
    (checks.check_budget_backup, lambda cmdp, then: budget_backup(cmdp, cmdp.gamma * then), "discount"),
    (checks.check_budget_backup, lambda cmdp, then: (cmdp.rewards + cmdp.transitions @ then[0]).max(1)[None],
     "without a budget"),
    (checks.check_keeps_limit, lambda costs, limit: max(costs) <= limit, "expectation"),
    (checks.check_keeps_limit, lambda costs, limit: np.mean(costs) < limit, "at most"),
    (checks.check_keeps_limit, lambda costs, limit: np.median(costs) <= limit, "their mean is not"),
    (checks.check_normalised_return, lambda total, task: total / task.max_return, "R_min is 0.38312"),
    (checks.check_normalised_return, lambda R, task: np.clip(normalised_return(R, task), 0, 1), "clips"),
    (checks.check_normalised_return, lambda R, task: min(normalised_return(R, task), 1), "clips"),
    (checks.check_normalised_return, lambda R, task: max(normalised_return(R, task), 0), "clips"),
]  # fmt: skip


@pytest.mark.parametrize("checker", ANSWERS, ids=lambda checker: checker.__name__)
def test_the_right_answer_passes(checker, capsys):
    checker(ANSWERS[checker])
    assert re.fullmatch(r"OK  \w+ is right in \d cases\n", capsys.readouterr().out)


@pytest.mark.parametrize("checker, answer, hint", MISTAKES)
def test_a_mistake_gets_its_hint_and_no_traceback(checker, answer, hint, capsys):
    checker(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


@pytest.mark.parametrize("checker", ANSWERS, ids=lambda checker: checker.__name__)
def test_a_placeholder_and_an_error_are_told(checker, capsys):
    checker(lambda *arguments: None)
    assert "returns nothing" in capsys.readouterr().out
    checker(lambda *arguments: 1 / 0)
    assert "raised ZeroDivisionError" in capsys.readouterr().out
    checker(lambda *arguments: "thirty")
    assert "= thirty, expected" in capsys.readouterr().out


@pytest.mark.parametrize(
    "form",
    [
        lambda cmdp: cmdp.initial @ without_start(cmdp, 100),  # stops 1e-4 from the end
        lambda cmdp: cmdp.initial[None] @ without_start(cmdp),
        lambda cmdp: torch.tensor(cmdp.initial) @ torch.tensor(without_start(cmdp)),
        lambda cmdp: float(cmdp.initial @ without_start(cmdp)),
    ],
)
def test_every_form_of_one_number_passes(form, capsys):
    checks.check_least_cost(form)
    assert capsys.readouterr().out.startswith("OK  ")


# --- The symbol table of notebook 0 ---


def named(path):
    """The object called `path`, e.g. 'losses.td_loss'. AttributeError if there is none.

    A field of a dataclass counts too, with or without a default.
    """
    module, names = f"tutorial_lib.{path}", []
    while True:
        try:
            found = importlib.import_module(module)
            break
        except ModuleNotFoundError:
            module, dot, name = module.rpartition(".")
            if not dot:
                raise
            names.insert(0, name)
    for name in names:
        fields = getattr(found, "__dataclass_fields__", {})
        found = fields[name] if name in fields else getattr(found, name)
    return found


def test_names_are_found():
    assert named("tasks.get_task") is get_task
    assert named("tasks.Task.horizon").name == "horizon"
    with pytest.raises(AttributeError):
        named("losses.no_such_loss")


@pytest.mark.skipif(not (NOTEBOOKS / "00_start_here.ipynb").exists(), reason="the notebook is not there yet")
def test_the_code_names_in_the_symbol_table_exist():
    notebook = nbformat.read(NOTEBOOKS / "00_start_here.ipynb", as_version=4)
    (table,) = [cell.source for cell in notebook.cells if "| paper | code |" in cell.source]
    columns = [line.split("|")[2] for line in table.splitlines() if line.startswith("|")]
    names = [name for column in columns for name in re.findall(r"`([\w.]+)`", column)]
    assert len(names) > 15
    for name in names:
        named(name)
