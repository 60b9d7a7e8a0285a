"""The capstone: scores a student's agent on frozen starts, beside agents that were measured before.

It is a thin layer over `playing.evaluate`: the episodes begin as those of `c2iql certify`, in states that
nothing was chosen on. The bar to beat is never typed in. It is read from the results of study `table1`, at
the cost that the student's agent pays.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tutorial_lib import playing, scores
from tutorial_lib.agents import Agent
from tutorial_lib.checkpoints import load_agent
from tutorial_lib.data import load_dataset, shipped_tasks
from tutorial_lib.files import written_whole
from tutorial_lib.studies.results import load_results

REFERENCES = ("C2IQL", "BC-Frontier", "BC (budget rule)")
"""The algorithms whose results are the bar: the course's own, and two that clone and have no critic."""
EPISODES = 20
"""The number of episodes for each run and limit. It is fixed, so that nobody can choose it by its result."""
PAYS_MORE = ", which pays more"
"""What stands behind the name of a reference that was measured at a higher cost only."""
NAME = "agent.safetensors"
"""The name of an agent's file in a folder."""


def load(path: Path) -> list[Agent]:
    """Returns the agent in a file, or those in the files `agent.safetensors` of a folder and its folders.

    Several files are one submission: one algorithm on one task, with different seeds or limits. Together they
    must have every limit of the task. Raises ValueError in one line where they do not.
    """
    files = sorted(path.rglob(NAME)) if path.is_dir() else [path]
    if not files:
        raise ValueError(f"{path}: holds no {NAME}: train an agent with `c2iql train`")
    agents = [load_agent(file) for file in files]
    kinds = sorted({f"{agent.name} on {agent.task.name}" for agent in agents})
    if len(kinds) > 1:
        raise ValueError(f"{path}: holds agents of several kinds ({', '.join(kinds)}): name one of them")
    runs = [run for agent in agents for run in zip(agent.seeds, agent.limits or agent.seeds, strict=True)]
    if len(set(runs)) < len(runs):
        raise ValueError(f"{path}: two files have the same seed{' and limit' if agents[0].limits else ''}")
    own = {limit for agent in agents for limit in agent.limits or agent.task.thresholds}
    if own != set(agents[0].task.thresholds):
        wanted, found = (", ".join(f"{x:g}" for x in sorted(y)) for y in (agents[0].task.thresholds, own))
        raise ValueError(
            f"{path}: the limits of {agents[0].task.name} are {wanted}, and these agents were trained for "
            f"{found}: train one for each limit, and name their folder"
        )
    return agents


def play(agents: Sequence[Agent], workers: int = 1) -> pd.DataFrame:
    """Returns the raw results of the capstone: `EPISODES` for each run and limit, from held-out starts."""
    parts = [playing.evaluate(agent, None, EPISODES, workers, held_out=True) for agent in agents]
    return pd.concat(parts, ignore_index=True)


def references(task: str, results: pd.DataFrame | None = None) -> pd.DataFrame:
    """Returns what the reference algorithms reach on a task: one row for each algorithm and limit.

    The columns are algorithm, threshold, cost (unsafe steps per episode) and reward_score, all means over
    seeds and episodes. `results` are raw results, by default those of study `table1`. An algorithm that was
    not run has no row.
    """
    raw = load_results("table1") if results is None else results
    raw = scores.with_scores(raw[(raw["task"] == task) & raw["algorithm"].isin(REFERENCES)])
    by = ["algorithm", "threshold"]
    return raw.groupby(by, sort=False)[["cost", "reward_score"]].mean().reset_index()


def bar_at(reference: pd.DataFrame, cost: float, limit: float) -> tuple[float, str]:
    """Returns the highest normalised reward of the references at a paid cost, and whose it is.

    The reward of an algorithm at a cost between two of its points is interpolated. Above its largest cost it
    is that of its last point. Below its least cost nothing was measured. Where this is so for all of them,
    the bar is the reward of the cheapest point, if this one keeps the limit. Otherwise there is no bar:
    (NaN, "").
    """
    best, name = math.nan, ""
    for algorithm, part in reference.groupby("algorithm", sort=False):
        part = part.groupby("cost")["reward_score"].max()  # costs rise, and each is there once
        if cost >= part.index[0]:
            value = float(np.interp(cost, part.index, part))
            if not value <= best:
                best, name = value, str(algorithm)
    if not name and len(reference):
        cheapest = reference.loc[reference["cost"].idxmin()]
        if cheapest["cost"] <= limit:
            best, name = float(cheapest["reward_score"]), f"{cheapest['algorithm']}{PAYS_MORE}"
    return best, name


def score(results: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """Returns one row for each limit: scores with 95% intervals, the share of episodes kept, and the bar.

    `reward` and `cost` are normalised, `paid` and `predicted` are in unsafe steps per episode. `reached` is
    true where the mean cost keeps the limit and the mean reward is at least the bar at this cost. Where no
    reference keeps the limit, to keep it is enough.
    """
    rows = []
    for row in scores.summarise(results).sort_values("threshold").to_dict("records"):
        part = results[results["threshold"] == row["threshold"]]
        bar, name = bar_at(reference, part["cost"].mean(), row["threshold"])
        earns = row["reward_score"] >= bar or (len(reference) > 0 and math.isnan(bar))
        rows.append(
            {"limit": row["threshold"], "seeds": row["seeds"], "episodes": row["episodes"]}
            | {f"reward{end}": row[f"reward_score{end}"] for end in ("", "_low", "_high")}
            | {f"cost{end}": row[f"cost_score{end}"] for end in ("", "_low", "_high")}
            | {"paid": part["cost"].mean(), "predicted": part["predicted_cost"].mean()}
            | {"share_kept": (part["cost"] <= row["threshold"]).mean(), "bar": bar, "bar_of": name}
            | {"reached": bool(row["cost_score"] <= 1 and earns)}
        )
    return pd.DataFrame(rows)


def verdict(table: pd.DataFrame) -> list[str]:
    """Returns the verdict in plain sentences: what was reached at each limit, and what to look at."""
    lines = [f"Reached at {table['reached'].sum()} of {len(table)} limits."]
    for row in table.to_dict("records"):
        lines.append(f"Limit {row['limit']:g}: {_on_cost(row)} {_on_reward(row)}{_advice(row)}")
    if table["seeds"].max() == 1:
        lines.append(
            "There is one seed. This says how this agent plays, and not how your method does: train more."
        )
    return lines


def _on_cost(row: dict[str, Any]) -> str:
    """Returns one sentence on what a row of the table pays."""
    sure = row["cost_high"] <= 1 or row["cost_low"] > 1
    verb = "keeps" if row["cost"] <= 1 else "breaks"
    return (
        f"It {verb} the limit: it pays {row['paid']:.1f} on average, and "
        f"{row['share_kept']:.0%} of its episodes keep the limit"
        f"{'.' if sure else ', but the interval of its mean cost contains the limit.'}"
    )


def _on_reward(row: dict[str, Any]) -> str:
    """Returns one sentence that compares the reward of a row of the table with the bar."""
    if math.isnan(row["bar"]):
        return "No reference agent was measured that pays so little and keeps this limit: there is no bar."
    side = "at or above" if row["reward"] >= row["bar"] else "below"
    sure = not row["reward_low"] <= row["bar"] <= row["reward_high"]
    return (
        f"Its reward of {row['reward']:.2f} is {side} the bar of {row['bar']:.2f} "
        f"({row['bar_of']}){'.' if sure else ', but the interval of its mean reward contains the bar.'}"
    )


def _advice(row: dict[str, Any]) -> str:
    """Returns what to look at where a row of the table falls short, or no words."""
    if row["cost"] > 1:
        if math.isnan(row["predicted"]):
            return " Look at what the policy is told, and at whether it pays more where it is told more."
        if row["predicted"] <= row["limit"]:
            return (
                f" Look at the cost critics: they predicted {row['predicted']:.1f} at the first step, "
                "and that would have kept the limit."
            )
        return (
            " Look at the penalty and the policy: the critics predicted "
            f"{row['predicted']:.1f} at the first step, so the agent did not count on keeping the limit."
        )
    if row["cost"] < 0.5 and not row["reached"]:
        return " Look at the told limit: less than half of the limit is used."
    if row["reward"] < row["bar"]:
        if row["bar_of"].endswith(PAYS_MORE):  # nothing was measured at this cost
            return " Look at the told limit: no reference was measured at so low a cost."
        return " Look at the policy extraction: at this cost more reward is possible."
    return ""


def trained_on_shipped_data(agents: Sequence[Agent]) -> bool | None:
    """Returns whether all agents learned from the shipped recordings, or None where none are shipped."""
    task = agents[0].task.name
    if task not in shipped_tasks():
        return None
    own = load_dataset(task).checksum
    return all(agent.data_checksum == own for agent in agents)


def save_report(agents: Sequence[Agent], table: pd.DataFrame, lines: Sequence[str], path: Path) -> None:
    """Writes the JSON that a teacher collects. Raises OSError if it cannot be written."""
    rows = table.astype(object).where(table.notna(), None).to_dict("records")  # JSON has no NaN
    report = {
        "task": agents[0].task.name,
        "algorithm": agents[0].name,
        "profile": agents[0].config.profile,
        "updates": [agent.updates for agent in agents],
        "seeds": sorted({seed for agent in agents for seed in agent.seeds}),
        "trained_on_shipped_data": trained_on_shipped_data(agents),
        "episodes_per_run_and_limit": EPISODES,
        "limits": rows,
        "reached": int(table["reached"].sum()),
        "verdict": list(lines),
    }
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(report, indent=1, allow_nan=False, default=_plain) + "\n")


def _plain(value: Any) -> Any:
    """Returns a number of NumPy as one of Python."""
    return value.item()
