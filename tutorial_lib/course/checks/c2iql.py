"""This module checks the answers to the exercises of notebook 11."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from scipy import stats

from tutorial_lib.course.checks.checker import given, name_of, text, try_answer

READINGS = {
    12: ("V_r(s)", {"Q_r target", "Q_c target"}),
    14: ("V_c(s)", {"V_r(s)", "Q_r target", "Q_c target"}),
    16: ("Q_r", {"V_r(s')"}),
    18: ("Q_c", {"V_c(s')"}),
    20: ("policy", {"V_r(s)", "Q_r target", "Q_c target"}),
}
"""For the line of each loss of Algorithm 2: the network that it trains, and those that stand still in it."""
_NAMES = ("V_r(s)", "V_r(s')", "V_c(s)", "V_c(s')", "Q_r", "Q_r target", "Q_c", "Q_c target", "policy")


def _plain(name: str) -> str:
    """Returns a network's name without spaces, underscores and capitals."""
    return "".join(name.replace("’", "'").split()).replace("_", "").replace(",", "").lower()


def check_readings(answer: Mapping[int, tuple[str, Iterable[str]]]) -> None:
    """Checks an exercise of notebook 11: which networks the loss of each line trains and asks.

    `answer` maps a line of Algorithm 2 (12, 14, 16, 18 and 20) to the network that its loss trains, and to
    the networks that it asks and holds still. Prints OK, or the first mistake with its misconception.
    """
    known = {_plain(name): name for name in _NAMES}
    for line, (trained, still) in READINGS.items():
        given = answer.get(line)
        if given is None or given is ... or len(given) != 2 or ... in given:
            print(f"NOT YET  line {line}: write a network and a set of networks in place of the `...`")
            return
        names = [given[0], *([given[1]] if isinstance(given[1], str) else given[1])]
        unknown = [str(name) for name in names if _plain(str(name)) not in known]
        if unknown:
            print(f"NOT YET  line {line}: {unknown[0]!r} is no name of the list: {', '.join(_NAMES)}")
            return
        learns, *others = (known[_plain(name)] for name in names)
        asked = set(others) - {learns}  # a loss always depends on the network that it trains
        if hint := _misread(line, learns, asked, trained, still):
            print(f"NOT YET  line {line}: {hint}")
            return
    print(f"OK  all {len(READINGS)} losses: what each trains and what each asks")


def _misread(line: int, learns: str, asked: set[str], trained: str, still: set[str]) -> str:
    """Returns a hint on the first mistake of one line, or no words."""
    if learns != trained:
        if learns == f"{trained} target":
            return "a target network is trained by no loss: it follows its network after each update"
        return f"its loss trains another network than {learns}: read its left side"
    if "policy" in asked:
        return "no value asks the policy: this is what keeps C2IQL within the data"
    online = {name for name in ("Q_r", "Q_c") if name in asked and f"{name} target" in still - asked}
    if online:
        return f"it asks the target network of {' and of '.join(sorted(online))}, and not the one that learns"
    if line in (16, 18) and asked & {"V_r(s)", "V_c(s)"}:
        return "a critic looks one step ahead: the value is taken at s'"
    if line in (14, 20) and "V_r(s)" not in asked:
        return "its weight M depends on u, and u is Q_r|c minus V_r(s)"
    if "Q_c target" in still - asked:
        return "the penalty is in Q_r|c, and it compares the reconstructed Q_c with the limit"
    if "Q_r target" in still - asked:
        return "the weight M depends on u, and u contains Q_r"
    missing, surplus = sorted(still - asked), sorted(asked - still)
    if missing:
        return f"it also asks {missing[0]}"
    return f"it does not ask {surplus[0]}" if surplus else ""


def check_after_update(answer: Callable) -> None:
    """Checks an exercise of notebook 11: one update of V, Q and the target of Q.

    `answer(v, q, q_target, reward, gamma, rate, tau, in_turn)` returns the three numbers after one update.
    One state has one action, which leads back to it, and kappa is 1/2. Without `in_turn`, both gradients are
    taken at the old numbers; with it, V moves first.
    """
    cases = []
    for numbers, in_turn, hint in (
        ((2.0, 4.0, 3.0, 1.0, 0.5, 0.0, 0.0), False, "with steps of zero nothing moves"),
        ((2.0, 4.0, 3.0, 1.0, 0.5, 0.1, 0.0), False, _HINTS[0]),
        ((2.0, 4.0, 3.0, 1.0, 0.5, 0.1, 0.5), False, _HINTS[1]),
        ((2.0, 4.0, 3.0, 1.0, 0.5, 0.1, 0.5), True, _HINTS[2]),
        ((1.0, -2.0, 5.0, 3.0, 0.9, 0.25, 0.1), False, "compare with the steps by hand, number by number"),
        ((1.0, -2.0, 5.0, 3.0, 0.9, 0.25, 0.1), True, "compare with the steps by hand, number by number"),
    ):
        cases.append(((*numbers, in_turn), _update_by_slopes(*numbers, in_turn), hint))
    try_answer(answer, cases)


_HINTS = (
    "V moves towards the target of Q, with the slope of (Q_target - V)^2 / 2, and Q towards r + gamma V with "
    "the slope of (r + gamma V - Q)^2. Without in_turn both are taken at the old numbers",
    "the target follows last, and moves towards the new Q",
    "in turn, Q sees the V that has already moved",
)


def _update_by_slopes(v, q, q_target, reward, gamma, rate, tau, in_turn, step=1e-5):
    """Returns V, Q and Q's target after one update, with slopes from finite differences of the two losses."""

    def slope(loss, x):
        return (loss(x + step) - loss(x - step)) / (2 * step)

    new_v = v - rate * slope(lambda x: 0.5 * (q_target - x) ** 2, v)
    seen = new_v if in_turn else v
    new_q = q - rate * slope(lambda x: (reward + gamma * seen - x) ** 2, q)
    return np.array([new_v, new_q, (1 - tau) * q_target + tau * new_q])


def check_paid_per_predicted(answer: Callable) -> None:
    """Checks an exercise of notebook 11.

    `answer(seed, paid, predicted)` returns, for each seed in rising order, what its episodes paid in the mean
    over what was predicted for them in the mean. The arguments are (episodes,).
    """
    ones = np.ones(2)
    try_answer(
        answer,
        [
            ((np.array([0, 0]), 30 * ones, 30 * ones), [1.0], "as predicted is 1"),
            ((np.array([0, 0]), 45 * ones, 30 * ones), [1.5], "paid over predicted: above 1 is an optimist"),
            (
                (np.array([0, 1, 0, 1]), np.array([20.0, 60, 40, 60]), 30 * np.ones(4)),
                [1.0, 2.0],
                "one number for each seed: an optimist and a pessimist must not cancel",
            ),
            (
                (np.array([3, 3]), np.array([10.0, 30]), np.array([1.0, 39])),
                [1.0],
                "the mean first, then the ratio: single episodes with a small prediction would decide",
            ),
            (
                (np.array([7, 2, 2]), np.array([10.0, 40, 20]), np.array([20.0, 15, 45])),
                [1.0, 0.5],
                "in the order of the seeds",
            ),
        ],
    )


def check_largest_chance(answer: Callable) -> None:
    """Checks an exercise of notebook 11.

    `answer(exceeded, episodes)` returns the largest chance of exceeding a limit with which `exceeded` or
    fewer of the episodes exceed it in at least 2.5% of all cases. Answers within 0.001 count.
    """
    name = name_of(answer)
    for exceeded, episodes in ((0, 50), (0, 10), (2, 10), (25, 50), (10, 10)):
        call = f"{name}({exceeded}, {episodes})"
        found = given(answer, (exceeded, episodes), call, lambda got: float(np.squeeze(got)))
        if found is None:
            return
        right = stats.binomtest(exceeded, episodes).proportion_ci(0.95, "exact")
        if not abs(found - right.high) <= 1e-3:
            hint = _hint(found, exceeded, episodes)
            print(f"NOT YET  {call} = {found:.4f}, expected {text(right.high)}: {hint}")
            return
    print(f"OK  {name} is right in 5 cases")


def _hint(found: float, exceeded: int, episodes: int) -> str:
    """Returns what is wrong with a bound, by the number that was found."""
    share = exceeded / episodes
    exact = stats.binomtest(exceeded, episodes)
    half = 1.96 * np.sqrt(share * (1 - share) / episodes)
    one_sided = exact.proportion_ci(0.9, "exact").high
    mistakes = (
        (share, "this is the share that was seen. None seen is not none possible"),
        (
            share + half,
            "the normal approximation has width zero at a share of zero, and is bad for few episodes",
        ),
        (exact.proportion_ci(0.95, "exact").low, "this is the smallest such chance, and not the largest"),
        (one_sided, "this bound is for 5%, and 2.5% are left on each side of a 95% interval"),
        (3 / episodes, "the rule of three is a bound for 5%, and rounded"),
    )
    for number, words in mistakes:
        if abs(found - number) <= 1e-3:
            return words
    return "solve P(at most this many exceed) = 0.025 for the chance"
