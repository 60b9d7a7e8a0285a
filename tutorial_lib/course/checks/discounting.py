"""This module checks the answers to the exercises of notebook 5."""

import functools
import math
from collections.abc import Callable

import numpy as np

from tutorial_lib.costs.discounting import average_threshold, discounted_sums
from tutorial_lib.course.checks.checker import text, try_answer


def check_false_positive(costs, gamma: float = 0.8, limit: float = 3, horizon: int = 10) -> None:
    """Checks an exercise of notebook 5: whether an episode with these costs is safe but rejected.

    `costs` holds a cost of 0 or 1 for each of the `horizon` steps.
    """
    _check_misjudged(costs, gamma, limit, horizon, safe=True)


def check_false_negative(costs, gamma: float = 0.8, limit: float = 3, horizon: int = 10) -> None:
    """Checks an exercise of notebook 5: whether an episode with these costs is unsafe but accepted.

    `costs` holds a cost of 0 or 1 for each of the `horizon` steps.
    """
    _check_misjudged(costs, gamma, limit, horizon, safe=False)


def _check_misjudged(costs, gamma, limit, horizon, safe):
    """Prints OK where L~ misjudges these costs, and otherwise what is wrong with them.

    The costs must be those of a safe episode where `safe` is true, and of an unsafe episode otherwise.
    """
    problem = _not_a_sequence(costs, horizon)
    if problem:
        print(f"NOT YET  {problem}")
        return
    costs = np.asarray(costs, float)
    total, discounted = costs.sum(), discounted_sums(costs, [gamma])[0]
    mark = average_threshold(limit, gamma, horizon)
    if safe and total > limit:
        print(f"NOT YET  {total:g} unsafe steps: more than the limit {limit:g}, so it is not safe")
    elif safe and discounted <= mark:
        print(
            f"NOT YET  discounted {discounted:.2f}, at most {mark:.2f}: accepted. Let the cost fall earlier"
        )
    elif not safe and total <= limit:
        print(f"NOT YET  {total:g} unsafe steps: within the limit {limit:g}, so it is not unsafe")
    elif not safe and discounted > mark:
        print(f"NOT YET  discounted {discounted:.2f}, above {mark:.2f}: rejected. Let it fall later")
    else:
        kind = "false positive: safe, and rejected" if safe else "false negative: unsafe, and accepted"
        print(f"OK  a {kind}")


def _not_a_sequence(costs, horizon) -> str:
    """Returns why `costs` is not a sequence of `horizon` zeros and ones, or an empty text where it is one."""
    if costs is None or costs is ...:
        return f"no costs: write {horizon} zeros and ones in place of the `...`"
    try:
        costs = np.asarray(costs, float)
    except (TypeError, ValueError):
        return f"{costs} is no sequence of numbers"
    if costs.shape != (horizon,):
        return f"shape {text(costs.shape)}: there are {horizon} steps"
    return "" if np.isin(costs, (0, 1)).all() else "a step costs 0 or 1"


def check_extremes(answer: Callable) -> None:
    """Checks an exercise of notebook 5.

    `answer(horizon, gamma, limit)` returns two numbers of unsafe steps: the smallest number that L~ can
    reject and the largest number that it can accept.
    """
    hints = {
        (10, 0.8, 3): "pack the unsafe steps at the start, then at the end, and compare with L~",
        (4, 0.5, 1): "L~ = 0.469: one step at the start counts 1, the last three together 0.875",
        (301, 0.99, 50): "Fig. 1's case: count up until L~ is passed",
        (100, 0.97, 50): "BallRun with its largest discount factor",
    }
    cases = []
    for (horizon, gamma, limit), hint in hints.items():
        mark = average_threshold(limit, gamma, horizon)
        powers = gamma ** np.arange(horizon)
        fewest = 1 + int(np.sum(np.cumsum(powers) <= mark))
        most = int(np.sum(np.cumsum(powers[::-1]) <= mark))
        cases.append(((horizon, gamma, limit), (fewest, most), hint))
    try_answer(answer, cases)


def check_updates_until(answer: Callable) -> None:
    """Checks an exercise of notebook 5.

    `answer(gamma, tau, share)` is the number of updates after which a critic that starts at zero has `share`
    of its value. Rounded numbers are accepted, too.
    """
    hints = {
        (0.5, 1.0, 0.75): "with tau = 1 the error halves at every update: 1, 1/2, 1/4",
        (0.9, 0.1, 0.5): "the error is multiplied by 1 - tau (1 - gamma) = 0.99 at every update",
        (0.5, 0.5, 0.99): "solve (1 - tau (1 - gamma))^n = 1 - share for n, without an approximation",
        (0.99, 0.005, 0.99): "the paper's smallest gamma on CarCircle, with IQL's tau",
        (0.999, 0.005, 0.99): "ten times the horizon needs ten times the updates",
    }
    exact = {case: math.log(1 - case[2]) / math.log(1 - case[1] * (1 - case[0])) for case in hints}

    @functools.wraps(answer)
    def unrounded(*arguments):
        got, right = answer(*arguments), exact[arguments]
        try:
            return right if any(abs(float(got) - n) < 1e-6 for n in (round(right), math.ceil(right))) else got
        except (TypeError, ValueError):  # `got` is not a number
            return got

    try_answer(unrounded, [(case, exact[case], hint) for case, hint in hints.items()])
