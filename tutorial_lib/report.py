"""Tables made from files: the datasheet of the shipped data and the results, in the Markdown that shows them.

A page keeps a pair of comments, `<!-- NAME:begin -->` and `<!-- NAME:end -->`; what stands between them
is written here and nowhere else, and a test fails where it is out of date.
"""

import hashlib
from pathlib import Path

import pandas as pd

from tutorial_lib.datasets import SHIPPED_DATA, load_dataset, shipped_tasks
from tutorial_lib.evaluation import summarise, with_scores
from tutorial_lib.tasks import get_task

ROOT = SHIPPED_DATA.parent
FIRST_LIGHT = SHIPPED_DATA / "results" / "first-light.csv"

PAPER_C2IQL = {
    "AntRun": (0.72, 1.00),
    "BallRun": (0.59, 0.95),
    "CarRun": (0.95, 0.08),
    "DroneRun": (0.71, 0.73),
    "AntCircle": (0.66, 0.76),
    "BallCircle": (0.72, 0.85),
    "CarCircle": (0.74, 0.93),
    "DroneCircle": (0.78, 0.85),
}
"""The paper's Table 1, last rows: C2IQL's normalised reward and cost, on DSRL's data."""


DSRL_FRONTIER = {
    "BallRun": {0: 440, 20: 450, 50: 900, 80: 1300},
    "CarRun": {0: 570},
    "BallCircle": {0: 600, 30: 700, 60: 880},
    "CarCircle": {0: 430, 30: 480, 100: 530},
}
"""The best returns in DSRL's data at some costs, read off its published plots."""


def datasheet() -> str:
    """One row per shipped dataset: size, episodes, ranges, how it was made, checksum."""
    rows = []
    for name in shipped_tasks():
        path, data = SHIPPED_DATA / f"{name}.hdf5", load_dataset(name)
        costs, returns = data.episode_costs, data.episode_returns
        minutes = int(data.attributes["wall_seconds"]) // 60
        rows.append(
            {
                "file": f"`{path.name}`",
                "MB": f"{path.stat().st_size / 1e6:.1f}",
                "episodes": f"{data.num_episodes} of {data.attributes['collected_episodes']}",
                "transitions": f"{len(data):,}",
                "cost": f"{costs.min():.0f} to {costs.max():.0f}, mean {costs.mean():.0f}",
                "return": f"{returns.min():.0f} to {returns.max():.0f}",
                "made with": f"`{data.attributes['made_by']}`, {minutes} min",
                "SHA-256": f"`{hashlib.sha256(path.read_bytes()).hexdigest()}`",
            }
        )
    return markdown(pd.DataFrame(rows))


def frontier() -> str:
    """The best return at a cost of at most so much, ours against DSRL's."""
    rows = []
    for name, points in DSRL_FRONTIER.items():
        data = load_dataset(name)
        for cost, dsrl in points.items():
            ours = data.episode_returns[data.episode_costs <= cost].max()
            row = {"task": name, "cost at most": cost, "DSRL": dsrl, "ours": f"{ours:.0f}"}
            rows.append(row | {"ours / DSRL": f"{ours / dsrl:.2f}"})
    return markdown(pd.DataFrame(rows))


def results_table(path: Path = FIRST_LIGHT) -> str:
    """C2IQL per task: scores per threshold with 95% intervals, and the paper's mean beside ours."""
    results = pd.read_csv(path)
    rows = []
    for task, part in results.groupby("task", sort=False):
        scores, row = with_scores(part), {"task": task}
        for _, line in summarise(part).iterrows():
            limit = get_task(task).cost_limit_names[line["threshold"]]
            row[f"{limit} limit: reward / cost"] = " / ".join(
                f"{line[name]:.2f} [{line[f'{name}_low']:.2f}, {line[f'{name}_high']:.2f}]"
                for name in ("reward_score", "cost_score")
            )
        row["mean: reward / cost"] = (
            f"{scores['reward_score'].mean():.2f} / {scores['cost_score'].mean():.2f}"
        )
        paper = PAPER_C2IQL[task]
        row["the paper's, on DSRL's data"] = f"{paper[0]:.2f} / {paper[1]:.2f}"
        rows.append(row)
    return markdown(pd.DataFrame(rows))


def markdown(table: pd.DataFrame) -> str:
    """A table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.astype(str).values]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def between_marks(page: str, name: str, text: str) -> str:
    """`page` with `text` between its marks called `name`. Raises ValueError where it has none."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if begin not in page or end not in page:
        raise ValueError(f"the page has no marks {begin} and {end}")
    head, rest = page.split(begin, 1)
    return head + begin + "\n" + text + "\n" + end + rest.split(end, 1)[1]


def pages() -> dict[Path, str]:
    """Every page that holds made tables, as it should read now."""
    data, readme = SHIPPED_DATA / "README.md", ROOT / "README.md"
    text = data.read_text()
    for name, table in (("datasheet", datasheet), ("frontier", frontier), ("results", results_table)):
        text = between_marks(text, name, table())
    return {data: text, readme: between_marks(readme.read_text(), "results", results_table())}


def write() -> list[Path]:
    """Bring the pages and the pictures of the datasets up to date. Returns what it wrote."""
    from tutorial_lib.plotting import cost_return_plane

    written = pages()
    for path, text in written.items():
        path.write_text(text)
    pictures = [SHIPPED_DATA / "planes" / f"{name}.png" for name in shipped_tasks()]
    for path in pictures:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(cost_return_plane(load_dataset(path.stem), get_task(path.stem)).small_png())
    return [*written, *pictures]
