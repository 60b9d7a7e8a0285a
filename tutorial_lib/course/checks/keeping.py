"""This module checks the answers to the exercises of notebook 12."""

from collections.abc import Callable, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from tutorial_lib.course.checks.checker import given, name_of, text

# --- The switch ---


def _switch_by_loop(limit: float, bold, safe, mistake: str = "") -> float:
    """Returns what the switch pays, step by step. A `mistake` makes one of the likely ones."""
    spent = 0.0
    for step, (fast, slow) in enumerate(zip(bold, safe, strict=True)):
        left = spent <= limit if mistake == "late" else spent < limit
        if mistake == "early":
            left = spent + fast <= limit
        if mistake == "mean":
            left = spent < limit * (step + 1) / len(bold)
        spent += fast if left else 0.0 if mistake == "free" else slow
    return min(spent, limit) if mistake == "cut" else spent


_SWITCH_CASES: tuple[tuple, ...] = (
    (2.0, (1, 1, 1, 1, 1), (0, 0, 0, 0, 0)),
    (2.0, (1, 0, 1, 1, 0), (0, 0, 0, 0, 0)),
    (0.0, (1, 1, 1), (0, 0, 0)),
    (np.inf, (1, 0, 1), (0, 0, 0)),
    (1.5, (1, 1, 1, 1), (0, 0, 0, 0)),
    (2.0, (1, 1, 1, 1, 1), (0, 0, 1, 1, 0)),
    (9.0, (1, 1, 1), (0, 0, 0)),
    (3.0, (0, 0, 0, 0, 1, 1, 1), (0, 0, 0, 0, 0, 0, 1)),
)
_SWITCH_HINTS = {
    "late": "nothing is left when spent equals the limit: the switch asks spent < limit",
    "early": "the rule acts after a cost was paid. It cannot see what the bold step will cost",
    "mean": "the switch does not spread the limit over the steps",
    "free": "the safe policy can also pay: count its costs after the switch",
    "cut": "what is paid can exceed the limit: nothing cuts the cost off",
}


def _switch_hint(case: tuple, got: float) -> str:
    """Returns what was mistaken, by comparing with the likely mistakes."""
    limit, bold, safe = case
    for kind, hint in _SWITCH_HINTS.items():
        if got == _switch_by_loop(limit, bold, safe, kind):
            return hint
    return "play it step by step: bold while spent < limit, safe from then on"


def check_switch(answer: Callable) -> None:
    """Checks an exercise of notebook 12: `answer(limit, bold, safe)` returns what the switch pays.

    `bold` and `safe` are the costs (T,) that the two policies would pay at each step.
    """
    name = name_of(answer)
    for case in _SWITCH_CASES:
        call = f"{name}({', '.join(text(x) for x in case)})"
        got = given(answer, case, call, float)
        if got is None:
            return
        right = _switch_by_loop(*case)
        if not abs(got - right) < 1e-9:
            hint = _switch_hint(case, got)
            print(f"NOT YET  {call} = {text(got)}, expected {text(right)}: {hint}")
            return
    print(f"OK  {name} is right in {len(_SWITCH_CASES)} cases")


# --- Obedience ---


def _ranks(values) -> np.ndarray:
    """Returns the rank of each value, (n,): how many are smaller, plus half of those that are equal."""
    values = np.asarray(values, float)
    return np.array([(values < x).sum() + ((values == x).sum() + 1) / 2 for x in values])


def rank_correlation(told, paid) -> float:
    """Returns Spearman's rank correlation of what was told and what was paid, both (n,), or NaN.

    Told limits may be infinite. Equal values share the mean of their ranks. It is NaN where all are equal.
    """
    a, b = _ranks(told), _ranks(paid)
    a, b = a - a.mean(), b - b.mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size else float("nan")


_OBEYS_CASES = (
    ((0, 10, 25, 40, np.inf), (0, 9, 20, 33, 50), "what is paid rises all the way: 1"),
    ((0, 10, 25, 40), (40, 25, 10, 0), "what is paid falls all the way: the network obeys backwards, -1"),
    ((0, 10, 25, 40, np.inf), (25, 19, 7, 3, 87), "use ranks: infinity is only the highest of what is told"),
    ((0, 10, 25, 40), (30, 31, 33, 90), "only the order counts, not the distances: use ranks"),
    ((0, 0, 25, 25, 40, 40), (1, 2, 9, 8, 20, 20), "equal values share the mean of their ranks"),
)


def check_obedience(answer: Callable) -> None:
    """Checks an exercise of notebook 12: `answer(told, paid)` returns the rank correlation (Spearman).

    The answer may be a number, or an object with the number as `statistic`, as scipy returns.
    """
    name = name_of(answer)
    for told, paid, hint in _OBEYS_CASES:
        call = f"{name}({text(told)}, {text(paid)})"
        pair = np.array(told, float), np.array(paid, float)
        got = given(answer, pair, call, lambda got: float(getattr(got, "statistic", got)))
        if got is None:
            return
        right = rank_correlation(told, paid)
        if not abs(got - right) < 1e-6:
            if got in (np.mean(np.less_equal(paid, told)), np.mean(np.less(paid, told))):
                hint = "this is how often the limit is kept. A network obeys if what it pays rises"
            print(f"NOT YET  {call} = {text(got)}, expected {text(right)}: {hint}")
            return
    print(f"OK  {name} is right in {len(_OBEYS_CASES)} cases")


# --- Who keeps it? ---


class Report(NamedTuple):
    """What an agent pays under the limits 10, 25 and 40, and when it is told infinity throughout."""

    throughout: tuple[float, float, float] | None
    """One limit told throughout, or None where nobody played it."""
    ruled: tuple[float, float, float]
    """With the budget rule."""
    infinity: float | None
    """Told infinity throughout, or None where nobody played it."""


REPORTS = {
    "P": Report((9, 24, 38), (9, 24, 39), 57),
    "Q": Report((57, 57, 57), (9, 24, 39), 57),
    "R": Report((30, 41, 52), (29, 40, 51), 57),
    "S": Report(None, (9, 24, 39), None),
    "T": Report((4, 5, 4), (5, 4, 4), 5),
    "U": Report((40, 25, 10), (10, 23, 24), 57),
}
"""Six agents that somebody reports on, in unsafe steps per episode."""
VERDICTS = ("network", "rule", "neither", "cannot say", "not needed")
"""The answers of the exercise."""
_WHO = {
    "P": (
        "network",
        "told one limit throughout, it already keeps all three, and told infinity it would pay more",
    ),
    "Q": (
        "rule",
        "alone, the network pays the same whatever it is told. Only with the rule are the limits kept",
    ),
    "R": ("neither", "compare the costs with the limits 10, 25 and 40: they are broken with the rule, too"),
    "S": ("cannot say", "the control is missing: nobody told the network one limit throughout"),
    "T": ("not needed", "told infinity it pays 5: no limit of the three asks anything of it"),
    "U": ("rule", "alone, it pays 40 under the limit 10. It obeys backwards, and the rule corrects it"),
}


def check_verdicts(answers: Mapping) -> None:
    """Checks an exercise of notebook 12: `answers` has one of `VERDICTS` for each agent of `REPORTS`."""
    for name, (right, hint) in _WHO.items():
        found = answers.get(name, ...) if isinstance(answers, Mapping) else ...
        if found is ...:
            print(f"NOT YET  {name}: write one of {', '.join(VERDICTS)} in place of the `...`")
            return
        if str(found).strip().lower() != right:
            print(f"NOT YET  {name}: not {text(found)!r}. {hint}")
            return
    print(f"OK  all {len(_WHO)} verdicts")


# --- Controls ---

CONTROLS = {
    "one limit throughout": {
        "network": "C2IQL",
        "between 0 and infinity": "told",
        "counts": "no",
        "covered": "no",
    },
    "budget rule": {"network": "C2IQL", "between 0 and infinity": "told", "counts": "yes", "covered": "no"},
    "budget rule, covered": {
        "network": "C2IQL",
        "between 0 and infinity": "told",
        "counts": "yes",
        "covered": "yes",
    },
    "switch": {"network": "C2IQL", "between 0 and infinity": "never", "counts": "yes", "covered": "no"},
    "cloning": {"network": "clone", "between 0 and infinity": "never", "counts": "no", "covered": "no"},
    "cloning, budget rule": {
        "network": "clone",
        "between 0 and infinity": "told",
        "counts": "yes",
        "covered": "no",
    },
}
"""The six ways to play of notebook 12, and in what they differ."""
QUESTIONS = {
    "what counting adds to the network": {"counts"},
    "what the covered rule adds": {"covered"},
    "what the limits between 0 and infinity add to counting": {"between 0 and infinity"},
    "what C2IQL's training adds to cloning, if both count": {"network"},
}
"""The questions of the exercise, and the one cause that the two runs of each may differ in."""


def _differences(first: str, second: str) -> set[str]:
    return {cause for cause in CONTROLS[first] if CONTROLS[first][cause] != CONTROLS[second][cause]}


def check_pairs(answers: Mapping) -> None:
    """Checks an exercise of notebook 12: `answers` has a pair of `CONTROLS` for each of `QUESTIONS`.

    The two runs of a pair differ in the cause that the question asks for, and in no other.
    """
    for question, causes in QUESTIONS.items():
        found = answers.get(question, ...) if isinstance(answers, Mapping) else ...
        if found is ... or (isinstance(found, tuple | list | set) and ... in found):
            print(f"NOT YET  {question}: write two controls in place of the `...`")
            return
        try:
            pair = [str(name).strip() for name in found]
        except TypeError:
            pair = []
        unknown = [name for name in pair if name not in CONTROLS]
        if len(pair) != 2 or unknown:
            print(f"NOT YET  {question}: {text(found)} is no pair. The controls are: {', '.join(CONTROLS)}")
            return
        differ = _differences(*pair)
        if differ != causes:
            words = " and ".join(f"'{cause}'" for cause in CONTROLS["switch"] if cause in differ) or "nothing"
            print(f"NOT YET  {question}: these two differ in {words}. Only '{min(causes)}' may differ")
            return
    print(f"OK  all {len(QUESTIONS)} pairs differ in one cause")


def right_pairs() -> dict[str, list[tuple[str, ...]]]:
    """Returns, for each of `QUESTIONS`, all pairs of `CONTROLS` that answer it."""
    return {
        question: [pair for pair in combinations(CONTROLS, 2) if _differences(*pair) == causes]
        for question, causes in QUESTIONS.items()
    }
