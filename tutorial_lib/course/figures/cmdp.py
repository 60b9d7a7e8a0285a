"""The figures of the tasks: their pictures, what the Circle pays for, and episodes driven by hand."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

from tutorial_lib.course.figures.episodes import _draw_path
from tutorial_lib.playing import Rollout
from tutorial_lib.style import (
    COST,
    LIMIT,
    NEUTRAL,
    REWARD,
    described,
    legend_below,
    one_figure,
    subplots,
)
from tutorial_lib.tasks import TASKS, Task, get_task, make_env, scene_of


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
    named = ", ".join(task.name for task in tasks.values())
    return described(figure, f"One camera image of each task at the start of an episode: {named}.")


@one_figure
def drives(task: Task, episodes: dict):
    """Draws whole episodes from above, with the cost zone, in one panel per title.

    `episodes` maps a title to an episode with rewards (T,), costs (T,) and positions (T, 2). The task's scene
    sets the layout of the panels.
    """
    scene = scene_of(task)
    shape, size = scene.layout(len(episodes))
    plt.rcParams["figure.constrained_layout.h_pad"] = 0.12  # panels with equal axes would touch the legend
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


@one_figure
def circle_reward():
    """Draws what the Circle's reward is made of: the distance d, and the two parts of the velocity."""
    figure, ax = subplots(figsize=(7.5, 6.5))
    scene = scene_of(get_task("BallCircle"))
    scene.draw(ax, np.zeros((1, 2)))
    place, along, outward = np.array([4.0, 4.6]), 3.6, 1.4
    out = place / np.linalg.norm(place)
    clockwise = np.array([out[1], -out[0]])
    ax.plot([0, place[0]], [0, place[1]], color=NEUTRAL, linewidth=2)
    ax.text(*(place / 2 + (-0.35, 0.35)), "$d$", fontsize=22, ha="right")
    arrows = {
        "the paid part, $v$": (along * clockwise, REWARD),
        "the other part": (outward * out, NEUTRAL),
        "velocity": (along * clockwise + outward * out, LIMIT),
    }
    for label, (way, colour) in arrows.items():
        end = {"arrowstyle": "-|>", "color": colour, "linewidth": 3, "mutation_scale": 20, "shrinkA": 0}
        ax.annotate("", place + way, place, arrowprops=end | {"shrinkB": 0}, zorder=4)
        ax.plot([], [], color=colour, linewidth=3, label=label)
    ax.plot(*place, "o", color=LIMIT, markersize=12, zorder=5)
    ax.text(7.5, -8.4, "cost 1", color=COST, fontsize=17, ha="center")
    ax.text(-7.5, -8.4, "cost 1", color=COST, fontsize=17, ha="center")
    legend_below(figure, ax)
    return described(
        figure,
        "A ball at distance d from the middle of the circle. Its velocity has a part along the circle, "
        "clockwise, which is paid, and a part outwards, which is not. "
        "Beyond x = 6 and x = -6 a step costs 1.",
    )
