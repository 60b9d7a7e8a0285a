"""The figures of the CMDP: the tasks, whole episodes and the shortcut grid."""

import functools

import numpy as np
from matplotlib.patches import Circle, Rectangle

from tutorial_lib.course import tabular
from tutorial_lib.course.figures.episodes import _draw_path
from tutorial_lib.playing import Rollout
from tutorial_lib.style import COST, DASHED, LIMIT, NEUTRAL, REWARD, legend_below, one_figure, subplots
from tutorial_lib.tasks import TASKS, Task, make_env, scene_of

# --- The tasks ---


@one_figure
def all_tasks(seed: int = 0, size=(320, 240), family: str = "bullet"):
    """Draws the first camera image of every task of a family, with a row per scene and a column per robot.

    Where the camera of the scene is far away, a ring marks the robot. Tasks without a scene are left out. The
    function raises ValueError if no task is left.
    """
    shown = [task for task in TASKS.values() if task.family == family and task.scene is not None]
    if not shown:
        raise ValueError(f"no task of the family {family!r} has a scene")
    tasks = {(scene_of(task), task.robot): task for task in shown}
    scenes, robots = (list(dict.fromkeys(part)) for part in zip(*tasks, strict=True))
    shape, figsize = (len(scenes), len(robots)), (3 * len(robots), 2.45 * len(scenes))
    figure, axes = subplots(*shape, figsize=figsize, squeeze=False)
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    for (scene, robot), task in tasks.items():
        ax = axes[scenes.index(scene), robots.index(robot)]
        env = make_env(task, render_mode="rgb_array", image_size=size)
        env.reset(seed=seed)
        ax.imshow(env.render())
        if scene.is_seen_from_afar:
            ax.add_patch(Circle(env.pixel, 20, fill=False, color="white", linewidth=2))
        env.close()
    for ax, robot in zip(axes[0], robots, strict=True):
        ax.set_title(robot)
    for ax, scene in zip(axes[:, 0], scenes, strict=True):
        ax.set_ylabel(scene.name, fontsize=15)
    return figure


@one_figure
def drives(task: Task, episodes: dict):
    """Draws whole episodes from above, with the cost zone, in one panel per title.

    `episodes` maps a title to an episode with rewards (T,), costs (T,) and positions (T, 2). The task's scene
    sets the layout of the panels.
    """
    scene = scene_of(task)
    shape, size = scene.layout(len(episodes))
    figure, axes = subplots(*shape, figsize=size, sharex=True, sharey=True, squeeze=False)
    for ax, (title, drive) in zip(axes.flat, episodes.items(), strict=True):
        zeros, length = np.zeros(len(drive.costs)), np.array([len(drive.costs)])
        one = Rollout(drive.rewards[:, None], drive.costs[:, None], zeros[:, None], drive.positions[:, None],
                      length, zeros[:1])  # fmt: skip
        _draw_path(ax, one, 0, task)
        summary = f"cost {np.sum(drive.costs):.0f}, return {np.sum(drive.rewards):.0f}"
        ax.set_title(f"{title}: {summary}" if scene.is_wide else f"{title}\n{summary}")
        ax.label_outer()
    legend_below(figure, *axes.flat)
    return figure


@one_figure
def trade_off(costs, returns, labels, words: str):
    """Draws one labelled dot per way of driving, at its cost and its return.

    A line joins the dots in the order in which they are given.
    """
    figure, ax = subplots(figsize=(9, 4.6))
    ax.plot(costs, returns, "o-", color=NEUTRAL, markersize=9, linewidth=1.5, markerfacecolor=REWARD)
    falls = np.append(np.diff(returns) < 0, False)
    falls[-1] = falls[-2]  # A label is above its dot where the line falls, and otherwise below it.
    for x, y, label, above in zip(costs, returns, labels, falls, strict=True):
        ax.annotate(f"{label}", (x, y), textcoords="offset points", xytext=(8, 6 if above else -14))
    ax.set(xlabel="cost of the episode", ylabel="return of the episode", title=words)
    ax.margins(0.14, 0.12)
    return figure


# --- The shortcut ---

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
    return figure


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
