"""The figures of single episodes: camera images, the path from above, and the cost at each step."""

import matplotlib.pyplot as plt
import numpy as np

from tutorial_lib.costs.conditioning import INFINITE_CODE, rescaled_budget
from tutorial_lib.playing import Rollout, rollout
from tutorial_lib.style import (
    COST,
    DASHED,
    LIMIT,
    NEUTRAL,
    REWARD,
    Picture,
    described,
    legend_below,
    one_figure,
    subplots,
)
from tutorial_lib.tasks import Task, make_env, scene_of

# --- The robot ---


def film(agent, limit: float, seed: int, steps, image_size=(360, 270), run: int = 0):
    """Returns camera images of one episode under `limit`, and the cost so far, at each of `steps`.

    The images are uint8 (frames, height, width, 3), and the costs are (frames,). The simulator draws a red
    sphere around the robot if its last step was unsafe.
    """
    env = make_env(agent.task, render_mode="rgb_array", image_size=image_size)
    player = agent.player([limit], [seed], run)
    observation, _ = env.reset(seed=seed)
    frames, costs, spent = [], [], 0.0
    for t in range(max(steps) + 1):
        if t in steps:
            frames.append(env.render())
            costs.append(spent)
        observation, reward, terminated, _, info = env.step(player.act(observation[None])[0])
        player.see(np.array([reward]), np.array([info["cost"]]))
        spent += info["cost"]
        if terminated:
            break
    env.close()
    return np.stack(frames), np.array(costs)


def multiple_exposure(frames: np.ndarray) -> np.ndarray:
    """Returns one image that combines the frames of a fixed camera.

    The background is the median of the frames. Moving parts appear once per frame, and they are paler in
    older frames.
    """
    scene = np.median(frames, axis=0)
    picture = scene.copy()
    for frame, strength in zip(frames, np.linspace(0.45, 1.0, len(frames)), strict=True):
        moved = np.abs(frame - scene).sum(-1) > 60
        picture[moved] += strength * (frame[moved] - picture[moved])
    return picture.astype(np.uint8)


@one_figure
def robot_at_limits(agent, limits=None, seed: int = 10):
    """Draws one episode per limit from the same start, with the robot at several steps in one image.

    The default limits are the task's thresholds.
    """
    task = agent.task
    limits = task.thresholds if limits is None else limits
    steps = range(task.horizon // 3, task.horizon // 3 + 36, 3)  # This is about one lap of a Ball or a Car.
    played = rollout(agent, limits, [seed] * len(limits))
    figure, axes = subplots(1, len(limits), figsize=(3.6 * len(limits), 3.5), squeeze=False)
    for e, (ax, limit) in enumerate(zip(axes[0], limits, strict=True)):
        frames, _ = film(agent, limit, seed, steps)
        ax.imshow(multiple_exposure(frames))
        ax.set_title(f"at most {limit:g} unsafe steps")
        ax.set_xlabel(_summary(played, e, "took {cost:.0f}, return {total:.0f}"))
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    words = "; ".join(f"{ax.get_title()}: {ax.get_xlabel()}" for ax in axes[0])
    return described(
        figure,
        f"{task.name}: the robot at several steps of an episode, in one image for each limit. {words}.",
    )


@one_figure
def frames_strip(frames, costs, steps, limit: float):
    """Draws frames of an episode side by side, each with its step and the cost so far."""
    figure, axes = subplots(1, len(frames), figsize=(12, 12 / len(frames)), squeeze=False)
    for ax, frame, cost, step in zip(axes[0], frames, costs, steps, strict=True):
        ax.imshow(frame)
        ax.set(xticks=[], yticks=[], title=f"step {step}")
        ax.set_xlabel(f"cost {cost:.0f} of {limit:g}", color=COST)
        ax.spines[:].set_visible(False)
    return figure


# --- Limits ---


@one_figure
def limits_kept(limits, costs):
    """Draws the cost of every episode, and their mean, beside the limit under which they were played.

    `limits` are (n,) and `costs` (n, episodes). Both are unsafe steps per episode.
    """
    limits, costs = np.asarray(limits, float), np.asarray(costs, float)
    figure, ax = subplots(figsize=(9, 5))
    spread = np.linspace(-0.18, 0.18, costs.shape[1])
    for x, (limit, paid) in enumerate(zip(limits, costs, strict=True)):
        ax.hlines(limit, x - 0.32, x + 0.32, **DASHED, label="limit")
        for above, colour, words in ((False, NEUTRAL, "kept the limit"), (True, COST, "cost more")):
            here = (paid > limit) == above
            label = f"episode that {words}"
            ax.plot(x + spread[here], paid[here], "o", color=colour, markersize=7, alpha=0.75, label=label)
        ax.plot(x, paid.mean(), "D", color=REWARD, markersize=11, label="mean", zorder=4)
    ax.set(xticks=range(len(limits)), xticklabels=[f"{limit:g}" for limit in limits])
    ax.set(xlabel="limit named by the user", ylabel="unsafe steps of an episode")
    ax.set_ylim(0, 1.08 * max(limits.max(), costs.max()))
    legend_below(figure, ax)
    found = zip(limits, costs.mean(1), (costs > limits[:, None]).sum(1), strict=True)
    words = "; ".join(f"limit {limit:g}: mean {mean:.1f}, {more} above it" for limit, mean, more in found)
    return described(figure, f"The costs of {costs.shape[1]} episodes under each limit. {words}.")


# --- Episodes ---


@one_figure
def paths(played: Rollout, task: Task, limits):
    """Draws each episode of a rollout from above: the robot's path, its unsafe steps, and the cost zone."""
    shape, size = scene_of(task).layout(len(limits), wide_panel=(11, 2.6))
    figure, axes = subplots(*shape, figsize=size, sharex=True, sharey=True, squeeze=False)
    for e, (ax, limit) in enumerate(zip(axes.flat, limits, strict=True)):
        _draw_path(ax, played, e, task)
        ax.set_title(f"limit {limit:g}: " + _summary(played, e, "cost {cost:.0f}, return {total:.0f}"))
        ax.label_outer()
    legend_below(figure, axes[0, 0])
    return figure


@one_figure
def budget(played: Rollout, task: Task, limits):
    """Draws the cost so far of each episode of a rollout, and the limit given at each step (eq. 23).

    The upper row shows the cost so far and the episode's limit. The lower row shows the given limit.
    """
    count = len(limits)
    figure, axes = subplots(
        2, count, figsize=(4 * count, 6), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 2)
    )
    for e, limit in enumerate(limits):
        _draw_cost_so_far(axes[0, e], played, e, limit)
        _draw_condition(axes[1, e], played, e, limit, task)
        axes[0, e].set_title(f"limit {limit:g}")
        axes[1, e].set_xlabel("step")
    for ax in axes.flat:
        ax.label_outer()
    legend_below(figure, *axes[:, 0])
    return figure


@one_figure
def episode(played: Rollout, task: Task, limit: float, e: int = 0):
    """Draws one episode: its path from above, its cost so far, and the limit given at each step."""
    figure, axes = plt.subplot_mosaic(
        [["path", "cost"], ["path", "condition"]],
        figsize=(12, 6),
        height_ratios=(3, 2),
        width_ratios=(5, 6),
        FigureClass=Picture,
    )
    _draw_path(axes["path"], played, e, task)
    _draw_cost_so_far(axes["cost"], played, e, limit)
    _draw_condition(axes["condition"], played, e, limit, task)
    axes["path"].set_title(f"limit {limit:g}: " + _summary(played, e, "cost {cost:.0f}, return {total:.0f}"))
    axes["cost"].set_xlim(axes["condition"].get_xlim())
    axes["cost"].tick_params(labelbottom=False)
    axes["condition"].set_xlabel("step")
    legend_below(figure, *axes.values())
    return figure


def _summary(played: Rollout, e: int, words: str) -> str:
    return words.format(cost=played.costs[:, e].sum(), total=played.rewards[:, e].sum())


def _draw_path(ax, played: Rollout, e: int, task: Task):
    scene, positions = scene_of(task), played.positions[: played.lengths[e], e]
    x, y = positions.T
    unsafe = played.costs[: played.lengths[e], e] > 0
    scene.draw(ax, positions)
    ax.plot(x, y, color=NEUTRAL, linewidth=1.5, label="the robot's way", zorder=2)
    ax.plot(x[0], y[0], "o", color=LIMIT, markersize=8, label="start", zorder=4)
    for marker, (reason, where) in zip("o^sDv", scene.reasons(positions).items(), strict=False):
        here = unsafe & where
        ax.plot(x[here], y[here], marker, color=COST, markersize=6, label=f"unsafe: {reason}", zorder=3)


def _draw_cost_so_far(ax, played: Rollout, e: int, limit: float):
    spent = np.concatenate([[0], np.cumsum(played.costs[: played.lengths[e], e])])
    ax.step(np.arange(len(spent)), spent, where="post", color=COST, label="cost so far")
    ax.axhline(limit, **DASHED, label="limit")
    ax.set(ylabel="cost so far", ylim=(0, 1.12 * max(ax.get_ylim()[1] / 1.12, spent[-1], limit)))


def _draw_condition(ax, played: Rollout, e: int, limit: float, task: Task):
    steps = np.arange(played.lengths[e])
    spent = np.concatenate([[0], np.cumsum(played.costs[:, e])])
    wish = [rescaled_budget(limit, spent[t], t, task.horizon) for t in steps]
    top = INFINITE_CODE * task.cost_range
    ax.plot(steps, np.clip(wish, 0, top), color=NEUTRAL, linewidth=1.5, label="eq. 23: budget left, rescaled")
    given = np.where(np.isinf(played.told[steps, e]), top, played.told[steps, e])
    ax.step(steps, given, where="post", color=LIMIT, label="threshold given")
    infinite = np.isinf(played.told[steps, e]).any()
    finite = sorted({*task.thresholds, *given[given < top]})
    ticks = [*finite, *([top] if infinite else [])]
    ax.set_yticks(ticks, [*map("{:g}".format, finite), *(["∞"] if infinite else [])])
    ax.set(ylabel="threshold", ylim=(-2, 1.1 * (top if infinite else task.cost_range)))
