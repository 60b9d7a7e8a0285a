"""CDT: its transformer and its loss in NumPy, what it draws and remembers by loops, and a toy it learns."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from randoms import ACT, OBS, of_run, randomise
from scipy.special import erf

from tutorial_lib.agents import get_algorithm
from tutorial_lib.agents.sequences import sequences
from tutorial_lib.checkpoints import load_agent, save_agent
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import TASKS
from tutorial_lib.training import train

T, K, WIDTH, HEADS = 8, 4, 8, 2
TASK = dataclasses.replace(
    TASKS["BallRun"], name="Toy", horizon=T, obs_dim=OBS, act_dim=ACT, thresholds=(2, 4, 6), cost_range=T
)
SMALL = {"hidden_width": WIDTH, "hidden_layers": 2, "heads": HEADS, "context": K, "batch_size": 16}
NAMES = ("observations", "actions", "costs", "returns_to_go", "costs_to_go", "timesteps")


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(TASKS, TASK.name, TASK)


def make_agent(seeds=(0,), **changes):
    kind = get_algorithm("CDT")
    return kind(TASK, kind.configure("small", **SMALL | changes), seeds)


def make_dataset(episodes=40):
    """Episodes of 3 to 8 steps. The first two numbers of an observation are its episode and its timestep."""
    rng = np.random.default_rng(0)
    lengths = rng.integers(3, T + 1, episodes)
    number, steps = np.repeat(np.arange(episodes), lengths), np.concatenate([np.arange(n) for n in lengths])
    rows, last = len(number), steps == lengths[number] - 1
    observations = np.stack([number, steps, rng.normal(size=rows)], 1).astype(np.float32)
    return Dataset(
        observations=observations,
        next_observations=observations,
        actions=rng.uniform(-1, 1, size=(rows, ACT)).astype(np.float32),
        rewards=rng.normal(2, 4, size=rows).astype(np.float32),
        costs=(rng.random(rows) < np.repeat(rng.random(episodes), lengths)).astype(np.float32),
        terminals=last & (lengths[number] < T),
        timeouts=last & (lengths[number] == T),
    )


DATA = make_dataset()


def episodes_of(dataset):
    """The rewards and costs of each episode, as lists, one transition at a time."""
    found = [([], [])]
    for reward, cost, end in zip(
        dataset.rewards.tolist(), dataset.costs.tolist(), dataset.terminals | dataset.timeouts, strict=True
    ):
        found[-1][0].append(reward)
        found[-1][1].append(cost)
        if end:
            found.append(([], []))
    return found[:-1]


EPISODES = episodes_of(DATA)
COSTS, RETURNS = np.array([sum(costs) for _, costs in EPISODES]), np.array([sum(r) for r, _ in EPISODES])
SPAN = RETURNS.max() - RETURNS.min()


def best_return(cost):
    return max(r for c, r in zip(COSTS, RETURNS, strict=True) if c <= max(cost, COSTS.min()))


def started(seed=0, **changes):
    """An agent before its first update, its data, and what one draw gives."""
    agent = make_agent(**changes)
    part = agent.select(DATA, math.inf)
    agent.prepare([part], progress=False)
    batch = agent.draw(part.tensors(), torch.Generator().manual_seed(seed), math.inf)
    return agent, part, batch


# --- The transformer, by hand ---


def norm(x, weight, bias):
    return (x - x.mean()) / math.sqrt(x.var() + 1e-5) * weight + bias


def policy_by_hand(p, returns, costs, observations, actions, timesteps):
    """The mean, log-std and cost logit of each step of one sequence, token by token and head by head."""
    tokens = []
    for parts in zip(returns, costs, observations, actions, timesteps, strict=True):
        for i, part in enumerate(parts[:4]):
            embedded = p[f"embed.{i}.weight"] @ np.atleast_1d(part) + p[f"embed.{i}.bias"]
            tokens.append(
                norm(embedded + p["time.weight"][parts[4]], p["first_norm.weight"], p["first_norm.bias"])
            )
    for layer in range(2):
        q = {key.split(".", 2)[2]: value for key, value in p.items() if key.startswith(f"layers.{layer}.")}
        inputs = [norm(x, q["attention_norm.weight"], q["attention_norm.bias"]) for x in tokens]
        queries, keys, values = zip(
            *(np.split(q["queries_keys_values.weight"] @ x, 3) for x in inputs), strict=True
        )
        after = []
        for i, x in enumerate(tokens):
            mixed = np.zeros(WIDTH)
            for head in range(HEADS):
                own = slice(head * WIDTH // HEADS, (head + 1) * WIDTH // HEADS)
                seen = range(i + 1)
                scores = [queries[i][own] @ keys[j][own] / math.sqrt(WIDTH / HEADS) for j in seen]
                for j, score in enumerate(np.exp(scores)):
                    mixed[own] += score / np.exp(scores).sum() * values[j][own]
            x = x + q["mix.weight"] @ mixed + q["mix.bias"]
            inner = q["net.0.weight"] @ norm(x, q["norm.weight"], q["norm.bias"]) + q["net.0.bias"]
            inner = 0.5 * inner * (1 + erf(inner / math.sqrt(2)))
            after.append(x + q["net.2.weight"] @ inner + q["net.2.bias"])
        tokens = after
    tokens = [norm(x, p["last_norm.weight"], p["last_norm.bias"]) for x in tokens]
    out = np.array([p["action.weight"] @ x + p["action.bias"] for x in tokens[2::4]])
    logits = np.array([p["cost.weight"] @ x + p["cost.bias"] for x in tokens[3::4]])[:, 0]
    return out[:, :ACT], np.clip(out[:, ACT:], -5, 2), logits


def test_the_transformer_and_the_loss_are_what_numpy_computes_token_by_token():
    agent, _, drawn = started(batch_size=6)
    randomise(agent, seed=3)
    agent.variables["return_scale"].fill_(7.0)
    batch = {name: value.double().numpy() for name, value in drawn.items()}
    p = {key: value[0].detach().double().numpy() for key, value in agent.parameters["policy"].items()}
    mean, std = (agent.variables[f"observation_{key}"][0].double().numpy() for key in ("mean", "std"))
    temperature = math.exp(agent.variables["log_temperature"].item())
    log_probs, entropies, crosses = [], [], []
    for b in range(6):
        length = int(batch["inside"][b].sum())  # the other steps are left out from the start
        own = {name: value[b, :length] for name, value in batch.items()}
        means, log_stds, logits = policy_by_hand(
            p,
            own["returns_to_go"] / 7,
            np.minimum(own["costs_to_go"], T) / T,
            (own["observations"] - mean) / std,
            own["actions"],
            own["timesteps"].astype(int),
        )
        for t in range(length):
            for mu, log_std, action in zip(means[t], log_stds[t], own["actions"][t], strict=True):
                density = math.exp(-0.5 * ((action - mu) / math.exp(log_std)) ** 2) / math.exp(log_std)
                log_probs.append(math.log(max(density, 1e-300) / math.sqrt(2 * math.pi)))
                entropies.append(0.5 * math.log(2 * math.pi * math.e * math.exp(2 * log_std)))
            chance = 1 / (1 + math.exp(-logits[t]))
            crosses.append(-math.log(chance if own["costs"][t] else 1 - chance))
    expected = {"log_likelihood": log_probs, "entropy": entropies, "cost_cross_entropy": crosses}
    expected = {name: np.mean(values) for name, values in expected.items()}
    scalars = agent.update({name: value[None] for name, value in drawn.items()})
    for name, value in expected.items():
        assert scalars[name].item() == pytest.approx(value, rel=1e-4), name
    loss = (
        -expected["log_likelihood"]
        - temperature * expected["entropy"]
        + 0.02 * expected["cost_cross_entropy"]
    )
    assert scalars["policy_loss"].item() == pytest.approx(loss, rel=1e-4)
    assert scalars["temperature"].item() == pytest.approx(temperature, rel=1e-5)
    step = 1e-3 * (expected["entropy"] - (-1))  # profile `small`: a hundredth of a nat for ten nats too many
    assert agent.variables["log_temperature"].item() == pytest.approx(math.log(temperature) - step, rel=1e-4)


@pytest.mark.parametrize("token", ["returns", "costs", "observations", "actions"])
def test_a_token_changes_no_prediction_that_stands_before_it(token):
    agent, generator = make_agent(), torch.Generator().manual_seed(0)
    randomise(agent)
    policy = agent.networks().policy
    shapes = {"returns": (), "costs": (), "observations": (OBS,), "actions": (ACT,)}
    inputs = {name: torch.randn(16, K, *shape, generator=generator) for name, shape in shapes.items()}
    timesteps = torch.arange(K).expand(16, K)
    with torch.no_grad():
        before = policy(**inputs, timesteps=timesteps)
        for k in range(K):
            changed = inputs[token].clone()
            changed[:, k] += 1.0
            after = policy(**inputs | {token: changed}, timesteps=timesteps)
            mean, log_std, logit = (
                (new - old).abs().flatten(2).amax(-1) if new.ndim > 2 else (new - old).abs()
                for new, old in zip(after, before, strict=True)
            )
            first = k + 1 if token == "actions" else k  # an action is predicted before it is seen
            assert not mean[:, :first].any() and not log_std[:, :first].any() and not logit[:, :k].any()
            assert (mean[:, first:] > 0).all() and (logit[:, k:] > 0).all()


def test_what_stands_after_the_end_of_an_episode_changes_nothing():
    """The loss of one short episode alone, and of the same episode before another one's steps."""
    agent, _, _ = started(context=3)
    randomise(agent)
    data = DATA.tensors()
    length = DATA.ends[0]  # the whole first episode, and then the same and 3 steps of the next one
    alone, padded = (sequences(data, torch.zeros(2, dtype=torch.long), n) for n in (length, length + 3))
    assert padded["inside"].sum(1).tolist() == [length, length] and alone["inside"].all()
    padded["actions"][:, length:] = 9.0
    results = []
    for batch in (alone, padded):
        copy = make_agent(context=3)
        copy.load_state(agent.state() | {"updates": torch.tensor(0)})
        results.append(copy.update({name: value[None] for name, value in batch.items()}))
    for name, value in results[0].items():
        assert value.item() == pytest.approx(results[1][name].item(), rel=1e-5), name


# --- What is drawn ---


def test_sequences_are_steps_of_one_episode_with_the_sums_that_are_still_to_come():
    _, _, batch = started(augmented_share=0.0, batch_size=400)
    ended = 0
    for b in range(400):
        number, start = batch["observations"][b, 0, :2].int().tolist()
        rewards, costs = EPISODES[number]
        for k in range(K):
            t = start + k
            assert batch["inside"][b, k] == (t < len(rewards))
            if t < len(rewards):
                assert batch["observations"][b, k, :2].tolist() == [number, t]
                assert batch["timesteps"][b, k] == t and batch["costs"][b, k] == costs[t]
                assert batch["returns_to_go"][b, k].item() == pytest.approx(sum(rewards[t:]), abs=1e-4)
                assert batch["costs_to_go"][b, k] == sum(costs[t:])
            ended += t >= len(rewards)
    assert 0 < ended < 400 * (K - 1)  # some sequences reach beyond the end


@pytest.mark.parametrize("reach", [0.5, 1.5])
def test_an_episode_is_drawn_with_a_weight_that_falls_with_its_cost(reach):
    _, _, batch = started(augmented_share=0.0, batch_size=20_000, cost_reach=reach)
    lengths = np.array([len(rewards) for rewards, _ in EPISODES])
    weights = lengths * np.maximum(0, reach * T - COSTS)
    found = np.bincount(batch["observations"][:, 0, 0].int().numpy(), minlength=len(weights)) / 20_000
    np.testing.assert_allclose(found, weights / weights.sum(), atol=0.006)
    if reach < 1:
        assert (weights == 0).any()


def test_augmented_sequences_ask_for_more_than_any_episode_reached():
    _, _, batch = started(augmented_share=0.5, batch_size=2_000, nearness=0.2)
    numbers, starts = batch["observations"][:, 0, :2].int().T.tolist()
    raises = []
    for b, (number, start) in enumerate(zip(numbers, starts, strict=True)):
        rewards, costs = EPISODES[number]
        more_return = batch["returns_to_go"][b, 0].item() - sum(rewards[start:])
        more_cost = batch["costs_to_go"][b, 0].item() - sum(costs[start:])
        if b >= 1_000:
            assert abs(more_return) < 1e-4 and more_cost == 0
            continue
        raises.append((more_return, more_cost))
        cost, total = COSTS[number] + more_cost, RETURNS[number] + more_return
        assert RETURNS[number] >= best_return(COSTS[number]) - 0.2 * SPAN - 1e-4  # it is near the frontier
        assert 0 <= more_cost <= 0.2 * T + 1e-5
        assert best_return(cost) - 1e-3 <= total <= RETURNS.max() + 0.2 * np.abs(RETURNS).max() + 1e-3
        for k in range(1, min(K, len(rewards) - start)):  # all steps are raised alike
            assert batch["returns_to_go"][b, k].item() == pytest.approx(
                sum(rewards[start + k :]) + more_return, abs=1e-3
            )
    assert np.std(raises, 0).min() > 0.1
    near = {i for i in range(40) if RETURNS[i] >= best_return(COSTS[i]) - 0.2 * SPAN}
    assert set(numbers[:1_000]) == near and len(near) < 40
    assert len(set(numbers[1_000:])) > len(near)


# --- Playing ---


def test_the_target_return_is_the_best_recorded_one_within_the_limit_and_is_saved(tmp_path):
    agent, _, _ = started()
    limits = np.array([0.0, 0.7, 2.0, 3.9, 7.0, 8.0, 50.0, math.inf])
    expected = [best_return(limit) for limit in limits]
    np.testing.assert_allclose(agent.target_returns(limits), expected, rtol=1e-5)
    assert len(set(expected)) == 3
    save_agent(agent, tmp_path / "agent.safetensors")
    np.testing.assert_allclose(
        load_agent(tmp_path / "agent.safetensors").target_returns(limits), expected, rtol=1e-5
    )
    dear = DATA.select(
        np.flatnonzero(COSTS >= 3)
    )  # no episode keeps a limit of 0: the cheapest are the target
    agent.prepare([agent.select(dear, math.inf)], progress=False)
    cheapest = max(RETURNS[COSTS == COSTS[COSTS >= 3].min()])
    assert agent.target_returns(np.zeros(1))[0] == pytest.approx(cheapest, rel=1e-5)


def test_a_player_remembers_the_last_steps_and_counts_down_what_it_was_told():
    agent, _, _ = started()
    randomise(agent, seed=1)
    agent.variables["frontier"].copy_(torch.arange(T + 2.0) * 3)
    limits = np.array([2.0, 5.0, math.inf])
    player, rng, steps = agent.player(limits, [0, 1, 2]), np.random.default_rng(4), []
    returns, left = np.array([6.0, 15.0, 27.0]), limits.copy()
    for t in range(T):
        observations, rewards = rng.normal(size=(3, OBS)), rng.normal(size=3)
        costs = np.array([1.0, t % 2, 1.0])
        np.testing.assert_array_equal(player.told, np.maximum(left, 0))
        actions = player.act(observations)
        steps.append([returns.copy(), np.maximum(left, 0), observations, np.zeros((3, ACT)), np.full(3, t)])
        for e in range(3):  # each episode alone, from what was noted down
            columns = [np.array([step[i][e] for step in steps[-K:]])[None] for i in range(5)]
            names = ("returns_to_go", "costs_to_go", "observations", "actions", "timesteps")
            expected = agent.act_after(dict(zip(names, columns, strict=True)))
            np.testing.assert_allclose(actions[e], expected[0], atol=1e-5)
        steps[-1][3] = actions
        player.see(rewards, costs)
        returns, left = returns - rewards, left - costs
    assert (left[0] < 0) and np.abs(actions).max() <= 1


def test_it_refuses_a_width_that_its_heads_do_not_divide():
    with pytest.raises(ValueError, match="hidden_width is 12, and must be a multiple of 8 heads"):
        get_algorithm("CDT").configure("small", hidden_width=12)


# --- Learning ---


def two_kinds(episodes=30):
    """Cheap episodes take -0.5 and earn 1 a step; costly ones take 0.5, earn 3 a step, and pay 1 a step."""
    rng = np.random.default_rng(0)
    rows = 2 * episodes * T
    costly = np.repeat(np.arange(2 * episodes) % 2, T)
    observations = rng.normal(size=(rows, OBS)).astype(np.float32)
    return Dataset(
        observations=observations,
        next_observations=observations,
        actions=np.repeat(costly[:, None] - 0.5, ACT, axis=1).astype(np.float32),
        rewards=(1.0 + 2 * costly).astype(np.float32),
        costs=costly.astype(np.float32),
        terminals=np.zeros(rows, bool),
        timeouts=np.arange(1, rows + 1) % T == 0,
    )


def test_told_a_low_limit_it_plays_the_cheap_kind_and_told_a_high_one_the_other():
    agent = make_agent(
        updates=250, policy_lr=1e-2, warm_up=20, hidden_width=16, hidden_layers=1, cost_reach=2.0
    )
    train(agent, two_kinds(), progress=False)
    limits = np.array([0.0, 1.0, float(T), math.inf])
    assert agent.target_returns(limits).tolist() == [T, T, 3 * T, 3 * T]
    player, rng = agent.player(limits, range(4)), np.random.default_rng(1)
    expected = np.repeat([[-0.5], [-0.5], [0.5], [0.5]], ACT, axis=1)
    for _ in range(T):
        actions = player.act(rng.normal(size=(4, OBS)))
        np.testing.assert_allclose(actions, expected, atol=0.2)
        costly = actions[:, 0] > 0
        player.see(1.0 + 2 * costly, costly.astype(float))


def test_runs_draw_from_their_own_seeds_and_learn_apart():
    agent = make_agent(seeds=(0, 5))
    part = agent.select(DATA, math.inf)
    agent.prepare([part, part], progress=False)
    data = [part.tensors()] * 2
    batch = agent.draw_all(data, [torch.Generator().manual_seed(seed) for seed in (0, 5)])
    alone = agent.draw(data[1], torch.Generator().manual_seed(5), math.inf)
    assert all(torch.equal(of_run(batch, 1)[name], alone[name]) for name in alone)
    assert {*NAMES, "inside"} == alone.keys() and not torch.equal(*batch["observations"])
