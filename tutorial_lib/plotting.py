"""The course's figures: each function draws one and returns it.

Everywhere cost is vermilion, reward blue and a limit a dashed line (Okabe and Ito's colours, which
colour-blind readers tell apart). A figure is closed before it is returned, so a notebook shows it once,
where it is the last value of a cell. `python -m tutorial_lib.plotting AGENT PNG` draws the README's.
"""

import base64
import csv
import functools
import io
import sys
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display
from matplotlib import ticker
from matplotlib.figure import Figure
from PIL import Image

from tutorial_lib.conditioning import INFINITE_CODE, rescaled_budget
from tutorial_lib.envs import make_env
from tutorial_lib.evaluation import Rollout, condition, rollout, summarise, with_scores
from tutorial_lib.tasks import Task

REWARD, COST, LIMIT, NEUTRAL = "#0072B2", "#D55E00", "#222222", "#8A8A8A"
DASHED = {"color": LIMIT, "linestyle": (0, (4, 2)), "linewidth": 2}
STYLE = {
    "font.size": 14,
    "axes.titlesize": 15,
    "axes.labelsize": 14,
    "legend.fontsize": 13,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 2.5,
    "figure.dpi": 80,
    "figure.constrained_layout.use": True,
}
WALL_X, CIRCLE_RADIUS = 6.0, 7.0  # Circle tasks: unsafe where |x| > 6; the reward is highest on the circle
WALL_Y = 2.0  # Run tasks: unsafe where |y| > 2, and above a speed limit


class Picture(Figure):
    """A figure that a notebook stores in 256 colours: half of the bytes or less, and no difference to see."""

    def small_png(self) -> bytes:
        """The picture in 256 colours."""
        file, small = io.BytesIO(), io.BytesIO()
        self.savefig(file, format="png", bbox_inches="tight")
        image = Image.open(file).convert("RGB").quantize(256, dither=Image.Dither.NONE)
        image.save(small, "PNG", optimize=True)
        return small.getvalue()

    def _ipython_display_(self):  # comes before matplotlib's own way, which _repr_png_ would not
        png = base64.b64encode(self.small_png()).decode()
        display({"image/png": png, "text/plain": repr(self)}, raw=True)


_subplots = functools.partial(plt.subplots, FigureClass=Picture)


def _one_figure(draw):
    """In the course's style, whatever the caller's; ticks are made when drawn, so drawing belongs inside."""

    @functools.wraps(draw)
    def in_style(*args, **options):
        with matplotlib.rc_context(STYLE):
            figure = draw(*args, **options)
            figure.draw_without_rendering()
        plt.close(figure)
        return figure

    return in_style


# --- The robot ---


def film(agent, limit: float, seed: int, steps, image_size=(360, 270), run: int = 0):
    """Pictures of one episode under `limit`, one at each of `steps`; and the cost so far at each of them.

    The simulator draws a red sphere around a robot whose last step was unsafe. Returns uint8 (frames,
    height, width, 3) and costs (frames,).
    """
    env = make_env(agent.task, render_mode="rgb_array", image_size=image_size)
    observation, _ = env.reset(seed=seed)
    _hide_red_sphere(env)
    frames, costs, spent = [], [], 0.0
    for t in range(max(steps) + 1):
        if t in steps:
            frames.append(env.render())
            costs.append(spent)
        limits = condition(agent, np.array([limit]), np.array([spent]), t) if agent.conditioned else [limit]
        observation, _, terminated, _, info = env.step(agent.act(observation[None], limits, run)[0])
        spent += info["cost"]
        if terminated:
            break
    env.close()
    return np.stack(frames), np.array(costs)


def _hide_red_sphere(env):
    """Until the first unsafe step the simulator makes it almost transparent, which off-screen is opaque."""
    robot = env._sim.agent
    robot._violates_constraints = True
    robot.violates_constraints(False)


def multiple_exposure(frames: np.ndarray) -> np.ndarray:
    """One picture from the frames of a still camera: the scene once, what moved every time, older paler."""
    scene = np.median(frames, axis=0)
    picture = scene.copy()
    for frame, strength in zip(frames, np.linspace(0.45, 1.0, len(frames)), strict=True):
        moved = np.abs(frame - scene).sum(-1) > 60
        picture[moved] += strength * (frame[moved] - picture[moved])
    return picture.astype(np.uint8)


@_one_figure
def robot_at_limits(agent, limits=None, seed: int = 10):
    """The same start under each limit (default: the task's three): the robot at several steps at once."""
    task = agent.task
    limits = task.thresholds if limits is None else limits
    steps = range(task.horizon // 3, task.horizon // 3 + 36, 3)  # a Ball's or a Car's lap, about
    played = rollout(agent, limits, [seed] * len(limits))
    figure, axes = _subplots(1, len(limits), figsize=(3.6 * len(limits), 3.5), squeeze=False)
    for e, (ax, limit) in enumerate(zip(axes[0], limits, strict=True)):
        frames, _ = film(agent, limit, seed, steps)
        ax.imshow(multiple_exposure(frames))
        ax.set_title(f"at most {limit:g} unsafe steps")
        ax.set_xlabel(_summary(played, e, "took {cost:.0f}, return {total:.0f}"))
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    return figure


@_one_figure
def frames_strip(frames, costs, steps, limit: float):
    """Frames of an episode side by side, each with its step and the cost so far."""
    figure, axes = _subplots(1, len(frames), figsize=(12, 12 / len(frames)), squeeze=False)
    for ax, frame, cost, step in zip(axes[0], frames, costs, steps, strict=True):
        ax.imshow(frame)
        ax.set(xticks=[], yticks=[], title=f"step {step}")
        ax.set_xlabel(f"cost {cost:.0f} of {limit:g}", color=COST)
        ax.spines[:].set_visible(False)
    return figure


# --- Episodes ---


@_one_figure
def paths(played: Rollout, task: Task, limits):
    """Each episode of a rollout from above: where the robot was, where that was unsafe, the cost zone."""
    count = len(limits)
    run = "Run" in task.name
    shape, size = ((count, 1), (11, 2.6 * count)) if run else ((1, count), (4 * count, 4.9))
    figure, axes = _subplots(*shape, figsize=size, sharex=True, sharey=True, squeeze=False)
    for e, (ax, limit) in enumerate(zip(axes.flat, limits, strict=True)):
        _draw_path(ax, played, e, task)
        ax.set_title(f"limit {limit:g}: " + _summary(played, e, "cost {cost:.0f}, return {total:.0f}"))
        ax.label_outer()
    _legend_below(figure, axes[0, 0])
    return figure


@_one_figure
def budget(played: Rollout, task: Task, limits):
    """Each episode of a rollout: the cost so far against its limit; below, the threshold given (eq. 23)."""
    count = len(limits)
    figure, axes = _subplots(
        2, count, figsize=(4 * count, 6), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 2)
    )
    for e, limit in enumerate(limits):
        _draw_cost_so_far(axes[0, e], played, e, limit)
        _draw_condition(axes[1, e], played, e, limit, task)
        axes[0, e].set_title(f"limit {limit:g}")
        axes[1, e].set_xlabel("step")
    for ax in axes.flat:
        ax.label_outer()
    _legend_below(figure, *axes[:, 0])
    return figure


@_one_figure
def episode(played: Rollout, task: Task, limit: float, e: int = 0):
    """One episode: from above, its cost so far against the limit, and the threshold given at each step."""
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
    _legend_below(figure, *axes.values())
    return figure


def _summary(played: Rollout, e: int, words: str) -> str:
    return words.format(cost=played.costs[:, e].sum(), total=played.rewards[:, e].sum())


def _draw_path(ax, played: Rollout, e: int, task: Task):
    x, y = played.positions[: played.lengths[e], e].T
    unsafe = played.costs[: played.lengths[e], e] > 0
    if "Run" in task.name:
        outside = np.abs(y) > WALL_Y
        height = max(3.0, 1.1 * np.abs(y).max(), ax.get_ylim()[1])  # panels share their axes
        for side in (-1, 1):
            ax.axhspan(side * WALL_Y, side * 1000, color=COST, alpha=0.15, linewidth=0)
        ax.set(ylim=(-height, height), yticks=(-WALL_Y, 0, WALL_Y))
    else:
        outside = np.abs(x) > WALL_X
        width = max(9.0, 1.1 * np.abs([x, y]).max(), ax.get_xlim()[1])
        for side in (-1, 1):
            ax.axvspan(side * WALL_X, side * 1000, color=COST, alpha=0.15, linewidth=0)
        angle = np.linspace(0, 2 * np.pi, 200)
        circle = CIRCLE_RADIUS * np.cos(angle), CIRCLE_RADIUS * np.sin(angle)
        ax.plot(*circle, color=REWARD, linewidth=1.5, alpha=0.6, label="where the reward is highest")
        ticks = (-WALL_X, 0, WALL_X)
        ax.set(xlim=(-width, width), ylim=(-width, width), xticks=ticks, yticks=ticks, aspect="equal")
    ax.plot(x, y, color=NEUTRAL, linewidth=1.5, label="the robot's way", zorder=2)
    ax.plot(x[0], y[0], "o", color=LIMIT, markersize=8, label="start", zorder=4)
    for where, marker, words in ((outside, "o", "unsafe: outside"), (~outside, "^", "unsafe: too fast")):
        if where is outside or "Run" in task.name:
            here = unsafe & where
            ax.plot(x[here], y[here], marker, color=COST, markersize=6, label=words, zorder=3)
    ax.set(xlabel="x (m)", ylabel="y (m)")


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
    given = np.where(np.isinf(played.conditions[steps, e]), top, played.conditions[steps, e])
    ax.step(steps, given, where="post", color=LIMIT, label="threshold given")
    infinite = np.isinf(played.conditions[steps, e]).any()
    ticks = [*task.thresholds, *([top] if infinite else [])]
    ax.set_yticks(ticks, [*map("{:g}".format, task.thresholds), *(["∞"] if infinite else [])])
    ax.set(ylabel="threshold", ylim=(0, 1.1 * (top if infinite else task.cost_range)))


def _legend_below(figure, *axes):
    entries = {
        label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    columns = len(entries) if len(entries) <= 5 else -(-len(entries) // 2)
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns)


# --- Training, results and data ---

CURVES = {
    "value_loss": "loss of $V_r$ (line 12)",
    "cost_value_loss": "loss of $V_c$ (line 14)",
    "critic_loss": "loss of $Q_r$ (line 16)",
    "cost_critic_loss": "loss of $Q_c$ (line 18)",
    "policy_loss": "loss of the policy (line 20)",
    "safe_fraction": "share of safe actions",
}
SQUARED_ERRORS = {
    "value_loss": REWARD,
    "critic_loss": REWARD,
    "cost_value_loss": COST,
    "cost_critic_loss": COST,
}


@_one_figure
def learning_curves(log, names=tuple(CURVES)):
    """Scalars of a training run over its updates, one panel each, one line per seed.

    Squared errors have a logarithmic scale. `log` is what `training.train` returns, or a metrics.csv.
    """
    rows = _read_log(log)
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure, axes = _subplots(lines, columns, figsize=(4 * columns, 2.8 * lines), sharex=True, squeeze=False)
    for ax, name in zip(axes.flat, names, strict=False):
        for seed in sorted({row["seed"] for row in rows}):
            x, y = zip(*[(row["update"], row[name]) for row in rows if row["seed"] == seed], strict=True)
            ax.plot(x, y, color=SQUARED_ERRORS.get(name, LIMIT), alpha=0.8)
        ax.set_title(CURVES.get(name, name.replace("_", " ")))
        if name in SQUARED_ERRORS:
            ax.set_yscale("log")
            ax.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 3)))
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_locator(ticker.NullLocator())
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("updates")
    return figure


def _read_log(log) -> list[dict[str, float]]:
    if not isinstance(log, str | Path):
        return log
    with open(log, newline="") as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


@_one_figure
def scores(results):
    """Return and cost per threshold: every episode a dot, the mean with its 95% bootstrap interval."""
    table = summarise(results)
    place = {threshold: x for x, threshold in enumerate(sorted(table["threshold"]))}
    episodes = with_scores(results)
    figure, axes = _subplots(1, 2, figsize=(12, 4.4))
    panels = (("reward_score", REWARD, 1.0), ("cost_score", COST, None))
    for ax, (score, colour, unit) in zip(axes, panels, strict=True):
        for _, row in table.iterrows():
            x, scale = place[row["threshold"]], unit or row["threshold"]
            dots = episodes.loc[episodes["threshold"] == row["threshold"], score].to_numpy() * scale
            spread = np.linspace(-0.22, 0.22, len(dots))
            ax.plot(x + spread, dots, "o", color=colour, markersize=5, alpha=0.3, markeredgewidth=0)
            mean, low, high = (scale * row[f"{score}{end}"] for end in ("", "_low", "_high"))
            bars = [[mean - low], [high - mean]]
            ax.errorbar(x, mean, bars, fmt="D", color=colour, markersize=9, capsize=8)
            if unit is None:
                ax.plot([x - 0.35, x + 0.35], [row["threshold"]] * 2, **DASHED)
        ax.set_xticks(list(place.values()), [f"{threshold:g}" for threshold in place])
        ax.set(xlabel="limit", xlim=(-0.5, len(place) - 0.5))
    axes[0].set(title="normalised return")
    axes[1].set(title="cost of an episode; dashed: its limit", ylim=(0, None))
    return figure


@_one_figure
def predicted_against_paid(results):
    """The cost that the critics expected at an episode's first step, and what it paid: a panel per limit."""
    limits = sorted(results["threshold"].unique())
    figure, axes = _subplots(
        1, len(limits), figsize=(4 * len(limits), 4.3), sharex=True, sharey=True, squeeze=False
    )
    end = 1.08 * max(results["predicted_cost"].max(), results["cost"].max(), *limits)
    for ax, limit in zip(axes[0], limits, strict=True):
        part = results[results["threshold"] == limit]
        ax.plot([0, end], [0, end], color=NEUTRAL, linewidth=1.5, label="paid as predicted")
        ax.axhline(limit, **DASHED, label="limit")
        dots = {"color": COST, "markersize": 8, "alpha": 0.6, "label": "episode"}
        ax.plot(part["predicted_cost"], part["cost"], "o", **dots)
        ax.set(title=f"limit {limit:g}", xlabel="predicted cost", xlim=(0, end), ylim=(0, end))
        ax.set_aspect("equal")
        ax.locator_params(nbins=4)
    axes[0, 0].set_ylabel("paid cost")
    _legend_below(figure, axes[0, 0])
    return figure


@_one_figure
def cost_return_plane(dataset, task: Task):
    """Every episode of a dataset by its cost and its return, with the task's three thresholds."""
    figure, ax = _subplots(figsize=(9, 5))
    ax.plot(dataset.episode_costs, dataset.episode_returns, "o", color=NEUTRAL, markersize=4, alpha=0.5)
    ax.set(xlabel="cost of the episode", ylabel="return of the episode")
    for threshold, word in task.cost_limit_names.items():
        ax.axvline(threshold, **DASHED)
        place = {"xy": (threshold, 1.01), "xycoords": ("data", "axes fraction"), "ha": "center"}
        ax.annotate(f"{word}\n{threshold:g}", **place)
    return figure


if __name__ == "__main__":
    from tutorial_lib.training import load_agent

    robot_at_limits(load_agent(sys.argv[1])).savefig(sys.argv[2], dpi=80)
