"""The losses against slow loops over plain numbers, and Theorems 1 and 2 on small tabular problems."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from tutorial_lib import losses as L

B, M, K = 7, 3, 2  # batch, cost discount factors, critics


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


# The losses by loops, as the paper writes them; lists in, a number out.


def slow_weight(u, kappa):
    return abs(kappa - (1 if u < 0 else 0))


def slow_expectile_loss(target, value, kappa):
    u = [q - v for q, v in zip(target, value, strict=True)]
    return sum(slow_weight(x, kappa) * x**2 for x in u) / len(u)


def slow_td_loss(target, q):
    total = 0
    for k in range(K):
        total += sum((target[b][i] - q[k][b][i]) ** 2 for b in range(B) for i in range(M)) / (B * M)
    return total


def slow_cost_value_loss(weight, q_cost, value_cost):
    errors = [weight[b] * (q_cost[b][i] - value_cost[b][i]) ** 2 for b in range(B) for i in range(M)]
    return sum(errors) / (B * M)


def slow_policy_loss(weight, log_prob):
    return -sum(w * x for w, x in zip(weight, log_prob, strict=True)) / len(weight)


CASES = {  # name: the loss, its loop, and the shapes of its tensors
    "expectile": (
        partial(L.expectile_loss, kappa=0.7),
        partial(slow_expectile_loss, kappa=0.7),
        [(B,), (B,)],
    ),
    "td": (L.td_loss, slow_td_loss, [(B, M), (K, B, M)]),
    "cost value": (L.cost_value_loss, slow_cost_value_loss, [(B,), (B, M), (B, M)]),
    "policy": (L.policy_loss, slow_policy_loss, [(B,), (B,)]),
}


@pytest.mark.parametrize("name", CASES)
def test_a_loss_is_its_loop(name, rng):
    loss, slow, shapes = CASES[name]
    arrays = [rng.normal(size=shape) for shape in shapes]
    result = loss(*map(tensor, arrays))
    assert result.shape == ()
    assert result.item() == pytest.approx(slow(*(a.tolist() for a in arrays)), rel=1e-6)


@pytest.mark.parametrize("name", CASES)
def test_gradients_flow_into_the_last_argument_alone_and_are_those_of_the_loop(name, rng):
    loss, slow, shapes = CASES[name]
    arrays = [rng.normal(size=shape) for shape in shapes]
    tensors = [tensor(a).requires_grad_() for a in arrays]
    loss(*tensors).backward()
    assert all(t.grad is None for t in tensors[:-1])

    def slow_at(index, step):
        moved = arrays[-1].copy()
        moved[index] += step
        return slow(*(a.tolist() for a in arrays[:-1]), moved.tolist())

    for index in np.ndindex(shapes[-1]):
        difference = (slow_at(index, 1e-6) - slow_at(index, -1e-6)) / 2e-6
        assert tensors[-1].grad[index].item() == pytest.approx(difference, abs=1e-6)


def test_td_loss_takes_one_value_per_transition_too(rng):
    target, q = rng.normal(size=B), rng.normal(size=(K, B))
    expected = sum(sum((t - x) ** 2 for t, x in zip(target, critic, strict=True)) / B for critic in q)
    assert L.td_loss(tensor(target), tensor(q)).item() == pytest.approx(expected)


def test_weights():
    u = torch.tensor([-2.0, -1e-6, 0.0, 3.0])
    torch.testing.assert_close(L.expectile_weight(u, 0.9), torch.tensor([0.1, 0.1, 0.9, 0.9]))
    u = torch.tensor([-1.0, 0.0, 1.0, 1.5, 1.6, 500.0])  # exp(3 * 1.5) = 90.02, exp(3 * 1.6) = 121.5
    expected = torch.tensor([math.exp(-3), 1.0, math.exp(3), math.exp(4.5), 100.0, 100.0])
    torch.testing.assert_close(L.awr_weight(u, 3.0), expected)


def test_penalised_q_by_hand():
    q = torch.tensor([5.0, 5.0, 5.0, -5.0, -5.0, 5.0])
    cost = torch.tensor([9.0, 10.0, 10.1, 9.0, 11.0, 1e9])
    limit = torch.tensor([10.0, 10.0, 10.0, 10.0, 10.0, math.inf])
    # The limit itself is allowed. A negative Q of an unsafe action becomes zero, a reward: the paper's rule.
    assert L.penalised_q(q, cost, limit).tolist() == [5.0, 5.0, 0.0, -5.0, 0.0, 5.0]


def test_priced_q_by_hand():
    q = torch.full((6,), 5.0)
    cost = torch.tensor([9.0, 12.0, 12.0, 9.0, 12.0, 1e9])
    state_cost = torch.tensor([8.0, 9.0, 13.0, 14.0, 12.0, 1.0])
    limit = torch.tensor([10.0, 10.0, 10.0, 10.0, 10.0, math.inf])
    # At a price of 3 an excess of 2 pays 6, and a state's excess of 1, 3 and 4 gives 3, 9 and 12 back.
    expected = [5.0, 5.0 - 6.0, 5.0 - 6.0 + 9.0, 5.0 + 12.0, 5.0, 5.0]
    assert L.priced_q(q, cost, state_cost, limit, 3.0).tolist() == expected


def test_td_target_by_hand():
    reward, value = torch.tensor([1.0, 2.0]), torch.tensor([10.0, 20.0])
    terminal_second = torch.tensor([1.0, 0.0])
    assert L.td_target(reward, 0.5, value, terminal_second).tolist() == [6.0, 2.0]
    cost, heads = torch.tensor([[1.0], [0.0]]), torch.tensor([[10.0, 20.0], [30.0, 40.0]])
    target = L.td_target(cost, torch.tensor([0.5, 0.25]), heads, torch.tensor([[1.0], [1.0]]))
    assert target.tolist() == [[6.0, 6.0], [15.0, 10.0]]


# What the losses are for: their minimisers. The loss is the library's, the search for its minimiser is not.


def gradient(loss, x):
    x = x.clone().requires_grad_()
    return torch.autograd.grad(loss(x), x)[0]


def bisect(loss, shape, low=-100.0, high=100.0):
    """Minimiser of a sum of convex functions, one of each coordinate of x."""
    low, high = (torch.full(shape, bound, dtype=torch.float64) for bound in (low, high))
    for _ in range(60):
        middle = (low + high) / 2
        falls = gradient(loss, middle) < 0
        low, high = torch.where(falls, middle, low), torch.where(falls, high, middle)
    return middle


def bottom(loss, shape):
    """Minimiser of a sum of parabolas, one of each coordinate: their gradients are straight lines."""
    at_0, at_1 = (gradient(loss, torch.full(shape, x, dtype=torch.float64)) for x in (0.0, 1.0))
    return at_0 / (at_0 - at_1)


@pytest.mark.parametrize("kappa", [0.1, 0.5, 0.7, 0.9])
def test_expectile_loss_is_least_at_the_expectile(kappa, rng):
    sample = rng.exponential(2.0, size=501) - 3
    low, high = sample.min(), sample.max()
    for _ in range(60):  # an expectile v balances kappa E[(x - v)+] and (1 - kappa) E[(v - x)+]
        v = (low + high) / 2
        above, below = sum(x - v for x in sample if x > v), sum(v - x for x in sample if x < v)
        low, high = (v, high) if kappa * above > (1 - kappa) * below else (low, v)
    best = bisect(lambda x: L.expectile_loss(tensor(sample), x.expand(501), kappa), (1,))
    assert best.item() == pytest.approx(v, abs=1e-6)
    if kappa == 0.5:
        assert v == pytest.approx(sample.mean())


STATES, ACTIONS = 5, 6


class Tabular:
    """A dataset of visits to every (s, a), with random Q_{r|c} and Q_c; mu are the shares of the actions."""

    def __init__(self, rng):
        self.visits = rng.integers(1, 6, size=(STATES, ACTIONS))
        rows = [(s, a) for s in range(STATES) for a in range(ACTIONS) for _ in range(self.visits[s, a])]
        self.s, self.a = np.array(rows).T
        self.mu = self.visits / self.visits.sum(1, keepdims=True)
        self.q = rng.normal(0, 5, size=(STATES, ACTIONS))
        self.q[rng.random((STATES, ACTIONS)) < 0.3] = 0.0  # penalised
        self.q_cost = rng.uniform(0, 10, size=(STATES, ACTIONS, M))

    def value(self, kappa):
        """The minimiser of eq. 13 for f = L_2^kappa, per state."""
        q = tensor(self.q[self.s, self.a])
        return bisect(lambda v: L.expectile_loss(q, v[self.s], kappa), (STATES,)).numpy()

    def implicit_policy(self, value, kappa):
        """Theorem 1's pi_imp = mu |f'(u)| / |u|, normalised; f' by finite differences."""

        def f(u):
            return slow_weight(u, kappa) * u * u

        policy = np.zeros((STATES, ACTIONS))
        for s in range(STATES):
            for a in range(ACTIONS):
                u = self.q[s, a] - value[s]
                policy[s, a] = self.mu[s, a] * abs((f(u + 1e-7) - f(u - 1e-7)) / 2e-7) / abs(u)
            policy[s] /= policy[s].sum()
        return policy


@pytest.mark.parametrize("kappa", [0.6, 0.7, 0.9])
@pytest.mark.parametrize("seed", range(3))
def test_theorem_1_the_minimiser_of_eq_13_is_the_mean_under_the_implicit_policy(seed, kappa):
    table = Tabular(np.random.default_rng(seed))
    value = table.value(kappa)
    mean = (table.implicit_policy(value, kappa) * table.q).sum(1)
    np.testing.assert_allclose(value, mean, atol=1e-5)
    behaviour = (table.mu * table.q).sum(1)
    assert (value > behaviour + 0.05).all()  # better than the data's own policy, or the test shows nothing


@pytest.mark.parametrize("kappa", [0.6, 0.7, 0.9])
@pytest.mark.parametrize("seed", range(3))
def test_theorem_2_the_minimiser_of_eq_17_is_the_cost_under_the_implicit_policy(seed, kappa):
    table = Tabular(np.random.default_rng(seed))
    value = table.value(kappa)
    weight = L.expectile_weight(tensor(table.q - value[:, None])[table.s, table.a], kappa)
    q_cost = tensor(table.q_cost[table.s, table.a])
    value_cost = bottom(lambda v: L.cost_value_loss(weight, q_cost, v[table.s]), (STATES, M)).numpy()
    expected = np.einsum("sa,sam->sm", table.implicit_policy(value, kappa), table.q_cost)
    np.testing.assert_allclose(value_cost, expected, rtol=1e-5)

    # Eq. 15's second line, as printed, lacks the division by E_mu[M].
    m = np.array([[slow_weight(q - v, kappa) for q in qs] for qs, v in zip(table.q, value, strict=True)])
    printed = np.einsum("sa,sa,sam->sm", table.mu, m, table.q_cost)
    np.testing.assert_allclose(printed / (table.mu * m).sum(1, keepdims=True), value_cost, rtol=1e-5)
    assert (printed < kappa * value_cost).all()


def test_cost_losses_evaluate_the_implicit_policy_as_a_linear_solve_does(rng):
    """Lines 13-14 and 17-18, repeated, on a dataset of random transitions; some of them are terminal."""
    table, gammas = Tabular(rng), np.array([0.6, 0.8, 0.85])
    value = table.value(0.7)
    rows = len(table.s)
    s_next, cost, mask = rng.integers(STATES, size=rows), rng.random(rows), 1.0 * (rng.random(rows) > 0.2)

    weight = L.expectile_weight(tensor((table.q - value[:, None])[table.s, table.a]), 0.7)
    value_cost = torch.zeros(STATES, M, dtype=torch.float64)
    for _ in range(150):
        target = L.td_target(tensor(cost)[:, None], tensor(gammas), value_cost[s_next], tensor(mask)[:, None])
        q_cost = bottom(lambda q, t=target: L.td_loss(t, q[None, table.s, table.a]), (STATES, ACTIONS, M))
        q_rows = q_cost[table.s, table.a]
        value_cost = bottom(lambda v, q=q_rows: L.cost_value_loss(weight, q, v[table.s]), (STATES, M))

    policy = table.implicit_policy(value, 0.7)
    step_cost, moves = np.zeros(STATES), np.zeros((STATES, STATES))
    for s, a, c, after, alive in zip(table.s, table.a, cost, s_next, mask, strict=True):
        share = policy[s, a] / table.visits[s, a]
        step_cost[s] += share * c
        moves[s, after] += share * alive
    for head, gamma in enumerate(gammas):
        expected = np.linalg.solve(np.eye(STATES) - gamma * moves, step_cost)
        np.testing.assert_allclose(value_cost[:, head].numpy(), expected, rtol=1e-5)
