"""VOCE against loops, SciPy's Gaussian and SciPy's SLSQP, and what it learns where the answer is known."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from plain import Plain
from randoms import of_run, random_batch, random_data, randomise
from scipy.optimize import minimize
from scipy.stats import multivariate_normal
from test_bcq import SlowLagrangian, make_agent, threshold, toy_data
from test_cpq import ACT, LIMIT, OBS, B, T

from tutorial_lib import training
from tutorial_lib.agents.voce import VOCE, GaussianPolicy, log_prob, sampled, solve_dual

SMALL = {"samples": 5, "compared": 2, "penalty_gap": 3.0}

# --- The Gaussian ---


def random_gaussians(count, act, seed=0):
    """Means (count, act) and Cholesky factors (count, act, act)."""
    rng = np.random.default_rng(seed)
    factors = np.tril(rng.normal(size=(count, act, act)), -1)
    factors[:, range(act), range(act)] = rng.uniform(0.2, 2, size=(count, act))
    return rng.normal(size=(count, act)), factors


@pytest.mark.parametrize("act", [1, 2, 8])
def test_densities_are_scipys(act):
    means, factors = random_gaussians(6, act)
    noise = np.random.default_rng(1).normal(size=(4, 6, act))
    mean, factor = torch.tensor(means), torch.tensor(factors)
    actions, log_density = sampled(torch.tensor(noise), mean, factor)
    again = log_prob(actions, mean, factor)
    for b in range(6):
        law = multivariate_normal(means[b], factors[b] @ factors[b].T)
        np.testing.assert_allclose(actions[:, b], means[b] + noise[:, b] @ factors[b].T, rtol=1e-9)
        np.testing.assert_allclose(log_density[:, b], law.logpdf(actions[:, b].numpy()), rtol=1e-6)
        np.testing.assert_allclose(again[:, b], log_density[:, b], rtol=1e-6)


def test_the_policy_can_have_every_mean_in_the_box_and_every_covariance():
    """The last layer's bias is set to what should give them."""
    agent = make_agent(VOCE)
    policy = GaussianPolicy(OBS, ACT, agent.config)
    last = list(policy.parameters())[-2:]
    with torch.no_grad():
        last[0].zero_()
        wanted, spread = np.array([-0.9, 0.4]), np.array([[0.3, 0.0], [-0.5, 0.8]])
        raw = np.log(np.expm1(np.diag(spread) - 0.007))
        entries = [raw[0], 7.0, spread[1, 0], raw[1]]
        last[1].copy_(torch.tensor([*np.log((1 + wanted) / (1 - wanted)), *entries]))
        mean, factor = policy(torch.randn(3, OBS, generator=torch.Generator().manual_seed(0)))
    for b in range(3):
        np.testing.assert_allclose(mean[b], wanted, rtol=1e-5)
        np.testing.assert_allclose(factor[b], spread, rtol=1e-5, atol=1e-7)


# --- The E-step ---


def dual(x, q, cost, limit, divergence):
    """g(eta, lambda), state by state."""
    eta, lam = x
    total = divergence * eta + lam * limit
    for b in range(q.shape[1]):
        value = (q[:, b] - lam * cost[:, b]) / eta
        total += eta * (value.max() + math.log(np.exp(value - value.max()).mean())) / q.shape[1]
    return total


def solved_by_slsqp(*problem):
    best = None
    for start in ((0.3, 0.1), (10.0, 3.0)):
        bounds, options = [(1e-3, 1e4), (0, 1e3)], {"ftol": 1e-13, "maxiter": 400}
        found = minimize(dual, start, problem, method="SLSQP", bounds=bounds, options=options)
        best = found if best is None or found.fun < best.fun else best
    return best


CASES = [(0.5, 2.0, 0.2), (-0.3, 2.0, 0.2), (-0.1, 0.1, 0.05), (-0.2, 20.0, 0.2), (-0.4, 5.0, 1.0)]
"""The limit above the mean cost, the spread of Q_r, and the divergence."""


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("case", CASES)
def test_the_dual_is_solved_as_by_slsqp(case, seed):
    slack, spread, divergence = case
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(12, 8))
    q = spread * (np.exp(z) if seed else z) + 40 * rng.normal(size=8)
    cost = 5 + 0.5 * z + rng.normal(size=(12, 8))
    limit = cost.mean() + slack
    best = solved_by_slsqp(q, cost, limit, divergence)
    for kind in (np.float64, np.float32):
        tensors = [torch.tensor(np.asarray(x, kind)) for x in (q, cost, limit)]
        found = [x.item() for x in solve_dual(*tensors, divergence)]
        assert dual(found, q, cost, limit, divergence) == pytest.approx(best.fun, abs=1e-4 * spread)
        assert found == pytest.approx(best.x, rel=2e-3, abs=1e-3 * spread)
        assert (found[1] > 0) == (slack < 0)


def test_the_weights_are_the_best_within_the_divergence_and_the_limit():
    """A solver maximises the mean Q_r over the weights themselves: the primal problem."""
    rng = np.random.default_rng(3)
    q, cost, states = rng.normal(size=(6, 2)), rng.normal(size=(6, 2)), 2
    limit, divergence = cost.mean() - 0.2, 0.15

    def shape(p):
        return p.reshape(6, states)

    constraints = [
        {"type": "eq", "fun": lambda p: shape(p).sum(0) - 1},
        {"type": "ineq", "fun": lambda p: divergence - (p * np.log(6 * p)).sum() / states},
        {"type": "ineq", "fun": lambda p: limit - (shape(p) * cost).sum() / states},
    ]
    start, options = np.full(12, 1 / 6), {"ftol": 1e-12, "maxiter": 500}
    primal = minimize(
        lambda p: -(shape(p) * q).sum() / states, start, bounds=[(1e-9, 1)] * 12, constraints=constraints,
        options=options,
    )  # fmt: skip
    eta, lam = solve_dual(torch.tensor(q), torch.tensor(cost), torch.tensor(limit), divergence)
    weights = torch.softmax((torch.tensor(q) - lam * torch.tensor(cost)) / eta, 0)
    assert primal.success and lam > 0
    np.testing.assert_allclose(weights, shape(primal.x), atol=2e-3)


def test_a_limit_that_no_weights_keep_leaves_the_cheapest_weights():
    rng = np.random.default_rng(0)
    q, cost = (torch.tensor(rng.normal(size=(8, 3))) for _ in range(2))
    eta, lam = solve_dual(q, cost, cost.min() - 1, 0.1)
    alone = solve_dual(-cost, cost, cost.max() + 1, 0.1)[0]  # the weights of the cost alone, unpriced
    assert 990 < lam <= 1000
    weights, cheapest = torch.softmax((q - lam * cost) / eta, 0), torch.softmax(-cost / alone, 0)
    torch.testing.assert_close(weights, cheapest, rtol=0, atol=5e-3)


def test_equal_actions_and_extreme_values_give_finite_numbers():
    ones = torch.ones(4, 3)
    for q, cost in ((ones, ones), (1e6 * torch.randn(4, 3), ones), (ones, 1e3 * torch.randn(4, 3))):
        assert all(x.isfinite() for x in solve_dual(q, cost, torch.tensor(0.5), 0.1))


# --- An update as loops ---


class Slow(SlowLagrangian):
    """One run, one transition and one action at a time; the networks too are written out."""

    def q(self, kind, *inputs):
        return self.critic(kind, "critics", 0.1 * 0.5 * 40 / T / (1 - 0.8), *inputs)

    def q_cost(self, kind, *inputs):
        return self.critic(kind, "cost_critics", threshold(3), *inputs)

    def gaussian(self, kind, s):
        """The mean and the Cholesky factor."""
        out, factor = self.stack(f"{kind}.policy", s), np.zeros((ACT, ACT))
        for i in range(ACT):
            for j in range(i + 1):
                x = out[ACT + ACT * i + j]
                factor[i, j] = math.log(1 + math.exp(x)) + 0.007 if i == j else x
        return np.array([2 / (1 + math.exp(-x)) - 1 for x in out[:ACT]]), factor

    def samples(self, kind, s, noise):
        """Actions and their log-densities, a list of pairs."""
        mean, factor = self.gaussian(kind, s)
        actions = [mean + factor @ z.numpy() for z in noise]
        return [(a, multivariate_normal(mean, factor @ factor.T).logpdf(a)) for a in actions]

    def penalty(self, q, s, recorded, uniform, own, sign):
        """Of each critic."""
        values = []
        for k in range(2):
            terms = [sign * (q("online", s, a)[k] - ACT * math.log(0.5)) for a in uniform]
            terms += [q("online", s, np.clip(a, -1, 1))[k] - log_density for a, log_density in own]
            values.append(math.log(sum(math.exp(x) for x in terms)) - q("online", s, recorded)[k])
        return np.array(values)

    def losses(self, batch):
        sums = {"critic_loss": 0.0, "cost_critic_loss": 0.0, "policy_loss": 0.0}
        penalty, cost_penalty, values, costs, likelihoods = 0.0, 0.0, [], [], []
        for row, x, s, s_next in self.rows(batch):
            own_next = self.samples("online", s_next, batch["next_noise"][:, row])
            own = own_next + self.samples("online", s, batch["noise"][:, row])
            uniform, a_next = [a[row].numpy() for a in batch["random"]], np.clip(own_next[0][0], -1, 1)
            y = 0.1 * x.rewards
            y += 0.8 * min(self.q("target", s_next, a_next)) * (not (x.terminals or x.timeouts))
            after = min(max(min(self.q_cost("target", s_next, a_next)), 0.0), 1 / (1 - 0.8))
            y_cost = x.costs + 0.8 * after * (not x.terminals)
            sums["critic_loss"] += sum((y - q) ** 2 for q in self.q("online", s, x.actions)) / B
            errors = [(y_cost - q) ** 2 for q in self.q_cost("online", s, x.actions)]
            sums["cost_critic_loss"] += sum(errors) / B
            penalty += self.penalty(self.q, s, x.actions, uniform, own, 1) / B
            cost_penalty += self.penalty(self.q_cost, s, x.actions, uniform, own, -1) / B

            old, new = self.gaussian("target", s), self.gaussian("online", s)
            actions = [a for a, _ in self.samples("target", s, batch["sample_noise"][:, row])]
            values.append([min(self.q("target", s, np.clip(a, -1, 1))) for a in actions])
            costs.append([min(self.q_cost("target", s, np.clip(a, -1, 1))) for a in actions])
            pairs = (new[0], old[1]), (old[0], new[1])
            laws = [multivariate_normal(mean, factor @ factor.T) for mean, factor in pairs]
            likelihoods.append([sum(law.logpdf(a) for law in laws) for a in actions])
        q, cost = np.array(values).T, np.array(costs).T
        self.cost = cost
        eta, lam = solved_by_slsqp(q, cost, threshold(LIMIT), 0.1).x
        weights = np.exp((q - lam * cost - (q - lam * cost).max(0)) / eta)
        weights /= weights.sum(0)
        sums["policy_loss"] = -(weights * np.array(likelihoods).T).sum() / B
        sums |= {"eta": eta, "multiplier": lam, "weighted_cost": (weights * cost).sum() / B}
        prices = np.exp(self.state["online.weights.log"][self.run])
        sums["critic_loss"] += prices[0] * penalty.sum()
        sums["cost_critic_loss"] += prices[1] * cost_penalty.sum()
        sums |= {"penalty": penalty.mean(), "cost_penalty": cost_penalty.mean()}
        sums["weights_loss"] = prices[0] * (3 - penalty.mean()) + prices[1] * (3 - cost_penalty.mean())
        return sums


@pytest.mark.parametrize("priced", [True, False])
@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_voces(seeds, priced):
    """Where the sampled actions cost too much without a price, and where they do not."""
    agent = make_agent(VOCE, seeds, **SMALL)
    batch, runs = random_batch(agent), range(len(seeds))
    for seed in range(9):
        randomise(agent, seed)
        for run in runs:  # the limit is a little below the mean cost, or far above it
            first = Slow(agent, run)
            first.losses(of_run(batch, run))
            change = threshold(LIMIT) - first.cost.mean() + (0.2 if priced else -1) * first.cost.std(0).mean()
            list(agent.target_parameters["cost_critics"].values())[-1][run] += change / threshold(3)
        slow = [Slow(agent, run).losses(of_run(batch, run)) for run in runs]
        if all((0.01 < one["multiplier"] < 50) if priced else one["multiplier"] < 1e-6 for one in slow):
            break
    else:
        pytest.fail("no state with such a multiplier")
    scalars = agent.update(batch)
    for run, expected in enumerate(slow):
        found = {key: value[run].item() for key, value in scalars.items()}
        assert found == pytest.approx(expected, rel=2e-3, abs=1e-3)


@pytest.mark.parametrize(
    ("loss", "network"), [("critic", "critics"), ("cost_critic", "cost_critics"), ("policy", "policy")]
)
def test_the_gradients_are_the_slopes_of_the_loops(loss, network):
    """In the output biases. So the penalties have a gradient, and the targets and the weights have none."""
    agent = make_agent(VOCE, **SMALL)
    randomise(agent, 3)
    batch, plain = of_run(random_batch(agent), 0), Plain(agent)
    last = list(plain.online[network].parameters())[-1]
    (found,) = torch.autograd.grad(plain.losses(batch)[0][loss], last)
    bias, expected = list(agent.parameters[network].values())[-1], []
    for k in range(bias.numel()):
        ends = []
        for step in (-1e-3, 2e-3):
            with torch.no_grad():
                bias.view(-1)[k] += step
            ends.append(Slow(agent, 0).losses(batch)[f"{loss}_loss"])
        with torch.no_grad():
            bias.view(-1)[k] -= 1e-3
        expected.append((ends[1] - ends[0]) / 2e-3)
    np.testing.assert_allclose(found.flatten(), expected, rtol=1e-2, atol=1e-3)
    unused = [ACT + 1] if network == "policy" else []  # the entry above the diagonal
    assert (np.delete(np.abs(expected), unused) > 1e-3).all()


# --- What it draws, and how it plays ---


def test_uniform_actions_fill_the_box_and_the_noise_is_normal():
    many = make_agent(VOCE, batch_size=500).draw(random_data(0), torch.Generator().manual_seed(4), LIMIT)
    shapes = {"noise": 10, "next_noise": 10, "sample_noise": 32, "random": 10}
    whole = torch.cat([many[key].flatten() for key in shapes])
    assert len(whole.unique()) > 0.99 * len(whole)
    for key, count in shapes.items():
        x = many[key]
        assert x.shape == (count, 500, ACT) and x.mean().item() == pytest.approx(0, abs=0.05)
        assert x.std().item() == pytest.approx(1 / math.sqrt(3) if key == "random" else 1, abs=0.05)
    assert 0.99 < many["random"].abs().max() <= 1


def test_the_action_that_runs_is_the_mean():
    agent = make_agent(VOCE)
    randomise(agent, 3)
    observations = np.random.default_rng(1).normal(size=(5, OBS))
    slow = Slow(agent, 0)
    expected = [slow.gaussian("online", slow.inputs(s))[0] for s in observations]
    player = agent.player(np.full(5, LIMIT), range(5))
    np.testing.assert_allclose(player.act(observations), expected, atol=1e-5)


@pytest.mark.parametrize("limits", [math.inf, (3.0, math.inf)])
def test_an_infinite_limit_is_refused(limits):
    with pytest.raises(ValueError, match="VOCE needs a finite limit"):
        make_agent(VOCE, (0, 1), limits)


# --- What it learns ---


def test_it_earns_what_the_limit_allows():
    """A step earns 10 x and costs 5 (1 + x), so the answer is x = 2 L~ / 10 - 1, or the largest x."""
    limits, expected = (7.0, 30.0), (-0.375, 1.0)
    assert [min(threshold(limit) / 5 - 1, 1) for limit in limits] == pytest.approx(expected, abs=1e-3)
    data = toy_data(lambda x: 5 * (1 + x))
    data = dataclasses.replace(data, rewards=10 * data.rewards)
    agent = make_agent(
        VOCE, (0, 0), limits, batch_size=32, hidden_width=16, critic_lr=2e-2, policy_lr=1e-2, target_tau=0.2,
        samples=8, compared=2, reward_factor=1.0,
    )  # fmt: skip
    log = training.train(agent, data, updates=120, log_every=120, progress=False)
    for run, answer in enumerate(expected):
        x = agent.act(data.observations, data.rewards, run)[:, 0]
        assert x.mean() == pytest.approx(answer, abs=0.15), log
        assert (log[run]["multiplier"] > 0.5) == (answer < 1), log
