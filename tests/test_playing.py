"""Rollouts against loops by hand in the real simulator; scores and intervals against arithmetic."""

import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from tutorial_lib.agents import get_algorithm
from tutorial_lib.playing import EPISODES_TOGETHER, evaluate, rollout
from tutorial_lib.scores import (
    certificate,
    normalised_cost,
    normalised_return,
    save_results,
    summarise,
    with_scores,
)
from tutorial_lib.tasks import TASKS, make_env

OPTIONS = {"profile": "test", "hidden_width": 16, "hidden_layers": 1}
RECONSTRUCTION = {"crm_width": 8, "crm_layers": 1}
COLUMNS = "task algorithm profile seed threshold episode return cost length".split()


def make_agent(name="C2IQL", task="BallRun", seeds=(0,), limits=None, **changes):
    """An agent that nobody has trained, with weights so large that it moves, and heeds its limit."""
    kind = get_algorithm(name)
    options = OPTIONS | (RECONSTRUCTION if hasattr(kind.Config, "crm") else {})
    agent = kind(TASKS[task], kind.Config(**options | changes), seeds, limits)
    generator = torch.Generator().manual_seed(3)
    for value in agent.parameters["policy"].values():
        value.data = 1.5 * torch.randn(value.shape, generator=generator)
    return agent


def same(rollout, other):
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(rollout, other, strict=True))


# --- Episodes ---


def test_the_same_seeds_give_the_same_episodes_whatever_ran_before():
    agent, seeds = make_agent(), [7, 8, 9]
    first = rollout(agent, [30, 50, 70], seeds)
    rollout(agent, 10, [100, 101, 102])
    rollout(make_agent("IQL"), 10, seeds)
    assert same(rollout(agent, [30, 50, 70], seeds), first)
    assert not same(rollout(agent, [30, 50, 70], [7, 8, 10]), first)


def test_some_of_the_seeds_give_their_rows_of_all():
    agent = make_agent(seeds=(0, 4, 2))
    whole = evaluate(agent, (60.5,), episodes=2)
    some = evaluate(agent, (60.5,), episodes=2, seeds=(2, 0))
    expected = whole[whole["seed"] != 4].reset_index(drop=True)
    pd.testing.assert_frame_equal(some, expected)


def test_more_workers_give_the_same_rows():
    agent = make_agent(seeds=(0, 4))
    alone = evaluate(agent, (60.5,), episodes=EPISODES_TOGETHER + 2, workers=1)
    beside = evaluate(agent, (60.5,), episodes=EPISODES_TOGETHER + 2, workers=2)
    pd.testing.assert_frame_equal(alone, beside, check_exact=True)
    assert len(alone) == alone["return"].nunique() == 2 * 12  # no two of them are the same episode


def budget_rule(limit, spent, t, task, config):
    """Eq. 23 and the closest value, for one episode, in plain numbers."""
    left, steps_left = limit - spent, task.horizon - t
    budget = left if config.time_limits == "mask" else left * task.horizon / steps_left
    if config.infinite_at_test == "covered" and left >= steps_left:
        return math.inf
    zero = (0.0,) if config.zero_threshold else ()  # halfway between two, the smaller is told
    places = {float(threshold): threshold for threshold in (*zero, *task.thresholds)}
    if config.infinite_at_test == "nearest":
        places[math.inf] = 1.5 * task.cost_range
    if budget == math.inf:
        return max(places)
    return min(places, key=lambda threshold: abs(places[threshold] - budget))


@pytest.mark.parametrize("infinite", ["covered", "nearest", "never"])
@pytest.mark.parametrize("time_limits", ["rate", "mask"])
@pytest.mark.parametrize("zero", [False, True])
def test_every_step_is_that_of_a_loop_by_hand_under_the_budget_rule(time_limits, infinite, zero):
    options = {"time_limits": time_limits, "infinite_at_test": infinite, "zero_threshold": zero}
    agent = make_agent(seeds=(0, 1), **options)
    limits, seeds, run = [0.0, 30.0, 35.5, 50.0, 100.0, math.inf], [11, 12, 13, 14, 15, 16], 1
    played = rollout(agent, limits, seeds, run)
    envs = [make_env("BallRun") for _ in seeds]
    observations = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)]
    spent = [0.0] * 6
    for t in range(100):
        given = [budget_rule(limits[e], spent[e], t, agent.task, agent.config) for e in range(6)]
        assert played.told[t].tolist() == given
        if t == 0:
            expected = agent.predicted_cost(np.stack(observations), np.array(given), run)
            np.testing.assert_array_equal(played.predicted_costs, expected)
        actions = agent.act(np.stack(observations), np.array(given), run)
        for e, env in enumerate(envs):
            observations[e], reward, _, _, info = env.step(actions[e])
            spent[e] += info["cost"]
            assert (played.rewards[t, e], played.costs[t, e]) == (reward, info["cost"])
            assert played.positions[t, e].tolist() == list(env.position)
    assert played.lengths.tolist() == [100] * 6
    assert 20 < max(spent) and len(np.unique(played.told)) > 2  # or little was shown


def test_the_budget_player_tells_what_is_left_and_rewards_change_nothing():
    """The player of C2IQL alone, without a simulator: told, act, see, over a few steps."""
    agent, limits = make_agent(infinite_at_test="never", zero_threshold=True), [30.0, 70.0]
    player = agent.player(limits, seeds=[0, 1])
    observations = np.random.default_rng(0).normal(size=(2, 7))
    spent = np.zeros(2)
    for t, costs in enumerate(([1, 0], [29, 0], [0, 40], [5, 0])):
        expected = [budget_rule(limits[e], spent[e], t, agent.task, agent.config) for e in (0, 1)]
        assert player.told.tolist() == expected
        np.testing.assert_array_equal(player.act(observations), agent.act(observations, np.array(expected)))
        found = player.predicted_cost(observations)
        np.testing.assert_array_equal(found, agent.predicted_cost(observations, np.array(expected)))
        player.see(np.full(2, 1e6), np.array(costs, float))
        spent += costs
    assert spent.tolist() == [35, 40] and player.told.tolist() == [0, 30]


def test_an_agent_that_is_trained_for_one_limit_is_told_none():
    agent = make_agent("CIQL", limits=30.0)
    played = rollout(agent, 30, [1, 2])
    assert np.isnan(played.told).all() and np.isnan(played.predicted_costs).all()
    assert set(evaluate(agent, episodes=2)["threshold"]) == {30.0}
    with pytest.raises(ValueError, match="trained for the limit 30, and can be told no other"):
        evaluate(agent, (50, 70), episodes=2)
    assert np.isfinite(rollout(make_agent("C2IQL w/o CC", limits=30.0), 30, [1]).predicted_costs).all()


def test_every_run_plays_under_the_limit_that_it_was_trained_for():
    agent = make_agent("CIQL", seeds=(0, 4, 0), limits=(30.0, 30.0, 70.0))
    results = evaluate(agent, episodes=2)
    keys = list(results[["seed", "threshold", "episode"]].itertuples(index=False, name=None))
    assert keys == [(s, limit, e) for s, limit in ((0, 30), (4, 30), (0, 70)) for e in (0, 1)]
    for run, seed in enumerate(agent.seeds):
        played = rollout(agent, agent.limits[run], [1000 * (seed + 1), 1000 * (seed + 1) + 1], run)
        assert results["return"][2 * run : 2 * run + 2].tolist() == played.rewards.sum(0).tolist()
    pd.testing.assert_frame_equal(evaluate(agent, (70, 30), episodes=2), results)
    with pytest.raises(ValueError, match="trained for the limit 30, 70, and can be told no other"):
        evaluate(agent, (30,), episodes=2)


class Scripted:
    """Stands in for a player: it says something else at every step, and writes down what it hears."""

    def __init__(self, limits, seeds, run):
        self.made_with, self.heard, self.t = (list(limits), list(seeds), run), [], 0

    @property
    def told(self):
        return np.array([100.0 + self.t, 200.0 + self.t])

    def act(self, observations):
        self.heard.append(("act", observations.copy()))
        weights = np.random.default_rng(0).normal(size=(17, 4))
        return np.tanh(observations @ (4 * weights))  # so rough that a drone falls

    def see(self, rewards, costs):
        self.heard.append(("see", rewards.copy(), costs.copy()))
        self.t += 1

    def predicted_cost(self, observations):
        assert not self.heard  # before the first step
        return observations[:, 0] + 7.0


def test_a_rollout_knows_nothing_of_limits_but_what_the_player_says():
    """It asks the player and tells it what happened, step by step; after a fall it reports zeros."""
    made = []

    def player(limits, seeds, run):
        made.append(Scripted(limits, seeds, run))
        return made[-1]

    agent = SimpleNamespace(task=TASKS["DroneRun"], player=player)
    played = rollout(agent, [30, math.inf], [5, 6], run=3)
    (scripted,) = made
    assert scripted.made_with == ([30.0, math.inf], [5, 6], 3)
    steps = max(played.lengths)
    assert min(played.lengths) < steps < 200  # both fall, one of them first
    assert [word for word, *_ in scripted.heard] == ["act", "see"] * steps
    first = [make_env("DroneRun").reset(seed=seed)[0] for seed in (5, 6)]
    np.testing.assert_array_equal(scripted.heard[0][1], first)
    np.testing.assert_array_equal(played.predicted_costs, np.stack(first)[:, 0] + 7.0)
    for t in range(steps):
        assert played.told[t].tolist() == [100 + t, 200 + t]
        np.testing.assert_array_equal(scripted.heard[2 * t + 1][1], played.rewards[t])
        np.testing.assert_array_equal(scripted.heard[2 * t + 1][2], played.costs[t])
    assert np.isnan(played.told[steps:]).all()  # nobody plays any more
    for e, length in enumerate(played.lengths):
        assert not played.rewards[length:, e].any() and played.rewards[:length, e].all()


def test_an_episode_that_ends_early_leaves_zeros():
    agent, seeds = make_agent(task="DroneRun"), range(4)
    played = rollout(agent, 30, seeds)
    envs = [make_env("DroneRun") for _ in seeds]
    observations = np.stack([env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)])
    lengths = [None] * len(seeds)
    for t in range(200):
        chosen = agent.act(observations, played.told[t])
        for e, env in enumerate(envs):
            if lengths[e] is None:
                observations[e], reward, terminated, truncated, _ = env.step(chosen[e])
                assert played.rewards[t, e] == reward
                lengths[e] = t + 1 if terminated or truncated else None
    assert played.lengths.tolist() == lengths
    assert min(lengths) < 100 and len(set(lengths)) > 2  # some fall, at different times
    for e, length in enumerate(lengths):
        for values in (played.rewards, played.costs, played.positions):
            assert not values[length:, e].any()
        assert played.rewards[:length, e].all()


def test_results_are_the_sums_of_the_rollouts():
    agent = make_agent(seeds=(0, 2), task="BallRun")
    results = evaluate(agent, episodes=3)
    assert set(COLUMNS) <= set(results.columns)
    keys = results[["seed", "threshold", "episode"]].itertuples(index=False, name=None)
    assert list(keys) == [(s, limit, e) for s in (0, 2) for limit in (30, 50, 70) for e in range(3)]
    assert set(zip(results["task"], results["algorithm"], results["profile"], strict=True)) == {
        ("BallRun", "C2IQL", "test")
    }
    for run, seed in enumerate((0, 2)):
        for limit in (30, 50, 70):
            part = results[(results["seed"] == seed) & (results["threshold"] == limit)]
            played = rollout(agent, limit, [1000 * (seed + 1) + episode for episode in range(3)], run)
            assert part["return"].tolist() == played.rewards.sum(0).tolist()
            assert part["cost"].tolist() == played.costs.sum(0).tolist()
            assert part["length"].tolist() == played.lengths.tolist()
            assert part["predicted_cost"].tolist() == played.predicted_costs.tolist()


def test_held_out_episodes_start_elsewhere():
    agent = make_agent(seeds=(0, 2), task="BallRun")
    results = evaluate(agent, [30], episodes=2, held_out=True)
    for run, seed in enumerate((0, 2)):
        played = rollout(agent, 30, [10_000_000 + 1000 * (seed + 1) + episode for episode in range(2)], run)
        assert results[results["seed"] == seed]["return"].tolist() == played.rewards.sum(0).tolist()
    assert set(results["return"]).isdisjoint(evaluate(agent, [30], episodes=2)["return"])


@pytest.mark.parametrize("bad", [-1, -0.001, math.nan])
def test_a_limit_that_is_none_is_refused(bad):
    with pytest.raises(ValueError, match="limit on the cost must be zero or more"):
        rollout(make_agent(), [30, bad], [0, 1])
    with pytest.raises(ValueError, match="limit on the cost must be zero or more"):
        evaluate(make_agent(), (30, bad), episodes=1)


# --- Scores ---


def test_scores_by_hand():
    ball = TASKS["BallRun"]  # its returns go from 26.3398 to 1327.4456
    assert normalised_return([26.3398, 1327.4456, 676.8927], ball) == pytest.approx([0, 1, 0.5])
    assert normalised_cost([0, 15, 30, 45], 30) == pytest.approx([0, 0.5, 1, 1.5])
    assert normalised_cost([0, 3], 0) == pytest.approx([1, 4])  # (C + 1) / (0 + 1): nothing kept but zero
    assert normalised_cost([5, 5, 5], [0, 10, math.inf]) == pytest.approx([6, 0.5, 0])


def results_of(returns, costs=None, **columns):
    columns = {"task": "BallRun", "algorithm": "A", "profile": "p", "seed": 0, "threshold": 30.0} | columns
    frame = pd.DataFrame({"return": returns, "cost": 15.0 if costs is None else costs} | columns)
    return frame.assign(episode=range(len(frame)), length=100)


def test_every_task_has_its_own_scale():
    both = pd.concat([results_of([26.3398]), results_of([204.2873, 574.6533], task="CarRun", threshold=10.0)])
    scored = with_scores(both).set_index("task")
    assert scored.loc["BallRun", "reward_score"] == pytest.approx(0)
    assert scored.loc["CarRun", "reward_score"].tolist() == pytest.approx([0, 1])
    assert scored["cost_score"].tolist() == pytest.approx([0.5, 1.5, 1.5])


def test_a_summary_has_a_row_for_each_threshold_with_means_and_counts():
    span = 1327.4456 - 26.3398
    parts = [
        results_of([26.3398, 26.3398 + span], costs=[0.0, 30.0], threshold=30.0),
        results_of([26.3398 + span / 2] * 3, costs=[35.0] * 3, threshold=70.0, seed=[0, 1, 2]),
    ]
    summary = summarise(pd.concat(parts))
    assert summary["threshold"].tolist() == [30, 70]
    assert summary["seeds"].tolist() == [1, 3] and summary["episodes"].tolist() == [2, 3]
    assert summary["reward_score"].tolist() == pytest.approx([0.5, 0.5])
    assert summary["cost_score"].tolist() == pytest.approx([0.5, 0.5])
    first, second = summary.to_dict("records")
    assert (first["cost_score_low"], first["cost_score_high"]) == pytest.approx(
        (0, 1)
    )  # 0, 0.5 or 1: all likely
    assert second["cost_score_low"] == second["cost_score_high"] == pytest.approx(0.5)  # nothing varies


def interval(costs):
    row = summarise(results_of([0.0] * len(costs), costs=costs)).iloc[0]
    return 30 * row["cost_score_low"], 30 * row["cost_score_high"]


def test_the_interval_is_the_bootstraps():
    rng = np.random.default_rng(0)
    for costs in (rng.exponential(20, size=30), rng.integers(0, 50, size=9).astype(float)):
        means = sorted(costs[rng.integers(len(costs), size=len(costs))].mean() for _ in range(20_000))
        low, high = means[500], means[-501]
        assert interval(costs) == pytest.approx((low, high), abs=0.05 * (high - low))


def test_the_interval_narrows_with_more_episodes_and_widens_with_their_spread():
    costs = np.random.default_rng(1).exponential(20, size=30)
    low, high = interval(costs)
    wide = interval(costs.mean() + 2 * (costs - costs.mean()))
    narrow = interval(np.tile(costs, 4))
    assert wide[1] - wide[0] == pytest.approx(2 * (high - low), rel=0.05)
    assert narrow[1] - narrow[0] == pytest.approx((high - low) / 2, rel=0.05)
    assert interval(costs) == (low, high)  # it is the same every time


def test_the_interval_covers_the_truth_nineteen_times_in_twenty():
    rng, covered = np.random.default_rng(2), 0
    for _ in range(120):
        low, high = interval(rng.normal(20, 5, size=30))
        covered += low <= 20 <= high
    assert 0.87 < covered / 120 < 0.99


# --- Files ---


def test_saved_results_are_read_back(tmp_path):
    results = evaluate(make_agent(), episodes=2)
    path = tmp_path / "deep" / "results.csv"
    save_results(results, path)
    read = pd.read_csv(path)
    assert read.columns.tolist() == results.columns.tolist()
    pd.testing.assert_frame_equal(read, results, check_dtype=False, rtol=1e-5)
    assert [p.name for p in path.parent.iterdir()] == ["results.csv"]


def test_a_write_that_breaks_off_leaves_the_old_results(tmp_path):
    path = tmp_path / "results.csv"
    path.write_text("old")

    class Broken(pd.DataFrame):
        def to_csv(self, target, **options):
            with open(target, "w") as file:
                file.write("task,algo")
            raise OSError("No space left on device")

    with pytest.raises(OSError, match="space"):
        save_results(Broken(), path)
    assert path.read_text() == "old"


# --- Certificates ---


def test_a_certificate_by_hand():
    costs = [10.0, 20.0, 30.0, 36.0]
    parts = [
        results_of([0.0] * 4, costs=costs, predicted_cost=[1.0, 2.0, 3.0, 6.0]),
        results_of([0.0] * 3, costs=[5.0, 5.0, 5.0], predicted_cost=math.nan, seed=1, threshold=70.0),
    ]
    first, second = certificate(pd.concat(parts)).to_dict("records")
    assert (first["task"], first["algorithm"], first["seed"], first["threshold"]) == ("BallRun", "A", 0, 30)
    assert (first["episodes"], first["cost"], first["predicted"], first["exceeds"]) == (4, 24, 3, 0.25)
    half = 3.18245 * math.sqrt((14**2 + 4**2 + 6**2 + 12**2) / 3 / 4)  # Student's t with 3 degrees of freedom
    assert (first["cost_low"], first["cost_high"]) == pytest.approx((24 - half, 24 + half), rel=1e-5)
    assert (second["cost_low"], second["cost"], second["cost_high"]) == (5, 5, 5)
    assert math.isnan(second["predicted"]) and (second["exceeds"], second["exceeds_low"]) == (0, 0)
    assert second["exceeds_high"] == pytest.approx(1 - 0.025 ** (1 / 3))  # three episodes may all keep it


@pytest.mark.parametrize("over, count", [(1, 4), (7, 20), (19, 20), (20, 20)])
def test_the_chance_to_exceed_has_the_interval_of_clopper_and_pearson(over, count):
    """At its ends, what was seen or more extreme has a chance of 2.5%."""

    def at_least(k, p):
        return sum(math.comb(count, j) * p**j * (1 - p) ** (count - j) for j in range(k, count + 1))

    costs = [31.0] * over + [30.0] * (count - over)  # a cost that equals the limit keeps it
    row = certificate(results_of([0.0] * count, costs=costs, predicted_cost=0.0)).iloc[0]
    assert at_least(over, row["exceeds_low"]) == pytest.approx(0.025)
    if over < count:
        assert 1 - at_least(over + 1, row["exceeds_high"]) == pytest.approx(0.025)
    else:
        assert row["exceeds_high"] == 1


def test_one_episode_proves_no_mean():
    row = certificate(results_of([0.0], costs=[5.0], predicted_cost=0.0)).iloc[0]
    assert (row["cost_low"], row["cost"], row["cost_high"]) == (0, 5, math.inf)
