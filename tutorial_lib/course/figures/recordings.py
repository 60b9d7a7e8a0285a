"""The figures of notebook 2: the recordings, before any training."""

import numpy as np
from matplotlib.colors import LogNorm

from tutorial_lib.data.recordings import best_left, best_mixture, near_best
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
from tutorial_lib.tasks import DSRL_FRONTIER, Task, get_task, scene_of

DOTS = {"marker": "o", "linestyle": "none", "markersize": 3, "alpha": 0.4, "markeredgewidth": 0}


@one_figure
def planes(datasets: dict, frontier: bool = False):
    """Draws every episode by its cost and its return, with one panel per dataset.

    `datasets` is {task name: Dataset}. Dashed lines are the thresholds. `frontier` adds the best return left
    under each limit and the best mixture of episodes. It also adds DSRL's frontier for the tasks where it was
    read off the plots.
    """
    figure, axes = task_panels(datasets, 3.6)
    for ax, (name, data) in zip(axes.flat, datasets.items(), strict=False):
        task = get_task(name)
        ax.plot(data.episode_costs, data.episode_returns, color=NEUTRAL, label="episode", **DOTS)
        for threshold in task.thresholds:
            ax.axvline(threshold, **(DASHED | {"linewidth": 1.5}), label="threshold")
        if frontier:
            limits = np.linspace(0, task.cost_range, 401)
            ax.plot(limits, best_left(data, limits)[1], color=REWARD, label="best episode left")
            mix = {"color": REWARD, "linewidth": 1.5, "linestyle": ":"}
            ax.plot(limits, best_mixture(data, limits), label="best mixture", **mix)
            mark = {"color": COST, "markersize": 9, "label": "DSRL's frontier, read off its plots"}
            if name in DSRL_FRONTIER:
                ax.plot(*zip(*DSRL_FRONTIER[name].items(), strict=True), "D", **mark)
        ax.set(xlabel="cost", xticks=[0, *task.thresholds])
    for ax in axes[:, 0]:
        ax.set_ylabel("return")
    legend_below(figure, *axes.flat)
    text = (
        f"The cost-return plane of {', '.join(datasets)}: a dot for every recorded episode, with its cost to "
        "the right and its return upwards. Dashed lines are the thresholds of the task."
    )
    if frontier:
        text += (
            " A staircase is the best return of the episodes within each limit. A dotted line above it is "
            "the best mixture of episodes. Diamonds are the best returns of DSRL's data."
        )
    return described(figure, text)


@one_figure
def filtered(dataset, task: Task, limit: float):
    """Draws BC-Safe's filter at one limit, and its effect over all limits.

    The left panel shows the episodes that pass. The right panel shows the share of episodes that pass and
    their best return.
    """
    passes = dataset.episode_costs <= limit
    costs, returns = dataset.episode_costs, dataset.episode_returns
    figure, (plane, over) = subplots(1, 2, figsize=(12, 4.8))
    for chosen, colour, words in ((~passes, NEUTRAL, "filtered out"), (passes, REWARD, "passes")):
        look = DOTS | {"markersize": 4, "alpha": 0.6, "color": colour, "label": words}
        plane.plot(costs[chosen], returns[chosen], **look)
    plane.axvline(limit, **DASHED, label="limit")
    words = f"limit {limit:g}: {passes.sum()} of {len(passes)} episodes pass"
    if passes.any():
        best = np.flatnonzero(passes)[returns[passes].argmax()]
        look = {"color": REWARD, "markersize": 20, "markeredgecolor": LIMIT}
        plane.plot(costs[best], returns[best], "*", label="the best of them", **look)
        words += f", best {returns[best]:.0f}"
    plane.set(title=words, xlabel="cost of the episode", ylabel="return of the episode")

    limits = np.linspace(0, task.cost_range, 401)
    shares, tops = best_left(dataset, limits)
    over.plot(limits, shares, color=NEUTRAL, label="episodes left / all")
    over.plot(limits, tops / returns.max(), color=REWARD, label="best return left / best of all")
    over.axvline(limit, **DASHED)
    over.set(title="over all limits", xlabel="limit", ylim=(0, 1.05))
    legend_below(figure, plane, over)
    text = (
        f"Left: every episode by its cost and its return. {words}; the others are greyed. Right: a larger "
        "limit lets more episodes pass, and their best return rises more slowly than their number."
    )
    return described(figure, text)


@one_figure
def visited(datasets: dict):
    """Draws the number of recorded steps in each bin of the robot's position after the step.

    Lines mark the cost zones.
    """
    figure, axes = task_panels(datasets, 3.5)
    for ax, (name, data) in zip(axes.flat, datasets.items(), strict=False):
        scene = scene_of(get_task(name))
        x, y = scene.positions(data.next_observations).T
        bins = [np.linspace(x.min(), x.max(), 61), np.linspace(y.min(), y.max(), 61)]
        *_, picture = ax.hist2d(x, y, bins, norm=LogNorm(1, 3000), cmap="Blues")
        scene.draw_walls(ax)
        ax.set(xlabel="x (m)", facecolor="white")
    for ax in axes[:, 0]:
        ax.set_ylabel("y (m)")
    figure.colorbar(picture, ax=axes, label="steps per bin", shrink=0.8)
    legend_below(figure, axes[0, 0])
    text = (
        f"Where the robots of {', '.join(datasets)} were, seen from above: a bin is darker the more recorded "
        "steps end in it. Lines are the edges of the cost zones. White places are in no recording."
    )
    return described(figure, text)


@one_figure
def examples_left(datasets: dict, share: float = 0.9):
    """Draws the number of episodes that pass the filter at each threshold.

    A second bar counts those that earn at least `share` of the best return left.
    """
    figure, axes = task_panels(datasets, 3.4)
    for ax, (name, data) in zip(axes.flat, datasets.items(), strict=False):
        thresholds = get_task(name).thresholds
        places = range(len(thresholds))
        left = [np.sum(data.episode_costs <= limit) for limit in thresholds]
        good = [near_best(data, limit, share) for limit in thresholds]
        ax.bar(places, left, color=NEUTRAL, alpha=0.4, label="keep the limit")
        words = f"and earn at least {share:.0%} of the best that do"
        ax.bar_label(ax.bar(places, good, color=REWARD, label=words), fontsize=13)
        ax.set_xticks(places, [f"{limit:g}" for limit in thresholds])
        ax.set_xlabel("limit")
    for ax in axes[:, 0]:
        ax.set_ylabel("episodes")
    legend_below(figure, axes[0, 0])
    text = (
        f"For each threshold of {', '.join(datasets)}, a grey bar counts the episodes that keep it, and a "
        f"blue bar those of them that earn at least {share:.0%} of the best. Its number stands on it."
    )
    return described(figure, text)


@one_figure
def at_the_wall(push, crossed, bins: int = 8):
    """Draws a histogram of pushes towards the wall (n,), and the share in each bin that soon crosses it.

    A push lies in [-1, 1].
    """
    edges = np.linspace(-1, 1, bins + 1)
    place = np.clip(np.digitize(push, edges) - 1, 0, bins - 1)
    counts = np.bincount(place, minlength=bins)
    shares = np.bincount(place, weights=crossed, minlength=bins) / np.maximum(counts, 1)
    figure, axes = subplots(1, 2, figsize=(12, 4.2))
    middles, width = (edges[1:] + edges[:-1]) / 2, 0.92 * (edges[1] - edges[0])
    axes[0].bar_label(axes[0].bar(middles, counts, width, color=NEUTRAL), fontsize=12)
    axes[1].bar(middles, shares, width, color=COST)
    axes[0].set(title="what was tried", ylabel="recorded steps", ylim=(0, 1.1 * counts.max()))
    axes[1].set(title="what came of it", ylabel="share that soon crosses the wall", ylim=(0, 1))
    for ax in axes:
        ax.set(xlabel="push: -1 brakes, 1 goes for the wall", xticks=(-1, -0.5, 0, 0.5, 1))
    text = (
        f"Left: the number of recorded steps for {bins} ranges of the push towards the wall, from full "
        f"braking ({counts[0]} steps) to full speed ahead ({counts[-1]} steps). Right: the share that "
        f"soon crosses the wall, from {shares[0]:.0%} to {shares[-1]:.0%}."
    )
    return described(figure, text)


@one_figure
def to_go(steps, masked, continued, fitted):
    """Draws the mean discounted return-to-go at each step, for two treatments of the end of a recording.

    The first treatment takes it as the end of the episode. The second takes it as a cut, after which the
    robot continues at its rate. `fitted` is what a model of the observation learns from the first. All are
    (T,), in discounted reward.
    """
    figure, ax = subplots(figsize=(11, 4.4))
    ax.plot(steps, continued, color=REWARD, label="a cut: the robot goes on at its rate")
    ax.plot(steps, masked, color=COST, label="the end: nothing follows")
    ax.plot(steps, fitted, color=COST, linestyle=":", label="the end, as a fit without a clock sees it")
    ax.set(xlabel="step", ylabel="discounted return to go", ylim=(0, None))
    legend_below(figure, ax)
    text = (
        "The mean discounted return to go over the steps of an episode. If the robot goes on after the time "
        "limit, it stays about level. If nothing follows, it falls to zero at the last step. A fit that sees "
        "only the observation stays level and lower."
    )
    return described(figure, text)


@one_figure
def plane_by_hand(episodes: dict[str, tuple[float, float]], limit: float):
    """Draws a few named episodes (cost, return), their frontier, their best mixtures, and a limit."""
    figure, ax = subplots(figsize=(9, 4.8))
    costs, returns = np.array(list(episodes.values()), float).T
    limits = np.linspace(0, costs.max() + 1, 701)
    best = np.array([returns[costs <= one].max(initial=-np.inf) for one in limits])
    points = list(episodes.values())
    chords = [
        np.interp(limits, (left[0], right[0]), (left[1], right[1]), left=-np.inf)
        for left in points
        for right in points
        if left[0] < right[0]
    ]
    mixed = np.maximum.reduce([best, *chords])  # the upper envelope
    ax.step(limits, best, where="post", color=REWARD, label="frontier: best episode within a limit")
    ax.plot(limits, mixed, color=REWARD, linewidth=1.5, linestyle=":", label="best mixture")
    ax.plot(costs, returns, "o", color=NEUTRAL, markersize=9, label="episode")
    for name, (cost, earned) in episodes.items():
        ax.annotate(name, (cost, earned), xytext=(7, -16), textcoords="offset points", fontsize=14)
    ax.axvline(limit, **DASHED, label="limit")
    ax.set(xlabel="cost", ylabel="return", ylim=(0, 1.1 * returns.max()))
    legend_below(figure, ax)
    text = (
        f"{len(episodes)} episodes on the cost-return plane. A staircase joins those on the frontier. A "
        "dotted line joins the corners of the best mixtures and lies on the staircase or above it."
    )
    return described(figure, text)


@one_figure
def by_source(dataset, counts: dict[str, int], task: Task):
    """Draws every episode by its cost and its return, with one panel for each source of the dataset.

    `counts` is {source: number of its episodes}, in the order of the episodes. Grey dots are the episodes of
    all other sources.
    """
    figure, axes = subplots(1, len(counts), figsize=(6 * len(counts), 4.4), squeeze=False, sharey=True)
    costs, returns = dataset.episode_costs, dataset.episode_returns
    first = 0
    for ax, (source, count) in zip(axes[0], counts.items(), strict=True):
        own = np.arange(first, first + count)
        first += count
        ax.plot(costs, returns, color=NEUTRAL, **(DOTS | {"alpha": 0.15}))
        ax.plot(costs[own], returns[own], color=REWARD, **(DOTS | {"alpha": 0.7}))
        ax.set(title=f"{source}: {count} episodes", xlabel="cost", xticks=[0, *task.thresholds])
    axes[0, 0].set_ylabel("return")
    named = " and ".join(f"{count} episodes of {source}" for source, count in counts.items())
    return described(figure, f"The cost-return plane of {task.name}, with {named} in blue.")


@one_figure
def frontier_left(numbers, left: dict[str, np.ndarray], exact):
    """Draws the share of the frontier that is left over the number of episodes that are kept (k,).

    `left` is {kind of thinning: shares (k,) or (k, draws)}, and `exact` (k,) is the computed mean for one.
    Bars span the lowest and the highest of several draws.
    """
    figure, ax = subplots(figsize=(10, 4.6))
    for (kind, shares), colour in zip(left.items(), (COST, REWARD), strict=False):
        shares = np.asarray(shares).reshape(len(numbers), -1)
        mean = shares.mean(1)
        span = [mean - shares.min(1), shares.max(1) - mean]
        ax.errorbar(numbers, mean, span, fmt="o", capsize=4, color=colour, label=kind)
    ax.plot(numbers, exact, color=COST, linewidth=1.5, label="mean at random, computed")
    ax.axhline(1, **DASHED, label="all episodes")
    ax.set(xscale="log", xlabel="episodes that are kept", ylabel="share of the frontier left")
    ax.set_xticks(numbers, [f"{number:g}" for number in numbers])
    ax.minorticks_off()
    legend_below(figure, ax)
    text = (
        "The share of the frontier that is left, over the number of episodes that are kept, on a logarithmic "
        f"axis. It rises towards 1. The kinds of thinning are: {', '.join(left)}."
    )
    return described(figure, text)
