"""The figures of the notions of safety: the aisle, the multiplier of a limit, and the map of all answers."""

import functools

import numpy as np
from matplotlib.patches import Circle

from tutorial_lib.course.tabular import safety as notions
from tutorial_lib.course.tabular import solve_episodes
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

SLOW, FAST = "#009E73", "#CC79A7"
HORIZON = 20
"""The steps of an episode in the aisle."""
HIGHEST = 9
"""The last bar of a distribution has the episodes of this cost and of all higher ones."""
_PLACES = {"free": (0.0, 0.0), "people": (3.4, 1.7), "close": (3.4, -1.7), "contact": (6.8, 0.0)}
_RADIUS = 0.62
# Each arrow: from, to, colour, the words, the bend of the arrow and the place of the words.
_ARROWS = (
    ("free", "people", SLOW, "1/4", -0.25, (1.25, 1.5)),
    ("free", "close", FAST, "1/4", 0.25, (1.25, -1.5)),
    ("people", "free", NEUTRAL, "1/2, either", -0.12, (2.3, 0.33)),
    ("people", "contact", FAST, "1/2", -0.2, (5.5, 1.45)),
    ("close", "people", SLOW, "3/4", 0.0, (3.75, 0.75)),
    ("close", "contact", SLOW, "1/4", -0.1, (4.65, -0.45)),
    ("close", "contact", FAST, "1/2", 0.25, (5.75, -1.4)),
    ("close", "free", FAST, "1/2", 0.1, (2.3, -0.55)),
)


@one_figure
def aisle_map():
    """Draws the states of the aisle, what a step earns there, and the moves with their probabilities."""
    figure, ax = subplots(figsize=(11, 5.6))
    words = {"free": "free\n+1 | +2", "people": "people\n0 | +2", "close": "close\n0 | +2"}
    words["contact"] = "contact\ncost 1"
    for start, end, colour, chance, bend, place in _ARROWS:
        look = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.4, "mutation_scale": 18}
        look |= {"connectionstyle": f"arc3,rad={bend}", "shrinkA": 43, "shrinkB": 43}
        ax.annotate("", _PLACES[end], _PLACES[start], arrowprops=look)
        ax.text(*place, chance, color="black" if colour == NEUTRAL else colour, ha="center", va="center")
    for name, place in _PLACES.items():
        edge = COST if name == "contact" else NEUTRAL
        ax.add_patch(Circle(place, _RADIUS, facecolor="white", edgecolor=edge, linewidth=2.5, zorder=3))
        ax.text(*place, words[name], ha="center", va="center", zorder=4, linespacing=1.3)
    notes = ((-0.75, 0.95, "stays: 3/4, either"), (3.4, 2.55, "waits: slow 1/2"), (7.2, 0.95, "lasts: 1/2"))
    for x, y, note in notes:
        ax.text(x, y, note, ha="center", va="center", color="black", fontsize=13)
    ax.plot([], [], color=SLOW, label="slow")
    ax.plot([], [], color=FAST, label="fast")
    ax.plot([], [], color=NEUTRAL, label="slow or fast")
    ax.set(xlim=(-1.9, 8.4), ylim=(-2.6, 2.9), aspect="equal")
    ax.set_axis_off()
    ax.text(6.8, -2.3, "contact leads to free with 1/2", ha="center", fontsize=13)
    legend_below(figure, ax)
    return described(
        figure,
        "Four states of a robot: free, people, close and contact. A free aisle earns 1 slow and 2 fast. "
        "Slow, people come into view with probability 1/4; fast, they are close. A fast step past people "
        "ends in contact with probability 1/2. From close, a slow step ends in contact with 1/4, a fast one "
        "with 1/2. A step in contact costs 1, and a contact lasts on with probability 1/2.",
    )


@one_figure
def multiplier_paths(paths: dict, limit: float, price: float):
    """Draws the expected cost and the multiplier over the updates, with a line for each way to update.

    `paths` maps a name to an array (updates, 2) of expected cost and multiplier. The dashed lines are the
    limit and `price`, the multiplier of the linear programme.
    """
    figure, axes = subplots(2, len(paths), figsize=(12, 6.4), sharex=True, sharey="row", squeeze=False)
    for (top, bottom), (name, path) in zip(axes.T, paths.items(), strict=True):
        top.plot(path[:, 0], color=COST, linewidth=1.6)
        top.axhline(limit, **DASHED)
        bottom.plot(path[:, 1], color=REWARD, linewidth=1.6)
        bottom.axhline(price, **DASHED)
        top.set(title=name)
        bottom.set(xlabel="update")
    axes[0, 0].set(ylabel="expected cost")
    axes[1, 0].set(ylabel="multiplier")
    ends = [f"{name}: the last cost is {path[-1, 0]:.2f}" for name, path in paths.items()]
    return described(
        figure,
        f"Expected cost (limit {limit:g}) and multiplier (of the linear programme: {price:.2f}) over the "
        f"updates. {'; '.join(ends)}.",
    )


@one_figure
def safety_map(limit: int):
    """Draws the answer of every notion of safety in the aisle under a limit on the cost of an episode.

    Left: the expected return over the expected cost, with the frontier of all policies. Right: the
    probabilities of the costs of an episode, with a row for each notion. The numbers join the two.
    """
    found = aisle_answers(limit)
    figure, (left, right) = subplots(1, 2, figsize=(12.5, 7), width_ratios=(6, 7))
    left.plot(*_frontier(), color=REWARD, label="the best return at each expected cost")
    left.axvline(limit, **DASHED, label="limit")
    together: dict = {}
    for number, one in enumerate(found.values(), 1):
        together.setdefault((round(one.cost, 2), round(one.reward, 1)), []).append(str(number))
    for (cost, reward), numbers in together.items():
        left.plot(cost, reward, "o", color=REWARD, markersize=9)
        words = ", ".join(numbers)
        left.annotate(words, (cost, reward), (9, -15), textcoords="offset points", fontweight="bold")
    left.set(xlim=(-0.1, 3.4), ylim=(14, 36), xlabel="expected cost, contacts", ylabel="expected return")
    _draw_rows(right, found, limit)
    figure.suptitle(f"limit {limit}", fontsize=16)
    legend_below(figure, left, right)
    told = [
        f"{n} {name}: return {one.reward:.1f}, cost {one.cost:.2f}, {one.exceeds(limit):.0%} above"
        for n, (name, one) in enumerate(found.items(), 1)
    ]
    return described(figure, f"Answers under the limit {limit}, with the share above it. {'; '.join(told)}.")


def _draw_rows(ax, found: dict, limit: int) -> None:
    """Draws the distribution of the cost for each answer, one row below the other."""
    costs = np.arange(HIGHEST + 1)
    for row, (name, one) in enumerate(found.items()):
        chances = one.chances[-1]
        shown = np.append(chances[:HIGHEST], chances[HIGHEST:].sum())
        base, above = -float(row), costs > limit
        for where, colour, words in ((~above, NEUTRAL, "keeps the limit"), (above, COST, "is above it")):
            label = words if row == 0 else None
            ax.bar(costs[where], 0.85 * shown[where], bottom=base, color=colour, label=label)
        text = f"{row + 1} {name}: {one.exceeds(limit):.0%} above"
        ax.text(HIGHEST + 0.5, base + 0.42, text, ha="right", va="bottom", fontsize=13)
        ax.axhline(base, color=NEUTRAL, linewidth=0.8)
    ax.axvline(limit + 0.5, **DASHED)
    ax.set(xlim=(-0.6, HIGHEST + 0.6), ylim=(0.1 - len(found) + 0.75, 0.8), yticks=[])
    ax.set_xticks(costs, [*map(str, costs[:-1]), f"{HIGHEST}+"])
    ax.set(xlabel="cost of an episode, contacts", title="how probable each cost is")
    ax.spines["left"].set_visible(False)


@functools.cache
def aisle_answers(limit: int) -> dict:
    """Returns `safety.answers` for the aisle, computed once for each limit."""
    return notions.answers(notions.aisle(), HORIZON, limit)


@functools.cache
def _frontier():
    """Returns expected costs and the best expected return at each of them."""
    world = notions.aisle()
    limits = np.append(np.linspace(0, 2.9, 30), 2.9444)
    return limits, np.array([solve_episodes(world, HORIZON, limit).reward for limit in limits])


@one_figure
def episodes_of_two(panels: dict, limit: float):
    """Draws the costs of the episodes of each policy as sorted bars. Those above the limit are vermilion.

    `panels` maps a name to costs (n,). The diamond at the left is their mean.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 4.2), sharey=True, squeeze=False)
    for ax, (name, costs) in zip(axes[0], panels.items(), strict=True):
        costs, order = np.sort(costs), np.arange(len(costs))
        above = costs > limit
        heights = np.maximum(costs, 0.05)  # so that an episode without any cost can be seen
        ax.bar(order[~above], heights[~above], color=NEUTRAL, label="keeps the limit")
        ax.bar(order[above], heights[above], color=COST, label="is above it")
        ax.axhline(limit, **DASHED, label="limit")
        ax.plot(-1.2, costs.mean(), "D", color=REWARD, markersize=10, label="mean")
        ax.set(title=name, xlabel="episodes, sorted by their cost", xticks=[])
    axes[0, 0].set_ylabel("cost of the episode")
    legend_below(figure, *axes[0])
    words = "; ".join(f"{name}: mean {np.mean(c):g}, highest {np.max(c):g}" for name, c in panels.items())
    return described(figure, f"Sorted costs of episodes, with the limit {limit:g}. {words}.")
