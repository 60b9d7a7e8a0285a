"""The problem sets and the exam: every number of a solution, computed from the problem's text alone."""

import itertools
import re
from fractions import Fraction
from math import log, sqrt
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize, stats

SITE = Path(__file__).parents[1] / "site"
PROBLEMS = (SITE / "problems.md").read_text(encoding="utf-8")
EXAM = (SITE / "exam.md").read_text(encoding="utf-8")


def solution(number):
    """The text of a folded solution: a number like "1.2" of the problem sets, or like 3 of the exam."""
    text, head = (
        (PROBLEMS, f"### Problem {number}:") if "." in str(number) else (EXAM, f"## Question {number}:")
    )
    after = text.split(head)[1]
    return re.search(r"<details>\n<summary>[\w ]+</summary>\n\n(.+?)\n\n</details>", after, re.DOTALL)[1]


def says(number, *values):
    """Asserts that a solution contains each of these texts as whole numbers."""
    text = solution(number)
    for value in values:
        assert re.search(rf"(?<![\d.,]){re.escape(value)}(?![\d]|[.,]\d)", text), (number, value)


def expectile(mu, q, kappa):
    """The V at which weighted differences balance, by a root finder."""
    mu, q = np.array(mu, float), np.array(q, float)
    balance = lambda v: (mu * np.where(q < v, 1 - kappa, kappa) * (q - v)).sum()  # noqa: E731
    return optimize.brentq(balance, q.min(), q.max(), xtol=1e-13)


def implicit(mu, q, kappa):
    """V, and the implicit policy by Theorem 1."""
    v = expectile(mu, q, kappa)
    weighted = np.array(mu) * np.where(np.array(q) < v, 1 - kappa, kappa)
    return v, weighted / weighted.sum()


def sequences(length):
    """All sequences of zeros and ones."""
    return np.array(list(itertools.product((0, 1), repeat=length)))


def verdicts(length, gamma, limit):
    """L~, and the fewest unsafe steps that are rejected and the most that are accepted, by trying all."""
    weights = gamma ** np.arange(length)
    mark, everything = limit / length * weights.sum(), sequences(length)
    total, accepted = everything.sum(1), everything @ weights <= mark
    return mark, total[~accepted].min(), total[accepted].max()


def test_every_problem_has_a_folded_solution():
    numbers = re.findall(r"^### Problem ([\d.]+): ", PROBLEMS, re.MULTILINE)
    assert [number.split(".")[0] for number in numbers] == ["1"] * 5 + ["2"] * 7 + ["3"] * 7
    assert all(len(solution(number)) > 100 for number in numbers)
    assert PROBLEMS.count("<details>") == PROBLEMS.count("</details>") == len(numbers)


def test_the_marks_of_the_exam_sum_to_ninety_and_every_scheme_to_its_question():
    marks = [int(mark) for mark in re.findall(r"^## Question \d+: .+ \((\d+) marks\)$", EXAM, re.MULTILINE)]
    assert sum(marks) == 90 and len(marks) == 8 == EXAM.count("<summary>Marking scheme</summary>")
    for number, expected in enumerate(marks, 1):
        parts = re.findall(r"^\([a-d]\) (\d+) marks?\b", solution(number), re.MULTILINE)
        if parts:
            assert sum(map(int, parts)) == expected, number


def best_mix(limit):
    reward, cost = np.array([2, 6, 9.0]), np.array([0, 4, 10.0])
    found = optimize.linprog(-reward, A_ub=[cost], b_ub=[limit], A_eq=[np.ones(3)], b_eq=[1])
    return found.x, -found.fun, -found.ineqlin.marginals[0]


def test_1_1():
    mix, reward, price = best_mix(6)
    assert mix == pytest.approx([0, 2 / 3, 1 / 3]) and reward == pytest.approx(7)
    assert price == pytest.approx(0.5) and best_mix(3)[2] == pytest.approx(1)
    says("1.1", "7", "6.2", "0.5", "4.4", "3.6")
    assert 0.4 * 2 + 0.6 * 9 == pytest.approx(6.2)
    for price, worth, taken in ((0.4, [2, 4.4, 5], 2), (0.6, [2, 3.6, 3], 1)):
        values = np.array([2, 6, 9]) - price * np.array([0, 4, 10])
        assert values == pytest.approx(worth) and values.argmax() == taken
    taken = [(np.array([2, 6, 9]) - p * np.array([0, 4, 10])).argmax() for p in (0.49, 0.51, 0.99, 1.01)]
    assert taken == [2, 1, 1, 0]


def test_1_2():
    costs = np.array([12, 25, 18, 31, 9, 22, 15, 27, 20, 11])
    spread = costs.std(ddof=1)
    error = stats.sem(costs)
    ends = costs.mean() - 2 * error, costs.mean() + 2 * error
    says("1.2", f"{costs.mean():.1f}", f"{spread:.2f}", f"{error:.2f}", f"{ends[0]:.1f}", f"{ends[1]:.1f}")
    says("1.2", f"{((costs - costs.mean()) ** 2).sum():.0f}", f"{(2 * spread) ** 2:.1f}", "216", "40%")
    assert (costs > 20).sum() == 4 and 215 < (2 * spread) ** 2 < 216


def test_1_3():
    pairs = [(a, 1 + b) for a in (2, -2) for b in (2, -2)]
    larger = np.mean([max(pair) for pair in pairs])
    honest = np.mean([(0, 1)[int(np.argmax(pair))] for pair in pairs])
    says("1.3", f"{larger:.2f}", f"{larger - 1:.2f}", f"{honest:.2f}", f"{1 - honest:.2f}")
    q = 0.0
    for _ in range(5000):
        q = 0.95 * (q + larger - 1)
    says("1.3", f"{q:.2f}")


def test_1_4():
    mu, q = [1 / 2, 1 / 4, 1 / 4], [2, 4, 10]
    v, policy = implicit(mu, q, 0.8)
    assert v == pytest.approx(48 / 7) and policy == pytest.approx([2 / 7, 1 / 7, 4 / 7])
    says("1.4", f"{v:.3f}", f"{np.dot(mu, q):.1f}")
    assert expectile(mu, q, 0.5) == pytest.approx(4.5) and expectile(mu, q, 1 - 1e-9) == pytest.approx(10)


def test_1_5():
    found = optimize.minimize_scalar(lambda v: (2 - v) ** 2 + (2 - v), bounds=(0, 5), method="bounded")
    assert found.x == pytest.approx(2.5, abs=1e-5)
    q = np.array([0, 0, 3.0])
    loss = lambda v: ((q - v) ** 2 / 2 + np.abs(q - v) ** 3 / 3).mean()  # noqa: E731
    v = optimize.minimize_scalar(loss, bounds=(0, 3), method="bounded", options={"xatol": 1e-10}).x
    weights = 1 + np.abs(q - v)
    policy = weights / weights.sum()
    assert policy @ q == pytest.approx(v, abs=1e-6)
    says(
        "1.5",
        "2.5",
        f"{v:.3f}",
        f"{weights[0]:.3f}",
        f"{weights[2]:.3f}",
        f"{policy[0]:.3f}",
        f"{policy[2]:.3f}",
    )


def test_2_1():
    mark, fewest, most = verdicts(5, 0.5, 2)
    weights = 0.5 ** np.arange(5)
    says("2.1", f"{weights.sum():.4f}", f"{mark:.3f}", f"{weights[2:].sum():.4f}", f"{weights[1:].sum():.4f}")
    assert (fewest, most) == (1, 3) and weights[2:].sum() <= mark < weights[1:].sum() < weights[0] + 0.001


def test_2_2():
    weights, mark = 0.95 ** np.arange(100), 0.2 * sum(0.95**t for t in range(100))
    fewest = next(k for k in range(101) if weights[:k].sum() > mark)
    most = max(k for k in range(101) if weights[100 - k :].sum() <= mark)
    assert (fewest, most) == (5, 69)
    late = log(0.05 * mark + 0.95**100) / log(0.95)
    says("2.2", f"{mark:.3f}", f"{1 - 0.05 * mark:.4f}", f"{log(1 - 0.05 * mark) / log(0.95):.2f}", "5", "69")
    says("2.2", f"{0.05 * mark + 0.95**100:.4f}", f"{late:.2f}")


@pytest.mark.parametrize(("gamma", "error"), [(0.98, 1), (0.998, 10)])
def test_2_3(gamma, error):
    updates, left = 0, 1.0
    while left > 0.05:
        left *= 1 - 0.01 * (1 - gamma)
        updates += 1
    shown = [int(n.replace(",", "")) for n in re.findall(r"\d\d+,\d{3}", solution("2.3"))]
    assert min(abs(n - updates) for n in shown) <= 1
    assert 0.02 * sum(gamma**t for t in range(20_000)) == pytest.approx(error)


def test_2_4_and_2_5():
    powers = np.array([[1, 0.5], [1, 0.8]])
    w = np.linalg.solve(powers.T, [1, 1])
    assert w == pytest.approx([-2 / 3, 5 / 3])
    rng = np.random.default_rng(0)
    says("2.4", f"{0.1 * np.linalg.norm(w):.3f}", f"{0.1 * np.abs(w).sum():.3f}", "0.1", "0.9", "0.77")
    assert (rng.normal(size=(200_000, 2)) @ w).std() * 0.1 == pytest.approx(0.180, abs=0.001)
    assert [w @ [0.5**t, 0.8**t] for t in (2, 3)] == pytest.approx([0.9, 0.77])
    heads = powers @ [1, 1]
    endless = np.array([sum(g**t for t in range(400)) for g in (0.5, 0.8)])
    cases = [0.8 * heads, heads * [1, 0.8], endless, endless * [1 - 0.25, 1 - 0.64], powers @ [2, 2] / 2]
    assert [w @ case for case in cases] == pytest.approx([1.6, 1.4, 7, 2, 2])
    says("2.5", "1.6", "1.4", "7", "1.44", "1.5", "1.8")


def test_2_6():
    problem = {"A_eq": [0.5 ** np.arange(4)], "b_eq": [1], "bounds": (0, 1)}
    least, most = (optimize.linprog(sign * np.ones(4), **problem) for sign in (1, -1))
    assert least.x == pytest.approx([1, 0, 0, 0]) and most.x == pytest.approx([0.125, 1, 1, 1])
    says("2.6", f"{most.x.sum():.3f}", "0.875")


def test_2_7():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400_000, 2)) * [3, 0.5]
    w = np.linalg.lstsq(x + rng.normal(size=x.shape) * 0.5, x.sum(1), rcond=None)[0]
    assert w == pytest.approx([0.973, 0.5], abs=0.005)
    says("2.7", f"{9 / 9.25:.3f}", "0.5", f"{(1 - 9 / 9.25) ** 2 * 9:.4f}", f"{0.25 * 0.25:.4f}")
    says("2.7", f"{(1 - 9 / 9.25) ** 2 * 9 + 0.0625:.3f}")


def test_3_1():
    mu, cost = np.array([0.4, 0.4, 0.2]), np.array([5, 15, 50])
    v, policy = implicit(mu, [2, 6, 0], 0.9)
    says("3.1", f"{v:.3f}", *(f"{p:.3f}" for p in policy), f"{policy @ cost:.2f}", f"{mu @ cost:.0f}")
    printed = mu * np.where(np.array([2, 6, 0]) < v, 0.1, 0.9) @ cost
    says("3.1", f"{printed:.1f}", f"{(mu * np.where(np.array([2, 6, 0]) < v, 0.1, 0.9)).sum():.2f}")
    v, policy = implicit(mu, [2, 6, 9], 0.9)
    says("3.1", f"{v:.3f}", f"{policy @ cost:.2f}")


def test_3_2():
    mu, cost = np.array([0.5, 0.5]), np.array([0, 40])
    for shift, probabilities, paid in ((0, [0.2, 0.8], 32), (5, [0.8, 0.2], 8)):
        reward = np.array([-2.0, -6.0]) + shift
        v, policy = implicit(mu, np.where(cost <= 10, reward, 0), 0.8)
        assert policy == pytest.approx(probabilities) and policy @ cost == pytest.approx(paid)
        for price in (0.01, 1, 100):
            priced = reward - price * (np.maximum(cost - 10, 0) - 3.0)  # whatever is given back
            assert implicit(mu, priced, 0.8)[1] == pytest.approx([0.8, 0.2])
        if not shift:
            assert v == pytest.approx(-0.4)
    says("3.2", "-0.4", "32", "8", "20")


def test_3_3():
    """V_c by summing the discounted costs of a policy that takes risky with a given probability."""
    value = lambda risky: sum(0.9**t * risky for t in range(600))  # noqa: E731
    assert [value(0.8), 1 + 0.9 * value(0.8), value(0.95)] == pytest.approx([8, 8.2, 9.5])
    assert [value(0.2), 1 + 0.9 * value(0.2)] == pytest.approx([2, 2.8])
    _, policy = implicit([0.5, 0.5], [0, 0.01], 0.8)  # risky is worth 0, careful a little more
    assert policy == pytest.approx([0.2, 0.8])
    says("3.3", "8", "8.2", "9.5", "2.8")


@pytest.mark.parametrize(
    ("limit", "spent", "step", "rescaled", "told"),
    [
        (30, 12, 40, 30, 25),
        (10, 15, 50, -10, 10),
        (25, 20, 95, 100, 40),
        (0, 0, 0, 0, 10),
        (17.5, 0, 0, 17.5, 10),
    ],
)
def test_3_4(limit, spent, step, rescaled, told):
    found = Fraction(limit - spent) * 100 / (100 - step)
    assert found == rescaled and min((10, 25, 40), key=lambda choice: abs(choice - found)) == told
    says("3.4", f"{rescaled:g}", str(told))


def test_3_5():
    rest = lambda told, t: Fraction(told) * (10 - t) / 10 - 1  # noqa: E731
    after = [rest(5, t) * 10 / (10 - t - 1) for t in (2, 8)]
    assert after == [Fraction(30, 7), 0]
    says("3.5", f"{float(after[0]):.2f}", "4", "1", "0")


@pytest.mark.parametrize(
    ("limit", "value", "cost", "policy"), [(20, 0.7, (0.175, 0.007), 1.08), (15, 2.7, (0.075, 0.003), 0.12)]
)
def test_3_6(limit, value, cost, policy):
    u = (4 if limit >= 18 else 0) - 3
    first, second = (0.7, 0.9) if u > 0 else (1 - 0.7, 1 - 0.9)
    assert first * u**2 == pytest.approx(value) and second * 1.2 == pytest.approx(policy)
    assert [first * (6.5 - 6) ** 2, first * (4.1 - 4) ** 2] == pytest.approx(cost)
    assert (1 + 0.9 * 5 - 4.5) ** 2 == 1
    assert [(1 + 0.9 * 6 - 7) ** 2, (1 + 0.8 * 4 - 4) ** 2] == pytest.approx([0.36, 0.04])
    says("3.6", f"{value:g}", f"{cost[0]:g}", f"{cost[1]:g}", f"{policy:g}", "0.36", "0.04")


def interval(first, second):
    """Mean, half width and ends of the 95% interval of a paired difference."""
    found = stats.ttest_rel(first, second).confidence_interval(0.95)
    middle = (found.low + found.high) / 2
    return middle, (found.high - found.low) / 2, found.low, found.high


def test_3_7():
    middle, half, low, high = interval([0.71, 0.75, 0.70], [0.69, 0.70, 0.68])
    says(
        "3.7",
        f"{np.mean([1.5, 0.8, 0.6]):.2f}",
        "0.90",
        f"{middle:.2f}",
        f"{half:.3f}",
        f"-{-low:.3f}",
        f"{high:.3f}",
    )
    says("3.7", f"{np.std([0.02, 0.05, 0.02], ddof=1):.4f}")
    largest = np.random.default_rng(0).normal(size=(400_000, 10)).max(1).mean()
    assert largest == pytest.approx(1.539, abs=0.003)
    says("3.7", f"{1.539 * 0.05:.3f}")


def test_exam_2():
    mark, fewest, most = verdicts(6, 0.7, 2)
    weights = 0.7 ** np.arange(6)
    assert (fewest, most) == (1, 3)
    says(2, f"{mark:.3f}", f"{weights[3:].sum():.3f}", f"{weights[2:].sum():.3f}", "3")


def test_exam_3():
    w = np.linalg.solve([[1, 1], [0.6, 0.9]], [1, 1])
    assert w == pytest.approx([-1 / 3, 4 / 3])
    says(3, f"{0.2 * sqrt((w**2).sum()):.3f}", "0.2", f"{w @ [1.6, 0.9 * 1.9]:.3f}", "1.71")
    assert 0.2 * w.sum() == pytest.approx(0.2)


def test_exam_4():
    v, policy = implicit([0.75, 0.25], [0, 6], 0.9)
    assert policy == pytest.approx([0.25, 0.75])
    says(4, f"{v:.1f}", f"{policy @ [2, 30]:.0f}")


def test_exam_5():
    _, policy = implicit([0.5, 0.5], np.where(np.array([5, 60]) <= 20, [-3, -8], 0), 0.9)
    assert policy[1] == pytest.approx(0.9)
    says(5, "0.9")


@pytest.mark.parametrize(
    ("limit", "spent", "step", "rescaled", "nearest"),
    [(60, 20, 100, 80, {70}), (50, 60, 150, -40, {30}), (30, 28, 190, 40, {30, 50})],
)
def test_exam_6(limit, spent, step, rescaled, nearest):
    found = (limit - spent) * 200 / (200 - step)
    distances = {choice: abs(choice - found) for choice in (30, 50, 70)}
    assert found == rescaled and {c for c, d in distances.items() if d == min(distances.values())} == nearest
    says(6, f"{rescaled:g}", *map(str, nearest))


def test_exam_8():
    costs = np.array([36, 45, 49]) / [30, 50, 70]
    assert costs == pytest.approx([1.2, 0.9, 0.7])
    middle, half, low, high = interval([0.80, 0.86, 0.77], [0.74, 0.79, 0.75])
    says(8, f"{costs.mean():.3f}", f"{middle:.2f}", f"{half:.3f}", f"-{-low:.3f}", f"{high:.3f}")
    says(8, f"{np.std([0.06, 0.07, 0.02], ddof=1):.4f}")
