"""BEAR-Lag against loops in plain numbers: its losses, the discrepancy, alpha, and what it learns."""

import math

import numpy as np
import pytest
import torch
from plain import Plain
from randoms import of_run, random_batch, randomise
from test_bcq import (
    TOY,
    SlowLagrangian,
    assert_earns_what_the_limit_allows,
    assert_losses_are,
    assert_noise,
    make_agent,
    toy_data,
)
from test_cpq import ACT, LIMIT, OBS, B

from tutorial_lib import training
from tutorial_lib.agents.bear import BEARLag, mmd


def slow_mmd(x, y, sigma):
    """Of n vectors and m vectors, by every pair of them."""

    def mean_kernel(some, others):
        total = 0.0
        for one in some:
            for other in others:
                total += math.exp(-sum((a - b) ** 2 for a, b in zip(one, other, strict=True)) / (2 * sigma))
        return total / (len(some) * len(others))

    return math.sqrt(mean_kernel(x, x) + mean_kernel(y, y) - 2 * mean_kernel(x, y) + 1e-6)


class Slow(SlowLagrangian):
    def before_tanh(self, kind, s, noise):
        out = self.stack(f"{kind}.policy", s)
        return out[:ACT] + np.exp(np.clip(out[ACT:], -20, 2)) * noise

    def next_actions(self, s_next, batch, row):
        return [np.tanh(self.before_tanh("target", s_next, n[row].numpy())) for n in batch["next_noise"]]

    def action(self, s, batch, row):
        return np.tanh(self.before_tanh("online", s, batch["noise"][0, row].numpy()))

    def losses(self, batch):
        sums, distances = super().losses(batch), []
        for row, _, s, _ in self.rows(batch):
            decoded = [self.stack("online.decoder", s, z[row].numpy()) for z in batch["latents"]]
            samples = [self.before_tanh("online", s, noise[row].numpy()) for noise in batch["noise"]]
            assert len(decoded) == len(samples) == self.config.matched_samples
            distances.append(slow_mmd(decoded, samples, self.config.sigma))
        sums["mmd"], sums["alpha"] = sum(distances) / B, math.exp(self.variable("log_alpha"))
        sums["policy_loss"] += sums["alpha"] * (sums["mmd"] - 0.05)
        return sums


@pytest.mark.parametrize("priced", [True, False])
@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_bears(seeds, priced):
    """With different numbers of actions for the targets and for the discrepancy, and a narrow kernel."""
    assert_losses_are(Slow, make_agent(BEARLag, seeds, matched_samples=4, sigma=1.5), priced)


# --- The discrepancy ---


@pytest.mark.parametrize("sigma", [0.3, 50.0])
def test_the_discrepancy_is_that_of_every_pair(sigma):
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(3, 5, ACT)), rng.normal(0.4, 1, size=(4, 5, ACT))
    found = mmd(torch.tensor(x).float(), torch.tensor(y).float(), sigma)
    expected = [slow_mmd(x[:, b], y[:, b], sigma) for b in range(5)]
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_the_discrepancy_of_two_points_and_of_equal_samples_is_known():
    """In float32 too, where the kernel of near actions is one but for its last digits."""
    for distance in (0.01, 0.3, 4.0):
        x, y = torch.zeros(1, 1, ACT), torch.zeros(1, 1, ACT)
        y[..., 0] = distance
        expected = math.sqrt(2 - 2 * math.exp(-(distance**2) / 100) + 1e-6)
        assert mmd(x, y, 50.0).item() == pytest.approx(expected, rel=1e-4)
    same = torch.randn(10, 6, ACT, generator=torch.Generator().manual_seed(0))
    np.testing.assert_allclose(mmd(same, same, 50.0), 1e-3, rtol=1e-2)


def test_alpha_takes_a_plain_step_where_the_policys_loss_rises_and_stays_within_its_bounds():
    cases = ((0.3, 0.05, None), (0.3, 3.0, None), (5.0, 0.0, 5.0), (-5.0, 9e5, -5.0))
    for start, largest, expected in cases:
        agent = make_agent(BEARLag, seeds=(0, 1), largest_mmd=largest)
        randomise(agent, 2)
        batch, log, losses = random_batch(agent), agent.variables["log_alpha"], []
        for at in (start + 0.01, start):
            log.fill_(at)
            losses.append(Plain(agent, 1).losses(of_run(batch, 1))[0]["policy"].item())
        scalars = agent.update(batch)
        for run in (0, 1):
            excess = scalars["mmd"][run].item() - largest
            step = start + 1e-3 * math.exp(start) * excess if expected is None else expected
            assert log[run].item() == pytest.approx(step, abs=1e-6)
        if expected is None:
            assert (losses[0] - losses[1]) * (log[1].item() - start) > 0  # it rises with alpha


def test_the_latents_are_clamped_and_the_noise_is_not():
    agent = make_agent(BEARLag, batch_size=500, matched_samples=4)
    shapes = {"latent_noise": (500, 4), "next_noise": (10, 500, 2), "noise": (4, 500, 2)}
    assert_noise(agent, ("latents",), shapes | {"latents": (4, 500, 4)})


def test_the_action_that_runs_is_the_squashed_mean():
    agent = make_agent(BEARLag)
    randomise(agent, 3)
    observations = np.random.default_rng(1).normal(size=(5, OBS))
    slow = Slow(agent, 0)
    expected = [np.tanh(slow.before_tanh("online", slow.inputs(s), 0.0)) for s in observations]
    player = agent.player(np.full(5, LIMIT), range(5))
    np.testing.assert_allclose(player.act(observations), expected, atol=1e-5)


# --- What it learns ---

FEW = TOY | {"matched_samples": 4}


def test_it_earns_what_the_limit_allows_where_the_discrepancy_may_be_large():
    assert_earns_what_the_limit_allows(BEARLag, 500, **FEW, largest_mmd=9.0)


def test_alpha_holds_the_policy_where_the_discrepancy_is_the_one_that_it_aims_at(largest=0.08):
    """With a wide kernel, the square of the MMD is that of the distance of the means, over sigma. Recorded is
    x within +-0.3, more is earned beyond, and nothing costs: so the distance is largest sqrt(50) along x."""
    agent = make_agent(BEARLag, limits=3.0, **FEW | {"alpha_lr": 0.1, "largest_mmd": largest})
    data = toy_data(lambda x: 0 * x, low=-0.3, high=0.3)
    training.train(agent, data, updates=400, progress=False)
    net, generator = agent.networks(0), torch.Generator().manual_seed(0)
    s = agent.network_input(net, torch.tensor(data.observations), torch.tensor(3.0))
    latents = torch.randn(len(s), 2 * ACT, generator=generator).clamp(-0.5, 0.5)
    with torch.no_grad():
        decoded = np.arctanh(net.decoder(s, latents).numpy()).mean(0)
    mean = np.arctanh(agent.act(data.observations, np.full(len(s), 3.0))).mean(0)
    assert mean - decoded == pytest.approx([largest * math.sqrt(50), 0], abs=0.1)
