"""The laps and the budget rule over them, against simulation, a loop over episodes, and hand-made cases."""

import math

import numpy as np
import pytest

from tutorial_lib.costs.conditioning import ConditioningConfig
from tutorial_lib.course import figures, laps, tabular, widgets
from tutorial_lib.course.tabular.cmdp import draw

CONFIG = ConditioningConfig.make("paper").changed(infinite_at_test="never")


def test_the_goal_leads_back_to_the_start():
    cmdp = tabular.laps(slip=0)
    straight = np.zeros((15, 4))
    straight[:, tabular.ARROWS.index("→")] = 1
    found = tabular.follow(cmdp, 100, lambda t: straight[None])
    # Four moves, one step on the goal, and so on: 20 laps, three hazards each.
    assert found.reward == pytest.approx(20)
    assert found.cost == pytest.approx(60)
    assert found.exceeds(59) == pytest.approx(1) and found.exceeds(60) == 0


def test_a_rate_policy_costs_its_limit_and_no_cheaper_one_is_to_be_had():
    cmdp = tabular.laps()
    policy = tabular.rate_policy(cmdp, 20, 100)
    stationary = tabular.occupancy(cmdp, policy)
    assert (stationary * cmdp.costs).sum() * (1 - cmdp.gamma) * 100 == pytest.approx(20)
    with pytest.raises(ValueError, match="least"):
        tabular.rate_policy(cmdp, 0.01, 100)


def test_follow_agrees_with_values_by_recursion():
    """Expected sums of random policies that depend on nothing spent: a plain backward recursion."""
    rng = np.random.default_rng(0)
    cmdp = tabular.random_cmdp(rng)
    policy = rng.dirichlet(np.ones(3), size=(12, 6))
    found = tabular.follow(cmdp, 12, lambda t: policy[t][None])
    reward, cost = np.zeros((2, 6))
    for t in reversed(range(12)):
        reward = (policy[t] * (cmdp.rewards + cmdp.transitions @ reward)).sum(1)
        cost = (policy[t] * (cmdp.costs + cmdp.transitions @ cost)).sum(1)
    assert found.reward == pytest.approx(cmdp.initial @ reward)
    assert found.cost == pytest.approx(cmdp.initial @ cost)
    np.testing.assert_allclose(found.chances.sum(1), 1)
    assert found.chances[0, 0] == pytest.approx(1)


def played(cmdp, choose, n, rng):
    """The cost and the reward of n episodes of 100 steps, with the actions `choose(t, spent, state)`."""
    state = draw(np.tile(cmdp.initial, (n, 1)), rng)
    spent, earned = np.zeros((2, n))
    for t in range(100):
        action = choose(t, spent, state)
        spent, earned = spent + cmdp.costs[state, action], earned + cmdp.rewards[state, action]
        state = draw(cmdp.transitions[state, action], rng)
    return spent, earned


def test_the_rule_agrees_with_played_episodes():
    """A loop over steps that asks for the nearest threshold in words of its own."""
    rng, cmdp, n, limit = np.random.default_rng(1), tabular.laps(), 4000, 20
    agent = laps.policies((10, 25, 40))
    found = laps.follow_rule(CONFIG, agent, limit)

    def choose(t, spent, state):
        budget = (limit - spent) * 100 / (100 - t)
        told = np.where(budget < 17.5, 10, np.where(budget < 32.5, 25, 40))
        return draw(np.stack([agent[b][s] for b, s in zip(told, state, strict=True)]), rng)

    spent, earned = played(cmdp, choose, n, rng)
    assert found.cost == pytest.approx(spent.mean(), abs=5 * spent.std() / n**0.5)
    assert found.reward == pytest.approx(earned.mean(), abs=5 * earned.std() / n**0.5)
    assert found.exceeds(limit) == pytest.approx((spent > limit).mean(), abs=0.04)


def test_what_is_told_by_hand():
    told = laps.told(CONFIG, 20)
    assert told.shape == (100, 101)
    assert told[0, 0] == 25  # 20 is nearer to 25 than to 10
    assert told[50, 0] == 40  # all of the budget for half of the steps
    assert told[50, 20] == told[99, 100] == 10  # spent, and overspent
    covered = laps.told(CONFIG.changed(infinite_at_test="covered"), 20)
    assert math.isinf(covered[80, 0]) and covered[79, 0] == 40


def best_with_payments(cmdp, state, steps, budget, price):
    """`tabular.plan_budget`, action by action: a plain recursion over every future."""
    if steps == 0:
        return 0.0
    found = []
    for a, cost in enumerate(cmdp.costs[state]):
        left = max(budget - cost, 0)
        later = [p * best_with_payments(cmdp, z, steps - 1, left, price)
                 for z, p in enumerate(cmdp.transitions[state, a]) if p > 0]  # fmt: skip
        found.append(cmdp.rewards[state, a] - price * max(cost - budget, 0) + sum(later))
    return max(found)


@pytest.mark.parametrize("seed, price", [(0, 0.3), (1, 2.0), (2, 0.0)])
def test_the_plan_against_every_future(seed, price):
    cmdp = tabular.random_cmdp(np.random.default_rng(seed), states=4, branching=2)
    cmdp.costs[1] = 1, 1, 2  # a state that costs whatever one does
    cmdp.rewards[2] -= 1
    values, actions = tabular.plan_budget(cmdp, 4, 2, price)
    assert values.shape == (5, 3, 4) and actions.shape == (4, 3, 4)
    for budget in range(3):
        for state in range(4):
            expected = best_with_payments(cmdp, state, 4, budget, price)
            assert values[0, budget, state] == pytest.approx(expected)
    cmdp.costs[:] /= 2
    with pytest.raises(ValueError, match="whole costs"):
        tabular.plan_budget(cmdp, 4, 2, price)


@pytest.mark.parametrize("clock", [True, False])
def test_the_planning_agent_agrees_with_played_episodes(clock):
    """A loop over steps that looks its actions up for each episode, with words of its own for eq. 23."""
    rng, cmdp, n, limit = np.random.default_rng(2), tabular.laps(), 4000, 10
    found = laps.follow_plan(limit, price=0.7, clock=clock)
    _, actions = tabular.plan_budget(cmdp, 100, 60, 0.7)

    def choose(t, spent, state):
        left = np.maximum(limit - spent, 0)
        told = np.minimum(np.round(left * 100 / (100 - t)), 60).astype(int)
        return actions[t, left.astype(int), state] if clock else actions[0, told, state]

    spent, earned = played(cmdp, choose, n, rng)
    assert found.cost == pytest.approx(spent.mean(), abs=5 * spent.std() / n**0.5)
    assert found.reward == pytest.approx(earned.mean(), abs=5 * earned.std() / n**0.5)
    assert found.exceeds(limit) == pytest.approx((spent > limit).mean(), abs=0.04)


def test_an_agent_with_every_rate_agrees_with_played_episodes():
    rng, cmdp, n, limit = np.random.default_rng(3), tabular.laps(), 4000, 10
    agent = laps.policies(range(61))

    def choose(t, spent, state):
        told = np.clip(np.round((limit - spent) * 100 / (100 - t)), 0, 60)
        return draw(np.stack([agent[b][s] for b, s in zip(told, state, strict=True)]), rng)

    spent, earned = played(cmdp, choose, n, rng)
    found = laps.follow_any_rate(limit)
    assert found.cost == pytest.approx(spent.mean(), abs=5 * spent.std() / n**0.5)
    assert found.reward == pytest.approx(earned.mean(), abs=5 * earned.std() / n**0.5)


def test_a_biased_agent_pays_in_proportion():
    for bias in (0.6, 1.6):
        agent = laps.policies((25,), bias)
        assert laps.follow_one(agent[25.0]).cost == pytest.approx(25 * bias, abs=0.3)
    assert laps.follow_one(laps.policies((0,))[0.0]).cost < 0.3


def test_the_slider_draws_another_limit():
    control = widgets.budget_slider(CONFIG, limit=20)
    limit, bias = control.kwargs_widgets
    title = control.result.axes[0].get_title()
    assert title.startswith("limit 20, bias 1: expected cost 20.3")
    limit.value = 35
    assert control.result.axes[0].get_title().startswith("limit 35, bias 1:")
    bias.value = 0.6
    assert control.result.axes[0].get_title().startswith("limit 35, bias 0.6:")


def test_the_figures_show_every_curve_and_every_panel():
    told = laps.told(CONFIG, 20)
    maps = figures.budget_maps({"one": (told, None), "two": (told, np.eye(101))}, (20, 20))
    assert [ax.get_title() for ax in maps.axes] == ["one", "two"]
    assert [text.get_text() for text in maps.legends[0].get_texts()][-3:] == ["told 10", "told 25", "told 40"]
    line = np.arange(3.0)
    pairs = {name: (line, line + n) for n, name in enumerate("abc")}
    curves = figures.against_optimum(line, pairs, (1,))
    assert [drawn.get_label() for drawn in curves.axes[0].lines][:3] == ["a", "b", "c"]
    agents = figures.with_and_without_rule(line, {"thrifty": (line, line), "spendthrift": (line, line)})
    assert [ax.get_title() for ax in agents.axes] == ["thrifty", "spendthrift"]
