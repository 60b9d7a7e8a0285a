"""Exact solutions against enumeration of all policies, simulation, closed forms and other solvers."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.optimize import brentq

from tutorial_lib.course import tabular
from tutorial_lib.course.tabular import random_cmdp, shortcut


def uniform(cmdp):
    return np.full(cmdp.rewards.shape, 1 / cmdp.rewards.shape[1])


def random_policy(cmdp, rng):
    return rng.dirichlet(np.ones(cmdp.rewards.shape[1]), size=cmdp.rewards.shape[0])


def iterated_values(cmdp, policy, signal, gamma, steps=2000):
    """V by a slow loop over states, actions and next states; no linear algebra."""
    states, actions = signal.shape
    v = np.zeros(states)
    for _ in range(steps):
        v = np.array([
            sum(policy[s, a] * (signal[s, a] + gamma * cmdp.transitions[s, a].dot(v)) for a in range(actions))
            for s in range(states)
        ])  # fmt: skip
    return v


def all_deterministic(cmdp):
    """(reward, cost) of each deterministic policy, by the slow loop."""
    states, actions = cmdp.rewards.shape
    for choice in itertools.product(range(actions), repeat=states):
        policy = np.eye(actions)[list(choice)]
        yield tuple(
            cmdp.initial @ iterated_values(cmdp, policy, signal, cmdp.gamma, 250)
            for signal in (cmdp.rewards, cmdp.costs)
        )


@pytest.fixture
def rng():
    return np.random.default_rng(0)


# --- CMDPs ---


def test_what_is_not_a_cmdp_is_refused(rng):
    good = random_cmdp(rng)
    for wrong in (
        {"transitions": good.transitions * 1.01},
        {"initial": good.initial - [1, 0, 0, 0, 0, -1]},
        {"costs": good.costs[:, :2]},
        {"gamma": 1.0},
    ):
        with pytest.raises(ValueError):
            dataclasses.replace(good, **wrong)


def test_random_cmdps_branch_as_asked(rng):
    cmdp = random_cmdp(rng, states=9, actions=4, gamma=0.8, branching=2)
    assert cmdp.transitions.shape == (9, 4, 9)
    assert ((cmdp.transitions > 0).sum(-1) == 2).all()
    assert set(np.unique(cmdp.costs)) == {0.0, 1.0}


@pytest.mark.parametrize(
    "way, steps, hazards",
    [("→→→→", 4, [1, 2, 3]), ("↑→→→→↓", 6, [3]), ("↑↑→→→→↓↓", 8, [])],
    ids=["through", "over", "around"],
)
def test_the_three_ways_of_the_shortcut_in_closed_form(way, steps, hazards):
    """Without slips: gamma^steps / (1 - gamma) in reward, gamma^t for the hazard left at step t."""
    cmdp = shortcut(slip=0.0)
    policy, state = uniform(cmdp), 10
    for arrow in way:
        action = tabular.ARROWS.index(arrow)
        policy[state] = np.eye(4)[action]
        state = int(cmdp.transitions[state, action].argmax())
    assert state == 14
    assert tabular.state_values(cmdp, policy)[10] == pytest.approx(0.9**steps / 0.1)
    assert tabular.state_values(cmdp, policy, "costs")[10] == pytest.approx(sum(0.9**t for t in hazards))


def test_a_slip_goes_anywhere():
    cmdp = shortcut(slip=0.2)
    right_from_the_middle = cmdp.transitions[6, 1]
    assert right_from_the_middle[[1, 7, 11, 5]] == pytest.approx([0.05, 0.85, 0.05, 0.05])
    assert cmdp.transitions[0, 0, [0, 1, 5]] == pytest.approx([0.9, 0.05, 0.05])  # the corner: two walls
    assert (cmdp.transitions[14, :, 14] == 1).all()


# --- A given policy ---


@pytest.mark.parametrize("signal", ["rewards", "costs"])
@pytest.mark.parametrize("gamma", [None, 0.5])
def test_values_of_a_policy(rng, signal, gamma):
    cmdp = random_cmdp(rng, states=4)
    policy = random_policy(cmdp, rng)
    expected = iterated_values(cmdp, policy, getattr(cmdp, signal), gamma or cmdp.gamma, 400)
    v = tabular.state_values(cmdp, policy, signal, gamma)
    assert v == pytest.approx(expected, abs=1e-9)
    q = tabular.action_values(cmdp, policy, signal, gamma)
    assert (policy * q).sum(1) == pytest.approx(expected, abs=1e-9)
    one = getattr(cmdp, signal)[2, 1] + (gamma or cmdp.gamma) * cmdp.transitions[2, 1] @ expected
    assert q[2, 1] == pytest.approx(one, abs=1e-9)


def test_occupancy_is_what_a_simulation_counts(rng):
    cmdp = random_cmdp(rng, states=4, gamma=0.8)
    policy = random_policy(cmdp, rng)
    visits = tabular.occupancy(cmdp, policy)
    assert visits.sum() == pytest.approx(5)
    played = tabular.simulate(cmdp, policy, 60, 20_000, rng)
    counted = np.zeros_like(visits)
    np.add.at(counted, (played.states, played.actions), 0.8 ** np.arange(60) / 20_000)
    assert counted == pytest.approx(visits, abs=0.03)
    assert (played.costs == cmdp.costs[played.states, played.actions]).all()


def test_a_policy_per_step_is_followed(rng):
    cmdp = random_cmdp(rng)
    policy = np.eye(3)[np.array([0, 1, 2, 1])][:, None, :].repeat(6, axis=1)
    assert (tabular.simulate(cmdp, policy, 4, 50, rng).actions == [0, 1, 2, 1]).all()


# --- The best policy under a limit ---


@pytest.mark.parametrize("seed", range(3))
def test_solve_against_all_deterministic_policies(seed):
    """Best and cheapest of 81; between, the frontier is their upper hull: a linear interpolation."""
    cmdp = random_cmdp(np.random.default_rng(seed), states=4, branching=2, gamma=0.8)
    reward, cost = np.array(list(all_deterministic(cmdp))).T
    assert tabular.solve(cmdp).reward == pytest.approx(reward.max(), abs=1e-6)
    with pytest.raises(ValueError, match="least achievable cost") as error:
        tabular.solve(cmdp, cost.min() - 1e-3)
    assert float(str(error.value).split()[-1]) == pytest.approx(cost.min(), abs=1e-5)
    assert tabular.least_cost(cmdp) == pytest.approx(cost.min(), abs=1e-6)
    for limit in np.linspace(cost.min() + 1e-6, cost.max(), 7):
        best = reward[cost <= limit].max()  # one policy, or a mixture of a cheap and a dear one:
        for i, j in itertools.product(np.flatnonzero(cost <= limit), np.flatnonzero(cost > limit)):
            share = (limit - cost[i]) / (cost[j] - cost[i])
            best = max(best, (1 - share) * reward[i] + share * reward[j])
        found = tabular.solve(cmdp, limit)
        assert found.reward == pytest.approx(best, abs=1e-5)
        assert found.cost <= limit + 1e-6


@pytest.mark.parametrize("limit", [0.05, 0.4, 1.0, 2.0])
def test_the_policy_earns_and_costs_what_the_programme_says(limit):
    cmdp = shortcut()
    found = tabular.solve(cmdp, limit)
    reward, cost = (cmdp.initial @ tabular.state_values(cmdp, found.policy, s) for s in ("rewards", "costs"))
    assert (found.reward, found.cost) == pytest.approx((reward, cost), abs=1e-6)
    assert found.cost == pytest.approx(limit)
    assert found.occupancy == pytest.approx(tabular.occupancy(cmdp, found.policy), abs=1e-6)


@pytest.mark.parametrize("limit", [0.05, 0.4, 1.0, 2.0])
def test_solve_against_the_lagrangian(limit):
    """Strong duality: min over the price of value iteration's best r - price (c - limit)."""

    def dual(price):
        v = np.zeros(15)
        for _ in range(300):
            v = (cmdp.rewards - price * cmdp.costs + 0.9 * cmdp.transitions @ v).max(1)
        return cmdp.initial @ v + price * limit

    cmdp = shortcut()
    found = tabular.solve(cmdp, limit)
    assert dual(found.price) == pytest.approx(found.reward, abs=1e-6)
    assert min(dual(price) for price in np.linspace(0, 3, 31)) >= found.reward - 1e-6


def test_between_the_ways_the_best_policy_mixes():
    found = tabular.solve(shortcut(), 1.0)
    seen = found.occupancy.sum(1) > 1e-9
    mixes = (found.policy.max(1) < 1 - 1e-6) & seen
    assert mixes.sum() == 1
    with pytest.raises(ValueError, match="limit 0.02: the least achievable cost is 0.0279"):
        tabular.solve(shortcut(), 0.02)


def test_no_limit_has_no_price(rng):
    cmdp = random_cmdp(rng)
    free = tabular.solve(cmdp)
    assert free.price == 0
    loose = tabular.solve(cmdp, free.cost + 1)
    assert (loose.price, loose.reward) == pytest.approx((0, free.reward))


# --- Episodes of fixed length ---


def best_tree(cmdp, state, steps, budget):
    """The hard budget, action by action: a plain recursion over every future."""
    if steps == 0:
        return 0.0
    values = [
        cmdp.rewards[state, a]
        + sum(p * best_tree(cmdp, z, steps - 1, budget - cmdp.costs[state, a])
              for z, p in enumerate(cmdp.transitions[state, a]) if p > 0)
        for a in range(cmdp.rewards.shape[1])
        if cmdp.costs[state, a] <= budget
    ]  # fmt: skip
    return max(values, default=0.0)


@pytest.mark.parametrize("seed", range(4))
def test_the_budget_optimum_against_every_future(seed):
    cmdp = random_cmdp(np.random.default_rng(seed), states=4, branching=2)
    cmdp.costs[1] = 1, 1, 2  # a state that costs whatever one does
    values, policy = tabular.budget_optimum(cmdp, 4, 2)
    assert values.shape == (5, 3, 4) and policy.shape == (4, 3, 4)
    for budget, state in itertools.product(range(3), range(4)):
        assert values[0, budget, state] == pytest.approx(best_tree(cmdp, state, 4, budget))
    assert (policy[:, 0, 1] == -1).all() and (policy[:, 2] >= 0).all()


@pytest.mark.parametrize("budget", [0, 3])
def test_the_budget_optimum_plays_as_promised(rng, budget):
    cmdp, horizon = shortcut(0.2), 12
    values, policy = tabular.budget_optimum(cmdp, horizon, budget)
    played = tabular.play_budget(cmdp, policy, 20_000, rng)
    assert played.costs.sum(1).max() == budget
    assert played.rewards.sum(1).mean() == pytest.approx(values[0, budget, 10], abs=0.06)
    stopped = played.actions[:, -1] == -1
    assert 0 < stopped.mean() < 0.5
    on_hazards = np.isin(played.states, [7, 11, 12, 13])  # stopped there, with nothing left to spend
    assert on_hazards[stopped, -1].all() and not (on_hazards & (played.costs == 0))[~stopped].any()
    assert (played.rewards[stopped] == 0).all() and (played.rewards[~stopped].sum(1) > 0).any()


def test_a_budget_for_certain():
    """-inf marks where no policy can keep the budget, whatever it slips on."""
    values, _ = tabular.budget_optimum(shortcut(), 5, 5, stopped=-np.inf)
    assert np.isneginf(values[0, 0, [10, 7, 11]]).all()
    assert np.isneginf(values[0, :5, 12]).all() and np.isfinite(values[0, 5]).all()
    assert values[2, 0, 0] == 0 and values[0, 0, 14] == 5  # a corner is three steps from the next hazard
    with pytest.raises(ValueError, match="whole costs"):
        tabular.budget_optimum(dataclasses.replace(shortcut(), costs=shortcut().costs / 2), 5, 5)


def test_the_expected_cost_optimum_of_an_episode():
    """Without slips: 8, 6 and 4 steps at the goal out of 12, for 3, 1 and 0 hazards, mixed in between."""
    cmdp = shortcut(slip=0.0)
    for limit, reward in ((0, 4), (0.5, 5), (1, 6), (2, 7), (3, 8), (9, 8)):
        assert tabular.solve_episodes(cmdp, 12, limit).reward == pytest.approx(reward)


def test_the_expected_cost_optimum_against_the_lagrangian(rng):
    cmdp, horizon, limit = random_cmdp(rng, states=4), 6, 0.6
    found = tabular.solve_episodes(cmdp, horizon, limit)

    def dual(price):
        v = np.zeros(4)
        for _ in range(horizon):
            v = (cmdp.rewards - price * cmdp.costs + cmdp.transitions @ v).max(1)
        return cmdp.initial @ v + price * limit

    assert dual(found.price) == pytest.approx(found.reward, abs=1e-6)
    played = tabular.simulate(cmdp, found.policy, horizon, 20_000, rng)
    assert played.rewards.sum(1).mean() == pytest.approx(found.reward, abs=0.03)
    assert played.costs.sum(1).mean() == pytest.approx(found.cost, abs=0.03) and found.cost <= limit + 1e-9
    with pytest.raises(ValueError, match="least achievable"):
        tabular.solve_episodes(cmdp, horizon, -1)


def test_a_hard_budget_earns_no_more_than_an_expected_one():
    cmdp = shortcut()
    values, _ = tabular.budget_optimum(cmdp, 12, 4)
    for budget in range(1, 5):
        assert values[0, budget, 10] <= tabular.solve_episodes(cmdp, 12, budget).reward + 1e-9


# --- Implicit Q-learning ---


@pytest.mark.parametrize("kappa", [0.1, 0.5, 0.7, 0.95])
def test_expectiles_against_root_finding(rng, kappa):
    mu, q = rng.dirichlet(np.ones(5), size=20), rng.normal(size=(20, 5))
    mu[:10, 2] = 0
    mu[:10] /= mu[:10].sum(1, keepdims=True)
    mu[0] = 0, 0, 0, 1, 0
    found = tabular.expectile(mu, q, kappa)
    for s in range(20):

        def slope(v, s=s):
            return (mu[s] * np.where(q[s] > v, kappa, 1 - kappa) * (q[s] - v)).sum()

        assert found[s] == pytest.approx(brentq(slope, q[s].min() - 1, q[s].max() + 1), abs=1e-9)


def test_the_implicit_policy_by_hand():
    mu, q, v = np.array([[0.5, 0.25, 0.25]]), np.array([[1.0, 3.0, 2.0]]), np.array([2.0])
    found = tabular.implicit_policy(mu, q, v, lambda u: np.where(u < 0, 0.2, 0.8))
    assert found == pytest.approx(np.array([[0.1, 0.2, 0.2]]) / 0.5)


def test_iql_at_one_half_is_the_behaviour_and_near_one_the_best(rng):
    cmdp = random_cmdp(rng)
    mu = random_policy(cmdp, rng)
    q, v = tabular.iql_fixed_point(cmdp, mu, 0.5)
    assert v == pytest.approx(iterated_values(cmdp, mu, cmdp.rewards, 0.9, 400), abs=1e-8)
    _, best = tabular.iql_fixed_point(cmdp, mu, 1 - 1e-7)
    greedy = np.zeros(6)
    for _ in range(500):
        greedy = (cmdp.rewards + 0.9 * cmdp.transitions @ greedy).max(1)
    assert best == pytest.approx(greedy, abs=1e-3)


@pytest.mark.parametrize("gamma", [None, 0.7])
def test_iql_values_are_those_of_its_implicit_policy(rng, gamma):
    cmdp = random_cmdp(rng)
    mu = random_policy(cmdp, rng)
    q, v = tabular.iql_fixed_point(cmdp, mu, 0.8, gamma)
    policy = mu * np.where(q < v[:, None], 0.2, 0.8)
    policy /= policy.sum(1, keepdims=True)
    assert v == pytest.approx(iterated_values(cmdp, policy, cmdp.rewards, gamma or 0.9, 400), abs=1e-8)


def test_ciql_with_a_loose_limit_is_iql_and_prices_its_policy(rng):
    cmdp = random_cmdp(rng)
    mu = random_policy(cmdp, rng)
    q, v = tabular.iql_fixed_point(cmdp, mu, 0.8)
    q_r, v_r, q_c, v_c = tabular.ciql_fixed_point(cmdp, mu, 0.8, limit=11)
    assert q_r == pytest.approx(q, abs=1e-9) and v_r == pytest.approx(v, abs=1e-9)
    policy = mu * np.where(q < v[:, None], 0.2, 0.8)
    policy /= policy.sum(1, keepdims=True)
    assert v_c == pytest.approx(iterated_values(cmdp, policy, cmdp.costs, 0.9, 400), abs=1e-8)
    assert q_c == pytest.approx(cmdp.costs + 0.9 * cmdp.transitions @ v_c, abs=1e-8)


def test_ciql_satisfies_its_equations_where_the_limit_binds():
    cmdp = shortcut()
    mu, kappa, limit = uniform(cmdp), 0.9, 1.0
    q_r, v_r, q_c, v_c = tabular.ciql_fixed_point(cmdp, mu, kappa, limit)
    unsafe = q_c > limit
    assert unsafe.any() and not unsafe.all()
    penalised = np.where(unsafe, 0, q_r)
    weight = np.where(penalised < v_r[:, None], 1 - kappa, kappa)
    assert (weight * (penalised - v_r[:, None])).sum(1) == pytest.approx(0, abs=1e-9)  # eqs. 11, 12
    assert (weight * (q_c - v_c[:, None])).sum(1) == pytest.approx(0, abs=1e-9)  # eq. 17
    assert q_r == pytest.approx(cmdp.rewards + 0.9 * cmdp.transitions @ v_r, abs=1e-9)
    assert q_c == pytest.approx(cmdp.costs + 0.9 * cmdp.transitions @ v_c, abs=1e-9)


def test_an_indicator_that_flips_for_ever_is_told():
    """One state. Risky earns 1 and costs 1, careful earns 0.1. While risky is safe it is favoured, which
    makes it unsafe; then it is shunned, which makes it safe."""
    ones = np.ones((1, 2, 1))
    cmdp = tabular.CMDP(ones, np.array([[1.0, 0.1]]), np.array([[1.0, 0.0]]), np.ones(1), 0.9)
    assert len(tabular.ciql_fixed_point(cmdp, uniform(cmdp), 0.9, 9.2)) == 4
    with pytest.raises(ArithmeticError, match="flips"):
        tabular.ciql_fixed_point(cmdp, uniform(cmdp), 0.9, 5.0)


# --- Prices ---


@pytest.mark.parametrize("price", [0.0, 0.4, 3.0])
def test_the_best_policy_at_a_price_beats_every_deterministic_one(price, rng):
    cmdp = random_cmdp(rng, states=3, actions=2, branching=2)
    worth = [reward - price * cost for reward, cost in all_deterministic(cmdp)]
    found = tabular.solve_priced(cmdp, price)
    assert found.reward - price * found.cost == pytest.approx(max(worth), abs=1e-6)
    assert found.price == price
    for value, signal in ((found.reward, cmdp.rewards), (found.cost, cmdp.costs)):
        assert value == pytest.approx(cmdp.initial @ iterated_values(cmdp, found.policy, signal, cmdp.gamma))


@pytest.mark.parametrize("price", [-0.1, np.nan])
def test_a_price_is_not_negative(price):
    with pytest.raises(ValueError, match="at least 0"):
        tabular.solve_priced(shortcut(), price)
