"""Behaviour cloning: its losses by loops, what it clones, which episodes it sees, and what it is told."""

import dataclasses

import numpy as np
import pytest
import torch
from torch.func import functional_call

from tutorial_lib.agents import get_algorithm
from tutorial_lib.checkpoints import load_agent, save_agent
from tutorial_lib.data.dataset import Dataset, DatasetError
from tutorial_lib.playing import evaluate
from tutorial_lib.tasks import get_task
from tutorial_lib.training import train

TASK = get_task("BallRun")
OPTIONS = {"hidden_width": 16, "hidden_layers": 1, "batch_size": 64, "updates": 400}
CHEAP, DEAR = np.array([0.6, -0.2]), np.array([-0.4, 0.7])


def make_agent(name, limits=None, seeds=(0,), **changes):
    kind = get_algorithm(name)
    return kind(TASK, kind.configure("small", **OPTIONS | changes), seeds, limits)


def make_dataset(costs=(10, 30, 31, 80), length=100):
    """One episode for each of `costs`; those of at most 30 always take CHEAP, the others always DEAR."""
    rng = np.random.default_rng(0)
    rows = length * len(costs)
    step_costs = np.concatenate([np.arange(length) < cost for cost in costs]).astype(np.float32)
    actions = np.repeat([CHEAP if cost <= 30 else DEAR for cost in costs], length, axis=0)
    return Dataset(
        observations=rng.normal(size=(rows, TASK.obs_dim)).astype(np.float32),
        next_observations=rng.normal(size=(rows, TASK.obs_dim)).astype(np.float32),
        actions=actions.astype(np.float32),
        rewards=np.zeros(rows, np.float32),
        costs=step_costs,
        terminals=np.zeros(rows, bool),
        timeouts=np.arange(1, rows + 1) % length == 0,
    )


def taken(agent, run=0):
    observations = np.random.default_rng(1).normal(size=(200, TASK.obs_dim))
    return agent.act(observations, np.full(200, 30.0), run)


def test_the_loss_is_the_mean_squared_error():
    agent = make_agent("BC-All")
    rng = np.random.default_rng(2)
    s, a = rng.normal(size=(12, TASK.obs_dim)), rng.uniform(-1, 1, size=(12, TASK.act_dim))
    weights = {k: v[0].detach() for k, v in agent.parameters["policy"].items()}
    total = 0.0
    for state, action in zip(s, a, strict=True):
        x = torch.tensor(np.array([state]), dtype=torch.float32)
        out = functional_call(agent.modules["policy"], weights, x)[0][0]
        total += sum((o - w) ** 2 for o, w in zip(out.tolist(), action, strict=True))
    batch = {"observations": torch.tensor(s[None]).float(), "actions": torch.tensor(a[None]).float()}
    scalars = agent.update(batch | {"limit": torch.zeros(1, 12)})
    assert scalars["policy_loss"].item() == pytest.approx(total / 24, rel=1e-4)


def test_all_clones_the_mean_of_what_was_done_and_safe_what_the_safe_did():
    data = make_dataset()
    everyone, safe = make_agent("BC-All"), make_agent("BC-Safe", 30.0)
    train(everyone, data, progress=False)
    train(safe, data, progress=False)
    assert np.abs(taken(safe) - CHEAP).mean() < 0.15
    assert np.abs(taken(everyone).mean(0) - (CHEAP + DEAR) / 2).max() < 0.1  # states tell nothing here


@pytest.mark.parametrize(("limit", "kept"), [(9, 0), (10, 1), (30, 2), (31, 3), (79.5, 3), (80, 4)])
def test_the_limit_itself_is_safe_and_no_safe_episode_is_an_error_that_says_so(limit, kept):
    agent, data = make_agent("BC-Safe", limit), make_dataset()
    if kept:
        assert agent.select(data, limit).episode_costs.tolist() == [10, 30, 31, 80][:kept]
    else:
        with pytest.raises(DatasetError, match="BC-Safe: no episode costs at most 9: the cheapest of 4"):
            train(agent, data, progress=False)
    everything = make_agent("BC-All").select(data, limit)
    np.testing.assert_array_equal(everything.observations, data.observations)
    np.testing.assert_array_equal(everything.episode_costs, data.episode_costs)


def test_every_run_learns_from_the_safe_episodes_of_its_own_limit():
    """Runs under a limit of 30 and of 80, side by side: their actions, and what normalises observations."""
    data, agent = make_dataset(), make_agent("BC-Safe", (30.0, 80.0), seeds=(0, 0))
    train(agent, data, progress=False)
    assert np.abs(taken(agent, 0) - CHEAP).mean() < 0.15
    assert np.abs(taken(agent, 1).mean(0) - (CHEAP + DEAR) / 2).max() < 0.1
    for run, rows in enumerate((200, 400)):
        seen, variables = data.observations[:rows], agent.networks(run)
        np.testing.assert_allclose(variables.observation_mean, seen.mean(0), atol=1e-5)
        np.testing.assert_allclose(variables.observation_std, seen.std(0) + 1e-3, rtol=1e-5)


def test_killed_and_resumed_it_still_sees_safe_episodes_alone(tmp_path):
    data, changes = make_dataset(), {"updates": 30}
    train(make_agent("BC-Safe", 30.0, **changes), data, updates=10, run_dir=tmp_path, progress=False)
    resumed, whole = (make_agent("BC-Safe", 30.0, **changes) for _ in range(2))
    train(resumed, data, run_dir=tmp_path, progress=False)
    train(whole, data, progress=False)
    np.testing.assert_array_equal(taken(resumed), taken(whole))


def test_saved_loaded_and_evaluated_like_any_agent(tmp_path):
    for name, own, limits in (("BC-All", None, [30, 50, 70]), ("BC-Safe", (30.0, 50.0), [30, 50])):
        agent = make_agent(name, own, seeds=(0, 4))
        train(agent, make_dataset(), updates=3, progress=False)
        save_agent(agent, tmp_path / "agent.safetensors")
        results = evaluate(load_agent(tmp_path / "agent.safetensors"), episodes=1)
        assert sorted(set(results["threshold"])) == limits and set(results["seed"]) == {0, 4}
        assert set(results["algorithm"]) == {name} and results["predicted_cost"].isna().all()


# --- BC-Frontier ---


def earning(returns, costs, length=100):
    """The dataset with these costs whose episodes earn `returns`, each in its last step."""
    rewards = np.zeros((len(costs), length), np.float32)
    rewards[:, -1] = returns
    return dataclasses.replace(make_dataset(costs, length), rewards=rewards.ravel())


@pytest.mark.parametrize("frontier_range", [0.0, 0.1, 0.3])
def test_frontier_keeps_what_earns_nearly_the_best_at_its_cost(frontier_range):
    rng = np.random.default_rng(3)
    costs, returns = rng.integers(0, 100, 60), rng.normal(50, 30, 60)
    returns = (returns + costs).astype(np.float32)
    kept = []
    for cost, total in zip(costs, returns, strict=True):
        best = max(r for c, r in zip(costs, returns, strict=True) if c <= cost)
        if total >= best - frontier_range * (max(returns) - min(returns)):
            kept.append((cost, total))
    agent = make_agent("BC-Frontier", frontier_range=frontier_range)
    found = agent.select(earning(returns, costs), np.inf)
    assert 0 < len(kept) < 60
    assert list(zip(found.episode_costs, found.episode_returns, strict=True)) == kept


def test_frontier_clones_those_episodes_alone():
    agent = make_agent("BC-Frontier")
    train(agent, earning([1, 2, 0, 1], (10, 30, 60, 80)), progress=False)  # the dear ones earn less
    assert np.abs(taken(agent) - CHEAP).mean() < 0.15


# --- BC (budget rule) ---

BUDGET = "BC (budget rule)"


def by_hand(agent, observations, budgets, times):
    """The policy's actions at normalised observations with two more numbers, one at a time."""
    weights = {key: value[0].detach() for key, value in agent.parameters["policy"].items()}
    mean, std = (agent.variables[f"observation_{key}"][0].numpy() for key in ("mean", "std"))
    actions = []
    for observation, budget, time in zip(observations, budgets, times, strict=True):
        numbers = [*(observation - mean) / std, min(budget, 80) / 80, time / 100]  # BallRun's range and T
        x = torch.tensor(np.array([numbers]), dtype=torch.float32)
        actions.append(functional_call(agent.modules["policy"], weights, x)[0][0].numpy(force=True))
    return np.array(actions)


def test_the_budget_rule_learns_from_the_cost_that_is_still_to_come():
    agent, data = make_agent(BUDGET), make_dataset()
    agent.prepare([data], progress=False)
    batch = agent.draw(data.tensors(), torch.Generator().manual_seed(0), np.inf)
    total = 0.0
    for b in range(64):
        (row,) = np.flatnonzero((data.observations == batch["observations"][b].numpy()).all(1))
        still = data.costs[row : (row // 100 + 1) * 100].sum()
        action = by_hand(agent, data.observations[row : row + 1], [still], [row % 100])[0]
        total += ((action - data.actions[row]) ** 2).sum()
    scalars = agent.update({name: value[None] for name, value in batch.items()})
    assert scalars["policy_loss"].item() == pytest.approx(total / 128, rel=1e-4)


def test_the_budget_rule_is_told_what_is_left_and_the_time():
    agent = make_agent(BUDGET)
    agent.prepare([make_dataset()], progress=False)
    limits = np.array([1.0, 5.0, np.inf])
    player, rng = agent.player(limits, [0, 1, 2]), np.random.default_rng(0)
    left = limits.copy()
    for t in range(8):
        observations = rng.normal(size=(3, TASK.obs_dim))
        np.testing.assert_array_equal(player.told, np.maximum(left, 0))
        expected = by_hand(agent, observations, np.maximum(left, 0), [t] * 3)
        np.testing.assert_allclose(player.act(observations), expected, atol=1e-5)
        costs = np.array([1.0, t % 2, 1.0])
        player.see(np.zeros(3), costs)
        left = left - costs
    assert left[0] < 0 < left[1]


def test_told_little_it_clones_the_cheap_and_told_much_the_dear():
    agent = make_agent(BUDGET, policy_lr=1e-2, updates=600)
    train(agent, make_dataset(costs=(0, 100, 0, 100)), progress=False)
    player, rng, missed = agent.player([0.0, 100.0], [0, 1]), np.random.default_rng(0), []
    for _ in range(80):  # after that both have little left
        actions = player.act(rng.normal(size=(2, TASK.obs_dim)))
        missed.append(np.abs(actions - [CHEAP, DEAR]))
        player.see(np.zeros(2), np.array([0.0, 1.0]))
    assert np.mean(missed, 0).max() < 0.2
