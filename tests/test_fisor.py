"""FISOR against its formulas as loops, Gaussians in closed form, and value iteration on a small problem."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from randoms import of_run, random_batch, random_data, randomise
from scipy.optimize import brentq

from tutorial_lib.agents.fisor import FISOR, action_weight, denoise, feasibility_target, noise_schedule
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import TASKS
from tutorial_lib.training import train

T, B, OBS, ACT = 10, 8, 3, 2
TASK = dataclasses.replace(
    TASKS["BallRun"], horizon=T, obs_dim=OBS, act_dim=ACT, thresholds=(1, 3, 6), cost_range=8,
    min_return=-5.0, max_return=40.0,
)  # fmt: skip
OPTIONS = {"gamma": 0.8, "batch_size": B, "updates": 100, "hidden_width": 8, "hidden_layers": 1}


def make_agent(seeds=(0,), **changes):
    return FISOR(TASK, FISOR.configure("paper", **OPTIONS | changes), seeds)


# --- The diffusion model ---


def test_the_schedule_is_that_of_the_publication_for_five_steps():
    alphas = noise_schedule(5).double().numpy()
    by_hand = [math.exp(-0.02 - 0.198 * odd) for odd in (1, 3, 5, 7, 9)]  # 9.9 / 50 = 0.198
    np.testing.assert_allclose(alphas, by_hand, rtol=1e-6)
    assert alphas.prod() == pytest.approx(math.exp(-5.05), rel=1e-5)


def exact_noise(mean, std, alphas):
    """E[noise | x] after each step, for data N(mean, std^2): Bayes' rule for two Gaussians."""
    kept = np.cumprod(alphas)

    def predict(x, step):
        k = kept[step]
        return math.sqrt(1 - k) / (k * std**2 + 1 - k) * (x - math.sqrt(k) * mean)

    return predict


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (0.3, 0.5), (-0.6, 0.1)])
def test_samples_of_a_gaussian_have_the_mean_and_the_variance_of_the_linear_recursion(mean, std):
    """With the exact noise each step is linear, so mean and variance follow by hand from N(0, 1)."""
    alphas = noise_schedule(5).double()
    noise = torch.randn(5, 200_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    samples = denoise(exact_noise(mean, std, alphas.numpy()), noise, alphas)
    m, variance, kept = 0.0, 1.0, np.cumprod(alphas.numpy())
    for t in (4, 3, 2, 1, 0):
        alpha, k = alphas[t].item(), kept[t]
        total = k * std**2 + 1 - k  # the variance of x after the step, if it started in the data
        slope = (1 - (1 - alpha) / total) / math.sqrt(alpha)
        m = slope * m + (1 - alpha) / total * math.sqrt(k) * mean / math.sqrt(alpha)
        variance = slope**2 * variance + (1 - alpha) * (t > 0)
    assert samples.mean().item() == pytest.approx(m, abs=0.006)
    assert samples.var().item() == pytest.approx(variance, rel=0.02)
    assert m == pytest.approx(mean, abs=0.06)  # and this is nearly the data's


def test_a_single_recorded_action_is_recovered_exactly():
    alphas = noise_schedule(5).double()
    noise = torch.randn(5, 100, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    samples = denoise(exact_noise(0.37, 0.0, alphas.numpy()), noise, alphas)
    torch.testing.assert_close(samples, torch.full_like(samples, 0.37), atol=1e-9, rtol=0)


def test_a_step_goes_to_the_mean_of_the_posterior_that_knows_the_noise():
    """Bayes' rule for x_(t-1) given x_t and the data: its mean, written with the predicted data."""
    alphas = noise_schedule(5).double()
    kept, x, eps = alphas.cumprod(0), torch.tensor([0.7, -1.1]).double(), torch.tensor([0.4, -0.9]).double()
    seen = []

    def predict(current, step):
        seen.append((step, current))
        return eps

    noise = torch.zeros(5, 2, dtype=torch.float64)
    noise[0] = x
    denoise(predict, noise, alphas)
    (first, start), (second, after) = seen[0], seen[1]
    data = (x - (1 - kept[4]).sqrt() * eps) / kept[4].sqrt()
    by_data = kept[3].sqrt() * (1 - alphas[4]) / (1 - kept[4])
    by_x = alphas[4].sqrt() * (1 - kept[3]) / (1 - kept[4])
    assert (first, second) == (4, 3) and torch.equal(start, x)
    torch.testing.assert_close(after, by_data * data + by_x * x)


def test_every_step_stays_within_the_bound():
    seen = []

    def predict(x, step):
        seen.append(x)
        return 5 * torch.ones_like(x)

    end = denoise(predict, 3 * torch.ones(5, 4), noise_schedule(5), bound=1.0)
    assert all((x.abs() <= 1).all() for x in [*seen[1:], end])


# --- The formulas as loops ---


def test_the_weights_by_hand():
    advantage = torch.tensor([0.5, 9.0, 0.5, 0.5, 0.5, 0.5])
    v_h = torch.tensor([-0.5, -0.5, -0.5, 0.5, 0.5, 0.0])
    q_h = torch.tensor([-0.9, 0.0, 0.1, 0.4, -8.0, -1.0])
    expected = [math.exp(1.5), 100.0, 0.0, math.exp(0.5), 150.0, math.exp(1.5)]
    assert action_weight(advantage, v_h, q_h, 3.0, 5.0).tolist() == pytest.approx(expected)


def test_the_feasibility_target_by_hand():
    h, following = torch.tensor([-1.0, -1.0, 25.0, -1.0]), torch.tensor([-0.9, 7.0, 3.0, 7.0])
    mask = torch.tensor([1.0, 1.0, 1.0, 0.0])
    expected = [0.1 * -1 + 0.9 * -0.9, 0.1 * -1 + 0.9 * 7, 25.0, -1.0]
    assert feasibility_target(h, 0.9, following, mask).tolist() == pytest.approx(expected)


class Slow:
    """One run, one transition at a time; the networks too are written out."""

    def __init__(self, agent, run):
        self.run = run
        self.state = {key: value.numpy().copy() for key, value in agent.state().items()}

    def weights(self, prefix):
        return [v[self.run].astype(float) for k, v in self.state.items() if k.startswith(prefix)]

    def inputs(self, observation):
        mean, std = (self.state[f"variable.observation_{name}"][self.run] for name in ("mean", "std"))
        return (observation.numpy().astype(float) - mean) / std

    def value(self, name, scale, s):
        w1, b1, w2, b2 = self.weights(f"online.{name}.net.")
        return scale * (1 + (w2 @ np.maximum(w1 @ s + b1, 0) + b2)[0])

    def critics(self, name, scale, *inputs):
        """The values of the two critics. name: online.NAME or target.NAME."""
        w1, b1, w2, b2 = self.weights(f"{name}.layers.")
        hidden = [np.maximum(np.concatenate(inputs) @ w1[k] + b1[k, 0], 0) for k in (0, 1)]
        return [scale * (1 + (x @ w2[k] + b2[k, 0])[0]) for k, x in enumerate(hidden)]

    def predicted_noise(self, s, a, step):
        get = {
            k.removeprefix("online.policy."): v[self.run].astype(float)
            for k, v in self.state.items()
            if k.startswith("online.policy.")
        }

        def layer(name, x):
            return get[f"{name}.weight"] @ x + get[f"{name}.bias"]

        def mish(x):
            return x * np.tanh(np.log1p(np.exp(x)))

        x = layer("first", np.concatenate([s, a])) + get["step.weight"][step]
        for b in range(3):
            normal = (x - x.mean()) / np.sqrt(x.var() + 1e-5)
            normal = normal * get[f"blocks.{b}.norm.weight"] + get[f"blocks.{b}.norm.bias"]
            x = x + layer(f"blocks.{b}.back", mish(layer(f"blocks.{b}.wide", normal)))
        return layer("last", mish(x))

    def losses(self, batch):
        names = "value critic policy feasibility_value feasibility_critic".split()
        sums = dict.fromkeys([f"{name}_loss" for name in names], 0.0)
        sums |= {"feasible_fraction": 0.0, "weight_mean": 0.0, "value_mean": 0.0}
        scale = 0.5 * 40 / T / (1 - 0.8)
        kept = np.cumprod([math.exp(-0.02 - 0.198 * odd) for odd in (1, 3, 5, 7, 9)])
        for row in range(B):
            x = {name: values[row] for name, values in batch.items()}
            s, s_next, a = self.inputs(x["observations"]), self.inputs(x["next_observations"]), x["actions"]
            a, goes_on = a.numpy().astype(float), not (x["terminals"] or x["timeouts"])
            q, v = min(self.critics("target.critics", scale, s, a)), self.value("value", scale, s)
            sums["value_loss"] += (0.9 if q > v else 0.1) * (q - v) ** 2 / B
            y = x["rewards"].item() + 0.8 * goes_on * self.value("value", scale, s_next)
            sums["critic_loss"] += sum((y - z) ** 2 for z in self.critics("online.critics", scale, s, a)) / B

            q_h = max(self.critics("target.feasibility_critics", -1, s, a))
            v_h = self.value("feasibility_value", -1, s)
            sums["feasibility_value_loss"] += (0.9 if q_h < v_h else 0.1) * (q_h - v_h) ** 2 / B
            h = 25.0 if x["costs"] > 0 else -1.0
            following = max(h, self.value("feasibility_value", -1, s_next))
            y = 0.2 * h + 0.8 * following if goes_on else h
            errors = [(y - z) ** 2 for z in self.critics("online.feasibility_critics", -1, s, a)]
            sums["feasibility_critic_loss"] += sum(errors) / B

            if v_h > 0:
                weight = min(math.exp(5 * (v_h - q_h)), 150.0)
            else:
                weight = min(math.exp(3 * (q - v) * T / 45), 100.0) if q_h <= 0 else 0.0
            step, noise = int(x["step"]), x["noise"].numpy()
            noisy = math.sqrt(kept[step]) * a + math.sqrt(1 - kept[step]) * noise
            sums["policy_loss"] += weight * sum((self.predicted_noise(s, noisy, step) - noise) ** 2) / B
            sums["feasible_fraction"] += (v_h <= 0) / B
            sums["weight_mean"] += weight / B
            sums["value_mean"] += v / B
        return sums


@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_fisors(seeds):
    agent, mixed = make_agent(seeds), 0
    for seed in range(4):
        randomise(agent, seed)
        agent.fill_last_bias(["feasibility_value", "feasibility_critics"], [-1.0] * len(seeds))  # around zero
        batch = random_batch(agent, seed)
        slow = [Slow(agent, run).losses(of_run(batch, run)) for run in range(len(seeds))]
        scalars = agent.update(batch)
        mixed += any(0 < one["feasible_fraction"] < 1 for one in slow)
        for run, expected in enumerate(slow):
            found = {key: value[run].item() for key, value in scalars.items()}
            assert found == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert mixed >= 2  # both kinds of weights were seen


def test_the_noise_of_an_update_has_the_shapes_and_the_distributions_that_it_is_for():
    agent = make_agent(batch_size=5_000)
    drawn = agent.draw(random_data(0), torch.Generator().manual_seed(3), math.inf)
    assert drawn["noise"].shape == (5_000, ACT) and drawn["step"].shape == (5_000,)
    assert abs(drawn["noise"].mean()) < 0.05 and abs(drawn["noise"].std() - 1) < 0.05
    shares = torch.bincount(drawn["step"]) / 5_000
    torch.testing.assert_close(shares, torch.full((5,), 0.2), atol=0.03, rtol=0)


# --- Playing ---


def test_the_played_action_is_the_candidate_with_the_least_q_h():
    """The candidates are written out: each is denoised alone, by the networks in plain numbers."""
    agent = make_agent()
    slow, alphas = Slow(agent, 0), [math.exp(-0.02 - 0.198 * odd) for odd in (1, 3, 5, 7, 9)]
    observations, kept = np.random.default_rng(1).normal(size=(3, OBS)), np.cumprod(alphas)
    played = agent.player([1.0] * 3, seeds=[5, 6, 7]).act(observations)
    for episode, seed in enumerate((5, 6, 7)):
        noise = np.random.default_rng(seed).normal(size=(5, 16, ACT))
        s = slow.inputs(torch.tensor(observations[episode]))
        candidates = []
        for candidate in range(16):
            x = noise[0, candidate]
            for n, t in enumerate((4, 3, 2, 1, 0)):
                x = x - (1 - alphas[t]) / math.sqrt(1 - kept[t]) * slow.predicted_noise(s, x, t)
                x = x / math.sqrt(alphas[t])
                x = x + math.sqrt(1 - alphas[t]) * noise[n + 1, candidate] if t else x
                x = np.clip(x, -1, 1)
            candidates.append((max(slow.critics("online.feasibility_critics", -1, s, x)), x))
        values = [value for value, _ in candidates]
        assert max(values) - min(values) > 1e-3
        np.testing.assert_allclose(played[episode], candidates[int(np.argmin(values))][1], atol=1e-4)


# --- What it learns ---

NEXT = np.array([[1, 2], [3, 0], [4, 1], [0, 0], [4, 4]])  # the next state of (s, a)
UNSAFE = np.array([[0, 0], [0, 0], [0, 0], [0, 0], [1, 1]])  # state 4 costs, and is never left
STATES, GAMMA = len(NEXT), 0.9


def iterated(expectile=0.9):
    """V_h and Q_h, by a plain loop. V_h is an expectile of the two recorded actions' Q_h."""
    v = np.full(STATES, -1.0)
    h = np.where(UNSAFE, 25.0, -1.0)
    for _ in range(400):
        q = np.array([[(1 - GAMMA) * h[s, a] + GAMMA * max(h[s, a], v[NEXT[s, a]]) for a in (0, 1)]
                      for s in range(STATES)])  # fmt: skip

        def slope(x, values):
            return sum((expectile if q_h < x else 1 - expectile) * (q_h - x) for q_h in values)

        v = np.array([brentq(slope, -2, 26, args=(row,)) for row in q])
    return v, q


def tabular(rows=2000):
    """Steps of random actions, -0.5 and 0.5 for the two actions, from random states with one-hot codes."""
    rng, one_hot = np.random.default_rng(0), np.eye(STATES, dtype=np.float32)
    states, actions = rng.integers(0, STATES, rows), rng.integers(0, 2, rows)
    return Dataset(
        observations=one_hot[states],
        next_observations=one_hot[NEXT[states, actions]],
        actions=(actions[:, None] - 0.5).astype(np.float32),
        rewards=np.zeros(rows, np.float32),
        costs=UNSAFE[states, actions].astype(np.float32),
        terminals=np.zeros(rows, bool),
        timeouts=np.arange(rows) == rows - 1,
    )


def test_feasibility_is_that_of_value_iteration():
    task = dataclasses.replace(TASK, obs_dim=STATES, act_dim=1)
    config = FISOR.configure(
        gamma=GAMMA, hidden_width=16, hidden_layers=1, blocks=1, batch_size=64, updates=800, critic_lr=1e-2,
        target_tau=0.2, normalise_observations=False,
    )  # fmt: skip
    agent = FISOR(task, config)
    train(agent, tabular(), progress=False)
    v, q = iterated()
    with torch.no_grad():
        net, one_hot = agent.networks(0), torch.eye(STATES)
        found = net.feasibility_value(one_hot)
        of_actions = [net.feasibility_critics(one_hot, torch.full((STATES, 1), a)) for a in (-0.5, 0.5)]
    np.testing.assert_allclose(found, v, atol=1.0)
    for a in (0, 1):
        np.testing.assert_allclose(of_actions[a].amax(0), q[:, a], atol=1.0)
    assert (np.sign(found) == np.sign(v)).all() and 0 < (v <= 0).sum() < STATES


def test_it_takes_the_best_reward_that_is_safe():
    """One step: the reward is the action, and an action above 0.6 costs. The others have Q_h = -1."""
    rng, rows = np.random.default_rng(0), 4000
    actions = rng.uniform(-1, 1, (rows, 1)).astype(np.float32)
    states = rng.normal(size=(rows, 1)).astype(np.float32)
    data = Dataset(
        observations=states, next_observations=states, actions=actions, rewards=actions[:, 0],
        costs=(actions[:, 0] > 0.6).astype(np.float32), terminals=np.ones(rows, bool),
        timeouts=np.zeros(rows, bool),
    )  # fmt: skip
    task = dataclasses.replace(TASK, obs_dim=1, act_dim=1, horizon=1, min_return=-1.0, max_return=1.0)
    config = FISOR.configure(
        hidden_width=32, hidden_layers=1, blocks=1, batch_size=128, updates=800, policy_lr=5e-3,
        critic_lr=5e-3, unsafe_step=2.0, reward_factor=8.0,
    )  # fmt: skip
    agent = FISOR(task, config)
    train(agent, data, progress=False)
    one_of = {
        n: agent.playing_with(candidates=n).player([0.0] * 500, range(500)).act(states[:500])[:, 0]
        for n in (1, 16)
    }
    safe = actions[actions <= 0.6]
    weight = np.exp(8 / 2 * safe)  # the range of returns is 2
    assert one_of[1].mean() == pytest.approx((weight * safe).sum() / weight.sum(), abs=0.1)
    assert (one_of[1] > 0.7).mean() < 0.05
    assert one_of[16].max() <= 0.6 and one_of[16].mean() > 0
