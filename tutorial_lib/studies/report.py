"""This module writes the datasheet of the shipped data and the tables of results into the Markdown pages.

All tables are computed from files. A page has a pair of comments for each table, `<!-- NAME:begin -->` and
`<!-- NAME:end -->`. Only this module writes the text between them. A test fails where this text is out of
date.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.agents.c2iql import C2IQLConfig
from tutorial_lib.costs.conditioning import threshold_set
from tutorial_lib.data.places import ROOT
from tutorial_lib.data.recordings import best_left, near_best
from tutorial_lib.data.sources import SHIPPED_DATA, load_dataset, shipped_tasks
from tutorial_lib.data.summary import sources_of
from tutorial_lib.files import check_output, sha256_of, written_whole
from tutorial_lib.scores import with_scores
from tutorial_lib.studies.figures import cost_return_plane, expected_costs, study_figure
from tutorial_lib.studies.grids import STUDIES, get_study, varied_options
from tutorial_lib.studies.paper import CLAIMS, OUR_NAMES, TABLE1
from tutorial_lib.studies.results import (
    RESULTS,
    SCORES,
    load_results,
    not_run,
    options_of,
    over_seeds,
    verdicts,
)
from tutorial_lib.style import Picture
from tutorial_lib.tasks import DSRL_FRONTIER, TASKS, get_task


def datasheet() -> str:
    """Returns one row for each shipped dataset: its size, episodes, ranges, origin and checksum.

    `near the best` counts, for each limit, the episodes that keep it and earn 90% of the best that does.
    """
    rows = []
    for name in shipped_tasks():
        path, data = SHIPPED_DATA / f"{name}.hdf5", load_dataset(name)
        costs, returns = data.episode_costs, data.episode_returns
        near = [str(near_best(data, limit)) for limit in get_task(name).thresholds]
        rows.append(
            {
                "file": f"`{path.name}`",
                "MB": f"{path.stat().st_size / 1e6:.1f}",
                "episodes": f"{data.num_episodes} of {data.attributes['collected_episodes']}",
                "transitions": f"{len(data):,}",
                "cost": f"{costs.min():.0f} to {costs.max():.0f}, mean {costs.mean():.0f}",
                "return": f"{returns.min().round() + 0:.0f} to {returns.max():.0f}",
                "sources": sources_of(data),
                "near the best": ", ".join(near),
                "made with": f"`{data.attributes['made_by']}`",
                "SHA-256": f"`{sha256_of(path)}`",
            }
        )
    return markdown(pd.DataFrame(rows))


def frontier() -> str:
    """Returns the best return of our datasets and of DSRL's at several upper limits of the episode cost."""
    rows = []
    for name in shipped_tasks():
        data, points = load_dataset(name), DSRL_FRONTIER.get(name, {})
        for (cost, dsrl), ours in zip(points.items(), best_left(data, list(points))[1], strict=True):
            row = {"task": name, "cost at most": cost, "DSRL": dsrl, "ours": f"{ours:.0f}"}
            rows.append(row | {"ours / DSRL": f"{ours / dsrl:.2f}"})
    return markdown(pd.DataFrame(rows))


def results_table(results: pd.DataFrame | None = None) -> str:
    """Returns C2IQL's scores of each task at each threshold, and the means of our runs and of the paper.

    The scores have 95% intervals over seeds.
    """
    results = load_results("table1") if results is None else results
    rows = []
    for task, part in results[results["algorithm"] == "C2IQL"].groupby("task", sort=False):
        row = {"task": task, "seeds": part["seed"].nunique()}
        for _, line in over_seeds(part, ("threshold",)).iterrows():
            limit = get_task(task).cost_limit_names[line["threshold"]]
            row[f"{limit} limit: reward / cost"] = " / ".join(
                f"{line[name]:.2f} [{line[f'{name}_low']:.2f}, {line[f'{name}_high']:.2f}]" for name in SCORES
            )
        row["mean: reward / cost"] = pair(*over_seeds(part).loc[0, list(SCORES)])
        row["the paper's, on DSRL's data"] = pair(*TABLE1["C2IQL"][task])
        rows.append(row)
    return markdown(pd.DataFrame(rows))


def baselines_table() -> str:
    """Returns mean reward / mean cost of our algorithms and of the paper's, on the paper's tasks.

    The table also names the algorithms that were not run.
    """
    results = load_results("table1")
    if not len(results):
        return f"*{not_run('table1')}.*"
    found = over_seeds(results).set_index(["algorithm", "task"])
    run = found.index.get_level_values(0).unique()
    ours = [name for name, kind in ALGORITHMS.items() if kind.in_table1]
    missing = [
        name
        for name in dict.fromkeys((*ours, *(OUR_NAMES.get(name, name) for name in TABLE1)))
        if name not in run
    ]
    rows, tasks = [], [task for task in TASKS if task in TABLE1["C2IQL"]]
    for name in run:
        row = {"": name, "seeds": found.loc[name, "seeds"].min()}
        for task in tasks:
            key = (name, task)
            row[task] = pair(*found.loc[key, list(SCORES)]) if key in found.index else "not run"
        rows.append(row)
    if missing:
        rows.append({"": ", ".join(missing), "seeds": "-"} | dict.fromkeys(tasks, "not run"))
    for name in ("C2IQL", *(name for name in run if name in TABLE1 and name != "C2IQL")):
        row = {"": f"the paper's {name}, on DSRL's data", "seeds": 5}
        rows.append(row | {task: pair(*TABLE1[name][task]) for task in tasks})
    return markdown(pd.DataFrame(rows))


def pair(reward: float, cost: float) -> str:
    """Returns `reward / cost` with two decimals, in italics where the rounded cost exceeds 1."""
    text = f"{round(reward, 2) + 0:.2f} / {cost:.2f}"  # + 0 turns -0.0 into 0.0
    return f"*{text}*" if round(cost, 2) > 1 else text


# --- Studies ---


def study_table(results: pd.DataFrame) -> pd.DataFrame:
    """Returns one row for each task and variant, with reward / cost at each limit.

    The last columns are the means and standard deviations over seeds.
    """
    by = ["task", "algorithm", *options_of(results)]
    rows = []
    for key, part in results.groupby(by, sort=False, dropna=False):
        row = dict(zip(by, key, strict=True)) | {"seeds": part["seed"].nunique()}
        if len(by) > 2 and results["algorithm"].nunique() == 1:
            del row["algorithm"]
        if "reconstruction_error" in part:
            row["error of the model"] = f"{part['reconstruction_error'].mean():.1f}"
        limits = with_scores(part).groupby("threshold")[list(SCORES)].mean()
        for limit, scores in limits.iterrows():
            word = get_task(row["task"]).cost_limit_names.get(limit)
            row[f"{word} limit" if word else f"limit {limit:g}"] = pair(*scores)
        mean = over_seeds(part, ("task",)).iloc[0]
        for score, word in zip(SCORES, ("reward", "cost"), strict=True):
            spread = "" if row["seeds"] == 1 else f" ± {mean[f'{score}_std']:.2f}"
            row[word] = f"{mean[score]:.2f}{spread}"
        rows.append(row)
    return pd.DataFrame(rows)


def paper_profile_table() -> str:
    """Returns the table and the figure of the runs of profile `paper`.

    The table has one row for each variant and number of updates. It also has the runs of profile `small` on
    the same data.
    """
    paper, small = load_results("paper-profile"), load_results("table1")
    if not len(paper):
        return "*Not run.*"
    same = small["task"].isin(paper["task"]) & (small["algorithm"] == "C2IQL")
    paper = paper.sort_values(["cost_critics", "updates"], kind="stable")
    both = pd.concat([paper, small[same].assign(cost_critics=C2IQLConfig.make("small").cost_critics)])
    words = both["profile"] + ", " + both["updates"].map("{:,} updates".format)
    table = markdown(study_table(both.assign(run=words)))
    return f"{table}\n\n![what the critics expect](results/paper-profile.png)"


def paper_profile_figure() -> Picture | None:
    """Returns the figure of the costs that the critics of profile `paper` predict during training.

    Returns None where the profile was not run.
    """
    log = load_results("paper-profile-training")
    if not len(log):
        return None
    task = get_task(load_results("paper-profile")["task"].iloc[0])
    told = threshold_set(task, with_zero=C2IQLConfig.make("paper").zero_threshold)
    return expected_costs(log, load_dataset(task.name).episode_costs.mean(), np.isinf(told).mean())


def _results_of(name: str) -> pd.DataFrame:
    """Returns the results of a study.

    Raises ValueError for an unknown study, and where a column of an option is missing that the study varies.
    """
    study, results = get_study(name), load_results(name)
    missing = [option for option in varied_options(study) if option not in results]
    if len(results) and missing:
        raise ValueError(f"{RESULTS / name}.csv: line 1: has no column {', '.join(missing)}")
    return results


def study_section(name: str) -> str:
    """Returns the Markdown section of a study.

    The section has the question, the table, the figure and the verdicts on the paper's claims. Where
    the study was not run, the section has its question and says that it was not run.
    """
    results, lines = _results_of(name), [f"### {name}", "", get_study(name).question, ""]
    if not len(results):
        return "\n".join([*lines, f"*{not_run(name)}.*"])
    lines += [markdown(study_table(results)), "", f"![{name}](results/{name}.png)", ""]
    claims = [claim for claim in CLAIMS if claim.study == name]
    if claims:
        lines += [markdown(verdicts(claims, results)), ""]
    return "\n".join(lines).rstrip()


def studies_text() -> str:
    """Returns the Markdown sections of all studies."""
    return "\n\n".join(study_section(name) for name in STUDIES)


def write_study(name: str) -> Path | None:
    """Draws a study's figure into the folder of its results, and returns the file's path.

    Returns None where the study was not run.
    """
    results, path = _results_of(name), RESULTS / f"{name}.png"
    if not len(results):
        return None
    check_output(path)
    return drawn(study_figure(name, results), path)


# --- Pages ---


def markdown(table: pd.DataFrame) -> str:
    """Returns a table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.astype(object).fillna("").astype(str).values]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def between_marks(page: str, name: str, text: str) -> str:
    """Returns `page` with `text` between its marks called `name`. Raises ValueError if a mark is missing."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if begin not in page or end not in page:
        raise ValueError(f"the page has no marks {begin} and {end}")
    head, rest = page.split(begin, 1)
    return head + begin + "\n" + text + "\n" + end + rest.split(end, 1)[1]


def pages() -> dict[Path, str]:
    """Returns the paths of the pages with tables, and the text that each page must have now."""
    data, readme = SHIPPED_DATA / "README.md", ROOT / "README.md"
    text = data.read_text(encoding="utf-8")
    made = {"datasheet": datasheet, "frontier": frontier, "studies": studies_text}
    made["paper-profile"] = paper_profile_table
    for name, table in made.items():
        text = between_marks(text, name, table())
    front = readme.read_text(encoding="utf-8")
    front_tables = (("results", results_table), ("baselines", baselines_table))
    for name, table in front_tables:
        front = between_marks(front, name, table())
    return {data: text, readme: front}


def write() -> list[Path]:
    """Writes the pages, the figures of the datasets and the studies' figures, and returns their paths.

    Everything is made before anything is written, so that an error leaves all files as they were.
    """
    texts = pages()
    figures = {SHIPPED_DATA / "planes" / f"{name}.png": dataset_figure(name) for name in shipped_tasks()}
    for name in STUDIES:
        results = _results_of(name)
        if len(results):
            figures[RESULTS / f"{name}.png"] = study_figure(name, results)
    if paper := paper_profile_figure():
        figures[RESULTS / "paper-profile.png"] = paper
    for path in (*texts, *figures):
        check_output(path)
    for path, text in texts.items():
        with written_whole(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return [*texts, *(drawn(figure, path) for path, figure in figures.items())]


def dataset_figure(name: str) -> Picture:
    """Returns the figure of the episodes of a shipped dataset."""
    return cost_return_plane(load_dataset(name), get_task(name))


def drawn(figure: Picture, path: Path) -> Path:
    """Writes the figure to `path` as an image of 256 colours, and returns `path`."""
    with written_whole(path) as temporary:
        temporary.write_bytes(figure.small_png())
    return path
