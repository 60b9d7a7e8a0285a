"""The figures of the budget rule (eq. 23): the limits it gives the agent, and the distance to the optimum."""

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch

from tutorial_lib.course import tabular
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
)

_SHADES = ["#F4F8FB", "#D9E8F3", "#B5D3E7", "#7FB2D6", "#3F8BC0"]


@one_figure
def budget_maps(panels: dict, limits):
    """Draws the limit that the agent is given at each step and cost so far, with one panel per limit.

    A darker shade means a higher given limit. `panels` maps a title to a pair: the given limits (T, C), and
    the probabilities of the cost so far (T+1, C) or None. With probabilities, the panel also shows the median
    and the central 80% of the cost so far.
    """
    choices = np.unique(np.concatenate([told.ravel() for told, _ in panels.values()]))
    shades = np.linspace(0, len(_SHADES) - 1, len(choices)).round().astype(int)
    colours = ListedColormap([_SHADES[shade] for shade in shades])  # A higher limit is darker.
    norm = BoundaryNorm(np.arange(len(choices) + 1) - 0.5, len(choices))
    figure, axes = subplots(1, len(panels), figsize=(12, 4.8), sharey=True, squeeze=False)
    top = 1.25 * max(limits)
    for ax, (title, (told, chances)), limit in zip(axes[0], panels.items(), limits, strict=True):
        index = np.searchsorted(choices, told).T
        steps, sums = np.arange(told.shape[0] + 1) - 0.5, np.arange(told.shape[1] + 1) - 0.5
        ax.pcolormesh(steps, sums, index, cmap=colours, norm=norm)
        if chances is not None:
            _draw_spending(ax, chances)
        ax.axhline(limit, **DASHED, label="limit")
        ax.set(title=title, xlabel="step", xlim=(0, told.shape[0]), ylim=(-0.5, top))
        ax.set_xticks(range(0, told.shape[0], told.shape[0] // 4))
    axes[0, 0].set_ylabel("cost so far, unsafe steps")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    for n, choice in enumerate(choices):
        handles.append(Patch(facecolor=colours(n), edgecolor=NEUTRAL))
        labels.append("told ∞" if np.isinf(choice) else f"told {choice:g}")
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return described(
        figure,
        "The limit that the agent is told, as a shade, over the step and the cost so far. It is darker where "
        "less was spent for the step. " + "; ".join(panels),
    )


def _draw_spending(ax, chances):
    steps = np.arange(len(chances))
    below = chances.cumsum(1)
    low, middle, high = ((below < share).sum(1) for share in (0.1, 0.5, 0.9))
    ax.fill_between(steps, low, high, color=COST, alpha=0.35, linewidth=0, label="spent: 80% of episodes")
    ax.plot(steps, middle, color=COST, label="median")


@one_figure
def against_optimum(limits, curves: dict, thresholds=()):
    """Draws the expected return and the expected cost under each limit, and the share of episodes above it.

    `curves` maps a name to returns and costs, and for a third panel also to shares, each as long as `limits`.
    The first curve is the reference for the others, and it is a broad pale line. The `thresholds` are
    triangles at the bottom.
    """
    count = len(next(iter(curves.values())))
    figure, axes = subplots(1, count, figsize=(12, 4.8))
    looks: list[dict] = [dict(color=REWARD, alpha=0.35, linewidth=9), dict(color=NEUTRAL, linestyle=":"),
             dict(color=COST), dict(color="#009E73", linestyle="-.")]  # fmt: skip
    titles = ("expected return", "expected cost", "share above the limit")
    for (name, rows), look in zip(curves.items(), looks, strict=False):
        for ax, values in zip(axes, rows, strict=True):
            ax.plot(limits, values, label=name, **look)
    axes[1].plot(limits, limits, **DASHED, label="limit")
    for ax in axes[2:]:
        ax.set_ylim(bottom=0)
    for ax, title in zip(axes, titles, strict=False):
        ax.set(title=title, xlabel="limit")
        low, high = ax.get_ylim()
        marks = [low + 0.03 * (high - low)] * len(thresholds)
        if len(thresholds):
            ax.plot(thresholds, marks, "^", color=LIMIT, markersize=10, label="thresholds of the set")
        ax.set_ylim(low, high)
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return described(
        figure, f"{', '.join(titles[:count])} over the limit. The lines are: {'; '.join(curves)}."
    )


@one_figure
def with_and_without_rule(limits, agents: dict):
    """Draws the expected cost of each agent under each limit, without and with the budget rule.

    Without the rule the agent is given the limit once, at the start. With the rule it is given what is left
    of the limit at every step. `agents` maps a title to the costs without and with the rule, each as long as
    `limits`.
    """
    figure, axes = subplots(1, len(agents), figsize=(12, 4.4), sharey=True, squeeze=False)
    for ax, (title, (without, with_rule)) in zip(axes[0], agents.items(), strict=True):
        ax.plot(limits, limits, **DASHED, label="limit")
        ax.plot(limits, without, "o-", color=NEUTRAL, markersize=8, label="told once, at the start")
        ax.plot(limits, with_rule, "o-", color=COST, markersize=8, label="told at every step (eq. 23)")
        ax.set(title=title, xlabel="limit")
    axes[0, 0].set_ylabel("expected cost")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return described(
        figure,
        "Expected cost over the limit, without and with the budget rule. Without it the cost is a staircase; "
        "with it the cost follows the dashed limit in the middle and is flat at the ends. "
        f"Panels: {'; '.join(agents)}.",
    )


@one_figure
def best_moves(panels: dict, rates):
    """Draws the best move at one state per panel, over the step and what is left of the budget.

    `panels` maps a title to indices of moves, (T, B), which `tabular.ARROWS` names. A dotted line joins the
    places at which eq. 23 gives the same limit, for each of `rates` (in unsafe steps per episode).
    """
    found = np.unique(np.stack(list(panels.values())))
    colours = ListedColormap([_SHADES[1], "#E9A77C", _SHADES[4], "#C9C9C9"][: len(found)])
    norm = BoundaryNorm(np.arange(len(found) + 1) - 0.5, max(2, len(found)))
    figure, axes = subplots(1, len(panels), figsize=(12, 5), sharey=True, squeeze=False)
    for ax, (title, moves) in zip(axes[0], panels.items(), strict=True):
        horizon, budgets = moves.shape
        corners = [np.arange(size + 1) - 0.5 for size in moves.shape]
        ax.pcolormesh(*corners, np.searchsorted(found, moves).T, cmap=colours, norm=norm)
        for n, rate in enumerate(rates):
            label = "" if n else "eq. 23 says the same limit"
            ax.plot([0, horizon], [rate, 0], color=LIMIT, linewidth=2, linestyle=":", label=label)
        ax.set(title=title, xlabel="step", xlim=(-0.5, horizon), ylim=(-0.5, budgets - 0.5))
    axes[0, 0].set(ylabel="left of the budget, unsafe steps")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    handles += [Patch(facecolor=colours(n), edgecolor=NEUTRAL) for n in range(len(found))]
    labels += [f"best move {tabular.ARROWS[move]}" for move in found]
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return described(
        figure,
        "The best move, as a colour, over the step and what is left of the budget. Dotted lines join places "
        f"with one told limit; they meet at the last step. Panels: {'; '.join(panels)}.",
    )


@one_figure
def recorded_budgets(panels: dict):
    """Draws eq. 23 along recorded episodes, each with its own cost as its limit.

    `panels` maps a title to rescaled budgets divided by the limit, (episodes, T). A panel shows the median
    and the central 80% of the episodes.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 4.6), sharey=True, squeeze=False)
    for ax, (title, shares) in zip(axes[0], panels.items(), strict=True):
        low, middle, high = np.quantile(shares, (0.1, 0.5, 0.9), axis=0)
        steps = np.arange(len(middle))
        ax.fill_between(steps, low, high, color=COST, alpha=0.3, linewidth=0, label="80% of episodes")
        ax.plot(steps, middle, color=COST, label="median")
        ax.axhline(1, **DASHED, label="cost at a steady rate")
        ax.set(title=title, xlabel="step", ylim=(0, 3))
    axes[0, 0].set_ylabel("told limit / the episode's cost")
    legend_below(figure, axes[0, 0])
    return described(
        figure,
        "What eq. 23 would say along recorded episodes whose limit is their own cost, divided by this cost, "
        f"over the step. A steady cost would stay at 1. Panels: {', '.join(panels)}.",
    )
