"""The figures of the shortcut: its ways, its frontier, the price of its limit, and the costs of episodes."""

import functools

import numpy as np
from matplotlib.patches import Rectangle

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

_STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))  # These are up, right, down and left in the plot.
_WAYS = {"straight on": ("→→→→", 0.14), "over": ("↑→→→→↓", 0.0), "around": ("↑↑→→→→↓↓", -0.14)}


def _places(layout):
    """Returns the centre of each cell in plot coordinates, (S, 2). The first row is at the top."""
    rows, columns = len(layout), len(layout[0])
    return np.array([(c, rows - 1 - r) for r in range(rows) for c in range(columns)], float)


def _draw_grid(ax, shade=None, layout=tabular.SHORTCUT):
    """Draws the cells of the grid, shaded by values in [0, 1].

    Hazards have a hatched frame. The letters S and G mark the start and the goal.
    """
    shade = np.zeros(len(layout) * len(layout[0])) if shade is None else np.clip(shade, 0, 1)
    for kind, (x, y), dark in zip("".join(layout), _places(layout), shade, strict=True):
        ax.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, color=str(1 - 0.45 * dark), linewidth=0))
        if kind == "h":
            frame = Rectangle((x - 0.46, y - 0.46), 0.92, 0.92, fill=False, edgecolor=COST, linewidth=2)
            frame.set(hatch="//", alpha=0.55)
            ax.add_patch(frame)
        elif kind != " ":
            ax.text(x - 0.44, y + 0.42, kind, ha="left", va="top", fontsize=17, fontweight="bold")
    rows, columns = len(layout), len(layout[0])
    lines = {"color": NEUTRAL, "linewidth": 0.8, "zorder": 1.5}
    ax.hlines(np.arange(rows + 1) - 0.5, -0.5, columns - 0.5, **lines)
    ax.vlines(np.arange(columns + 1) - 0.5, -0.5, rows - 0.5, **lines)
    ax.set(xlim=(-0.55, columns - 0.45), ylim=(-0.55, rows - 0.45), xticks=[], yticks=[], aspect="equal")
    ax.spines[:].set_visible(False)


def _draw_policy(ax, policy, shown, layout=tabular.SHORTCUT):
    """Draws an arrow for each action in the cells that are `shown`.

    The length of an arrow grows with the probability of its action. Actions with a probability of at most
    0.02 get no arrow.
    """
    for state, (x, y) in enumerate(_places(layout)):
        if not shown[state] or "".join(layout)[state] == "G":
            continue
        for chance, (dx, dy) in zip(policy[state], _STEPS, strict=True):
            if chance > 0.02:
                reach = 0.1 + 0.34 * chance
                arrow = {"arrowstyle": "-|>", "color": LIMIT, "linewidth": 2.2, "mutation_scale": 15}
                arrow |= {"shrinkA": 0, "shrinkB": 0}
                ax.annotate("", (x + reach * dx, y + reach * dy), (x, y), arrowprops=arrow, zorder=4)


@one_figure
def shortcut_map():
    """Draws the shortcut grid with its three ways, and names the steps and the hazards of each way."""
    figure, ax = subplots(figsize=(9, 4.6))
    _draw_grid(ax)
    places = _places(tabular.SHORTCUT)
    for (name, (way, shift)), colour in zip(_WAYS.items(), (COST, LIMIT, REWARD), strict=True):
        moves = np.array([_STEPS[tabular.ARROWS.index(arrow)] for arrow in way])
        corners = places[10] + np.vstack([[0, 0], np.cumsum(moves, axis=0)])
        on_hazard = sum("".join(tabular.SHORTCUT)[_cell(corner)] == "h" for corner in corners)
        x, y = (corners + (shift, 0)).T if len(way) > 4 else corners.T
        label = f"{name}: {len(way)} steps, {on_hazard} on hazards"
        ax.plot(x, y, color=colour, linewidth=4, alpha=0.85, label=label, zorder=3)
    legend_below(figure, ax)
    return described(
        figure,
        "A grid of three rows and five columns. The start S is at the lower left, the goal G at the lower "
        "right. "
        "The three cells between them are hazards, and so is the middle cell of the middle row. "
        + ". ".join(line.get_label() for line in ax.lines),
    )


def _cell(place):
    return int((len(tabular.SHORTCUT) - 1 - place[1]) * len(tabular.SHORTCUT[0]) + place[0])


@one_figure
def shortcut_under_limit(limit: float):
    """Draws the shortcut's Pareto frontier and the best policy under the limit.

    The left panel marks the limit on the frontier. The right panel shows the policy, and cells are darker
    where it goes more often.
    """
    cost, reward = _frontier()
    figure, (left, right) = subplots(1, 2, figsize=(12, 4.6), width_ratios=(5, 6))
    left.plot(cost, reward, color=REWARD, label="the best reward under each limit")
    left.axvspan(-1, cost[0], color=COST, alpha=0.3, linewidth=0, label="no policy keeps this limit")
    left.axvline(limit, **DASHED, label="limit")
    left.set(xlim=(-0.1, 2.8), ylim=(0, 7), xlabel="limit on the discounted cost")
    left.set(ylabel="discounted reward")
    try:
        found = tabular.solve(tabular.shortcut(), limit)
    except ValueError:
        _draw_grid(right)
        left.set_title(f"limit {limit:g}: no policy keeps it")
        right.set_title(f"the most timid one costs {cost[0]:.3f}")
    else:
        visits = found.occupancy.sum(1)
        left.plot(found.cost, found.reward, "o", color=REWARD, markersize=12, zorder=4)
        left.set_title(f"limit {limit:g}: reward {found.reward:.2f}, cost {found.cost:.2f}")
        _draw_grid(right, visits)
        _draw_policy(right, found.policy, visits > 0.02)
        right.set_title("the best policy; dark: where it goes")
    legend_below(figure, left)
    return figure


@one_figure
def mixed_ways(ways: dict, limit: float, mix):
    """Draws ways as dots at their cost and reward, and the mix of them that is best under the limit.

    `ways` maps a name to (cost, reward). `mix` is the (cost, reward) of the best mix. A line joins the ways
    in the order of their costs: its points are the mixes of two neighbours.
    """
    figure, ax = subplots(figsize=(8, 5))
    corners = np.array(sorted(ways.values()))
    ax.plot(*corners.T, color=NEUTRAL, linewidth=2, label="mixes of two neighbours")
    for name, (cost, reward) in ways.items():
        ax.plot(cost, reward, "o", color=REWARD, markersize=11, zorder=3)
        ax.annotate(name, (cost, reward), textcoords="offset points", xytext=(-10, 8), ha="right")
    ax.plot(*mix, "D", color=COST, markersize=12, zorder=4, label="the best mix that keeps the limit")
    ax.axvline(limit, **DASHED, label="limit")
    ax.set(xlabel="discounted cost", ylabel="discounted reward", title=f"limit {limit:g}")
    ax.margins(0.25, 0.14)
    legend_below(figure, ax)
    names = ", ".join(f"{name} at ({cost:.2f}, {reward:.2f})" for name, (cost, reward) in ways.items())
    return described(
        figure,
        f"Cost and reward of the ways: {names}. The best mix under the limit {limit:g} lies on the line "
        f"between two of them, at ({mix[0]:.2f}, {mix[1]:.2f}).",
    )


@one_figure
def price_of_limit(limit: float, price: float):
    """Draws a price on the shortcut: as a slope at the frontier, and on the curve g(price).

    The left panel has the policies that are best where a unit of cost costs `price`, at which a line with
    this slope touches the frontier. The right panel has g(price) = max over policies of
    R - price (C - limit), whose lowest point is the best reward under the limit.
    """
    cost, reward = _frontier()
    prices, bounds = _dual_curve(limit)
    h = _priced(price)
    figure, (left, right) = subplots(1, 2, figsize=(12, 5))
    left.plot(cost, reward, color=REWARD, label="the best reward under each limit")
    left.plot([0, 2.8], [h, h + price * 2.8], color=COST, linewidth=2, label="slope: the price")
    left.axvline(limit, **DASHED, label="limit")
    at_limit = h + price * limit
    left.plot(limit, at_limit, "D", color=COST, markersize=11, zorder=4, label="g(price)")
    left.set(xlim=(-0.1, 2.8), ylim=(3.5, 7), xlabel="limit on the discounted cost")
    left.set(ylabel="discounted reward", title=f"price {price:.2f}")
    right.plot(prices, bounds, color=NEUTRAL, label="g(price)")
    right.plot(price, at_limit, "D", color=COST, markersize=11, zorder=4)
    best = tabular.solve(tabular.shortcut(), limit).reward
    right.axhline(best, color=REWARD, linewidth=1.5, label="best reward under the limit")
    right.set(xlabel="price of a unit of cost", title=f"g({price:.2f}) = {at_limit:.2f}, best {best:.2f}")
    right.set(ylim=(best - 0.4, best + 1.6))
    legend_below(figure, left, right)
    return described(
        figure,
        f"Left: the frontier, and a line of slope {price:.2f} that touches it and meets the limit {limit:g} "
        f"at {at_limit:.2f}. Right: g(price), which is lowest where it equals the best reward {best:.2f}.",
    )


@functools.cache
def _priced(price: float) -> float:
    """Returns the largest R - price * C on the shortcut."""
    found = tabular.solve_priced(tabular.shortcut(), price)
    return found.reward - price * found.cost


@functools.cache
def _dual_curve(limit: float):
    """Returns prices from 0 to 2 with the best one among them, and g at each of them."""
    best = tabular.solve(tabular.shortcut(), limit).price
    prices = np.sort(np.append(np.linspace(0, 2, 41), min(best, 2)))
    return prices, np.array([_priced(price) + price * limit for price in prices.tolist()])


@functools.cache
def _frontier():
    cmdp = tabular.shortcut()
    least, most = tabular.least_cost(cmdp), tabular.solve(cmdp).cost
    limits = np.append(np.linspace(least + 1e-9, most, 60), 5.0)
    return limits, np.array([tabular.solve(cmdp, limit).reward for limit in limits])


@one_figure
def episode_costs(panels: dict, limit: float):
    """Draws the share of episodes at each cost, in one panel per title.

    The dashed line is the limit, and the diamond is the mean cost.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 4.2), sharex=True, sharey=True, squeeze=False)
    # The quantile cuts the empty tail.
    top = int(max(np.ceil(np.quantile(costs, 0.998)) for costs in panels.values()))
    length = int(max(np.max(costs) for costs in panels.values())) + 1
    for ax, (title, costs) in zip(axes[0], panels.items(), strict=True):
        share = np.bincount(np.asarray(costs, int), minlength=length) / len(costs)
        above = np.arange(length) > limit
        for where, colour, words in ((~above, NEUTRAL, "kept the limit"), (above, COST, "did not")):
            ax.bar(np.flatnonzero(where), share[where], color=colour, label=f"episodes that {words}")
        ax.axvline(limit, **DASHED, label="limit")
        ax.plot(np.mean(costs), 0.03, "D", color=REWARD, markersize=11, label="mean cost", zorder=4)
        ax.set(title=title, xlabel="cost of the episode", xlim=(-0.7, top + 0.7), xticks=range(top + 1))
    axes[0, 0].set_ylabel("share of episodes")
    legend_below(figure, *axes[0])
    return figure
