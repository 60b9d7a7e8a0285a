"""The figures of discounted costs: timelines, Fig. 1, the updates that a large gamma needs, and the
sequences of costs that a few discounted sums allow.
"""

import numpy as np
from matplotlib.colors import to_rgba

from tutorial_lib.costs.discounting import average_threshold, discounted_sums, misjudged
from tutorial_lib.course.undiscounting import extremal_costs
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
from tutorial_lib.tasks import Task

FALSE_POSITIVE, FALSE_NEGATIVE = "safe, but rejected", "unsafe, but accepted"
COLOURS = {FALSE_POSITIVE: REWARD, FALSE_NEGATIVE: COST}


@one_figure
def timelines(costs, gamma: float, limit: float, names=None):
    """Draws sequences of costs (n, T) in rows, and compares eq. 1 and eq. 2 for each of them.

    The left panel shows every unsafe step, and a step is paler where its weight is smaller. The right panel
    shows the cost in units of its limit L, and the discounted cost in units of its limit L~.
    """
    costs = np.atleast_2d(costs)
    count, horizon = costs.shape
    ratios = {
        "cost $C\\,/\\,L$": costs.sum(1) / limit,
        r"discounted cost $\tilde C\,/\,\tilde L$": discounted_sums(costs, [gamma])[:, 0]
        / average_threshold(limit, gamma, horizon),
    }
    figure, (steps, bars) = subplots(
        1, 2, figsize=(12, 1.6 + 0.95 * count), sharey=True, width_ratios=(3, 2), layout="constrained"
    )
    for row, sequence in enumerate(costs):
        _draw_steps(steps, row, sequence, gamma)
    for offset, (label, values), colour in zip((-0.18, 0.18), ratios.items(), (LIMIT, COST), strict=True):
        bars.barh(np.arange(count) + offset, values, 0.32, color=colour, label=label)
    bars.axvline(1, **DASHED, label="limit")
    bars.locator_params(axis="x", nbins=5)
    bars.set(xlabel="in units of the limit", xlim=(0, max(1.15, *map(np.max, ratios.values())) * 1.05))
    names = [f"{total:g} unsafe steps" for total in costs.sum(1)] if names is None else names
    steps.set_yticks(range(count), names)
    steps.set(xlabel="step", xlim=(-0.02 * horizon, 1.01 * horizon), ylim=(count - 0.5, -0.5))
    steps.spines["left"].set_visible(False)
    steps.tick_params(axis="y", length=0)
    legend_below(figure, bars)
    rows = zip(names, *ratios.values(), strict=True)
    words = "; ".join(f"{name}: cost {a:.2f}, discounted cost {b:.2f} of its limit" for name, a, b in rows)
    return described(figure, f"The unsafe steps of {count} episodes as coloured marks. {words}.")


def _draw_steps(ax, row: int, costs, gamma: float):
    """Draws one sequence as a grey band, with its unsafe steps coloured by their weight gamma^t."""
    horizon = len(costs)
    ax.barh(row, horizon, 0.62, color=NEUTRAL, alpha=0.15)
    unsafe = np.flatnonzero(costs)
    colours = [to_rgba(COST, 0.15 + 0.85 * gamma**t) for t in unsafe]
    ax.bar(unsafe + 0.5, 0.62, 1.0, row - 0.31, color=colours)


@one_figure
def falling_cost(gamma: float, start: int, horizon: int = 301, limit: float = 50, lengths=(40, 60)):
    """Draws two blocks of unsafe steps, one shorter and one longer than the limit, that begin at `start`.

    The upper panel shows the blocks and the weight gamma^t of a step. The lower panel shows their discounted
    cost for every start, in units of L~. The line is thick where the discounted cost misjudges the block.
    """
    time, mark = np.arange(horizon), average_threshold(limit, gamma, horizon)
    figure, (above, below) = subplots(2, 1, figsize=(12, 6), height_ratios=(2, 3), sharex=True)
    above.fill_between(time, gamma**time, color=NEUTRAL, alpha=0.25, label=r"weight of a step, $\gamma^t$")
    for length, colour, place in zip(lengths, (REWARD, COST), (0.3, 0.8), strict=True):
        begin = min(start, horizon - length)
        word = "safe" if length <= limit else "unsafe"
        above.barh(place, length, 0.3, begin, color=colour, alpha=0.9, label=f"{length} steps: {word}")
        starts = np.arange(horizon - length + 1)
        ratio = gamma**starts * (1 - gamma**length) / (1 - gamma) / mark
        wrong = (ratio > 1) == (length <= limit)
        below.plot(starts, ratio, color=colour, linewidth=1.5)
        kind = FALSE_POSITIVE if length <= limit else FALSE_NEGATIVE
        below.plot(starts, np.where(wrong, ratio, np.nan), color=colour, linewidth=6, label=kind)
        below.plot(begin, ratio[begin], "o", color=colour, markersize=13, markeredgecolor="white")
    below.axhline(1, **DASHED, label=r"limit $\tilde L$")
    above.set(
        ylim=(0, 1.05), yticks=(0, 1), title=f"$\\gamma$ = {gamma:g}, both blocks start at step {start}"
    )
    below.set(xlabel="step at which the block starts", ylabel=r"$\tilde C\,/\,\tilde L$", ylim=(0, None))
    below.set_xlim(0, horizon)
    legend_below(figure, above, below)
    text = (
        f"Two blocks of {lengths[0]} and {lengths[1]} unsafe steps and the weights of the steps for gamma ="
        f" {gamma:g}. Below, their discounted cost for every start: it falls as the block starts later."
    )
    return described(figure, text)


@one_figure
def mismatch(panels, ylabel: str = r"discounted cost $\tilde C$"):
    """Draws the paper's Fig. 1: a dot per sequence, at its cost and an estimate of its cost.

    Sequences that the estimate misjudges are coloured. `panels` maps a title to (costs (n,), estimates (n,),
    limit of the costs, limit of the estimates).
    """
    figure, axes = task_panels(panels, 4.6)
    for ax, (title, panel) in zip(axes.flat, panels.items(), strict=False):
        _draw_mismatch(ax, title, *panel)
    for ax in axes[:, 0]:
        ax.set_ylabel(ylabel)
    legend_below(figure, axes[0, 0])
    shares = [
        f"{title}: {misjudged(*panel).false_positives:.1%} safe but rejected, "
        f"{misjudged(*panel).false_negatives:.1%} unsafe but accepted"
        for title, panel in panels.items()
    ]
    return described(figure, f"A dot per sequence, at its cost and the estimate. {'; '.join(shares)}.")


def _draw_mismatch(ax, title, cost, estimate, limit, mark):
    shares = misjudged(cost, estimate, limit, mark)
    safe, accepted = cost <= limit, estimate <= mark
    dots = {"linestyle": "", "marker": "o", "markersize": 3, "markeredgewidth": 0, "alpha": 0.5}
    right = safe == accepted
    kinds = ((FALSE_POSITIVE, safe & ~accepted), (FALSE_NEGATIVE, ~safe & accepted))
    for kind, here in (("judged right", right), *kinds):
        colour = COLOURS.get(kind, NEUTRAL)
        ax.plot(cost[here], estimate[here], color=colour, **dots)
        ax.plot([], [], "o", color=colour, markersize=9, label=kind)  # This is a larger dot for the legend.
    ax.axvline(limit, **DASHED, label="limits")
    ax.axhline(mark, **DASHED)
    ax.set(xlabel="cost $C$", xlim=(0, None), ylim=(0, None))
    ax.set_title(f"{title}\n")
    words = ((FALSE_POSITIVE, shares.false_positives, 0.0), (FALSE_NEGATIVE, shares.false_negatives, 1.0))
    for kind, share, x in words:
        place = {"xy": (x, 1.02), "xycoords": "axes fraction", "ha": "left" if x == 0 else "right"}
        ax.annotate(f"{share:.1%}", **place, color=COLOURS[kind], fontweight="bold")


@one_figure
def misjudged_shares(counts):
    """Draws the shares of a dataset's episodes that eq. 2 misjudges, with one panel per task.

    `counts` maps a task to {limit: (false positives, false negatives)}, and both values are shares. Blue bars
    are false positives. Vermilion bars are false negatives.
    """
    figure, axes = task_panels(counts, 3.9, sharey=True)
    for ax, limits in zip(axes.flat, counts.values(), strict=False):
        x = np.arange(len(limits))
        positives, negatives = 100 * np.array(list(limits.values())).T
        ax.bar(x - 0.2, positives, 0.38, color=COLOURS[FALSE_POSITIVE], label=FALSE_POSITIVE)
        ax.bar(x + 0.2, negatives, 0.38, color=COLOURS[FALSE_NEGATIVE], label=FALSE_NEGATIVE)
        ax.set_xticks(x, [f"{limit:g}" for limit in limits])
        ax.set(xlabel="limit $L$")
    for ax in axes[:, 0]:
        ax.set_ylabel("% of the episodes")
    legend_below(figure, axes[0, 0])
    return described(figure, "Bars: the share of each task's episodes that eq. 2 misjudges, at each limit.")


@one_figure
def long_memory(gammas, shares, updates, marked=(), available: float = 400_000):
    """Draws the share of misjudged sequences and the updates of a critic over the horizon 1 / (1 - gamma).

    `shares` maps a name to the shares of sequences misjudged at each gamma (n,). `updates` (n,) holds the
    number of updates until a critic has settled. The gammas in `marked` are labelled. `available` is the
    number of updates in a run, and a dotted line shows it.
    """
    memory = 1 / (1 - np.asarray(gammas))
    figure, (left, right) = subplots(1, 2, figsize=(12, 4.6))
    for (name, values), style in zip(shares.items(), ("-", "--", ":"), strict=False):
        left.plot(memory, 100 * np.asarray(values), style, color=COST, label=f"misjudged: {name}")
    right.plot(memory, updates, color=LIMIT, label="updates until settled")
    right.axhline(available, color=NEUTRAL, linestyle=":", label=f"{available:,.0f} updates")
    for gamma in marked:
        at = 1 / (1 - gamma)
        right.plot(at, np.interp(at, memory, updates), "o", color=LIMIT, markersize=9)
        place = {"xytext": (-8, 6), "textcoords": "offset points", "ha": "right"}
        right.annotate(f"$\\gamma$ = {gamma:g}", (at, np.interp(at, memory, updates)), **place)
    left.set(
        xscale="log", xlabel=r"horizon $1 / (1 - \gamma)$ in steps", ylabel="% misjudged", ylim=(0, None)
    )
    right.set(xscale="log", yscale="log", xlabel=r"horizon $1 / (1 - \gamma)$ in steps", ylabel="updates")
    legend_below(figure, left, right)
    text = (
        "Left: the share of misjudged sequences falls to almost zero as the horizon 1 / (1 - gamma) grows."
        f" Right: the updates until a critic has settled grow with it, and pass {available:,.0f}."
    )
    return described(figure, text)


@one_figure
def two_steps(head: float, gamma: float):
    """Draws all pairs of costs in [0, 1] with the discounted sum `head`, as a line in the unit square.

    The two ends of the line have the least and the largest undiscounted sum. Grey lines join pairs with the
    same undiscounted sum.
    """
    least, most = extremal_costs([head], [gamma], 2)
    figure, ax = subplots(figsize=(8, 5.4))
    ax.fill([0, 1, 1, 0], [0, 0, 1, 1], color=NEUTRAL, alpha=0.12, label="costs between 0 and 1")
    ax.plot(*zip(least, most, strict=True), color=COST, linewidth=5, label=f"discounted sum {head:g}")
    for costs, word in ((least, "least"), (most, "largest")):
        total = costs.sum()
        ends = np.clip([total - 1, total], 0, 1)
        ax.plot(ends, total - ends, color=NEUTRAL, linestyle="--", linewidth=1.5)
        ax.plot(*costs, "o", color=LIMIT, markersize=12, clip_on=False, zorder=5)
        place = {"xytext": (12, 10), "textcoords": "offset points"}
        ax.annotate(f"{word} sum {total:.3g}", costs, **place)
    ax.plot([], [], color=NEUTRAL, linestyle="--", linewidth=1.5, label="same undiscounted sum")
    ax.set(xlabel="cost $c_0$", ylabel="cost $c_1$", xlim=(0, 1.25), ylim=(0, 1.15), aspect="equal")
    ax.set(xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
    legend_below(figure, ax)
    text = (
        f"The unit square of two costs. A line holds the pairs whose discounted sum is {head:g}. At its ends"
        f" the undiscounted sum is {least.sum():.3g} and {most.sum():.3g}."
    )
    return described(figure, text)


@one_figure
def extremal_sequences(task: Task, cost: float, known=((0,), (0, 2), (0, 1, 2))):
    """Draws the cheapest and the dearest sequence that share discounted sums with a steady cost.

    `cost` is the undiscounted sum of the steady cost, in unsafe steps. Each element of `known` lists the
    indices of the discount factors whose sums are known, and has two rows in the figure.
    """
    steady, gammas = np.full(task.horizon, cost / task.horizon), np.asarray(task.gammas)
    rows = [(f"steady: {cost:g}", steady, NEUTRAL)]
    for heads in map(list, known):
        sums = f"{len(heads)} sum" + "s" * (len(heads) > 1)
        found = extremal_costs(discounted_sums(steady, gammas[heads]), gammas[heads], task.horizon)
        for word, costs, colour in zip(("least", "most"), found, (REWARD, COST), strict=True):
            rows.append((f"{sums}, {word}: {costs.sum():.1f}", costs, colour))
    figure, ax = subplots(figsize=(12, 1.6 + 0.62 * len(rows)))
    for row, (_, costs, colour) in enumerate(rows):
        ax.barh(row, task.horizon, 0.7, color=NEUTRAL, alpha=0.12)
        ax.bar(np.arange(task.horizon) + 0.5, -0.7 * costs, 1.0, row + 0.35, color=colour)
    ax.set_yticks(range(len(rows)), [name for name, *_ in rows])
    ax.set(xlabel="step (the height of a bar is the cost of the step)", xlim=(0, task.horizon))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    words = "; ".join(name for name, *_ in rows)
    return described(
        figure, f"Cost sequences with equal discounted sums, on {task.name}. {words} unsafe steps."
    )
