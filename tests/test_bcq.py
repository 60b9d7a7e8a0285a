"""BCQ-Lag, and what it shares with BEAR-Lag, against loops in plain numbers: losses, targets, multiplier."""

import math

import numpy as np
import pytest
import test_cpq
import torch
from plain import Plain
from randoms import of_run, random_batch, random_data, randomise
from test_cpq import ACT, LIMIT, OBS, OPTIONS, TASK, B, T

from tutorial_lib import training
from tutorial_lib.agents.bcq import BCQLag
from tutorial_lib.agents.lagrangian import soft_clipped_max
from tutorial_lib.data.dataset import Dataset


def make_agent(kind=BCQLag, seeds=(0,), limits=LIMIT, **changes):
    return kind(TASK, kind.configure("paper", **OPTIONS | changes), seeds=seeds, limits=limits)


def threshold(limit, gamma=0.8):
    """L~ of eq. 2, as a sum."""
    return limit * sum(gamma**t for t in range(T)) / T


# --- The equations as loops ---


class SlowLagrangian(test_cpq.Slow):
    """One run, one transition and one action at a time; the networks too are written out."""

    def variable(self, name):
        return float(self.state[f"variable.{name}"][self.run])

    def stack(self, network, *inputs):
        """The linear layers of `network`, e.g. 'target.policy', with ReLU between them, as numbers (out,)."""
        x, layers = np.concatenate(inputs), self.weights(f"{network}.net.")
        for weight, bias in zip(layers[::2], layers[1::2], strict=True):
            x = weight @ x + bias
            x = x if weight is layers[-2] else np.maximum(x, 0)
        return x

    def multiplier(self, error):
        """One step of OSRL's controller."""
        total = max(self.variable("error_sum") + error, 0.0)
        rise = max(error - self.variable("last_error"), 0.0)
        return max(0.1 * max(error, 0.0) + 0.003 * total + 0.001 * rise, 0.0)

    def next_actions(self, s_next, batch, row):
        raise NotImplementedError

    def action(self, s, batch, row):
        raise NotImplementedError

    def target(self, q, s_next, actions):
        """The largest mixture of two target critics over the actions."""
        best = -math.inf
        for action in actions:
            one, other = q("target", s_next, action)
            best = max(best, 0.75 * min(one, other) + 0.25 * max(one, other))
        return best

    def losses(self, batch):
        gamma, names = self.config.gamma, ("critic_loss", "cost_critic_loss", "policy_loss", "vae_loss")
        sums, errors = dict.fromkeys(names, 0.0), []
        for row, x, s, s_next in self.rows(batch):
            actions = self.next_actions(s_next, batch, row)
            assert len(actions) == 10
            goes_on, stands = not (x.terminals or x.timeouts), not x.terminals
            y = x.rewards + goes_on * gamma * self.target(self.q, s_next, actions)
            after = min(max(self.target(self.q_cost, s_next, actions), 0.0), 1 / (1 - gamma))
            y_cost = x.costs + stands * gamma * after
            sums["critic_loss"] += sum((y - q) ** 2 for q in self.q("online", s, x.actions)) / B
            costs = self.q_cost("online", s, x.actions)
            sums["cost_critic_loss"] += sum((y_cost - q) ** 2 for q in costs) / B

            latent, log_std = self.latent(s, x.actions)
            z = latent + np.exp(log_std) * batch["latent_noise"][row].numpy()
            decoded = np.tanh(self.stack("online.decoder", s, z))
            sums["vae_loss"] += (sum((decoded - x.actions) ** 2) / ACT + 0.5 * self.kl(s, x.actions)) / B

            action = self.action(s, batch, row)
            sums["policy_loss"] -= 0.1 * min(self.q("online", s, action)) / B
            errors.append(min(self.q_cost("online", s, action)) - threshold(LIMIT))
        sums["error"] = sum(errors) / B
        sums["multiplier"] = self.multiplier(sums["error"])
        sums["policy_loss"] += sums["multiplier"] * sums["error"]
        return sums


class Slow(SlowLagrangian):
    def perturbed(self, kind, s, latent):
        """The decoded action and what the policy makes of it."""
        decoded = np.tanh(self.stack("online.decoder", s, latent))
        change = np.tanh(self.stack(f"{kind}.policy", s, decoded))
        return np.clip(decoded + self.config.phi * change, -1, 1)

    def next_actions(self, s_next, batch, row):
        return [self.perturbed("target", s_next, z[row].numpy()) for z in batch["next_latents"]]

    def action(self, s, batch, row):
        return self.perturbed("online", s, batch["latents"][row].numpy())


def assert_losses_are(slow_kind, agent, priced):
    """An update of random networks logs what the loops compute, where lambda is positive, or zero."""
    batch, runs = random_batch(agent), range(len(agent.seeds))
    for seed in range(300):
        randomise(agent, seed)
        agent.variables["error_sum"].abs_()
        slow = [slow_kind(agent, run).losses(of_run(batch, run)) for run in runs]
        if all((one["multiplier"] > 0) == priced for one in slow):
            break
    else:
        pytest.fail("no state with such a multiplier")
    scalars = agent.update(batch)
    for run, expected in enumerate(slow):
        found = {key: value[run].item() for key, value in scalars.items()}
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("priced", [True, False])
@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_bcqs(seeds, priced):
    assert_losses_are(Slow, make_agent(seeds=seeds, phi=0.3), priced)


def test_the_targets_mix_the_critics_of_each_action_before_the_largest_counts():
    q = torch.randn(2, 5, 7, generator=torch.Generator().manual_seed(0))
    for b, found in enumerate(soft_clipped_max(q, 0.75).tolist()):
        mixed = [0.75 * min(q[:, n, b].tolist()) + 0.25 * max(q[:, n, b].tolist()) for n in range(5)]
        assert found == pytest.approx(max(mixed), abs=1e-6)


# --- The multiplier ---


def test_the_multiplier_is_the_controllers_over_many_updates():
    """The sum of errors that never falls below zero is the sum minus its smallest value so far."""
    agent = make_agent(seeds=(0, 1), reward_weight=0.0)
    batch, errors, found = random_batch(agent), [], []
    for update in range(40):
        cost = 0.4 * math.sin(update / 4)
        agent.fill_last_bias(("cost_critics",), [cost, -cost])
        scalars = agent.update(batch)
        errors.append(scalars["error"].double().numpy())
        found.append(scalars["multiplier"].double().numpy())
    for run in (0, 1):
        e = np.array(errors)[:, run]
        assert 5 < (e > 0).sum() < 35
        sums = np.cumsum(e)
        kept = sums - np.minimum(np.minimum.accumulate(sums), 0)
        rises = np.maximum(np.diff(e, prepend=0.0), 0)
        expected = 0.1 * np.maximum(e, 0) + 0.003 * kept + 0.001 * rises
        np.testing.assert_allclose(np.array(found)[:, run], expected, rtol=1e-4, atol=1e-5)
        assert agent.variables["error_sum"][run].item() == pytest.approx(kept[-1], rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(("cost", "sign"), [(3.0, 1), (-1.5, -1)])
def test_the_sum_of_errors_moves_where_the_policys_loss_rises(cost, sign):
    """The policy minimises and the multiplier maximises one function: here is its slope by differences."""
    agent = make_agent()
    batch, total = random_batch(agent), agent.variables["error_sum"]
    agent.fill_last_bias(("cost_critics",), [cost])
    losses = []
    for start in (100.0, 104.0):
        total.fill_(start)
        losses.append(Plain(agent).losses(of_run(batch, 0))[0]["policy"].item())
    slope = (losses[1] - losses[0]) / 4
    scalars = agent.update(batch)
    assert slope == pytest.approx(0.003 * scalars["error"].item(), rel=1e-3)
    assert (total.item() - 104.0) * sign > 0 and slope * sign > 0


def test_the_cost_critics_start_at_the_recorded_cost_in_the_unit_of_the_limit():
    agent = make_agent(seeds=(0, 1))
    data = [toy_data(lambda x, rate=rate: rate + 0 * x) for rate in (0.2, 0.7)]
    agent.prepare(data, progress=False)
    for parameters in (agent.parameters, agent.target_parameters):
        bias = list(parameters["cost_critics"].values())[-1].detach()
        first = 3 / T / (1 - 0.8) * (1 + bias)
        for run, rate in enumerate((0.2, 0.7)):
            np.testing.assert_allclose(first[run], threshold(rate * T), rtol=1e-5)


@pytest.mark.parametrize("limits", [math.inf, (3.0, math.inf)])
def test_an_infinite_limit_is_refused(limits):
    with pytest.raises(ValueError, match="BCQ-Lag needs a finite limit"):
        make_agent(seeds=(0, 1), limits=limits)


# --- What it draws ---


def assert_noise(agent, bounded, shapes):
    """The numbers that an update draws: their shapes, their moments, and no number twice."""
    many = agent.draw(random_data(0), torch.Generator().manual_seed(4), LIMIT)
    assert {key: tuple(many[key].shape) for key in shapes} == shapes
    every = torch.cat([many[key].flatten() for key in shapes])
    inside = every[every.abs() != 0.5]
    assert len(inside.unique()) > 0.99 * len(inside)
    for key in shapes:
        x, clamped = many[key], key in bounded
        assert x.mean().item() == pytest.approx(0, abs=0.06)
        assert (x.abs().max().item() == 0.5) == clamped
        if clamped:  # the share of a standard normal outside is 0.617
            assert (x.abs() == 0.5).float().mean().item() == pytest.approx(0.617, abs=0.03)
        else:
            assert x.std().item() == pytest.approx(1, abs=0.06)


def test_the_latents_are_clamped_normal_numbers():
    shapes = {"latent_noise": (500, 4), "next_latents": (10, 500, 4), "latents": (500, 4)}
    assert_noise(make_agent(batch_size=500), ("next_latents", "latents"), shapes)


# --- How it plays ---


def test_a_player_decodes_a_latent_of_each_episodes_own_seed_at_every_step():
    agent, seeds = make_agent(phi=0.3), (5, 6, 5)
    randomise(agent, 3)
    observations = np.random.default_rng(1).normal(size=(3, OBS))
    slow, dice = Slow(agent, 0), [np.random.default_rng(seed) for seed in seeds]
    player = agent.player(np.full(3, LIMIT), seeds)
    for _ in range(3):
        expected = []
        for s, generator in zip(observations, dice, strict=True):
            latent = np.clip(generator.normal(size=2 * ACT), -0.5, 0.5)
            expected.append(slow.perturbed("online", slow.inputs(s), latent))
        np.testing.assert_allclose(player.act(observations), expected, atol=1e-5)
    middle = [slow.perturbed("online", slow.inputs(s), np.zeros(2 * ACT)) for s in observations]
    np.testing.assert_allclose(agent.act(observations, np.full(3, LIMIT)), middle, atol=1e-5)


# --- What it learns ---


def toy_data(cost, low=-1.0, high=1.0, rows=400):
    """Episodes of one step, which earn the first number x of the action and cost cost(x)."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(low, high, size=(rows, ACT)).astype(np.float32)
    return Dataset(
        observations=rng.normal(size=(rows, OBS)).astype(np.float32),
        next_observations=rng.normal(size=(rows, OBS)).astype(np.float32),
        actions=actions,
        rewards=actions[:, 0],
        costs=cost(actions[:, 0]).astype(np.float32),
        terminals=np.ones(rows, bool),
        timeouts=np.zeros(rows, bool),
    )


SIZES = {"batch_size": 32, "hidden_width": 16, "samples": 2}
TOY = SIZES | {"critic_lr": 1e-2, "policy_lr": 1e-2, "integral_gain": 0.01}


def assert_earns_what_the_limit_allows(kind, updates, **changes):
    """A step costs (1 + x) / 2, so the answer is x = 2 L~ - 1, or the largest x if the limit allows it."""
    limits, expected = (0.7, 3.0), (-0.375, 1.0)
    assert [min(2 * threshold(limit) - 1, 1) for limit in limits] == pytest.approx(expected, abs=1e-3)
    agent = make_agent(kind, seeds=(0, 0), limits=limits, **TOY | changes)
    data = toy_data(lambda x: (1 + x) / 2)
    log = training.train(agent, data, updates=updates, log_every=updates, progress=False)
    for run, answer in enumerate(expected):
        x = agent.player(np.full(400, 3.0), range(400), run).act(data.observations)[:, 0]
        within = 0.12 if answer < 1 else 0.25  # a tanh hardly reaches one
        assert x.mean() == pytest.approx(answer, abs=within), log
        assert (log[run]["multiplier"] > 0.05) == (answer < 1), log


def test_it_earns_what_the_limit_allows():
    assert_earns_what_the_limit_allows(BCQLag, 500, phi=2.0)


def test_it_stays_near_what_the_vae_decodes():
    """More is earned outside the data, and the policy goes no further than phi."""
    agent = make_agent(limits=3.0, phi=0.1, **TOY)
    data = toy_data(lambda x: 0 * x, low=-0.4, high=0.2)
    training.train(agent, data, updates=300, progress=False)
    net = agent.networks(0)
    s = agent.network_input(net, torch.tensor(data.observations), torch.tensor(3.0))
    with torch.no_grad():
        decoded = net.decoder(s, torch.zeros(len(s), 2 * ACT)).numpy()
    x = agent.act(data.observations, np.full(400, 3.0))
    assert np.abs(x - decoded).max() < 0.1001 and (x - decoded)[:, 0].mean() > 0.08
    assert decoded[:, 0].mean() == pytest.approx(-0.1, abs=0.1)
