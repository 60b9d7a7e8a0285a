"""The notions of safety of notebook 15: exact solvers against oracles, checkers, and the picture of all."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest

from tutorial_lib.course import checks, figures, tabular
from tutorial_lib.course.tabular import safety

WORLD = safety.aisle()


def by_walking(world, horizon, policy):
    """The return and the probabilities of the costs, by a walk over all paths, one at a time."""
    reward, chances = 0.0, np.zeros(horizon + 1)

    def walk(t, spent, s, chance, earned):
        nonlocal reward
        if t == horizon:
            chances[spent] += chance
            reward += chance * earned
            return
        for a in np.flatnonzero(policy[t, spent, s]):
            for z in np.flatnonzero(world.transitions[s, a]):
                step = chance * policy[t, spent, s, a] * world.transitions[s, a, z]
                walk(t + 1, spent + int(world.costs[s, a]), z, step, earned + world.rewards[s, a])

    for s in np.flatnonzero(world.initial):
        walk(0, 0, s, world.initial[s], 0.0)
    return reward, chances


def every_policy(world, horizon):
    """The best return at each distribution of the cost that a deterministic policy can have.

    The policies are all functions of step, spent cost and state. They are made by recursion: an outcome from
    (t, spent, s) is an action, and an outcome for each state that can follow it.
    """

    @functools.cache
    def outcomes(t, spent, s):
        if t == horizon:
            return {tuple(np.eye(horizon + 1)[spent]): 0.0}
        found = {}
        for a in range(world.rewards.shape[1]):
            after = np.flatnonzero(world.transitions[s, a])
            weights = world.transitions[s, a, after]
            sets = [outcomes(t + 1, spent + int(world.costs[s, a]), z).items() for z in after]
            for combination in itertools.product(*sets):
                chances = tuple((weights @ np.array([chances for chances, _ in combination])).round(9))
                reward = world.rewards[s, a] + weights @ np.array([reward for _, reward in combination])
                found[chances] = max(found.get(chances, -np.inf), float(reward))
        return found

    found = outcomes(0, 0, int(world.initial.argmax()))
    return [(reward, np.array(chances)) for chances, reward in found.items()]


def best_mix(policies, function, bound):
    """The largest return of a mixture of two policies with a mean of `function` of at most `bound`."""
    points = np.array([(chances @ function, reward) for reward, chances in policies])
    best = points[points[:, 0] <= bound + 1e-9, 1].max(initial=-np.inf)
    for (x, r), (y, q) in itertools.combinations(points, 2):
        if min(x, y) <= bound <= max(x, y) and x != y:
            share = (bound - y) / (x - y)
            best = max(best, share * r + (1 - share) * q)
    return best


SHORT = dataclasses.replace(WORLD, initial=np.eye(4)[2])
"""The aisle, for episodes that begin close to people."""


@pytest.fixture(scope="module")
def all_of_five_steps():
    return every_policy(SHORT, 5)


def test_every_policy_was_found(all_of_five_steps):
    best, _ = safety.plan_bill(SHORT, 5, np.zeros(6))
    assert len(all_of_five_steps) > 20
    assert max(reward for reward, _ in all_of_five_steps) == pytest.approx(by_walking(SHORT, 5, best)[0])


COSTS = np.arange(6.0)


@pytest.mark.parametrize(
    "function, bound",
    [
        (COSTS, 0.5),
        (COSTS, 0.8),
        ((COSTS > 0).astype(float), 0.4),
        ((COSTS > 1).astype(float), 0.2),
        (np.clip(COSTS - 1, 0, None) / 0.1, 3.0),
        (COSTS**2, 1.5),
    ],
)
def test_the_linear_programme_finds_the_best_mixture_of_all_policies(function, bound, all_of_five_steps):
    found = safety.solve_spent(SHORT, 5, function, bound)
    assert found.reward == pytest.approx(best_mix(all_of_five_steps, function, bound), abs=1e-5)
    reward, chances = by_walking(SHORT, 5, found.policy)
    assert reward == pytest.approx(found.reward, abs=1e-7)
    assert chances @ function <= bound + 1e-7


def test_for_the_expected_cost_the_spent_cost_is_of_no_use():
    for limit in (0.0, 0.7, 2.0):
        known = safety.solve_spent(WORLD, 12, np.arange(13.0), limit)
        unknown = tabular.solve_episodes(WORLD, 12, limit)
        assert known.reward == pytest.approx(unknown.reward, abs=1e-6)
        assert known.price == pytest.approx(unknown.price, abs=1e-4) or limit == 0


def test_a_plan_for_a_bill_is_the_best_of_all_policies(all_of_five_steps):
    for bill in (0 * COSTS, 3 * COSTS, 20 * (COSTS > 1), np.array([0, 0, 5, 4, 9.0, 9.0])):
        policy, value = safety.plan_bill(SHORT, 5, bill)
        best = max(reward - chances @ bill for reward, chances in all_of_five_steps)
        assert value == pytest.approx(best, abs=1e-6)
        reward, chances = by_walking(SHORT, 5, policy)
        assert reward - chances @ bill == pytest.approx(value)


def test_a_plan_for_the_overspent_budget_is_that_of_the_budget_as_state():
    horizon, limit, price = 15, 2, 20.0
    bill = price * np.clip(np.arange(horizon + 1) - limit, 0, None)
    values, _ = tabular.plan_budget(WORLD, horizon, limit, price)
    assert safety.plan_bill(WORLD, horizon, bill)[1] == pytest.approx(values[0, limit, 0])


def test_the_worst_cost_is_that_of_the_worst_path():
    def worst(t, s):
        if t == 5:
            return 0
        return min(
            WORLD.costs[s, a] + max(worst(t + 1, z) for z in np.flatnonzero(WORLD.transitions[s, a]))
            for a in range(2)
        )

    table = safety.worst_costs(WORLD, 5)
    assert table.tolist() == [[worst(t, s) for s in range(4)] for t in range(6)]


@pytest.mark.parametrize("limit", [0, 1, 3])
def test_behind_the_shield_no_episode_is_above_the_limit_and_none_earns_more(limit):
    allowed = safety.shield(WORLD, 20, limit)
    policy, value = safety.plan_bill(WORLD, 20, np.zeros(21), allowed)
    found = tabular.follow(WORLD, 20, policy.__getitem__)
    assert found.exceeds(limit) == 0
    values, _ = tabular.budget_optimum(WORLD, 20, limit, stopped=-np.inf)
    assert found.reward == pytest.approx(values[0, limit, 0])
    assert value == pytest.approx(found.reward)
    assert safety.solve_spent(WORLD, 20, (np.arange(21) > limit) * 1.0, 0.0).reward == pytest.approx(value)


def test_where_nothing_is_certain_the_shield_allows_the_least_worst():
    allowed = safety.shield(WORLD, 20, 0)
    assert allowed[0, 3].tolist() == [[True, False], [True, False], [True, True], [True, True]]


def test_tail_mean_is_the_mean_of_the_worst_sorted_episodes():
    rng = np.random.default_rng(0)
    costs = rng.integers(0, 8, 1000)
    chances = np.bincount(costs) / 1000
    for share in (0.05, 0.1, 0.37, 1.0):
        worst = np.sort(costs)[-round(1000 * share) :]
        assert safety.tail_mean(chances, share) == pytest.approx(worst.mean())


def test_solve_tail_is_the_best_mixture_of_all_policies_over_a_grid_of_eta(all_of_five_steps):
    for limit in (2.2, 2.5, 3.0):
        best = max(
            best_mix(all_of_five_steps, np.clip(COSTS - eta, 0, None) / 0.2, limit - eta)
            for eta in (0, 0.5, 1, 1.5, 2, limit - 0.1)
        )
        found = safety.solve_tail(SHORT, 5, limit, 0.2)
        assert found.reward == pytest.approx(best, abs=1e-5)
        assert safety.tail_mean(by_walking(SHORT, 5, found.policy)[1], 0.2) <= limit + 1e-6


def test_an_impossible_limit_is_an_error():
    with pytest.raises(ValueError, match="no policy keeps the bound"):
        safety.solve_spent(WORLD, 5, np.ones(6), 0.5)
    with pytest.raises(ValueError, match="no policy keeps the limit"):
        always = tabular.CMDP(WORLD.transitions, WORLD.rewards, np.ones((4, 2)), WORLD.initial, 0.9)
        safety.solve_tail(always, 5, 2, 0.1)
    dear = tabular.CMDP(WORLD.transitions, WORLD.rewards, 2 * WORLD.costs, WORLD.initial, 0.9)
    with pytest.raises(ValueError, match="costs must be 0 or 1"):
        safety.plan_bill(dear, 5, np.zeros(6))


def test_actions_that_are_not_allowed_are_not_taken():
    allowed = np.array([[True, True], [True, False], [False, True], [True, True]])
    found = safety.solve_spent(WORLD, 8, np.arange(9.0), 0.3, allowed)
    assert (found.policy[..., ~allowed] == 0).all()
    free = safety.solve_spent(WORLD, 8, np.arange(9.0), 0.3)
    assert found.reward < free.reward


def test_replanning_limits_the_cost_to_come():
    """At the last step, and at the second to last one, by hand."""
    policy = safety.replanned(WORLD, 2, 1)
    people, close, contact = 1, 2, 3
    assert policy[1, 0, people].tolist() == [0, 1]  # the last step cannot lead to a cost
    assert policy[0, 0, people].tolist() == [0, 1]  # contact in the last step costs 1 with 1/2
    assert safety.replanned(WORLD, 2, 0)[0, 0, people].tolist() == [1, 0]
    assert safety.replanned(WORLD, 2, 0)[0, 0, close].tolist() == [1, 0]  # nothing is certain: the least
    assert policy[1, 1, contact].sum() == 1


def test_the_answers_are_nested_as_the_notions_are():
    found = figures.aisle_answers(2)
    assert found["hard"].exceeds(2) == 0
    assert found["chance"].exceeds(2) == pytest.approx(0.1, abs=1e-6)
    assert found["expected cost"].cost == pytest.approx(2, abs=1e-6)
    assert safety.tail_mean(found["CVaR"].chances[-1], 0.1) == pytest.approx(2, abs=1e-6)
    returns = [found[name].reward for name in ("hard", "CVaR", "chance", "no limit")]
    assert returns == sorted(returns) and found["CVaR"].reward < found["expected cost"].reward


# Checkers


def sorted_tail(chances, share):
    costs = np.repeat(np.arange(len(chances)), np.round(np.asarray(chances) * 10_000).astype(int))
    return np.sort(costs)[-int(round(10_000 * share)) :].mean()


def by_eta(chances, share):
    costs = np.arange(len(chances))
    return min(eta + chances @ np.clip(costs - eta, 0, None) / share for eta in costs)


@pytest.mark.parametrize("answer", [sorted_tail, by_eta, safety.tail_mean])
def test_every_form_of_the_tail_mean_passes(answer, capsys):
    checks.check_tail_mean(answer)
    assert capsys.readouterr().out.startswith("OK  ")


def value_at_risk(chances, share):
    return float(np.searchsorted(np.cumsum(chances), 1 - share + 1e-9))


@pytest.mark.parametrize(
    "answer, hint",
    [
        (value_at_risk, "fill the share up"),
        (lambda chances, share: chances @ np.arange(len(chances)), "the worst half costs 2"),
        (lambda chances, share: float(len(chances) - 1), "fill the share up"),
        (lambda chances, share: by_eta(chances, share) * share, "the worst half costs 2"),
        (lambda chances, share: None, "returns nothing"),
        (lambda chances, share: 1 / 0, "raised ZeroDivisionError"),
    ],
)
def test_a_wrong_tail_mean_gets_its_hint(answer, hint, capsys):
    checks.check_tail_mean(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


KEPT = {
    ("steady", 2): {"expected"},
    ("steady", 4): {"expected", "chance", "CVaR", "hard"},
    ("rare", 2): {"expected", "chance"},
    ("rare", 4): {"expected", "chance"},
}


@pytest.mark.parametrize("form", [set, list, tuple, frozenset])
def test_the_kept_notions_pass(form, capsys):
    checks.check_kept({key: form(names) for key, names in KEPT.items()})
    assert capsys.readouterr().out == "OK  all four tables of kept notions\n"


def test_a_single_name_may_stand_alone(capsys):
    checks.check_kept(KEPT | {("steady", 2): "expected"})
    assert capsys.readouterr().out.startswith("OK")


@pytest.mark.parametrize(
    "key, names, hint",
    [
        (("steady", 2), set(), "mean of exactly the limit keeps it"),
        (("steady", 2), {"expected", "chance"}, "five are not"),
        (("steady", 2), {"expected", "CVaR"}, "the two worst episodes"),
        (("steady", 4), {"expected", "chance", "CVaR"}, "hard is kept"),
        (("rare", 2), {"expected"}, "chance is kept"),
        (("rare", 2), {"expected", "chance", "hard"}, "one episode above"),
        (("rare", 4), {"expected", "chance", "CVaR"}, "CVaR is not kept"),
        (("rare", 4), {"mean"}, "the names are"),
        (("rare", 4), ..., "in place of"),
        (("rare", 4), None, "the names are"),
    ],
)
def test_a_wrong_notion_gets_its_hint(key, names, hint, capsys):
    checks.check_kept(KEPT | {key: names})
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  {key[0]}, limit {key[1]}: ") and hint in said and said.count("\n") == 1


def test_the_table_of_kept_notions_is_that_of_the_sorted_costs():
    """KEPT, from the records alone."""
    for (name, limit), names in KEPT.items():
        costs = sorted(checks.RECORDS[name])
        assert sum(costs) == 40 and ("expected" in names) == (sum(costs) / 20 <= limit)
        assert ("chance" in names) == (sum(cost > limit for cost in costs) <= 2)
        assert ("CVaR" in names) == (sum(costs[-2:]) / 2 <= limit)
        assert ("hard" in names) == (costs[-1] <= limit)


BY_HAND = {"first": 1, "after a contact": 1, "after none": 4 / 15, "return": 4.9}


def test_the_game_by_hand_is_solved_by_a_grid():
    """Over the probabilities to be fast at first, after no contact, and after a slow first round."""
    x, y, z = np.meshgrid(*[np.linspace(0, 1, 61)] * 3, indexing="ij")
    risk = x * (1 / 4 + 3 / 4 * z / 4) + (1 - x) * y / 4
    earned = x * (3 + 3 / 4 + 3 / 4 * (1 + 2 * z)) + (1 - x) * (2 + 2 * y)
    kept = risk <= 0.3 + 1e-9
    best = np.argmax(np.where(kept, earned, -1))
    assert x.flat[best] == 1 and z.flat[best] == pytest.approx(4 / 15)  # 16 of 60
    assert earned.flat[best] == pytest.approx(4.9)


@pytest.mark.parametrize("number", [float, np.float64, lambda n: round(n, 2), np.array, str])
def test_the_game_by_hand_passes(number, capsys):
    checks.check_by_hand({name: number(n) for name, n in BY_HAND.items()})
    assert capsys.readouterr().out.startswith("OK  ")


@pytest.mark.parametrize(
    "name, wrong, hint",
    [
        ("first", 0, "nothing else earns as much"),
        ("after a contact", 0, "above the limit already"),
        ("after none", 0.2, "1/4 of the 0.3"),
        ("after none", 0.05, "1/4 of the 0.3"),
        ("return", 4.5, "3 for the first round"),
        ("return", ..., "in place of"),
        ("return", "much", "3 for the first round"),
        ("return", None, "3 for the first round"),
        ("return", float("nan"), "3 for the first round"),
    ],
)
def test_a_wrong_number_of_the_game_gets_its_hint(name, wrong, hint, capsys):
    checks.check_by_hand(BY_HAND | {name: wrong})
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  {name}: ") and hint in said and said.count("\n") == 1


REQUIRED = {
    "fee": ("expected", "BCQ-Lag"),
    "acid": ("hard", "FISOR"),
    "void": ("chance", "none"),
    "insurer": ("CVaR", "none"),
    "ward": ("budget", "C2IQL"),
}


@pytest.mark.parametrize(
    "change",
    [{}, {"ward": ["budget", "caps"]}, {"fee": ("Expected", "CPQ")}, {"insurer": ("cvar", "None")}],
)
def test_right_requirements_pass(change, capsys):
    checks.check_requirements(REQUIRED | change)
    assert capsys.readouterr().out.startswith("OK  ")


@pytest.mark.parametrize(
    "name, answer, hint",
    [
        ("fee", ("budget", "C2IQL"), "limit on the mean"),
        ("acid", ("chance", "none"), "no share of episodes"),
        ("acid", ("hard", "C2IQL"), "C2IQL does not give it"),
        ("void", ("CVaR", "none"), "not how far"),
        ("insurer", ("expected", "CPQ"), "worst episodes alone"),
        ("ward", ("expected", "C2IQL"), "changes daily"),
        ("ward", ("budget", "BC-Safe"), "BC-Safe does not give it"),
        ("ward", ..., "in place of"),
        ("ward", (..., ...), "in place of"),
        ("ward", "budget", "a pair is expected"),
        ("ward", ("safe", "C2IQL"), "the notions are"),
    ],
)
def test_a_wrong_requirement_gets_its_hint(name, answer, hint, capsys):
    checks.check_requirements(REQUIRED | {name: answer})
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  {name}: ") and hint in said.replace("and not", "not")
    assert said.count("\n") == 1


def test_the_methods_of_the_requirements_are_algorithms():
    from tutorial_lib.agents import ALGORITHMS

    named = set().union(*(methods for _, methods, _ in checks.REQUIREMENTS.values())) - {"none"}
    assert named <= set(ALGORITHMS)


@pytest.mark.parametrize("answer", [{"a", "b", "c", "d"}, ["d", "c", "b", "a"], "abcd", "A, B, C, D"])
def test_the_four_faults_pass(answer, capsys):
    checks.check_faults(answer)
    assert capsys.readouterr().out.startswith("OK  ")


@pytest.mark.parametrize(
    "answer, hint",
    [
        ({"a", "b", "c"}, "1 of the four faults"),
        (set(), "4 of the four faults"),
        ({"a", "b", "c", "d", "e"}, "e is no fault"),
        ("abcg", "g is no fault"),
        ({"z"}, "the letters are"),
        (..., "in place of"),
        (4, "in place of"),
    ],
)
def test_wrong_faults_get_their_hint(answer, hint, capsys):
    checks.check_faults(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


@pytest.mark.parametrize(
    "check", [checks.check_kept, checks.check_by_hand, checks.check_requirements, checks.check_faults]
)
def test_no_answer_at_all_is_no_error(check, capsys):
    check(None)
    assert capsys.readouterr().out.startswith("NOT YET  ")


# Figures


def test_the_map_moves_with_the_limit():
    low, high = figures.safety_map(0), figures.safety_map(2)
    for figure, limit in ((low, 0), (high, 2)):
        left, right = figure.axes
        (line,) = [line for line in left.lines if line.get_label() == "limit"]
        assert set(line.get_xdata()) == {limit}
        rows = [text.get_text() for text in right.texts]
        assert [row.split(":")[0] for row in rows] == [
            f"{n} {name}" for n, name in enumerate(figures.aisle_answers(limit), 1)
        ]
        assert rows[-1].endswith(" 0% above")
    assert "limit 2" in high.alt_text() and low.small_png() != high.small_png()


def test_the_bars_of_the_map_are_the_probabilities():
    figure = figures.safety_map(2)
    right, found = figure.axes[1], figures.aisle_answers(2)
    heights = np.array([bar.get_height() for bar in right.patches]).reshape(len(found), -1).sum(1)
    assert np.allclose(heights, heights[0])  # each row sums to the same


def test_the_multiplier_has_two_panels_for_each_way():
    paths = {"a": np.array([[1.0, 0.0], [2.0, 3.0]]), "b": np.array([[0.0, 1.0], [2.0, 4.0]])}
    figure = figures.multiplier_paths(paths, 2, 3.5)
    assert [ax.get_title() for ax in figure.axes[:2]] == ["a", "b"]
    assert figure.axes[2].lines[0].get_ydata().tolist() == [0, 3]
    assert set(figure.axes[3].lines[1].get_ydata()) == {3.5}


def test_the_map_of_the_aisle_names_its_states():
    words = " ".join(text.get_text() for text in figures.aisle_map().axes[0].texts)
    assert all(name in words for name in safety.AISLE)


def test_two_policies_show_their_episodes():
    figure = figures.episodes_of_two({name: np.array(c) for name, c in checks.RECORDS.items()}, 2)
    assert [ax.get_title() for ax in figure.axes] == ["steady", "rare"]
    assert [len(ax.patches) for ax in figure.axes] == [20, 20]
    assert "highest 12" in figure.alt_text()
