"""The capstone: its bar against interpolation by hand, its verdict on made-up results, and the command."""

import json

import numpy as np
import pandas as pd
import pytest
from tiny import make_agent

from tutorial_lib import playing
from tutorial_lib.checkpoints import save_agent
from tutorial_lib.data import load_dataset
from tutorial_lib.scores import normalised_return
from tutorial_lib.studies import capstone
from tutorial_lib.tasks import TASKS

BALL = TASKS["BallRun"]


def episodes(cost, score, limit=30, algorithm="C2IQL", seed=0, predicted=20.0, count=4):
    """Raw results of episodes that all cost and earn the same. `score` is a normalised return."""
    reward = BALL.min_return + score * (BALL.max_return - BALL.min_return)
    one = {
        "task": "BallRun", "algorithm": algorithm, "profile": "small", "seed": seed, "threshold": limit,
        "return": reward, "cost": cost, "length": 100, "predicted_cost": predicted, "updates": 1,
    }  # fmt: skip
    return pd.DataFrame([one | {"episode": number} for number in range(count)])


def raw(*points, **options):
    """Raw results with one limit for each pair (cost, score)."""
    return pd.concat([episodes(*pair, limit=30 + 20 * n, **options) for n, pair in enumerate(points)])


# --- The bar ---


def test_the_bar_is_read_from_the_results_and_interpolated_at_the_paid_cost():
    mine = raw((10, 0.2), (20, 0.6), (40, 0.7))
    table = capstone.references("BallRun", pd.concat([mine, raw((12, 0.3), algorithm="BC-Frontier")]))
    assert capstone.bar_at(table, 10, 30) == (pytest.approx(0.2), "C2IQL")
    assert capstone.bar_at(table, 15, 30) == (pytest.approx(0.4), "C2IQL")  # halfway from 0.2 to 0.6
    assert capstone.bar_at(table, 12, 30) == (pytest.approx(0.3), "BC-Frontier")  # C2IQL has 0.28 there
    assert capstone.bar_at(table, 30, 30) == (pytest.approx(0.65), "C2IQL")
    assert capstone.bar_at(table, 99, 30) == (pytest.approx(0.7), "C2IQL")
    assert capstone.bar_at(table, 9.9, 30) == (pytest.approx(0.2), "C2IQL, which pays more")
    bar, name = capstone.bar_at(table, 8, 9)  # the cheapest pays 10, and breaks the limit 9
    assert np.isnan(bar) and name == ""


def test_points_that_cost_less_under_a_higher_limit_are_sorted():
    table = capstone.references("BallRun", raw((30, 0.5), (10, 0.1)))
    assert capstone.bar_at(table, 20, 30) == (pytest.approx(0.3), "C2IQL")


def test_other_algorithms_and_tasks_are_no_bar():
    other = episodes(5, 0.9, algorithm="CPQ")
    foreign = episodes(5, 0.9).assign(task="CarRun")
    assert capstone.references("BallRun", pd.concat([other, foreign])).empty
    assert np.isnan(capstone.bar_at(capstone.references("BallRun", other), 50, 60)[0])


def test_the_shipped_results_give_every_shipped_task_a_bar():
    """Whatever the results are: the bar at the cost of a row is at least the reward of this row."""
    for task in TASKS:
        table = capstone.references(task)
        assert set(table["algorithm"]) & set(capstone.REFERENCES), task
        for row in table.itertuples():
            bar, name = capstone.bar_at(table, row.cost, row.threshold)
            assert bar >= row.reward_score - 1e-9 and name


# --- The scores and the verdict ---

REFERENCE = capstone.references("BallRun", raw((10, 0.2), (20, 0.6), (40, 0.7)))


def judged(*points, **options):
    table = capstone.score(raw(*points, **options), REFERENCE)
    return table, "\n".join(capstone.verdict(table))


def test_scores_are_means_and_shares():
    results = pd.concat([episodes(20, 0.5), episodes(40, 0.9, seed=1)])
    (row,) = capstone.score(results, REFERENCE).to_dict("records")
    assert (row["limit"], row["seeds"], row["episodes"], row["share_kept"]) == (30, 2, 8, 0.5)
    assert row["paid"] == 30 and row["cost"] == pytest.approx(1.0) and row["reward"] == pytest.approx(0.7)
    assert row["bar"] == pytest.approx(0.65) and row["reached"]
    assert row["cost_low"] < 1 < row["cost_high"]
    assert normalised_return(results["return"], BALL).mean() == pytest.approx(row["reward"])


@pytest.mark.parametrize(
    ("point", "predicted", "reached", "phrases"),
    [
        ((20, 0.7), 20.0, True, ["Reached at 1 of 1", "keeps the limit", "at or above the bar of 0.60"]),
        ((20, 0.6), 20.0, True, ["at or above", "contains the bar"]),
        ((20, 0.5), 20.0, False, ["Reached at 0 of 1", "below the bar of 0.60", "policy extraction"]),
        ((31, 0.9), 22.0, False, ["breaks the limit", "0% of its episodes", "cost critics", "22.0"]),
        ((31, 0.9), 35.0, False, ["breaks the limit", "penalty", "did not count on keeping"]),
        ((31, 0.9), np.nan, False, ["breaks the limit", "what the policy is told"]),
        ((5, 0.1), 20.0, False, ["below the bar of 0.20 (C2IQL, which", "half of the limit is used"]),
        ((30, 0.65), 20.0, True, ["keeps the limit", "pays 30.0"]),
    ],
)
def test_the_verdict_says_what_was_reached_and_what_to_look_at(point, predicted, reached, phrases):
    table, text = judged(point, predicted=predicted)
    assert table["reached"].tolist() == [reached]
    for phrase in phrases:
        assert phrase in text
    assert "There is one seed" in text


def test_to_keep_a_limit_that_no_reference_keeps_is_enough():
    table = capstone.score(episodes(4, 0.01, limit=5), REFERENCE)
    assert table["reached"].tolist() == [True] and "there is no bar" in capstone.verdict(table)[1]
    table = capstone.score(episodes(6, 0.01, limit=5), REFERENCE)
    assert table["reached"].tolist() == [False]
    table = capstone.score(episodes(4, 0.9, limit=5), REFERENCE[:0])  # nothing was measured at all
    assert table["reached"].tolist() == [False]


def test_a_draw_of_intervals_is_said():
    mixed = pd.concat([episodes(20, 0.5), episodes(38, 0.8, seed=1)])
    text = "\n".join(capstone.verdict(capstone.score(mixed, REFERENCE)))
    assert "the interval of its mean cost contains the limit" in text
    assert "the interval of its mean reward contains the bar" in text and "There is one seed" not in text


# --- The command ---


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(capstone, "EPISODES", 2)


def test_the_command_plays_held_out_starts_and_writes_what_it_prints(tmp_path, c2iql, short):
    agent = make_agent("C2IQL", limits=None)
    save_agent(agent, tmp_path / "agent.safetensors")
    status, out, err = c2iql("capstone", tmp_path / "agent.safetensors", "--workers", 1)
    assert (status, err) == (0, "")
    assert "of 3 limits." in out and "reward_low" in out and "by the rules it does not count" in out
    report = json.loads((tmp_path / "agent-capstone.json").read_text())
    assert [row["limit"] for row in report["limits"]] == list(BALL.thresholds)
    assert report["trained_on_shipped_data"] is False and report["seeds"] == [0]
    assert all(line in out for line in report["verdict"])
    played = playing.evaluate(agent, None, 2, held_out=True)
    assert [row["paid"] for row in report["limits"]] == pytest.approx(
        played.groupby("threshold")["cost"].mean().tolist()
    )
    again = c2iql("capstone", tmp_path / "agent.safetensors", "--workers", 1)
    assert again[1] == out


def test_a_folder_with_one_agent_for_each_limit_is_one_submission(tmp_path, c2iql, short):
    for limit in BALL.thresholds:
        save_agent(make_agent("BC-Safe", limits=limit), tmp_path / f"{limit:g}" / capstone.NAME)
    status, out, err = c2iql("capstone", tmp_path, "--workers", 1)
    assert (status, err) == (0, "") and "of 3 limits." in out
    report = json.loads((tmp_path / "capstone.json").read_text())
    assert [row["predicted"] for row in report["limits"]] == [None] * 3  # NaN is no JSON


def test_data_of_the_task_count(tmp_path):
    agent = make_agent("C2IQL", limits=None)
    agent.data_checksum = load_dataset("BallRun").checksum
    assert capstone.trained_on_shipped_data([agent]) is True
    assert capstone.trained_on_shipped_data([make_agent("C2IQL", limits=None), agent]) is False


def test_errors_are_one_line_and_exit_status_2(tmp_path, c2iql):
    (tmp_path / "none").mkdir()
    for name, agents in {
        "kinds": [make_agent("C2IQL", limits=None), make_agent("IQL")],
        "twice": [make_agent("C2IQL", limits=None), make_agent("C2IQL", limits=None)],
        "limits": [make_agent("BC-Safe", limits=25.0)],
    }.items():
        for number, agent in enumerate(agents):
            save_agent(agent, tmp_path / name / str(number) / capstone.NAME)
    (tmp_path / "damaged.safetensors").write_text("no agent")
    for words, phrase in (
        (["none"], "holds no agent.safetensors"),
        (["missing.safetensors"], "no such file"),
        (["damaged.safetensors"], "not an agent of this version"),
        (["kinds"], "agents of several kinds (C2IQL on BallRun, IQL on BallRun)"),
        (["twice"], "two files have the same seed"),
        (["limits"], "were trained for 25: train one for each limit"),
        (["kinds", "--workers", "0"], "must be 1 or more"),
        (["kinds", "--out", tmp_path / "none"], "is a folder"),
    ):
        status, out, err = c2iql("capstone", tmp_path / words[0], *words[1:])
        assert status == 2 and out == "", words
        assert err.count("\n") == 1 and phrase in err, words
