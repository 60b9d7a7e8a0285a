"""Results per seed, intervals and verdicts against loops and made-up results; the paper's tables; figures."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.course import figures
from tutorial_lib.data.sources import load_dataset
from tutorial_lib.studies.grids import STUDIES, varied_options
from tutorial_lib.studies.paper import CLAIMS, TABLE1, TABLE1_AVERAGES, TABLE1_STD, TABLE2, Claim
from tutorial_lib.studies.results import (
    OWN_COLUMNS,
    RESULTS,
    against,
    difference,
    kept,
    load_results,
    options_of,
    over_seeds,
    seed_interval,
    seed_means,
    verdicts,
)
from tutorial_lib.tasks import TASKS


def make_results(groups, seeds=(0, 1, 2), limits=(30, 50, 70), task="CarCircle", episodes=2, noise=0.0):
    """Rows of groups (columns, reward, cost in limits); seed s adds s / 100 to both; `noise` per run."""
    rng, rows = np.random.default_rng(0), []
    low, high = TASKS[task].min_return, TASKS[task].max_return
    for columns, reward, cost in groups:
        for seed in seeds:
            shift = seed / 100 + noise * rng.normal()
            for limit in limits:
                for episode in range(episodes):
                    row = {"task": task, "algorithm": "C2IQL", "profile": "small", "seed": seed}
                    row |= {"threshold": limit, "episode": episode, "length": 300, "updates": 1}
                    row |= {"return": low + (reward + shift) * (high - low), "cost": (cost + shift) * limit}
                    rows.append(row | {"predicted_cost": 0.8 * limit} | columns)
    return pd.DataFrame(rows)


# --- The paper's tables ---


def test_the_averages_of_table_1_are_those_that_it_prints():
    assert TABLE1.keys() == TABLE1_AVERAGES.keys()
    for name, rows in TABLE1.items():
        assert rows.keys() == TABLE1_STD.keys() <= TASKS.keys()
        found = np.mean(list(rows.values()), axis=0)
        assert found == pytest.approx(TABLE1_AVERAGES[name], abs=0.008), name  # some cut off, not rounded


def test_table_2_has_a_column_for_each_noise_level():
    assert {len(row) for row in TABLE2.values()} == {8}
    assert all(cost <= 50 for cost in TABLE2["cost"])


def test_every_claim_is_about_a_study_and_what_it_varies():
    for claim in CLAIMS:
        varied = {"algorithm", *varied_options(STUDIES[claim.study])}
        for side in (claim.high, claim.low):
            assert not isinstance(side, dict) or set(side) <= varied
        for side in (claim.high, claim.low):
            if isinstance(side, dict) and "algorithm" in side:
                assert side["algorithm"] in ALGORITHMS


# --- Per seed ---


def test_a_seeds_mean_is_that_of_its_limits_whatever_their_numbers_of_episodes():
    results = make_results([({}, 0.5, 0.4)])
    extra = results[(results["seed"] == 1) & (results["threshold"] == 30)].assign(cost=300.0)
    results = pd.concat([results] + [extra] * 5, ignore_index=True)
    found = seed_means(results).set_index("seed")
    for seed in (0, 1, 2):
        by_limit = []
        for limit in (30, 50, 70):
            costs = [
                row["cost"] / limit
                for _, row in results.iterrows()
                if row["seed"] == seed and row["threshold"] == limit
            ]
            by_limit.append(sum(costs) / len(costs))
        assert found.loc[seed, "cost_score"] == pytest.approx(sum(by_limit) / 3)
        assert found.loc[seed, "reward_score"] == pytest.approx(0.5 + seed / 100)


def test_over_seeds_by_hand():
    row = over_seeds(make_results([({}, 0.5, 0.4)])).iloc[0]
    assert (row["task"], row["algorithm"], row["seeds"]) == ("CarCircle", "C2IQL", 3)
    assert row["reward_score"] == pytest.approx(0.51) and row["reward_score_std"] == pytest.approx(0.01)
    half = 4.302653 * 0.01 / 3**0.5  # Student's t of two degrees of freedom, from a printed table
    assert row["cost_score_low"] == pytest.approx(0.41 - half, abs=1e-6)
    assert row["cost_score_high"] == pytest.approx(0.41 + half, abs=1e-6)
    assert np.isnan(over_seeds(make_results([({}, 0.5, 0.4)], seeds=(0,))).iloc[0]["cost_score_low"])


@pytest.mark.parametrize("seeds", [3, 5])
def test_the_interval_over_seeds_covers_the_truth_nineteen_times_in_twenty(seeds):
    rng = np.random.default_rng(0)
    hits = 0
    for values in rng.normal(2.0, 0.7, size=(4_000, seeds)):
        low, high = seed_interval(values)
        hits += low <= 2.0 <= high
    assert hits / 4_000 == pytest.approx(0.95, abs=0.012)
    assert np.isnan(seed_interval([1.0])).all()


def test_a_difference_is_paired_by_seed():
    noisy = [({"crm_noise": 0.2}, 0.7, 0.9), ({"crm_noise": 4.0}, 0.6, 0.5)]
    results = pd.concat(
        [make_results(noisy[:1], seeds=(0, 1, 2)), make_results(noisy[1:], seeds=(1, 2, 9))],
        ignore_index=True,
    )
    found = difference(results, "reward_score", {"crm_noise": 0.2}, {"crm_noise": 4.0})
    assert found == pytest.approx([0.1, 0.1])  # seeds 1 and 2, whose shifts cancel
    above = difference(results, "cost_score", {"crm_noise": 0.2}, 1.0)
    assert above == pytest.approx([-0.1, -0.09, -0.08])
    assert len(difference(results, "cost_score", {"crm_noise": 7.0}, 1.0)) == 0


# --- Verdicts ---


CLAIM = Claim("kappas", "more earns more", "Fig. 0", "reward_score", {"kappa_1": 0.9}, {"kappa_1": 0.5})


def test_without_rows_every_verdict_is_not_run():
    empty = load_results("no-such-study")
    assert (
        verdicts([CLAIM, dataclasses.replace(CLAIM, where={"kappa_2": 0.9})], empty)["ours"].tolist()
        == ["not run"] * 2
    )
    assert over_seeds(empty).empty


@pytest.mark.parametrize(
    ("high", "low", "noise", "seeds", "verdict"),
    [
        (0.8, 0.6, 0.001, (0, 1, 2), "agrees"),
        (0.6, 0.8, 0.001, (0, 1, 2), "contradicts"),
        (0.61, 0.6, 0.1, (0, 1, 2), "undecided"),
        (0.9, 0.1, 0.0, (0,), "undecided"),
    ],
)
def test_a_verdict_needs_an_interval_on_one_side_of_zero(high, low, noise, seeds, verdict):
    groups = [({"kappa_1": 0.9}, high, 0.5), ({"kappa_1": 0.5}, low, 0.5)]
    table = verdicts([CLAIM], make_results(groups, seeds, noise=noise))
    assert table["ours"].tolist() == [verdict] and table["task"].tolist() == ["CarCircle"]


def test_what_was_not_run_is_said_so():
    empty = load_results("no-such-study")
    assert verdicts([CLAIM], empty)["ours"].tolist() == ["not run"]
    half = make_results([({"kappa_1": 0.9}, 0.5, 0.5)])
    assert verdicts([CLAIM], half)["ours"].tolist() == ["not run"]


def test_where_restricts_both_sides():
    groups = [({"kappa_1": 0.9}, 0.8, 0.5), ({"kappa_1": 0.5}, 0.6, 0.5)]
    results = make_results(groups, noise=0.001)
    results.loc[(results["threshold"] != 50) & (results["kappa_1"] == 0.9), "return"] -= 500
    at = Claim("kappas", "more", "", "reward_score", {"kappa_1": 0.9}, {"kappa_1": 0.5}, {"threshold": 50})
    assert verdicts([CLAIM], results)["ours"].tolist() == ["contradicts"]
    assert verdicts([at], results)["ours"].tolist() == ["agrees"]


# --- Figures ---


def lines_of(ax):
    return {line.get_label(): line for line in ax.lines if not line.get_label().startswith("_")}


def test_variants_draws_each_limits_mean_for_each_variant():
    groups = [({"algorithm": "CIQL"}, 0.3, 0.2), ({"algorithm": "C2IQL"}, 0.7, 0.9)]
    figure = figures.variants(make_results(groups))
    left, right = figure.axes
    assert lines_of(left)["CIQL"].get_ydata() == pytest.approx([0.31] * 3)
    assert lines_of(right)["C2IQL"].get_ydata() == pytest.approx([0.91] * 3)
    assert [label.get_text() for label in right.get_xticklabels()] == ["30", "50", "70"]


def test_variants_are_named_by_what_differs():
    both = make_results(
        [({"time_limits": "rate", "kappa_1": 1}, 1, 1), ({"time_limits": "mask", "kappa_1": 1}, 1, 1)]
    )
    assert set(figures.variant_names(both)) == {"time limits: rate", "time limits: mask"}
    sizes = [("linear", 64, 2), ("mlp", 16, 1)]
    columns = [dict(zip(("crm", "crm_width", "crm_layers"), size, strict=True)) for size in sizes]
    assert set(figures.variant_names(make_results([(c, 1, 1) for c in columns]))) == {"linear", "1 x 16"}
    assert options_of(both) == ["time_limits", "kappa_1"]


def test_expectiles_has_a_line_for_each_kappa_2():
    groups = [({"kappa_1": a, "kappa_2": b}, a, b) for a in (0.5, 0.7, 0.9) for b in (0.5, 0.9)]
    left, right = figures.expectiles(make_results(groups)).axes
    assert lines_of(left)[r"$\kappa_2$ = 0.9 (policy)"].get_ydata() == pytest.approx([0.51, 0.71, 0.91])
    assert lines_of(right)[r"$\kappa_2$ = 0.5 (policy)"].get_ydata() == pytest.approx([0.51] * 3)


def test_noise_levels_shows_the_papers_beside_ours():
    groups = [({"crm_noise": level}, 0.5, 0.8) for level in (0.0, 0.5, 4.0)]
    right = figures.noise_levels(make_results(groups)).axes[1]
    assert lines_of(right)["our cost"].get_ydata() == pytest.approx([0.81 * 50] * 3)
    assert list(lines_of(right)["the paper's"].get_ydata()) == [46.60, 47.89, 36.20]


def test_per_limit_shows_the_cost_paid_under_each_tasks_own_limits():
    parts = [make_results([({}, 0.5, 0.8)], task="CarRun", limits=(10, 20, 40))]
    parts += [make_results([({}, 0.7, 0.5), ({"algorithm": "CPQ"}, 0.2, 2.0)])]
    mixed = pd.concat(parts).sample(frac=1, random_state=0)  # whatever the rows' order
    figure = figures.per_limit(mixed)
    costs = {
        ax.get_xlabel() and tuple(ax.get_xticks()): lines_of(ax) for ax in figure.axes if ax.get_xlabel()
    }
    assert costs[(10, 20, 40)]["C2IQL"].get_ydata() == pytest.approx([8.1, 16.2, 32.4])
    assert costs[(30, 50, 70)]["CPQ"].get_ydata() == pytest.approx([60.3, 100.5, 140.7])


def test_against_paper_marks_the_papers_value():
    left = figures.against_paper(make_results([({}, 0.5, 0.8)])).axes[0]
    assert lines_of(left)["the paper's, on DSRL's data"].get_ydata().tolist() == [0.74]


def test_promises_draws_every_agents_means():
    (ax,) = figures.promises(make_results([({}, 0.5, 0.8)])).axes
    line = lines_of(ax)["high limit"]
    assert line.get_xdata() == pytest.approx([56] * 3) and line.get_ydata() == pytest.approx([56, 56.7, 57.4])


def test_expected_costs_draws_each_run_beside_what_the_data_paid():
    log = pd.DataFrame({"cost_critics": [1, 2, 2], "update": [1000, 1000, 2000]})
    left, right = figures.expected_costs(
        log.assign(cost_mean=[56.0, 70.0, 90.0], safe_fraction=[0.5, 0.4, 0.3]), recorded=55.0, unlimited=0.25
    ).axes
    assert lines_of(left)["the highest of 2"].get_xydata().tolist() == [[1, 70], [2, 90]]
    assert lines_of(right)["one cost critic"].get_xydata().tolist() == [[1, 0.5]]
    assert lines_of(left)["paid by the recorded episodes"].get_ydata() == pytest.approx([55, 55])
    assert lines_of(right)["those told infinity"].get_ydata() == pytest.approx([0.25, 0.25])


def test_without_rows_every_figure_says_that_nothing_was_run():
    empty = load_results("no-such-study")
    draws = (figures.variants, figures.expectiles, figures.noise_levels, figures.per_limit)
    for draw in (*draws, figures.against_paper, figures.promises):
        (ax,) = draw(empty).axes
        assert ax.texts[0].get_text() == "not run: no results to draw"


# --- Against a base, and what was kept ---


def test_against_a_base_every_other_variant_has_a_row():
    groups = [({"crm": "mlp"}, 0.7, 0.9), ({"crm": "linear"}, 0.5, 0.95), ({"crm": "none"}, 0.7, 0.2)]
    table = against(make_results(groups, noise=0.002), {"crm": "mlp"}).set_index("crm")
    assert set(table.index) == {"linear", "none"}
    assert table.loc["linear", "reward is"] == "lower" and table.loc["linear", "cost is"] == "higher"
    assert table.loc["none", "cost is"] == "lower" and table.loc["none", "reward is"] == "undecided"
    assert float(table.loc["linear", "reward"]) == pytest.approx(-0.2, abs=0.02)


def test_kept_counts_agents_and_episodes_by_loop():
    rng = np.random.default_rng(3)
    results = make_results([({}, 0.5, 0.9), ({"algorithm": "CPQ"}, 0.5, 1.1)], episodes=4)
    results["cost"] += rng.normal(0, 12, len(results))
    table = kept(results).set_index("algorithm")
    for name in ("C2IQL", "CPQ"):
        part = results[results["algorithm"] == name]
        agents = [
            part[(part["seed"] == seed) & (part["threshold"] == limit)]["cost"].mean() <= limit
            for seed in (0, 1, 2)
            for limit in (30, 50, 70)
        ]
        episodes = [row["cost"] <= row["threshold"] for _, row in part.iterrows()]
        assert table.loc[name, "agents and limits kept"] == pytest.approx(np.mean(agents))
        assert table.loc[name, "episodes kept"] == pytest.approx(np.mean(episodes))


# --- Luck ---


def test_seeds_raise_one_false_alarm_in_twenty_and_episodes_many():
    rng = np.random.default_rng(1)
    found = figures.simulated_intervals(3, 0.05, 2_000, rng)
    by_episodes, by_seeds = (((x[:, 0] > 0) | (x[:, 1] < 0)).mean() for x in found)
    assert by_seeds == pytest.approx(0.05, abs=0.015) and by_episodes > 0.5
    same = figures.simulated_intervals(3, 0.0, 2_000, rng)[0]  # runs that differ in nothing but episodes
    assert ((same[:, 0] > 0) | (same[:, 1] < 0)).mean() == pytest.approx(0.05, abs=0.02)


def test_the_best_checkpoint_flatters_by_the_expected_maximum():
    scores = figures.picked_checkpoints(10, 9)
    assert scores[:, -1].mean() == pytest.approx(0.7, abs=0.005)
    assert scores.max(1).mean() - 0.7 == pytest.approx(1.5388 * 0.05, abs=0.003)  # of ten normals, tabulated


def test_pictures_of_luck_count_and_mark():
    figure = figures.false_alarms(3, 0.0)
    counts = [int(ax.get_title().split(". ")[1].split(" of")[0]) for ax in figure.axes]
    assert all(count <= 4 for count in counts)
    left = figures.lucky_checkpoints(30, 5).axes[0]
    lines = lines_of(left)
    assert lines["the best"].get_ydata()[0] == max(lines["evaluation"].get_ydata())
    assert lines["the last"].get_ydata()[0] == lines["evaluation"].get_ydata()[-1]


def test_room_left_shows_the_best_recorded_episode_within_each_limit():
    data = load_dataset("BallRun")
    figure = figures.room_left(make_results([({}, 0.2, 0.9)], task="BallRun"))
    best = [
        max(r for r, c in zip(data.episode_returns, data.episode_costs, strict=True) if c <= limit)
        for limit in (30, 50, 70)
    ]
    task = TASKS["BallRun"]
    expected = [(r - task.min_return) / (task.max_return - task.min_return) for r in best]
    assert lines_of(figure.axes[0])["best recorded"].get_ydata() == pytest.approx(expected)


def test_twelve_algorithms_look_different_and_none_is_left_out():
    names = [f"algorithm {i}" for i in range(12)]
    looks = figures.algorithm_looks(pd.DataFrame({"algorithm": names}))
    assert list(looks) == names and len({(look["color"], look["marker"]) for look in looks.values()}) == 12


# --- Files of results ---


@pytest.fixture
def table(tmp_path):
    """The lines of a file of two runs with two episodes each, and a function that writes and reads it."""
    make_results([({"kappa_1": 0.5}, 0.5, 0.4)], (0, 1), (30,)).to_csv(tmp_path / "whole.csv", index=False)
    lines = (tmp_path / "whole.csv").read_text().splitlines(keepends=True)

    def read(data, name="kappas"):
        path = tmp_path / f"{name}.csv"
        path.write_bytes(data if isinstance(data, bytes) else "".join(data).encode())
        return load_results(name, tmp_path)

    return lines, read


def with_value(lines, line, column, text):
    """The lines, of which one (counted from 1) has another value in a column."""
    names, values = lines[0].strip().split(","), lines[line - 1].strip().split(",")
    values[names.index(column)] = text
    return [*lines[: line - 1], ",".join(values) + "\n", *lines[line:]]


def without_column(lines, column):
    place = lines[0].strip().split(",").index(column)
    rows = [line.strip().split(",") for line in lines]
    return [",".join(row[:place] + row[place + 1 :]) + "\n" for row in rows]


VALUES = {
    "seed": ["", "low", "nan", "0.5", "-1", "1e999", "1_0", "\u0661"],
    "threshold": ["low", "nan", "-1", "-inf", ""],
    "return": ["inf", "-inf", "NaN", "", "None", "0x10", "1,5"],
    "cost": ["-1", "inf", "nan", "", "low"],
    "length": ["9.5", "-1"],
    "predicted_cost": ["nan", "inf", "low"],
    "task": ["", "CarSquare", "0"],
    "algorithm": [""],
    "kappa_1": ["high"],
}
FILES = {  # what is wrong: (the file's lines, the line that is named, words of the error)
    "empty": (lambda x: [], 1, "no end"),
    "nothing but a line end": (lambda x: ["\n"], 1, "no column task"),
    "cut off in a line": (lambda x: [*x[:-1], x[-1][:-9]], 5, "cut off"),
    "cut off between lines": (lambda x: x[:-1], 4, "has 1 episodes, and other runs have 2"),
    "a line is missing": (lambda x: [*x[:3], *x[4:]], 4, "lines are missing"),
    "semicolons": (lambda x: [line.replace(",", ";") for line in x], 1, "commas separate columns"),
    "a line twice": (lambda x: [*x, x[2]], 6, "same episode as line 3"),
    "all lines twice": (lambda x: [*x, *x[1:]], 6, "same episode as line 2"),
    "no header": (lambda x: x[1:], 1, "no column"),
    "a conflict": (
        lambda x: [*x[:2], "<<<<<<< HEAD\n", x[2], "=======\n", x[2], ">>>>>>> b\n"],
        3,
        "conflict",
    ),
    "NUL bytes": (lambda x: [*x[:3], "\0" * 50 + "\n"], 4, "NUL"),
    "nothing but NUL bytes": (lambda x: ["\0" * 500], 1, "NUL"),
    "other text": (lambda x: "".join(x).replace("C2IQL", "\u00c92IQL").encode("latin-1"), 2, "UTF-8"),
    "another format": (lambda x: b"\x89PNG\r\n\x1a\n", 1, "UTF-8"),
    "a value too many": (lambda x: [*x[:3], x[3].strip() + ",7\n", *x[4:]], 4, "values for"),
    "an empty line": (lambda x: [*x[:3], "\n", *x[3:]], 4, "0 values"),
    "an open quote": (lambda x: [*x[:2], '"' + x[2], *x[3:]], None, "delimiter|quote|end of data|values"),
    "a column twice": (lambda x: [x[0].replace("profile", "task"), *x[1:]], 1, "profile"),
    "an option twice": (
        lambda x: [x[0].strip() + ",kappa_1\n", *(y.strip() + ",1\n" for y in x[1:])],
        1,
        "two",
    ),
}


def test_a_whole_file_of_results_is_read_as_it_was_written(table):
    lines, read = table
    results = make_results([({"kappa_1": 0.5}, 0.5, 0.4)], (0, 1), (30,))
    pd.testing.assert_frame_equal(read(lines), results)
    pd.testing.assert_frame_equal(read([line.replace("\n", "\r\n") for line in lines]), results)
    pd.testing.assert_frame_equal(read("".join(lines).encode("utf-8-sig")), results)
    assert len(read(lines[:1])) == 0
    for column, text in (
        ("predicted_cost", ""),
        ("threshold", "inf"),
        ("return", "-1.5e+03"),
        ("kappa_1", ""),
    ):
        changed = lines
        for line in range(2, 6):
            changed = with_value(changed, line, column, text)
        assert read(changed)[column].nunique(dropna=False) == 1


@pytest.mark.parametrize(("column", "text"), [(name, x) for name in VALUES for x in VALUES[name]])
def test_a_value_that_results_cannot_have_is_named_with_its_file_and_line(column, text, table):
    lines, read = table
    with pytest.raises(ValueError) as error:
        read(with_value(lines, 4, column, text))
    assert "kappas.csv: line 4: " in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("column", OWN_COLUMNS)
def test_a_missing_column_is_named(column, table):
    lines, read = table
    with pytest.raises(ValueError, match=f"kappas.csv: line 1: has no column {column} "):
        read(without_column(lines, column))


@pytest.mark.parametrize("wrong", FILES)
def test_a_file_that_is_no_whole_table_is_named_with_its_line(wrong, table):
    lines, read = table
    change, line, words = FILES[wrong]
    with pytest.raises(ValueError, match=words) as error:
        read(change(lines))
    assert f"kappas.csv: {'' if line is None else f'line {line}: '}" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_log_of_a_training_has_numbers_in_every_column(table):
    _, read = table
    log = "seed,update,policy_loss\n0,250,1.5\n0,500,{}\n"
    assert read(log.format("-2e-05").encode(), "x-training")["policy_loss"].tolist() == [1.5, -2e-05]
    for text in ("", "nan", "low"):
        with pytest.raises(ValueError, match="x-training.csv: line 3: policy_loss is"):
            read(log.format(text).encode(), "x-training")


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.csv")), ids=lambda path: path.stem)
def test_the_shipped_results_are_read(path):
    if path.stem != "reconstruction":  # of another kind
        pd.testing.assert_frame_equal(load_results(path.stem), pd.read_csv(path))
