"""WSAC-style against its formulas as loops in plain numbers, and what it learns where the answer is known."""

import math

import numpy as np
import pytest
import torch
from plain import Plain
from randoms import of_run, random_batch, random_data, randomise
from test_bcq import make_agent, threshold, toy_data
from test_cpq import ACT, LIMIT, OBS, B, T
from test_cpq import Slow as SlowNetworks

from tutorial_lib import training
from tutorial_lib.agents.wsac import WSAC

BETA, PENALTY = 2.5, 1.5
OPTIONS = {"beta": BETA, "penalty": PENALTY, "cloning_share": 0.2}  # of 100 updates


class Slow(SlowNetworks):
    """One run, one transition at a time; the networks too are written out."""

    unit = 0.5 * 40 / T  # of the reward: half of the best mean reward of a step

    def q(self, kind, *inputs):
        return self.critic(kind, "critics", threshold(T), *inputs)

    def q_cost(self, kind, *inputs):
        return self.critic(kind, "cost_critics", threshold(3), *inputs)

    def gaussian(self, network, s):
        log_std, w1, b1, w2, b2 = self.weights(f"online.{network}.")
        return np.tanh(w2 @ np.maximum(w1 @ s + b1, 0) + b2), np.exp(np.clip(log_std, -5, 2))

    def sample(self, s, noise):
        mean, std = self.gaussian("policy", s)
        return np.clip(mean + std * noise, -1, 1)

    def log_prob(self, network, s, a):
        mean, std = self.gaussian(network, s)
        return math.log(np.prod(np.exp(-(((a - mean) / std) ** 2) / 2) / std / math.sqrt(2 * math.pi)))

    def judged(self, q, x, s, s_next, a, a_next, reward, follows):
        """Of one transition and each critic: the gap, and the Bellman error with both kinds of targets."""
        own_next, gaps, errors = q("online", s_next, a_next), [], []
        for k, value in enumerate(q("online", s, x.actions)):
            gaps.append(q("online", s, a)[k] - value)
            both = (reward + follows - value) ** 2, (reward + self.decay * own_next[k] - value) ** 2
            errors.append(sum(both) / 2)
        return gaps, errors

    def losses(self, batch):
        keys = "critic cost_critic reference policy".split()
        sums = dict.fromkeys([f"{key}_loss" for key in keys] + ["reward_gap", "cost_gap", "excess"], 0.0)
        cloned = improved = 0.0
        for row, x, s, s_next in self.rows(batch):
            a, a_next = (
                self.sample(state, batch[key][row].numpy())
                for state, key in ((s, "noise"), (s_next, "next_noise"))
            )
            self.decay = 0.0 if x.terminals or x.timeouts else 0.8
            follows = self.decay * min(self.q("target", s_next, a_next))
            gaps, errors = self.judged(self.q, x, s, s_next, a, a_next, x.rewards / self.unit, follows)
            sums["critic_loss"] += (sum(gaps) + BETA * sum(errors)) / B
            sums["reward_gap"] += sum(gaps) / 2 / B

            self.decay = 0.0 if x.terminals else 0.8
            both = self.q_cost("target", s_next, a_next)
            follows = self.decay * min(max(sum(both) / 2, 0.0), 1 / (1 - 0.8))
            gaps, errors = self.judged(self.q_cost, x, s, s_next, a, a_next, x.costs, follows)
            sums["cost_critic_loss"] += (-PENALTY * sum(gaps) + BETA * sum(errors)) / B
            sums["cost_gap"] += sum(gaps) / 2 / B

            sums["reference_loss"] -= self.log_prob("reference", s, x.actions) / B
            cloned -= self.log_prob("policy", s, x.actions) / B
            of_reference = self.q_cost("online", s, self.gaussian("reference", s)[0])[0]
            excess = max(self.q_cost("online", s, a)[0] - min(of_reference, threshold(LIMIT)), 0.0)
            sums["excess"] += excess / B
            improved += (PENALTY * excess - self.q("online", s, a)[0]) / B
        made = self.state["variable.updates_made"][self.run]
        sums["policy_loss"] = cloned if made < 20 else improved
        return sums


@pytest.mark.parametrize("made", [19, 20])
@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_those_of_the_loops(seeds, made):
    agent = make_agent(WSAC, seeds, **OPTIONS)
    for seed in range(2):
        randomise(agent, seed)
        agent.variables["updates_made"].fill_(made)
        batch = random_batch(agent, seed)
        slow = [Slow(agent, run).losses(of_run(batch, run)) for run in range(len(seeds))]
        scalars = agent.update(batch)
        for run, expected in enumerate(slow):
            found = {key: value[run].item() for key, value in scalars.items()}
            assert found == pytest.approx(expected, rel=1e-4, abs=1e-4)
        assert agent.variables["updates_made"].tolist() == [made + 1] * len(seeds)


@pytest.mark.parametrize(
    ("loss", "network"), [("critic", "critics"), ("cost_critic", "cost_critics"), ("policy", "policy")]
)
def test_the_gradients_are_the_slopes_of_the_loops(loss, network):
    """In the output biases. So each critic's own next value has a gradient, and the target has none."""
    agent = make_agent(WSAC, **OPTIONS)
    randomise(agent, 3)
    agent.variables["updates_made"].fill_(50)  # the policy improves
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
    assert np.abs(expected).min() > 1e-3
    np.testing.assert_allclose(found.flatten(), expected, rtol=1e-2, atol=1e-3)


# --- What it draws, and how it plays ---


def test_the_noise_of_the_actions_at_both_states_is_normal_and_its_own():
    many = make_agent(WSAC, batch_size=2_000).draw(random_data(0), torch.Generator().manual_seed(4), LIMIT)
    noise = torch.cat([many["noise"], many["next_noise"]])
    assert noise.shape == (4_000, ACT) and len(noise.unique()) > 0.99 * noise.numel()
    assert noise.mean().item() == pytest.approx(0, abs=0.05)
    assert noise.std().item() == pytest.approx(1, abs=0.05)


def test_the_action_that_runs_is_the_mean():
    agent = make_agent(WSAC)
    randomise(agent, 3)
    observations = np.random.default_rng(1).normal(size=(5, OBS))
    slow = Slow(agent, 0)
    expected = [slow.gaussian("policy", slow.inputs(s))[0] for s in observations]
    player = agent.player(np.full(5, LIMIT), range(5))
    np.testing.assert_allclose(player.act(observations), expected, atol=1e-5)


@pytest.mark.parametrize("limits", [math.inf, (3.0, math.inf)])
def test_an_infinite_limit_is_refused(limits):
    with pytest.raises(ValueError, match="WSAC-style needs a finite limit"):
        make_agent(WSAC, (0, 1), limits)


# --- What it learns ---

TOY = {
    "batch_size": 32, "hidden_width": 16, "critic_lr": 1e-2, "policy_lr": 1e-2, "updates": 300,
}  # fmt: skip


def learned(limits, data, **changes):
    """The mean of the first number x of the action, for each limit."""
    agent = make_agent(WSAC, (0,) * len(limits), limits, **TOY | changes)
    training.train(agent, data, progress=False)
    return [agent.act(data.observations, data.rewards, run)[:, 0].mean() for run in range(len(limits))]


def test_it_costs_what_the_reference_costs_or_what_the_limit_allows():
    """A step earns x and costs (1 + x) / 2. The reference plays x = 0, the mean of the recorded actions.

    In the critic's unit a step earns x / 2. So with lambda = 2, the gradient vanishes where half of the
    policy's actions cost too much, and the spread of its actions does not move the mean.
    """
    limits = (0.7, 3.0)
    assert 2 * threshold(limits[0]) - 1 == pytest.approx(-0.375, abs=1e-3)
    assert threshold(limits[1]) > 0.5  # where the reference costs less
    found = learned(limits, toy_data(lambda x: (1 + x) / 2), penalty=2.0)
    assert found == pytest.approx([-0.375, 0.0], abs=0.12)


def test_a_low_penalty_buys_all_that_is_earned():
    """Half a reward is more than a cost of a half at the price of 0.5."""
    assert learned((0.7,), toy_data(lambda x: (1 + x) / 2), penalty=0.5, updates=150)[0] > 0.8
