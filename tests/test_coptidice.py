"""COptiDICE against its formulas as loops, a linear programme, and a convex solver on the primal problem."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from randoms import of_run, random_batch, random_data, randomise
from scipy.optimize import linprog, minimize, minimize_scalar

from tutorial_lib.agents.coptidice import COptiDICE, cost_bound, density_ratio, dual_loss
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import TASKS
from tutorial_lib.training import train

T, B, OBS, ACT = 10, 8, 3, 2
TASK = dataclasses.replace(
    TASKS["BallRun"], horizon=T, obs_dim=OBS, act_dim=ACT, thresholds=(1, 3, 6), cost_range=8,
    min_return=-5.0, max_return=40.0,
)  # fmt: skip
OPTIONS = {"gamma": 0.8, "batch_size": B, "updates": 100, "hidden_width": 8, "hidden_layers": 1}
LIMIT = 3.0


def make_agent(seeds=(0,), limits=LIMIT, **changes):
    return COptiDICE(TASK, COptiDICE.configure("paper", **OPTIONS | changes), seeds, limits)


# --- The formulas as loops ---


class Slow:
    """One run, one transition at a time; the networks too are written out."""

    def __init__(self, agent, run):
        self.config, self.run = agent.config, run
        self.state = {key: value.numpy().copy() for key, value in agent.state().items()}

    def weights(self, prefix):
        return [v[self.run].astype(float) for k, v in self.state.items() if k.startswith(prefix)]

    def inputs(self, observation):
        mean, std = (self.state[f"variable.observation_{name}"][self.run] for name in ("mean", "std"))
        return (observation.numpy().astype(float) - mean) / std

    def positive(self, name):
        return math.log(1 + math.exp(self.state[f"online.{name}.raw"][self.run]))

    def potential(self, name, scale, s):
        """The lowest of the two networks."""
        (w1, b1, w2, b2), values = self.weights(f"online.{name}.networks."), []
        for k in range(2):
            values.append(scale * (1 + (np.maximum(s @ w1[k] + b1[k, 0], 0) @ w2[k] + b2[k, 0])[0]))
        return min(values)

    def nu(self, s):
        return self.potential("nu", 0.1 * 0.5 * 40 / T / (1 - 0.8), s)

    def chi(self, s):
        return self.potential("chi", 3 / T / (1 - 0.8), s)

    def log_prob(self, s, action):
        log_std, w1, b1, w2, b2 = self.weights("online.policy.")
        mean = np.tanh(w2 @ np.maximum(w1 @ s + b1, 0) + b2)
        std = np.exp(np.clip(log_std, -5, 2))
        densities = np.exp(-(((action - mean) / std) ** 2) / 2) / std / math.sqrt(2 * math.pi)
        return math.log(densities.prod())

    def losses(self, batch):
        lam, tau, alpha = self.positive("multiplier"), self.positive("tau"), self.config.alpha
        nu_sum, exponentials, ws, policy = 0.0, [], [], 0.0
        for row in range(B):
            s, s_next, first = (
                self.inputs(batch[f"{kind}observations"][row]) for kind in ("", "next_", "first_")
            )
            reward, cost = batch["rewards"][row].item(), batch["costs"][row].item()
            g = 0.0 if batch["terminals"][row] or batch["timeouts"][row] else 0.8
            e = 0.1 * reward - lam * cost + g * self.nu(s_next) - self.nu(s)
            w = math.exp(e / alpha) if e < 0 else 1 + e / alpha
            f = w * math.log(w) - w + 1 if w < 1 else (w - 1) ** 2 / 2
            nu_sum += (1 - 0.8) * self.nu(first) + w * e - alpha * f
            bound = (1 - 0.8) * self.chi(first) + w * (cost + g * self.chi(s_next) - self.chi(s))
            exponentials.append(math.exp(bound / tau))
            ws.append(w)
            noisy = s + 0.1 * batch["noise"][row].numpy()
            policy -= w * self.log_prob(noisy, batch["actions"][row].numpy()) / B
        weights = np.array(exponentials) * ws
        cost = (weights * batch["costs"].numpy()).sum() / weights.sum()
        return {
            "nu_loss": nu_sum / B,
            "chi_loss": tau * (math.log(sum(exponentials) / B) + 0.01),
            "multiplier_loss": lam * (LIMIT / T - cost),
            "policy_loss": policy,
            "multiplier": lam,
            "tau": tau,
            "cost_per_step": cost,
            "weight_mean": sum(ws) / B,
        }


@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_coptidices(seeds):
    agent = make_agent(seeds)
    for seed in range(3):
        randomise(agent, seed)
        batch = random_batch(agent, seed)
        slow = [Slow(agent, run).losses(of_run(batch, run)) for run in range(len(seeds))]
        scalars = agent.update(batch)
        for run, expected in enumerate(slow):
            found = {key: value[run].item() for key, value in scalars.items()}
            assert found == pytest.approx(expected, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("alpha", [0.5, 2.0])
def test_the_ratio_maximises_the_dual_and_is_the_duals_slope(alpha):
    e = torch.linspace(-3, 3, 13, dtype=torch.float64, requires_grad=True)
    w = density_ratio(e, alpha)
    grid = np.linspace(1e-6, 10, 200_001)
    f = np.where(grid < 1, grid * np.log(grid) - grid + 1, (grid - 1) ** 2 / 2)
    values = [(grid * x - alpha * f) for x in e.detach().numpy()]
    np.testing.assert_allclose(w.detach(), [grid[v.argmax()] for v in values], atol=1e-3)
    loss = dual_loss(torch.zeros_like(e), e, alpha, 0.9)
    assert loss.item() == pytest.approx(np.mean([v.max() for v in values]), abs=1e-6)
    (slope,) = torch.autograd.grad(loss, e)
    torch.testing.assert_close(slope * 13, w.detach())


def test_ratios_and_gradients_stay_finite_for_extreme_differences():
    e = torch.tensor([-1e5, 1e5], requires_grad=True)
    (slope,) = torch.autograd.grad(dual_loss(torch.zeros(2), e, 0.1, 0.9), e)
    assert density_ratio(e, 0.1).isfinite().all() and slope.isfinite().all()


@pytest.mark.parametrize("radius", [0.01, 0.2])
def test_the_bound_is_the_highest_mean_cost_within_the_radius(radius):
    """A solver maximises the mean over weights whose divergence from uniform ones is at most the radius."""
    cost = np.random.default_rng(0).normal(size=6)
    divergence = {"type": "ineq", "fun": lambda p: radius - (p * np.log(6 * p)).sum()}
    one = {"type": "eq", "fun": lambda p: p.sum() - 1}
    start, box = np.full(6, 1 / 6), [(1e-9, 1)] * 6
    options = {"constraints": [divergence, one], "bounds": box, "options": {"ftol": 1e-12}}
    highest = -minimize(lambda p: -p @ cost, start, **options).fun

    def bound(log_tau):
        return cost_bound(torch.tensor(cost), torch.tensor(math.exp(log_tau)), radius).item()

    lowest = minimize_scalar(bound, bounds=(-5, 5), method="bounded", options={"xatol": 1e-9})
    assert lowest.fun == pytest.approx(highest, abs=1e-6)


# --- A small CMDP ---

NEXT = np.array([[1, 2], [2, 0], [0, 3], [3, 1]])  # the next state of (s, a)
REWARD = np.array([[0.0, 1.0], [0.2, 1.0], [0.1, 0.6], [0.3, 0.8]])
COST = np.array([[0.0, 1.0], [0.0, 0.5], [0.0, 1.0], [0.0, 0.0]])
GAMMA, STATES = 0.9, len(NEXT)


def flow():
    """The matrix and the vector of the flow constraints on an occupancy, with 8 entries d(s, a)."""
    matrix = np.zeros((STATES, STATES, 2))
    for s in range(STATES):
        for a in range(2):
            matrix[s, s, a] += 1
            matrix[NEXT[s, a], s, a] -= GAMMA
    return matrix.reshape(STATES, -1), (1 - GAMMA) * (np.arange(STATES) == 0)


def linear_programme(limit):
    """The best occupancy (8,) with a cost per step of at most the limit."""
    matrix, start = flow()
    found = linprog(-REWARD.ravel(), COST.reshape(1, -1), [limit], matrix, start)
    assert found.status == 0
    return found.x


def solved_dual(alpha, limit):
    """The least value of the dual over nu and lambda, by the library's functions, and w / 8: (), (8,)."""
    reward, cost = torch.tensor(REWARD), torch.tensor(COST)

    def evaluate(x):
        nu, lam = x[:STATES], x[STATES]
        e = (reward - lam * cost + GAMMA * nu[NEXT] - nu[:, None]).flatten()
        return dual_loss(nu[:1].expand(8), e, alpha, GAMMA) + lam * limit, e

    def value_and_gradient(x):
        x = torch.tensor(x, requires_grad=True)
        value, _ = evaluate(x)
        return value.item(), torch.autograd.grad(value, x)[0].numpy()

    bounds = [(None, None)] * STATES + [(0, None)]
    options = {"maxiter": 10_000, "maxfun": 50_000, "ftol": 1e-15, "gtol": 1e-10}
    found = minimize(value_and_gradient, np.ones(STATES + 1), jac=True, bounds=bounds, options=options)
    return found.fun, density_ratio(evaluate(torch.tensor(found.x))[1], alpha).numpy() / 8


def divergence(d):
    w = 8 * np.maximum(d, 1e-12)
    return np.where(w < 1, w * np.log(w) - w + 1, (w - 1) ** 2 / 2).mean()


@pytest.mark.parametrize("limit", [0.1, 0.25, 1.0])
def test_with_a_small_alpha_the_dual_is_the_linear_programme(limit):
    d = linear_programme(limit)
    best, alpha = d @ REWARD.ravel(), 3e-3
    value, occupancy = solved_dual(alpha, limit)
    assert best - alpha * divergence(d) - 1e-5 <= value <= best + 1e-5
    matrix, start = flow()
    np.testing.assert_allclose(matrix @ occupancy, start, atol=1e-3)
    assert occupancy @ COST.ravel() <= limit + 1e-3
    assert occupancy @ REWARD.ravel() == pytest.approx(best, abs=2 * alpha * divergence(d))


@pytest.mark.parametrize("alpha", [0.3, 1.0])
def test_the_dual_has_the_value_of_the_primal(alpha):
    """A solver maximises E_d[r] - alpha D_f over the occupancies of at most a cost of 0.2."""
    matrix, start = flow()
    constraints = [
        {"type": "eq", "fun": lambda d: matrix @ d - start},
        {"type": "ineq", "fun": lambda d: 0.2 - d @ COST.ravel()},
    ]
    options = {"constraints": constraints, "bounds": [(1e-9, 1)] * 8, "options": {"ftol": 1e-12}}
    primal = minimize(lambda d: alpha * divergence(d) - d @ REWARD.ravel(), np.full(8, 1 / 8), **options)
    value, occupancy = solved_dual(alpha, 0.2)
    assert primal.success and value == pytest.approx(-primal.fun, abs=1e-6)
    np.testing.assert_allclose(occupancy, primal.x, atol=1e-3)


def recorded(rows=4000):
    """A long episode of random actions, -0.5 and 0.5 for the two actions, with one-hot observations."""
    rng, s, states = np.random.default_rng(0), 0, []
    actions = rng.integers(0, 2, rows)
    for a in actions:
        states.append(s)
        s = NEXT[s, a]
    states, one_hot = np.array(states), np.eye(STATES, dtype=np.float32)
    return Dataset(
        observations=one_hot[states],
        next_observations=one_hot[NEXT[states, actions]],
        actions=(actions[:, None] - 0.5).astype(np.float32),
        rewards=REWARD[states, actions].astype(np.float32),
        costs=COST[states, actions].astype(np.float32),
        terminals=np.zeros(rows, bool),
        timeouts=np.arange(rows) == rows - 1,
    )


def occupancy_of(policy):
    """d(s, a), (8,), of a policy with probabilities (S,) of the second action."""
    chosen = np.stack([1 - policy, policy], 1)
    moves = np.zeros((STATES, STATES))
    for s in range(STATES):
        for a in range(2):
            moves[s, NEXT[s, a]] += chosen[s, a]
    visits = np.linalg.solve(np.eye(STATES) - GAMMA * moves.T, (1 - GAMMA) * (np.arange(STATES) == 0))
    return (visits[:, None] * chosen).ravel()


def test_it_learns_the_best_policy_of_each_limit():
    """The mean action tells the probability of the second action, because the actions are -0.5 and 0.5."""
    limits = (0.1, 0.25)  # per step
    task = dataclasses.replace(TASK, obs_dim=STATES, act_dim=1, max_return=20.0)
    config = COptiDICE.configure(
        gamma=GAMMA, alpha=0.03, reward_factor=1.0, cost_radius=1e-4, state_noise=0.0, hidden_width=32,
        hidden_layers=1, batch_size=64, normalise_observations=False, updates=1000, critic_lr=3e-3,
        policy_lr=3e-3, scalar_lr=1e-2,
    )  # fmt: skip
    agent = COptiDICE(task, config, (0, 0), [T * limit for limit in limits])
    train(agent, recorded(), progress=False)
    for run, limit in enumerate(limits):
        mean = agent.act(np.eye(STATES), np.zeros(STATES), run)[:, 0]
        d, best = occupancy_of(np.clip(mean + 0.5, 0, 1)), linear_programme(limit)
        assert d @ COST.ravel() == pytest.approx(limit, abs=0.03)
        assert d @ REWARD.ravel() == pytest.approx(best @ REWARD.ravel(), abs=0.05)


# --- What is drawn ---


def test_initial_states_are_those_of_their_episodes():
    steps = np.concatenate([np.arange(n) for n in (4, 7, 2)])
    data = random_data(0, rows=13)._replace(timesteps=torch.tensor(steps, dtype=torch.float32))
    batch = make_agent(batch_size=600).draw(data, torch.Generator().manual_seed(0), LIMIT)
    starts = data.observations[[0, 4, 11]]
    which = (batch["first_observations"][:, None] == starts).all(-1)
    assert which.sum(1).eq(1).all()
    shares = which.double().mean(0).numpy()
    np.testing.assert_allclose(shares, np.array([4, 7, 2]) / 13, atol=0.05)
    assert batch["noise"].shape == (600, OBS) and abs(batch["noise"].std().item() - 1) < 0.1


@pytest.mark.parametrize("limits", [math.inf, (3.0, math.inf)])
def test_an_infinite_limit_is_refused(limits):
    with pytest.raises(ValueError, match="COptiDICE needs a finite limit"):
        make_agent((0, 1), limits)
