"""This module checks the answers to the exercises of notebook 15."""

from collections.abc import Callable, Iterable

import numpy as np

from tutorial_lib.course.checks.checker import text, try_answer
from tutorial_lib.course.tabular.safety import tail_mean

NOTIONS = ("expected", "chance", "CVaR", "hard", "budget")
"""The notions of safety, as the exercises name them."""

RECORDS = {
    "steady": (1,) * 5 + (2,) * 10 + (3,) * 5,
    "rare": (0,) * 10 + (2,) * 8 + (12,) * 2,
}
"""The costs of twenty episodes of two policies. Both have a mean of 2."""

_DOTS = "in place of the `...`"


def check_tail_mean(answer: Callable) -> None:
    """Checks an exercise of notebook 15: `answer(chances, share)` returns the mean of the worst share."""
    half, record = np.array([0.5, 0.0, 0.5]), np.bincount(RECORDS["rare"]) / 20
    hints = (
        ((half, 0.5), "the worst half costs 2 in every episode"),
        ((record, 0.1), "two of twenty episodes are the worst tenth, and each costs 12"),
        ((record, 0.2), "the worst four episodes cost 12, 12, 2 and 2: fill the share up with the next cost"),
        ((half, 0.25), "half of the episodes cost 2, and only a quarter counts: take a part of them"),
        ((half, 1.0), "the worst share of 100% is all episodes: the mean"),
        ((np.array([1.0]), 0.1), "one cost alone is its own tail"),
    )
    try_answer(answer, [(case, tail_mean(*case), hint) for case, hint in hints])


KEPT_HINTS = {
    "expected": "the mean of both policies is 2, and a mean of exactly the limit keeps it",
    "chance": "count the episodes above the limit: two of twenty are at most a tenth, five are not. An "
    "episode that costs exactly the limit is not above it",
    "CVaR": "take the mean of the two worst episodes",
    "hard": "one episode above the limit is enough to break it",
}


def check_kept(answers: dict) -> None:
    """Checks an exercise of notebook 15: which notions each policy of `RECORDS` keeps under two limits.

    `answers` maps (policy, limit) to the names of the notions that are kept, as a set or a list. The chance
    and the tail are those of a tenth of the episodes.
    """
    for name, record in RECORDS.items():
        costs = np.array(record)
        for limit in (2, 4):
            right = {
                "expected": costs.mean() <= limit,
                "chance": (costs > limit).mean() <= 0.1,
                "CVaR": np.sort(costs)[-2:].mean() <= limit,
                "hard": costs.max() <= limit,
            }
            found = answers.get((name, limit), ...) if isinstance(answers, dict) else ...
            if found is ...:
                print(f"NOT YET  {name}, limit {limit}: write the names of the kept notions {_DOTS}")
                return
            named = _names(found)
            if not named <= right.keys():
                print(f"NOT YET  {name}, limit {limit}: the names are {', '.join(right)}, not {text(found)}")
                return
            for notion, kept in right.items():
                if kept != (notion in named):
                    words = "is kept" if kept else "is not kept"
                    print(f"NOT YET  {name}, limit {limit}: {notion} {words}: {KEPT_HINTS[notion]}")
                    return
    print("OK  all four tables of kept notions")


def _names(found) -> set:
    """Returns the names that the reader wrote, as a set. A single name may stand alone."""
    if isinstance(found, str):
        return {found} if found else set()
    return set(map(str, found)) if isinstance(found, Iterable) else {str(found)}


# The game by hand: fast earns 3 and touches with 1/4, slow earns 1. No contact is allowed, but in 30% of all
# episodes. To be fast at first costs 1/4 of the 30%, and 1/20 is left for the second round: (3/4) (1/4) q.
BY_HAND = {
    "first": (1.0, "a fast first round earns 2 more and risks 1/4; nothing else earns as much for its risk, "
              "because after a contact a fast second round adds no risk"),
    "after a contact": (1.0, "the episode is above the limit already, and a further contact does not change "
                        "that. So the second round is fast"),
    "after none": (4 / 15, "1/4 of the 0.3 is spent on the first round. The second one adds (3/4) q (1/4)"),
    "return": (4.9, "3 for the first round, then 3 after a contact (1/4), and 1 + 2 q after none (3/4)"),
}  # fmt: skip
"""The numbers of the exercise with a hint each: three probabilities to be fast, and the expected return."""


def check_by_hand(answers: dict) -> None:
    """Checks an exercise of notebook 15: the best policy of a game of two rounds under a chance constraint.

    `answers` has a number for each name of `BY_HAND`, which may be rounded to two decimals.
    """
    for name, (right, hint) in BY_HAND.items():
        found = answers.get(name, ...) if isinstance(answers, dict) else ...
        if found is ...:
            print(f"NOT YET  {name}: write a number {_DOTS}")
            return
        try:
            wrong = not abs(float(found) - right) <= 0.006
        except (TypeError, ValueError):
            wrong = True
        if wrong:
            print(f"NOT YET  {name}: {text(found)} is not right. {hint}")
            return
    print("OK  the best policy under the chance constraint, and its return of 4.9")


TRAINED_FOR_A_LIMIT = {"BCQ-Lag", "BEAR-Lag", "COptiDICE", "CPQ", "CIQL", "VOCE", "WSAC-style"}
TOLD_THE_LIMIT = {"C2IQL", "CAPS", "CDT", "BC (budget rule)"}
REQUIREMENTS = {
    "fee": ("expected", TRAINED_FOR_A_LIMIT, "a total over ten thousand episodes is a limit on the mean"),
    "acid": ("hard", {"FISOR"}, "'whatever they do' leaves no share of episodes and no average"),
    "void": ("chance", {"none"}, "it counts how many episodes are above the limit, and not how far"),
    "insurer": ("CVaR", {"none"}, "it is an average, but of the worst episodes alone"),
    "ward": ("budget", TOLD_THE_LIMIT, "the limit changes daily, and the robot acts on what is left of it"),
}
"""For each requirement: the notion that it asks for, the methods of this course that give it, and a hint."""


def check_requirements(answers: dict) -> None:
    """Checks an exercise of notebook 15: a notion and a method for each of `REQUIREMENTS`.

    `answers` maps the name of a requirement to a pair (notion, method). The method is "none" where no method
    of the course's library has the notion.
    """
    for name, (notion, methods, hint) in REQUIREMENTS.items():
        found = answers.get(name, ...) if isinstance(answers, dict) else ...
        if found is ... or (isinstance(found, tuple | list) and ... in found):
            print(f"NOT YET  {name}: write a notion and a method {_DOTS}")
            return
        if not isinstance(found, tuple | list) or len(found) != 2:
            print(f"NOT YET  {name}: a pair is expected, such as ('expected', 'CPQ'), not {text(found)}")
            return
        if str(found[0]).lower() not in [one.lower() for one in NOTIONS]:
            print(f"NOT YET  {name}: the notions are {', '.join(NOTIONS)}, not {text(found[0])}")
            return
        if str(found[0]).lower() != notion.lower():
            print(f"NOT YET  {name}: {found[0]} is not what it asks for: {hint}")
            return
        if str(found[1]).lower() not in [one.lower() for one in methods]:
            print(f"NOT YET  {name}: {notion} is right, but {found[1]} does not give it: see the table")
            return
    print("OK  a notion and a method for all five requirements")


CLAIMS = {
    "a": (True, "Under the limit 20, Ours costs 1.62 limits. The mean over the limits hides it"),
    "b": (True, "The best of 40 checkpoints, chosen on the episodes that are reported, is a lucky one"),
    "c": (True, "The bold method is above two of the three limits. Among unsafe methods, return is no merit"),
    "d": (True, "A discounted sum is smaller than the cost that the limit is about"),
    "e": (False, "one agent for each limit is more work, but the table says so, and it is the usual way"),
    "f": (False, "dividing by the limit is the usual unit, and 1 means that the limit is reached"),
    "g": (False, "three seeds are few, but their number and their spread are given, so a reader can judge"),
    "h": (False, "constants of the task make returns comparable, as long as all methods share them"),
}
"""Which of the statements on the made-up table name a fault, and why."""


def check_faults(answers: Iterable) -> None:
    """Checks an exercise of notebook 15: the letters of the four faults of a made-up table.

    `answers` is a set, a list or a string of letters.
    """
    if answers is ... or not isinstance(answers, Iterable):
        print(f"NOT YET  write the letters of the four faults {_DOTS}")
        return
    named = {letter.lower() for letter in map(str, answers) if letter.strip(" ,;")}
    if not named <= CLAIMS.keys():
        print(f"NOT YET  the letters are {', '.join(CLAIMS)}, not {', '.join(sorted(named - CLAIMS.keys()))}")
        return
    for letter, (fault, why) in CLAIMS.items():
        if letter in named and not fault:
            print(f"NOT YET  {letter} is no fault: {why}")
            return
    missing = [letter for letter, (fault, _) in CLAIMS.items() if fault and letter not in named]
    if missing:
        print(f"NOT YET  {len(missing)} of the four faults are missing: what is each number a mean of?")
        return
    print("OK  all four faults, and no statement that is none")
