"""The figures of chance: spreads, intervals, selected checkpoints, and summaries over tasks."""

import numpy as np
from matplotlib import ticker

from tutorial_lib.data.recordings import best_left
from tutorial_lib.data.sources import load_dataset
from tutorial_lib.scores import normalised_return, with_scores
from tutorial_lib.studies.figures import algorithm_looks, or_not_run
from tutorial_lib.studies.results import SCORES, seed_interval
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

STUDIES, EPISODES, EPISODE_SPREAD = 20, 30, 0.05


def simulated_intervals(seeds: int, spread: float, studies: int = STUDIES, rng=None):
    """Returns two sets of intervals (studies, 2) of a true difference of zero.

    The unit of the first set is the episode, and the unit of the second set is the seed. Every study compares
    two variants of `seeds` runs. The true score of a run varies with standard deviation `spread`. Each run
    plays 30 episodes, whose scores vary with standard deviation 0.05.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    skill = rng.normal(0, spread, (studies, 2, seeds, 1))
    episodes = skill + rng.normal(0, EPISODE_SPREAD, (studies, 2, seeds, EPISODES))
    mean = episodes.mean((2, 3))
    error = np.sqrt((episodes.var((2, 3)) / (seeds * EPISODES)).sum(1))
    middle = mean[:, 0] - mean[:, 1]
    by_episodes = np.stack([middle - 1.96 * error, middle + 1.96 * error], 1)
    pairs = episodes.mean(3)[:, 0] - episodes.mean(3)[:, 1]
    return by_episodes, np.array([seed_interval(row) for row in pairs])


@one_figure
def false_alarms(seeds: int = 3, spread: float = 0.05):
    """Draws the intervals of twenty studies of two equal variants, and marks those that exclude zero.

    The left panel uses the episode as the unit, and the right panel uses the seed.
    """
    figure, axes = subplots(1, 2, figsize=(12, 4.6), sharey=True)
    intervals = simulated_intervals(seeds, spread)
    for ax, found, unit in zip(axes, intervals, ("episode", "seed"), strict=True):
        wrong = (found[:, 0] > 0) | (found[:, 1] < 0)
        for x, (low, high) in enumerate(found):
            colour = COST if wrong[x] else NEUTRAL
            ax.errorbar(x, (low + high) / 2, (high - low) / 2, fmt="o", color=colour, capsize=4, markersize=6)
        ax.axhline(0, **DASHED)
        ax.set(
            title=f"unit: the {unit}. {wrong.sum()} of {STUDIES} see a difference", xlabel="simulated study"
        )
        ax.set_xticks([])
    axes[0].set_ylabel("difference in score")
    axes[0].set_ylim(-0.35, 0.35)
    return figure


def picked_checkpoints(checkpoints: int, episodes: int, runs: int = 2_000) -> np.ndarray:
    """Returns evaluations (runs, checkpoints) of agents whose true score is 0.7 at every checkpoint."""
    rng = np.random.default_rng(0)
    return 0.7 + rng.normal(0, 0.15 / episodes**0.5, (runs, checkpoints))


@one_figure
def lucky_checkpoints(checkpoints: int = 20, episodes: int = 5):
    """Draws the evaluations of one run, and the reported score over many runs.

    The right panel compares the score of the last checkpoint with the score of the best checkpoint.
    """
    scores = picked_checkpoints(checkpoints, episodes)
    figure, axes = subplots(1, 2, figsize=(12, 4.4), sharey=True)
    axes[0].plot(range(1, checkpoints + 1), scores[0], "o-", color=NEUTRAL, linewidth=1.5, label="evaluation")
    best = int(scores[0].argmax())
    axes[0].plot(best + 1, scores[0, best], "D", color=COST, markersize=12, label="the best")
    axes[0].plot(checkpoints, scores[0, -1], "s", color=REWARD, markersize=12, label="the last")
    axes[0].set(title="one run", xlabel="checkpoint", ylabel="score")
    axes[0].xaxis.set_major_locator(ticker.MaxNLocator(integer=True))
    reported = {"the last": (scores[:, -1], REWARD), "the best": (scores.max(1), COST)}
    for place, (values, colour) in enumerate(reported.values()):
        style = {"color": colour, "capsize": 8, "markersize": 11}
        axes[1].errorbar(place, values.mean(), values.std(), fmt="o", **style)
    axes[1].set_xticks([0, 1], reported, fontsize=14)
    axes[1].set(title="2,000 runs: mean and spread of what is reported", xlim=(-0.6, 1.6))
    for ax in axes:
        ax.axhline(0.7, **DASHED, label="the truth, always")
    axes[0].set_ylim(0.3, 1.1)
    legend_below(figure, axes[0])
    return figure


@one_figure
def room_left(results):
    """Draws the best recorded return within each limit and the algorithms' mean returns, per task.

    A hollow mark means that the mean cost is above the limit, so this return does not count.
    """
    scored = with_scores(results)
    tasks = list(scored["task"].unique())
    figure, axes = task_panels(tasks, 3.6, sharey=True)
    looks = algorithm_looks(scored)
    for ax, name in zip(axes.flat, tasks, strict=False):
        task, data = get_task(name), load_dataset(name)
        best = normalised_return(best_left(data, task.thresholds)[1], task)
        places = range(len(task.thresholds))
        ax.plot(places, best, "_", color=LIMIT, markersize=40, markeredgewidth=3, label="best recorded")
        for algorithm in ("C2IQL", "BC-Safe"):
            part = scored[(scored["task"] == name) & (scored["algorithm"] == algorithm)]
            means = part.groupby("threshold")[list(SCORES)].mean().reindex(task.thresholds)
            if means.notna().any(axis=None):
                look, rewards = looks[algorithm] | {"linewidth": 1.5}, means["reward_score"].to_numpy()
                ax.plot(places, rewards, **look, label=algorithm)
                unsafe = np.flatnonzero(means["cost_score"] > 1)
                ax.plot(unsafe, rewards[unsafe], **look | {"linestyle": "", "markerfacecolor": "white"})
        ax.set_xticks(places, [f"{limit:g}" for limit in task.thresholds])
        ax.set(xlabel="limit", xlim=(-0.5, len(places) - 0.5))
    axes[0, 0].set_ylim(0, None)
    for ax in axes[:, 0]:
        ax.set_ylabel("normalised return")
    legend_below(figure, *axes[0])
    return figure


@one_figure
@or_not_run
def spread_ratios(ratios):
    """Draws one mark for each task and limit: the spread over seeds in units of what episodes alone explain.

    `ratios` is a series with the levels `task` and `threshold`. Marks without a value are left out.
    """
    tasks = list(ratios.index.get_level_values("task").unique())
    figure, ax = subplots(figsize=(12, 4.2))
    for x, task in enumerate(tasks):
        values = ratios.loc[task].sort_index()
        for place, value in enumerate(values):
            label = ("small", "middle", "high", "further")[min(place, 3)] + " limit"
            style = {"color": COST, "alpha": 0.4 + 0.3 * min(place, 2), "markersize": 10, "label": label}
            ax.plot(x + 0.15 * (place - (len(values) - 1) / 2), value, "os^D"[min(place, 3)], **style)
    ax.axhline(1, **DASHED, label="seeds differ by their episodes' luck alone")
    ax.set(ylabel="spread over seeds /\nexpected from episodes", yscale="log")
    ax.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_locator(ticker.NullLocator())
    ax.set_xticks(range(len(tasks)), tasks, rotation=15)
    legend_below(figure, ax)
    words = (
        "The spread of the normalised cost over seeds, divided by what the luck of episodes explains, at the"
    )
    return described(figure, f"{words} limits of {', '.join(tasks)}. The dashed line is at 1.")


@one_figure
@or_not_run
def aggregates(rows):
    """Draws a mean over tasks for each system, with its interval, in one panel per limit.

    `rows` has the columns `system`, `limit` (words), `value`, `low`, `high` and `tasks` (a number). A hollow
    mark stands for a system that was not run on as many tasks as the others.
    """
    limits, systems = list(rows["limit"].unique()), list(rows["system"].unique())
    figure, axes = subplots(
        1, len(limits), figsize=(12, 0.42 * len(systems) + 1.4), sharex=True, sharey=True, squeeze=False
    )
    for ax, limit in zip(axes[0], limits, strict=True):
        for _, row in rows[rows["limit"] == limit].iterrows():
            y, whole = systems.index(row["system"]), row["tasks"] == rows["tasks"].max()
            ax.plot([row["low"], row["high"]], [y, y], color=REWARD, linewidth=1.5)
            ax.plot(row["value"], y, "D", color=REWARD, markersize=9, fillstyle="full" if whole else "none")
        ax.set(title=limit, xlabel="normalised return")
    axes[0, 0].set_yticks(range(len(systems)), systems)
    axes[0, 0].set_ylim(len(systems) - 0.5, -0.5)
    words = (
        "The interquartile mean of the normalised return over tasks and seeds, with 95% intervals, under the"
    )
    return described(figure, f"{words} {', '.join(limits)}, for {', '.join(systems)}.")


@one_figure
@or_not_run
def profiles(results, curves: dict):
    """Draws performance profiles: the share of runs beyond a score, over that score, one line per system.

    `curves` maps a panel's title to (label of the horizontal axis, grid (G,), {system: shares (G,)}). The
    looks of the systems are those that they have in `results`.
    """
    looks = algorithm_looks(results)
    first = next(iter(looks))
    figure, axes = subplots(1, len(curves), figsize=(12, 4.4), sharey=True, squeeze=False)
    for ax, (title, (label, grid, shares)) in zip(axes[0], curves.items(), strict=True):
        for name, share in shares.items():
            look = {"color": looks[name]["color"], "linewidth": 3 if name == first else 1.2}
            dashes = "-" if list(looks).index(name) < 9 else "--"  # Colours repeat after nine systems.
            ax.plot(grid, share, dashes, label=name, **look)
        ax.set(title=title, xlabel=label, ylim=(0, 1.02))
    axes[0, 0].set_ylabel("share of pairs (seed, limit)")
    handles = dict(zip(*reversed(axes[0, 0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=min(5, len(handles)))
    words = " and ".join(curves)
    return described(figure, f"Performance profiles, {words}, with a line for each of {', '.join(looks)}.")
