"""The figures of training and results: learning curves, our results beside the paper's, and variants.

The figures of studies that notebooks alone use are here. Those that `c2iql report` draws, too, are in
`tutorial_lib.studies.figures`.
"""

import csv
import itertools
from pathlib import Path

import numpy as np
from matplotlib import ticker

from tutorial_lib.scores import with_scores
from tutorial_lib.studies.figures import MARKS, PANELS, VARIANTS, or_not_run, variant_names
from tutorial_lib.studies.paper import TABLE1
from tutorial_lib.studies.results import seed_interval, seed_means
from tutorial_lib.style import (
    COST,
    DASHED,
    LIMIT,
    NEUTRAL,
    REWARD,
    described,
    legend_below,
    one_figure,
    subplots,
    task_panels,
)
from tutorial_lib.tasks import get_task

# --- Training, results and data ---

CURVES = {
    "value_loss": "loss of $V_r$ (line 12)",
    "cost_value_loss": "loss of $V_c$ (line 14)",
    "critic_loss": "loss of $Q_r$ (line 16)",
    "cost_critic_loss": "loss of $Q_c$ (line 18)",
    "policy_loss": "loss of the policy (line 20)",
    "safe_fraction": "share of safe actions",
}
SQUARED_ERRORS = {
    "value_loss": REWARD,
    "critic_loss": REWARD,
    "cost_value_loss": COST,
    "cost_critic_loss": COST,
}


@one_figure
def learning_curves(log, names=tuple(CURVES)):
    """Draws scalars of a run over its updates, with one panel per scalar and one line per seed.

    Squared errors have a logarithmic scale. `log` is the value that `training.train` returns, or the path of
    a metrics.csv.
    """
    rows = _read_log(log)
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure, axes = subplots(lines, columns, figsize=(4 * columns, 2.8 * lines), sharex=True, squeeze=False)
    for ax, name in zip(axes.flat, names, strict=False):
        for seed in sorted({row["seed"] for row in rows}):
            x, y = zip(*[(row["update"], row[name]) for row in rows if row["seed"] == seed], strict=True)
            ax.plot(x, y, color=SQUARED_ERRORS.get(name, LIMIT), alpha=0.8)
        ax.set_title(CURVES.get(name, name.replace("_", " ")))
        if name in SQUARED_ERRORS:
            ax.set_yscale("log")
            ax.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 3)))
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_locator(ticker.NullLocator())
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("updates")
    return figure


def _read_log(log) -> list[dict[str, float]]:
    if not isinstance(log, str | Path):
        return log
    with open(log, newline="") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


# --- Studies ---


@one_figure
@or_not_run
def against_paper(results, algorithm: str = "C2IQL"):
    """Draws every task's return and cost beside the paper's: seeds, and their mean with its 95% interval."""
    part = seed_means(results[results["algorithm"] == algorithm], ("task",))
    tasks = list(part["task"].unique())
    figure, axes = subplots(1, 2, figsize=(12, 4.6))
    for ax, (score, title, colour), column in zip(axes, PANELS, (0, 1), strict=True):
        for x, task in enumerate(tasks):
            dots = part.loc[part["task"] == task, score].to_numpy()
            _interval_and_dots(ax, x - 0.12, dots, colour, f"ours, {algorithm}")
            if task in TABLE1.get(algorithm, {}):
                paper = TABLE1[algorithm][task][column]
                style = {"color": NEUTRAL, "markersize": 10, "fillstyle": "none", "markeredgewidth": 2}
                ax.plot(x + 0.2, paper, "o", **style, label="the paper's, on DSRL's data")
        turned = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"} if len(tasks) > 4 else {}
        ax.set_xticks(range(len(tasks)), tasks, **turned)
        ax.set(title=title, xlim=(-0.5, len(tasks) - 0.5))
    axes[1].axhline(1, **DASHED, label="limit")
    axes[1].set_ylim(0, None)
    legend_below(figure, *axes)
    return figure


def _interval_and_dots(ax, x, dots, colour, label):
    spread = np.linspace(-0.07, 0.07, len(dots)) if len(dots) > 1 else [0]
    ax.plot(x + spread, dots, "o", color=colour, markersize=6, alpha=0.4, markeredgewidth=0)
    low, high = seed_interval(dots)
    bars = [[dots.mean() - low], [high - dots.mean()]] if len(dots) > 1 else None
    ax.errorbar(x, dots.mean(), bars, fmt="D", color=colour, markersize=9, capsize=6, label=label)


@one_figure
@or_not_run
def promises(results):
    """Draws the predicted cost of an episode against the paid cost, with one panel per task.

    Each mark is the mean of one agent at one limit.
    """
    results = results[results["algorithm"].eq("C2IQL") & results["predicted_cost"].notna()]
    means = results.groupby(["task", "seed", "threshold"])[["predicted_cost", "cost"]].mean().reset_index()
    tasks = list(results["task"].unique())
    figure, axes = task_panels(tasks, 3.8)
    for ax, task in zip(axes.flat, tasks, strict=False):
        part, names = means[means["task"] == task], get_task(task).cost_limit_names
        end = 1.1 * part[["predicted_cost", "cost", "threshold"]].to_numpy().max()
        ax.plot([0, end], [0, end], color=NEUTRAL, linewidth=1.5, label="paid as predicted")
        looks = zip(itertools.cycle((0.35, 0.65, 1)), itertools.cycle("os^DvPX"), strict=False)
        for (alpha, mark), (limit, name) in zip(looks, names.items(), strict=False):
            rows = part[part["threshold"] == limit]
            style = {"color": COST, "alpha": alpha, "markersize": 9, "label": f"{name} limit"}
            ax.plot(rows["predicted_cost"], rows["cost"], mark, **style)
            ax.axhline(limit, color=LIMIT, linestyle=":", linewidth=1, label="the limits")
        ax.set(xlabel="predicted cost", xlim=(0, end), ylim=(0, end))
        ax.locator_params(nbins=4)
    for ax in axes[:, 0]:
        ax.set_ylabel("paid cost")
    legend_below(figure, axes[0, 0])
    return figure


@one_figure
@or_not_run
def paid_and_earned(results):
    """Draws the normalised return against the cost that was paid, with one panel per task.

    A small mark is one seed at one limit. A large mark is the mean of the seeds, and a line joins the means
    of one variant from its lowest limit to its highest. A dotted line is a limit.
    """
    results = with_scores(results.assign(variant=variant_names(results)))
    tasks, names = list(results["task"].unique()), list(results["variant"].unique())
    figure, axes = task_panels(tasks, 4.6)
    for ax, task in zip(axes.flat, tasks, strict=False):
        part = results[results["task"] == task]
        seeds = part.groupby(["variant", "threshold", "seed"])[["cost", "reward_score"]].mean()
        for index, name in enumerate(names):
            if name not in seeds.index:
                continue
            look = {"color": VARIANTS[index % len(VARIANTS)], "marker": MARKS[index % len(MARKS)]}
            dots, means = seeds.loc[name], seeds.loc[name].groupby("threshold").mean()
            ax.plot(dots["cost"], dots["reward_score"], linestyle="", markersize=5, alpha=0.35, **look)
            ax.plot(means["cost"], means["reward_score"], linewidth=1.5, markersize=10, label=name, **look)
        for limit in sorted(part["threshold"].unique()):
            ax.axvline(limit, color=LIMIT, linestyle=":", linewidth=1, label="a limit")
        ax.set(xlabel="cost paid", xlim=(0, None))
    for ax in axes[:, 0]:
        ax.set_ylabel("normalised return")
    legend_below(figure, *axes.flat[: len(tasks)])
    words = "Normalised return over the cost paid, one line from the lowest limit to the highest for each of"
    return described(figure, f"{words} {', '.join(names)}, on {', '.join(tasks)}. Dotted: the limits.")


@one_figure
@or_not_run
def differences(rows):
    """Draws differences between two variants with their intervals, one row of panels per task.

    `rows` has the columns `task`, `pair` (words), `limit` (a number, or 'mean') and, for each score, its
    difference and its interval (the score's name with `_low` and `_high`). A filled mark is a difference
    whose interval excludes zero.
    """
    tasks, pairs = list(rows["task"].unique()), list(rows["pair"].unique())
    height = (0.75 * len(pairs) + 1.2) * len(tasks) + 0.6
    figure, axes = subplots(len(tasks), 2, figsize=(12, height), squeeze=False, sharex="col", sharey=True)
    for line, task in zip(axes, tasks, strict=True):
        part = rows[rows["task"] == task]
        limits = list(part["limit"].unique())
        for ax, (score, title, colour) in zip(line, PANELS, strict=True):
            for _, row in part.iterrows():
                place, mean = limits.index(row["limit"]), row["limit"] == "mean"
                y = pairs.index(row["pair"]) + (place - (len(limits) - 1) / 2) * 0.18
                low, high = row[f"{score}_low"], row[f"{score}_high"]
                style = {"color": NEUTRAL if mean else colour, "marker": "D" if mean else "os^vP"[place % 5]}
                style["fillstyle"] = "full" if low > 0 or high < 0 else "none"
                label = "mean over limits" if mean else f"limit {row['limit']:g}"
                ax.plot([low, high], [y, y], color=style["color"], linewidth=1.5)
                ax.plot(row[score], y, linestyle="", markersize=9, label=label, **style)
            ax.axvline(0, **DASHED)
            ax.set_title(f"{task}: {title}")
            ax.set_yticks(range(len(pairs)), pairs)
    axes[0, 0].set_ylim(len(pairs) - 0.4, -0.6)
    legend_below(figure, axes[0, 1])
    words = f"Differences in return (left) and cost (right) at each limit of {', '.join(tasks)}, with 95%"
    text = f"{words} intervals: {', '.join(pairs)}. A grey mark is the mean over limits."
    return described(figure, text)
