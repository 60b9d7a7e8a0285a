"""CAPS against its formulas as loops, its rule by brute force, and a toy whose values have a closed form."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from randoms import of_run, random_batch, randomise

from tutorial_lib.agents.caps import CAPS, choose_heads, head_weights
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import TASKS
from tutorial_lib.training import train

T, B, OBS, ACT, HEADS = 10, 8, 3, 2, 3
TASK = dataclasses.replace(
    TASKS["BallRun"], horizon=T, obs_dim=OBS, act_dim=ACT, thresholds=(1, 3, 6), cost_range=8,
    min_return=-5.0, max_return=40.0,
)  # fmt: skip
OPTIONS = {
    "gamma": 0.8, "batch_size": B, "updates": 100, "hidden_width": 8, "hidden_layers": 1, "heads": HEADS,
    "kappa_1": 0.7, "awr_alpha": 3.0, "reward_factor": 0.1,
}  # fmt: skip


def make_agent(seeds=(0,), **changes):
    return CAPS(TASK, CAPS.configure("paper", **OPTIONS | changes), seeds)


# --- The formulas as loops ---


class Slow:
    """One run, one transition at a time; the networks too are written out."""

    def __init__(self, agent, run=0):
        self.run, self.state = run, {key: value.numpy().copy() for key, value in agent.state().items()}

    def weights(self, prefix):
        return [v[self.run].astype(float) for k, v in self.state.items() if k.startswith(prefix)]

    def inputs(self, observation):
        mean, std = (self.state[f"variable.observation_{name}"][self.run] for name in ("mean", "std"))
        return (np.asarray(observation, float) - mean) / std

    def value(self, name, scale, s):
        w1, b1, w2, b2 = self.weights(f"online.{name}.")
        return scale * (1 + (w2 @ np.maximum(w1 @ s + b1, 0) + b2)[0])

    def critics(self, name, scale, s, action):
        """The values of both critics."""
        x, (w1, b1, w2, b2) = np.concatenate([s, action]), self.weights(f"{name}.layers.")
        hidden = [np.maximum(x @ w1[k] + b1[k, 0], 0) for k in range(2)]
        return [scale * (1 + (hidden[k] @ w2[k] + b2[k, 0])[0]) for k in range(2)]

    def policies(self, s):
        """The mean action and the standard deviations of each head."""
        log_std, w1, b1, w2, b2 = self.weights("online.policy.")
        output = w2 @ np.maximum(w1 @ s + b1, 0) + b2
        means = [np.tanh(output[ACT * head : ACT * (head + 1)]) for head in range(HEADS)]
        return means, np.exp(np.clip(log_std, -5, 2))

    def losses(self, batch):
        """IQL on the rewards, IQL on minus the costs, and the likelihoods with the weights of both."""
        total = dict.fromkeys(CAPS.scalars, 0.0)
        for row in range(B):
            s, s_next = (self.inputs(batch[f"{kind}observations"][row]) for kind in ("", "next_"))
            a = batch["actions"][row].numpy().astype(float)
            over = bool(batch["terminals"][row] or batch["timeouts"][row])
            weights = []
            for of, payment, scale, factor in (
                ("", batch["rewards"][row].item(), 0.5 * 40 / T / 0.2, 0.1),
                ("cost_", -batch["costs"][row].item(), -3 / T / 0.2, 1.0),
            ):
                v = self.value(f"{of}value", scale, s)
                q = min(self.critics(f"target.{of}critics", scale, s, a))
                target = payment + (0 if over else 0.8 * self.value(f"{of}value", scale, s_next))
                total[f"{of}value_loss"] += (0.7 if q > v else 0.3) * (q - v) ** 2
                errors = [target - x for x in self.critics(f"online.{of}critics", scale, s, a)]
                total[f"{of}critic_loss"] += errors[0] ** 2 + errors[1] ** 2
                total[f"{of}value_mean"] += v if of == "" else -v
                weights.append(min(math.exp(3 * factor * (q - v)), 100))
            means, stds = self.policies(s)
            for head, share in enumerate((0, 0.5, 1)):
                z = (a - means[head]) / stds[head]
                density = (np.exp(-(z**2) / 2) / stds[head] / math.sqrt(2 * math.pi)).prod()
                weight = (1 - share) * weights[0] + share * weights[1]
                total["policy_loss"] -= weight * math.log(density) / HEADS
        return {key: value / B for key, value in total.items()}


@pytest.mark.parametrize("seeds", [(4,), (4, 9)])
def test_an_updates_losses_are_those_of_two_iqls_and_their_heads(seeds):
    agent = make_agent(seeds)
    for seed in range(3):
        randomise(agent, seed)
        batch = random_batch(agent, seed)
        slow = [Slow(agent, run).losses(of_run(batch, run)) for run in range(len(seeds))]
        scalars = agent.update(batch)
        for run, expected in enumerate(slow):
            found = {key: value[run].item() for key, value in scalars.items()}
            assert found == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_the_first_head_follows_the_reward_and_the_last_the_cost():
    reward, cost = torch.tensor([1.0, 8.0]), torch.tensor([4.0, 0.0])
    expected = [[1, 2, 3, 4], [8, 16 / 3, 8 / 3, 0]]
    torch.testing.assert_close(head_weights(reward, cost, 4), torch.tensor(expected))


# --- Switching ---


def chosen_by_loop(q_reward, q_cost, threshold):
    """The number of the head, for lists of the heads' values, and whether any head fits."""
    fitting = [head for head, cost in enumerate(q_cost) if cost <= threshold]
    if fitting:
        return max(fitting, key=lambda head: q_reward[head]), True
    return min(range(len(q_cost)), key=lambda head: q_cost[head]), False


def test_the_rule_is_the_loops():
    rng = np.random.default_rng(0)
    q_reward, q_cost = rng.normal(size=(2, 500, 4))
    threshold = rng.choice([-1.5, -0.5, 0.0, 0.5, np.inf], 500)
    threshold[:50] = q_cost[:50, 2]  # a cost that is just the budget fits
    expected = [chosen_by_loop(*row) for row in zip(q_reward, q_cost, threshold, strict=True)]
    assert {fits for _, fits in expected} == {True, False}
    found = choose_heads(*map(torch.tensor, (q_reward, q_cost, threshold)))
    assert found.tolist() == [head for head, _ in expected]


def test_a_player_switches_by_what_is_left_and_the_time():
    agent, limits = make_agent(), np.array([0.0, 1.0, 2.5, 5.0, 8.0, np.inf])
    randomise(agent, 3)
    slow, player, rng = Slow(agent), agent.player(limits, range(6)), np.random.default_rng(0)
    spent, seen = np.zeros(6), []
    for t in range(T):
        observations = rng.normal(size=(6, OBS))
        actions, predicted = player.act(observations), player.predicted_cost(observations)
        np.testing.assert_array_equal(player.told, [max(x, 0) for x in limits - spent])
        for e, observation in enumerate(observations):
            s = slow.inputs(observation)
            means, _ = slow.policies(s)
            q_reward = [min(slow.critics("online.critics", 0.5 * 40 / T / 0.2, s, a)) for a in means]
            q_cost = [max(slow.critics("online.cost_critics", 3 / T / 0.2, s, a)) for a in means]
            left = max(limits[e] - spent[e], 0)
            evenly = sum(0.8**k for k in range(T - t)) / (T - t)  # one unit, spent evenly and discounted
            head, fits = chosen_by_loop(q_reward, q_cost, left * evenly)
            np.testing.assert_allclose(actions[e], means[head], atol=1e-5)
            assert predicted[e] == pytest.approx(spent[e] + q_cost[head] / evenly, rel=1e-4, abs=1e-4)
            seen.append((head, fits))
        costs = (rng.random(6) < 0.6).astype(float)
        player.see(np.ones(6), costs)
        spent = spent + costs
    assert {head for head, _ in seen} == {0, 1, 2} and {fits for _, fits in seen} == {True, False}


# --- A toy: a cheap way to earn, and a dear one that earns more ---

STEPS, GAMMA = 20, 0.9
TOY = dataclasses.replace(TASK, horizon=STEPS, act_dim=1, max_return=800.0)


def toy_data(rows=4000):
    """Action -0.5 earns 10, and action 0.5, half of all, earns 30 and costs 1. Nothing is observed."""
    dear = np.random.default_rng(0).permutation(np.arange(rows) % 2 == 0)
    return Dataset(
        observations=np.ones((rows, OBS), np.float32),
        next_observations=np.ones((rows, OBS), np.float32),
        actions=(dear[:, None] - 0.5).astype(np.float32),
        rewards=np.where(dear, 30, 10).astype(np.float32),
        costs=dear.astype(np.float32),
        terminals=np.zeros(rows, bool),
        timeouts=np.arange(1, rows + 1) % STEPS == 0,
    )


NEXT = GAMMA * (1 - 1 / STEPS)  # what a critic that cannot see the time makes of the next value
# The expectile 0.7 of two equally frequent numbers is 0.7 of the way from the lower to the higher.
V_REWARD, V_COST = (10 + 0.7 * 20) / (1 - NEXT), 0.3 / (1 - NEXT)
Q_REWARD, Q_COST = np.array([10, 30]) + NEXT * V_REWARD, np.array([0, 1]) + NEXT * V_COST


def cost_by_hand(limit):
    """What an episode costs when the rule switches between the two exact actions and values."""
    spent = 0
    for t in range(STEPS):
        n = STEPS - t
        threshold = max(limit - spent, 0) * sum(GAMMA**k for k in range(n)) / n
        spent += chosen_by_loop(Q_REWARD, Q_COST, threshold)[0]
    return spent


@pytest.fixture(scope="module")
def learned():
    config = CAPS.configure(
        gamma=GAMMA, heads=2, hidden_width=16, hidden_layers=1, batch_size=128, updates=400, critic_lr=5e-3,
        value_lr=5e-3, policy_lr=2e-2, normalise_observations=False,
    )  # fmt: skip
    agent = CAPS(TOY, config)
    train(agent, toy_data(), progress=False)
    return agent


def test_the_critics_of_the_toy_are_those_of_the_closed_form(learned):
    net, s, a = learned.networks(), torch.ones(2, OBS), torch.tensor([[-0.5], [0.5]])
    np.testing.assert_allclose(net.critics(s, a), [Q_REWARD, Q_REWARD], rtol=0.03)
    np.testing.assert_allclose(net.cost_critics(s, a), [Q_COST, Q_COST], atol=0.25)
    means = net.policy(s)[0][0, :, 0].tolist()
    assert means == pytest.approx([0.5, -0.45], abs=0.1)  # weights of e^1.8 : e^-4.2, and of e^0.9 : e^-2.1


def test_told_a_low_limit_it_takes_the_cheap_way_and_told_a_high_one_the_dear(learned):
    limits = np.array([0.0, 5.0, 10.0, 15.0, 60.0, np.inf])
    player, cost = learned.player(limits, range(6)), np.zeros(6)
    for _ in range(STEPS):
        dear = player.act(np.ones((6, OBS)))[:, 0] > 0
        player.see(np.where(dear, 30.0, 10.0), dear.astype(float))
        cost += dear
    assert cost[0] == 0 and cost[4] == cost[5] == STEPS
    expected = np.array([cost_by_hand(limit) for limit in limits])
    assert np.abs(cost - expected).max() <= 1 and (cost <= limits).all()
    assert 0 < expected[1] < expected[2] < expected[3] < STEPS
