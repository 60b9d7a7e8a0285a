"""CPQ, with the push and without, against its equations written out as loops, in plain numbers."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from plain import Plain
from randoms import of_run, random_batch, random_data, randomise

from tutorial_lib import training
from tutorial_lib.agents.cpq import CPQ, PushedCPQ
from tutorial_lib.course.maximisation_bias import latent_divergences
from tutorial_lib.data.dataset import Batch, Dataset
from tutorial_lib.tasks import TASKS

T, B, OBS, ACT = 10, 8, 3, 2
TASK = dataclasses.replace(
    TASKS["BallRun"],
    horizon=T,
    obs_dim=OBS,
    act_dim=ACT,
    thresholds=(1, 3, 6),
    cost_range=8,
    min_return=-5.0,
    max_return=40.0,
)
OPTIONS = {"gamma": 0.8, "batch_size": B, "updates": 100, "hidden_width": 8, "hidden_layers": 1}
LIMIT = 3.0
SCALARS = ("critic_loss", "cost_critic_loss", "policy_loss", "safe_fraction", "negative_q")


def make_agent(kind=CPQ, seeds=(0,), limits=LIMIT, **changes):
    return kind(TASK, kind.configure("paper", **OPTIONS | changes), seeds=seeds, limits=limits)


# --- The equations as loops ---


class Slow:
    """One run, one transition and one sample at a time; the networks too are written out."""

    def __init__(self, agent, run):
        self.config, self.run = agent.config, run
        self.state = {key: value.numpy().copy() for key, value in agent.state().items()}
        self.log_multiplier = self.state.get("variable.log_multiplier", [0.0] * (run + 1))[run]

    def inputs(self, observation):
        """The normalised observation."""
        mean, std = (self.state[f"variable.observation_{name}"][self.run] for name in ("mean", "std"))
        return (observation - mean) / std

    def weights(self, prefix):
        return [v[self.run].astype(float) for k, v in self.state.items() if k.startswith(prefix)]

    def dense(self, network, *inputs):
        """A stack of linear layers with ReLU between them, as numbers (out,)."""
        x, layers = np.concatenate(inputs), self.weights(f"online.{network}.net.")
        for weight, bias in zip(layers[::2], layers[1::2], strict=True):
            x = weight @ x + bias
            x = x if weight is layers[-2] else np.maximum(x, 0)
        return x

    def critic(self, kind, network, scale, *inputs):
        """Each critic's value of one state and action, a list."""
        values, layers = [], self.weights(f"{kind}.{network}.layers.")
        for k in range(len(layers[0])):
            x = np.concatenate(inputs)
            for weight, bias in zip(layers[::2], layers[1::2], strict=True):
                x = x @ weight[k] + bias[k, 0]
                x = x if weight is layers[-2] else np.maximum(x, 0)
            values.append(scale * (1 + x[0]))
        return values

    def q(self, kind, *inputs):
        return self.critic(kind, "critics", 0.5 * 40 / T / (1 - self.config.gamma), *inputs)

    def q_cost(self, kind, *inputs):
        return self.critic(kind, "cost_critics", 3 / T / (1 - self.config.gamma), *inputs)

    def act(self, s, noise):
        out = self.dense("policy", s)
        return np.tanh(out[:ACT] + np.exp(np.clip(out[ACT:], -20, 2)) * noise)

    def latent(self, s, a):
        out = self.dense("encoder", s, a)
        return out[: 2 * ACT], np.clip(out[2 * ACT :], -4, 15)

    def kl(self, s, a):
        """From the textbook's formula, one dimension after the other."""
        mean, log_std = self.latent(s, a)
        terms = [(math.exp(z) ** 2 + m * m - 1) / 2 - z for m, z in zip(mean, log_std, strict=True)]
        return sum(terms) / len(terms)

    def rows(self, batch):
        """Each transition and the noise that belongs to it, in double precision."""
        for row in range(B):
            x = Batch(**{field: batch[field][row].numpy().astype(float) for field in Batch._fields})
            yield row, x, self.inputs(x.observations), self.inputs(x.next_observations)

    def losses(self, batch):
        gamma, sums = self.config.gamma, dict.fromkeys(SCALARS, 0.0)
        limit = LIMIT * sum(gamma**t for t in range(T)) / T
        for row, x, s, s_next in self.rows(batch):
            a_next = self.act(s_next, batch["next_noise"][row].numpy())
            cost_next = min(self.q_cost("target", s_next, a_next))
            q_next = min(self.q("target", s_next, a_next)) if cost_next <= limit else 0.0
            y = x.rewards + (0.0 if x.terminals or x.timeouts else gamma * q_next)
            y_cost = x.costs + (0.0 if x.terminals else gamma * min(max(cost_next, 0.0), 1 / (1 - gamma)))
            sums["critic_loss"] += sum((y - q) ** 2 for q in self.q("online", s, x.actions)) / B
            errors = [(y_cost - q) ** 2 for q in self.q_cost("online", s, x.actions)]
            sums["cost_critic_loss"] += sum(errors) / B

            action = self.act(s, batch["noise"][row].numpy())
            safe = min(self.q_cost("online", s, action)) <= limit
            q = min(self.q("online", s, action))
            sums["policy_loss"] -= safe * q / B
            sums["safe_fraction"] += safe / B
            sums["negative_q"] += (q < 0) / B
        return sums

    def pushed_losses(self, batch):
        sums, samples = self.losses(batch), []
        limit = LIMIT * sum(self.config.gamma**t for t in range(T)) / T
        sums |= {"vae_loss": 0.0, "alpha": math.exp(self.log_multiplier)}
        for row, x, s, _ in self.rows(batch):
            latent, log_std = self.latent(s, x.actions)
            noise = batch["latent_noise"][row].numpy()
            decoded = np.tanh(self.dense("decoder", s, latent + np.exp(log_std) * noise))
            sums["vae_loss"] += (sum((decoded - x.actions) ** 2) / ACT + 0.5 * self.kl(s, x.actions)) / B
            samples += [(s, self.act(s, noise[row].numpy())) for noise in batch["sample_noise"]]
        assert len(samples) == 10 * B
        outside = sorted(samples, key=lambda pair: self.kl(*pair))[-len(samples) // 4 :]
        costs = [min(self.q_cost("online", *pair)) for pair in outside]
        sums["outside_cost"] = sum(costs) / len(costs)
        sums["shortfall"] = 1.5 * limit - sums["outside_cost"]
        sums["cost_critic_loss"] += sums["alpha"] * max(sums["shortfall"], 0.0)
        return sums


@pytest.mark.parametrize(("kind", "missing"), [(CPQ, None), (PushedCPQ, True), (PushedCPQ, False)])
@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_cpqs(kind, seeds, missing):
    """On batches with safe and unsafe actions, and where actions outside cost too little, or enough."""
    agent = make_agent(kind, seeds)
    batch = random_batch(agent)
    for seed in range(200):
        randomise(agent, seed)
        slow = []
        for run in range(len(seeds)):
            one = Slow(agent, run)
            slow.append((one.losses if kind is CPQ else one.pushed_losses)(of_run(batch, run)))
        mixed = all(0.2 < one["safe_fraction"] < 0.8 for one in slow)
        if mixed and all(missing is None or (one["shortfall"] > 0) == missing for one in slow):
            break
    else:
        pytest.fail("no batch that shows everything")
    scalars = agent.update(batch)
    for run, expected in enumerate(slow):
        found = {key: value[run].item() for key, value in scalars.items()}
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-4)


# --- The push ---


def cost_gradients(agent):
    """The gradients of the cost critics' loss in these critics' own parameters, in one run."""
    plain = Plain(agent)
    losses, _ = plain.losses(of_run(random_batch(agent), 0))
    return torch.autograd.grad(losses["cost_critic"], list(plain.online["cost_critics"].parameters()))


def test_the_price_of_actions_outside_has_a_gradient_in_proportion_to_the_multiplier():
    """OSRL's has none: see the module's list of departures. Where nothing is missing there is none either."""
    agent, gradients = make_agent(PushedCPQ), []
    randomise(agent, 0)
    multiplier = agent.variables["log_multiplier"]
    agent.fill_last_bias(("cost_critics",), [-9.0])
    for log in (0.0, 1.0, 2.0):
        multiplier.fill_(log)
        gradients.append(cost_gradients(agent))
    for at_0, at_1, at_2 in zip(*gradients, strict=True):
        one, two = at_1 - at_0, at_2 - at_0
        torch.testing.assert_close(two, one * (math.e**2 - 1) / (math.e - 1), rtol=1e-3, atol=1e-5)
    assert all((at_1 - at_0).abs().max() > 1e-3 for at_0, at_1, _ in zip(*gradients, strict=True))
    agent.fill_last_bias(("cost_critics",), [90.0])
    with_any = cost_gradients(agent)
    multiplier.fill_(-5.0)
    torch.testing.assert_close(with_any, cost_gradients(agent), rtol=0, atol=0)


def test_the_multiplier_takes_a_plain_step_and_stays_within_its_bounds():
    agent = make_agent(PushedCPQ, seeds=(0, 1))
    batch, log = random_batch(agent), agent.variables["log_multiplier"]
    for start, cost, expected in ((0.3, 2.0, None), (5.0, 0.0, 5.0), (-5.0, 90.0, -5.0)):
        log.fill_(start)
        agent.fill_last_bias(("cost_critics",), [cost, cost])
        scalars = agent.update(batch)
        for run in (0, 1):
            missing = 1.5 * LIMIT * sum(0.8**t for t in range(T)) / T - scalars["outside_cost"][run].item()
            step = start + 1e-4 * math.exp(start) * missing if expected is None else expected
            assert log[run].item() == pytest.approx(step, abs=1e-6)
            assert (missing > 0) == (cost == 0.0)
    log.fill_(5.0)
    agent.fill_last_bias(("cost_critics",), [90.0, 90.0])
    agent.update(batch)
    assert (log < 5.0).all()  # a bound can be left


def test_the_noise_of_an_update_has_the_shapes_that_it_is_for_and_nothing_is_drawn_twice():
    agent = make_agent(PushedCPQ)
    drawn = agent.draw(random_data(0), torch.Generator().manual_seed(3), LIMIT)
    noise = {key: drawn[key] for key in ("next_noise", "noise", "sample_noise", "latent_noise")}
    assert [x.shape for x in noise.values()] == [(B, ACT), (B, ACT), (10, B, ACT), (B, 2 * ACT)]
    whole = torch.cat([x.flatten() for x in noise.values()])
    assert len(whole.unique()) > 0.99 * len(whole)
    many = make_agent(PushedCPQ, batch_size=2_000).draw(
        random_data(0), torch.Generator().manual_seed(4), LIMIT
    )
    for key in noise:
        assert many[key].mean().item() == pytest.approx(0, abs=0.05)
        assert many[key].std().item() == pytest.approx(1, abs=0.05)


# --- What it learns ---


def dataset(rows=200, low=-1.0, high=1.0, cost=0.4, terminal=False):
    rng = np.random.default_rng(0)
    return Dataset(
        observations=rng.normal(size=(rows, OBS)).astype(np.float32),
        next_observations=rng.normal(size=(rows, OBS)).astype(np.float32),
        actions=rng.uniform(low, high, size=(rows, ACT)).astype(np.float32),
        rewards=rng.normal(2, 1, size=rows).astype(np.float32),
        costs=(rng.random(rows) < cost).astype(np.float32),
        terminals=np.full(rows, terminal),
        timeouts=(np.arange(1, rows + 1) % T == 0) & (not terminal),
    )


def test_actions_outside_the_data_come_to_look_too_costly():
    """Episodes of one free step, actions in a corner: these stay cheap, those far away do not."""
    agent = make_agent(PushedCPQ, batch_size=64, hidden_width=32, critic_lr=1e-3, policy_lr=0.0)
    data = dataset(low=0.6, high=0.9, cost=0.0, terminal=True)
    log = training.train(agent, data, updates=400, log_every=100, progress=False)
    limit = LIMIT * sum(0.8**t for t in range(T)) / T
    assert log[0]["outside_cost"] < 1.4 * limit < log[-1]["outside_cost"] < 1.8 * limit  # and no further
    with torch.no_grad():
        net = agent.networks(0)
        s = agent.network_input(net, torch.tensor(data.observations), torch.tensor(LIMIT))
        recorded = net.cost_critics(s, torch.tensor(data.actions)).amin(0)
        opposite = net.cost_critics(s, -torch.tensor(data.actions)).amin(0)
    assert recorded.abs().mean() < 0.3 * limit and (opposite > limit).float().mean() > 0.9


def test_a_vae_finds_random_actions_strange_where_the_recorded_ones_tell_something():
    """Recorded are 0.9 and -0.9 at random, so the latent must say which; others spread there."""
    rng = np.random.default_rng(1)
    data = dataset(rows=1000)
    corners = rng.choice([-0.9, 0.9], size=(1000, ACT)).astype(np.float32)
    data = dataclasses.replace(data, actions=corners)
    known, random = latent_divergences(data, updates=200, width=32, n=500)
    assert known.shape == random.shape == (500,) and (known >= 0).all()
    again = latent_divergences(data, updates=200, width=32, n=500)
    assert np.array_equal(known, again[0]) and np.array_equal(random, again[1])
    assert np.std(known) < np.std(random)


def test_the_action_that_runs_is_the_squashed_mean_without_noise():
    agent = make_agent()
    randomise(agent, 3)
    observations = np.random.default_rng(1).normal(size=(5, OBS))
    slow = Slow(agent, 0)
    expected = [slow.act(slow.inputs(s), 0.0) for s in observations]
    np.testing.assert_allclose(agent.act(observations, np.full(5, LIMIT)), expected, atol=1e-5)
    assert np.isnan(agent.predicted_cost(observations, np.full(5, LIMIT))).all()


@pytest.mark.parametrize("limits", [math.inf, (3.0, math.inf)])
def test_an_infinite_limit_is_refused(limits):
    with pytest.raises(ValueError, match="CPQ needs a finite limit"):
        make_agent(seeds=(0, 1), limits=limits)
