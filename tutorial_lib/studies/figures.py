"""The figures of the studies: variants, expectiles, noise, and every system at every limit.

Every figure is drawn from raw results. In the figures of seeds a small mark is a seed, and a larger mark is
the mean of the seeds. If the results have no rows, a figure with the decorator `or_not_run` says that the
study was not run.
"""

import functools

import numpy as np
import pandas as pd

from tutorial_lib.scores import with_scores
from tutorial_lib.studies.paper import TABLE2
from tutorial_lib.studies.results import options_of, seed_means
from tutorial_lib.style import (
    COST,
    DASHED,
    NEUTRAL,
    REWARD,
    described,
    legend_below,
    one_figure,
    subplots,
)
from tutorial_lib.tasks import Task

VARIANTS = ("#222222", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8A8A8A", "#F0E442", "#0072B2", "#D55E00")
MARKS = "Ds^ovPX<>"
FIGURE_2 = ("C2IQL", "C2IQL (printed)", "CDT")  # the two systems of the paper's Fig. 2, and one as printed
PANELS = (("reward_score", "normalised return", REWARD), ("cost_score", "normalised cost", COST))


def or_not_run(draw):
    """Returns a version of `draw` that says, if the results have no rows, that the study was not run."""

    @functools.wraps(draw)
    def maybe(results, *args, **options):
        if len(results):
            return draw(results, *args, **options)
        figure, ax = subplots(figsize=(9, 1))
        ax.set_axis_off()
        ax.text(0.5, 0.5, "not run: no results to draw", ha="center", va="center", color=NEUTRAL)
        return described(figure, "Nothing is drawn, because the study was not run.")

    return maybe


def variant_names(results: pd.DataFrame) -> pd.Series:
    """Returns a short name for each row: the options that differ between the runs of its study."""
    options = [name for name in options_of(results) if results[name].nunique(dropna=False) > 1]
    if not options:
        return results["algorithm"]
    if "crm" in options or "crm_width" in options:  # The variants differ in the size of the model.
        sizes = results["crm_layers"].astype(str) + " x " + results["crm_width"].astype(str)
        return sizes.where(results["crm"] != "linear", "linear")
    names = results[options[0]].astype(str) if len(options) == 1 else None
    if names is not None:
        return options[0].replace("_", " ") + ": " + names
    return results[options].apply(lambda row: ", ".join(f"{k}={v}" for k, v in row.items()), axis=1)


@one_figure
@or_not_run
def variants(results):
    """Draws return and cost at each limit, with one row of panels per task and one line per variant."""
    results = results.assign(variant=variant_names(results))
    tasks, names = list(results["task"].unique()), list(results["variant"].unique())
    size = (12, 3.6 * len(tasks) + 0.8)
    figure, axes = subplots(len(tasks), 2, figsize=size, squeeze=False, sharex="row")
    for row, task in zip(axes, tasks, strict=True):
        part = seed_means(results[results["task"] == task], ("variant", "threshold"))
        limits = sorted(part["threshold"].unique())
        for ax, (score, title, _) in zip(row, PANELS, strict=True):
            for index, name in enumerate(names):
                shift = (index - (len(names) - 1) / 2) * 0.4 / len(names)
                _seeds_by(ax, part[part["variant"] == name], "threshold", limits, score, index, shift, name)
            ax.set_xticks(range(len(limits)), [f"{limit:g}" for limit in limits])
            ax.set_title(f"{task}: {title}")
        row[1].axhline(1, **DASHED, label="limit")
        row[1].set_ylim(0, None)
    for ax in axes[-1]:
        ax.set_xlabel("limit")
    legend_below(figure, axes[0, 1])
    return figure


def _seeds_by(ax, part, column, values, score, index, shift, label):
    """Draws each seed as a dot and the means as a line, over the `values` of `column`."""
    style = {"color": VARIANTS[index % len(VARIANTS)], "marker": MARKS[index % len(MARKS)]}
    x = [place + shift for place in range(len(values))]
    scores = [part.loc[part[column] == value, score].to_numpy() for value in values]
    for place, dots in zip(x, scores, strict=True):
        ax.plot([place] * len(dots), dots, linestyle="", markersize=5, alpha=0.4, markeredgewidth=0, **style)
    means = [dots.mean() if len(dots) else np.nan for dots in scores]
    ax.plot(x, means, markersize=10, linewidth=1.5, label=label, **style)


@one_figure
@or_not_run
def expectiles(results, limit: float = 50):
    """Draws the paper's Fig. 4: return and cost over kappa_1 at one limit, with one line per kappa_2."""
    part = seed_means(results[results["threshold"] == limit], ("kappa_1", "kappa_2"))
    values, others = (sorted(part[name].unique()) for name in ("kappa_1", "kappa_2"))
    figure, axes = subplots(1, 2, figsize=(12, 4.6))
    for ax, (score, title, _) in zip(axes, PANELS, strict=True):
        for index, other in enumerate(others):
            rows = part[part["kappa_2"] == other]
            shift = (index - (len(others) - 1) / 2) * 0.12
            label = rf"$\kappa_2$ = {other:g} (policy)"
            _seeds_by(ax, rows, "kappa_1", values, score, index, shift, label)
        ax.set_xticks(range(len(values)), [f"{value:g}" for value in values])
        ax.set(title=f"{title} at limit {limit:g}", xlabel=r"$\kappa_1$ (values)")
    axes[1].axhline(1, **DASHED, label="limit")
    axes[1].set_ylim(0, None)
    legend_below(figure, axes[1])
    return figure


@one_figure
@or_not_run
def noise_levels(results, limit: float = 50):
    """Draws our results beside the paper's Table 2: return and cost over the noise in training the model."""
    part = results[results["threshold"] == limit].groupby(["crm_noise", "seed"])[["return", "cost"]].mean()
    part = part.reset_index()
    levels = sorted(part["crm_noise"].unique())
    figure, axes = subplots(1, 2, figsize=(12, 4.6))
    for ax, column, colour in zip(axes, ("return", "cost"), (REWARD, COST), strict=True):
        means = [part.loc[part["crm_noise"] == level, column].mean() for level in levels]
        place = {level: x for x, level in enumerate(levels)}
        x = part["crm_noise"].map(place)
        ax.plot(x, part[column], "o", color=colour, markersize=6, alpha=0.4, markeredgewidth=0)
        ax.plot(range(len(levels)), means, "D-", color=colour, markersize=9, label=f"our {column}")
        paper = [TABLE2[column][TABLE2["noise"].index(level)] for level in levels]
        ax.plot(
            range(len(levels)),
            paper,
            "o--",
            color=NEUTRAL,
            markersize=8,
            fillstyle="none",
            label="the paper's",
        )
        ax.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
        ax.set(xlabel="standard deviation of the noise", title=f"{column} at limit {limit:g}", ylim=(0, None))
    axes[1].axhline(limit, **DASHED, label="limit")
    legend_below(figure, *axes)
    return figure


def algorithm_looks(results) -> dict[str, dict]:
    """Returns the colour and the marker of each algorithm, by its place in the results.

    All figures of the same results therefore draw an algorithm in the same way.
    """
    looks = {}
    for place, name in enumerate(results["algorithm"].unique()):
        again = place // len(VARIANTS)  # A repeated colour gets another mark.
        colour, mark = VARIANTS[place % len(VARIANTS)], MARKS[(place + again) % len(MARKS)]
        looks[name] = {"color": colour, "marker": mark, "markersize": 8}
    return looks


@one_figure
@or_not_run
def per_limit(results):
    """Draws the paper's Fig. 2: return and cost at each limit, a column per task, a line per algorithm."""
    results = with_scores(results)
    tasks, looks = list(results["task"].unique()), algorithm_looks(results)
    for name, look in looks.items():  # Among many lines the first one must be found.
        many = len(looks) > 4 and name != next(iter(looks))
        look |= {"linewidth": 0.8, "markersize": 4} if many else {"linewidth": 1.5}
    columns = min(4, len(tasks))
    blocks = -(-len(tasks) // columns)
    size = (12, 4.0 * blocks + 0.8)
    figure, axes = subplots(2 * blocks, columns, figsize=size, squeeze=False)
    for place, task in enumerate(tasks):
        block, column = divmod(place, columns)
        part = results[results["task"] == task]
        limits = np.array(sorted(part["threshold"].unique()))
        means = part.groupby(["algorithm", "threshold"])[["reward_score", "cost"]].mean()
        for ax, score in zip(axes[2 * block : 2 * block + 2, column], ("reward_score", "cost"), strict=True):
            for name, style in looks.items():
                if name in means.index.get_level_values(0):
                    ax.plot(limits, means.loc[name, score].reindex(limits), **style, label=name)
            ax.set_xticks(limits)
        axes[2 * block, column].set_title(task)
        axes[2 * block + 1, column].plot([0, limits.max()], [0, limits.max()], **DASHED, label="cost = limit")
        axes[2 * block + 1, column].set(xlabel="limit", ylim=(0, None))
    returns = results.groupby(["task", "algorithm", "threshold"])["reward_score"].mean()
    for block in range(blocks):
        for ax in axes[2 * block]:
            ax.set_ylim(min(0, returns.min() - 0.05), max(1, returns.max()) + 0.05)
        axes[2 * block, 0].set_ylabel("normalised return")
        axes[2 * block + 1, 0].set_ylabel("cost paid")
    for ax in axes[2 * (blocks - 1) :].T[len(tasks) - columns * (blocks - 1) :].flat:
        ax.set_visible(False)
    legend_below(figure, *axes.flat)
    return described(figure, _per_limit_text(tasks, list(looks)))


def _per_limit_text(tasks: list[str], names: list[str]) -> str:
    """Returns the alternative text of `per_limit`."""
    return (
        f"Normalised return and paid cost over the limit, with a column for each of {', '.join(tasks)} and a "
        f"line for each of {', '.join(names)}. A dashed line shows where the paid cost equals the limit."
    )


@one_figure
def expected_costs(log, recorded: float, unlimited: float):
    """Draws the mean expected cost of recorded actions in long runs, and the share that looks safe.

    `log` has a row for each `cost_critics` and logged `update`. `recorded` is the mean cost of the recorded
    episodes. `unlimited` is the share of the transitions whose given limit is infinite.
    """
    figure, axes = subplots(1, 2, figsize=(12, 4.6))
    panels = (("cost_mean", "expected cost of recorded actions"), ("safe_fraction", "share that looks safe"))
    for ax, (column, title) in zip(axes, panels, strict=True):
        for index, (count, run) in enumerate(log.groupby("cost_critics")):
            words = "one cost critic" if count == 1 else f"the highest of {count}"
            ax.plot(run["update"] / 1000, run[column], color=VARIANTS[index], linewidth=1.5, label=words)
        ax.set(title=title, xlabel="thousand updates", ylim=(0, None))
    axes[0].axhline(recorded, **DASHED, label="paid by the recorded episodes")
    axes[1].axhline(unlimited, color=COST, linestyle=":", label="those told infinity")
    legend_below(figure, *axes)
    return figure


def study_figure(name: str, results):
    """Draws the figure of the study with this name."""
    figures = {"kappas": expectiles, "crm-noise": noise_levels, "table1": per_limit}
    return figures.get(name, variants)(results)


@one_figure
def cost_return_plane(dataset, task: Task):
    """Draws every episode of a dataset by its cost and its return, with the task's thresholds."""
    figure, ax = subplots(figsize=(9, 5))
    ax.plot(dataset.episode_costs, dataset.episode_returns, "o", color=NEUTRAL, markersize=4, alpha=0.5)
    ax.set(xlabel="cost of the episode", ylabel="return of the episode")
    for threshold, word in task.cost_limit_names.items():
        ax.axvline(threshold, **DASHED)
        place = {"xy": (threshold, 1.01), "xycoords": ("data", "axes fraction"), "ha": "center"}
        ax.annotate(f"{word}\n{threshold:g}", **place)
    return figure
