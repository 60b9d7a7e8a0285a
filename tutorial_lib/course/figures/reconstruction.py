"""The figures of cost reconstruction: the weights of the heads, and the effects of noise, model size, time
limits and critics that have not settled.
"""

import numpy as np
import torch
from matplotlib import ticker

from tutorial_lib.course.undiscounting import cost_bounds, head_bounds, steady_heads, weight_curve
from tutorial_lib.style import COST, DASHED, LIMIT, NEUTRAL, REWARD, legend_below, one_figure, subplots
from tutorial_lib.tasks import Task

GREEN, PURPLE = "#009E73", "#CC79A7"  # These are two more colours of Okabe and Ito.


@one_figure
def flat_curve(weights, gammas, horizon: int):
    """Draws the weighted discounts of the heads, w_i gamma_i^t, and their sum.

    Both panels show three times the horizon.
    """
    steps = 3 * horizon
    figure, (parts, whole) = subplots(1, 2, figsize=(12, 4.6))
    for weight, gamma, style in zip(weights, gammas, ("-", "--", ":", "-.", "-"), strict=False):
        label = f"{weight:+.1f} of $\\gamma$ = {gamma:g}"
        curve = weight_curve([weight], [gamma], steps)
        parts.plot(curve, style, color=REWARD, linewidth=2, label=label)
    parts.axhline(0, color=NEUTRAL, linewidth=1)
    whole.plot(weight_curve(weights, gammas, steps), color=COST, label="their sum")
    whole.axhline(1, **DASHED, label="undiscounted")
    whole.set(ylim=(0, None))
    for ax in (parts, whole):
        ax.axvspan(horizon, steps, color=NEUTRAL, alpha=0.2, linewidth=0, label="beyond the time limit")
        ax.set(xlabel="step", xlim=(0, steps))
    parts.set_ylabel("what a cost of 1 counts")
    legend_below(figure, parts, whole)
    return figure


@one_figure
def model_sizes(table, trained: dict):
    """Draws the error over the model size, with one panel per test noise and one line per training noise.

    `table` is the table of `reconstruction_study`. `trained` maps the name of a training noise to its (noise,
    noise_rate). Each dot is the error on random sequences. The linear model is at the left.
    """
    tests = {"clean inputs": (0.0, 0.0), "noise 0.1": (0.1, 0.0), "0.01 cost per step": (0.0, 0.01)}
    figure, axes = subplots(1, len(tests), figsize=(12, 4.8))
    sizes = list(dict.fromkeys(table["size"]))
    for ax, (title, (noise, rate)) in zip(axes, tests.items(), strict=True):
        part = table[(table["test_noise"] == noise) & (table["test_noise_rate"] == rate)]
        for (name, (own, own_rate)), style, colour in zip(
            trained.items(), ("-", "--", ":"), (REWARD, COST, GREEN), strict=False
        ):
            line = part[(part["noise"] == own) & (part["noise_rate"] == own_rate)].set_index("size")
            errors = line["rmse_random"].reindex(sizes)
            ax.plot(range(len(sizes)), errors, style, marker="o", markersize=8, color=colour, label=name)
        ax.set_xticks(range(len(sizes)), [size.replace(" ", "") for size in sizes], rotation=45)
        ax.set(title=f"tested on {title}", yscale="log")
        low, high = ax.get_ylim()
        ticks = [tick for tick in (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if low <= tick <= high]
        ax.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.yaxis.set_minor_locator(ticker.NullLocator())
    axes[0].set_ylabel("error in unsafe steps (RMS)")
    legend_below(figure, axes[0])
    return figure


@one_figure
def time_limits(ratios):
    """Draws the reconstructed cost divided by the true cost of an episode, with a group of bars per task.

    `ratios` maps a task to {treatment: ratio}. Every task has the same treatments.
    """
    words = list(next(iter(ratios.values())))
    colours = dict(zip(words, (LIMIT, COST, REWARD, "#56B4E9"), strict=False))
    width = 0.84 / len(words)
    figure, ax = subplots(figsize=(12, 4.8))
    for place, word in enumerate(words):
        x = np.arange(len(ratios)) + (place - (len(words) - 1) / 2) * width
        heights = [treatments[word] for treatments in ratios.values()]
        ax.bar(x, heights, 0.92 * width, color=colours[word], label=word)
    ax.axhline(1, **DASHED, label="the truth")
    ax.set_xticks(range(len(ratios)), ratios, rotation=20)
    ax.set(ylabel="reconstructed / true cost")
    legend_below(figure, ax)
    return figure


@one_figure
def settling(updates, curves, truth: float):
    """Draws the reconstructed cost over the updates of the critics, with one line per model.

    The dashed line is the true cost.
    """
    figure, ax = subplots(figsize=(11, 4.6))
    styles = zip(("-", "--", ":", "-."), (REWARD, COST, GREEN, PURPLE), strict=True)
    for (name, values), (style, colour) in zip(curves.items(), styles, strict=False):
        ax.plot(updates, values, style, color=colour, label=name)
    ax.axhline(truth, **DASHED, label="the truth")
    ax.set(xlabel="updates", ylabel="unsafe steps", xlim=(0, max(updates)), ylim=(0, None))
    ax.xaxis.set_major_formatter("{x:,.0f}")
    legend_below(figure, ax)
    return figure


@one_figure
def head_error(models, task: Task, head: int, error: float, cost: float = 60):
    """Draws the costs that models reconstruct from the heads of a steady cost when one head has an error.

    `head` counts from 1, and `error` is added to that head. The left panel shows the heads. The right panel
    shows the answer of each model for every error. The grey band contains the errors for which some cost
    sequence has these heads. If some sequence has the heads with `error`, a bar shows the range of its
    possible costs.
    """
    heads = steady_heads(task, cost)
    off = error * (np.arange(len(heads)) == head - 1)
    figure, (left, right) = subplots(1, 2, figsize=(12, 5), width_ratios=(2, 3))
    place = np.arange(len(heads))
    left.bar(place - 0.2, heads, 0.38, color=NEUTRAL, label="right heads")
    left.bar(place + 0.2, heads + off, 0.38, color=COST, label="the critics' heads")
    left.set_xticks(place, [f"$\\gamma$ = {gamma:g}" for gamma in task.gammas])
    left.set(ylabel="discounted cost", title=f"head {head} off by {error:+.2f}")
    tried = np.linspace(-2, 2, 81)
    inputs = heads + np.outer(tried, np.arange(len(heads)) == head - 1)
    for (name, model), colour in zip(models.items(), (REWARD, COST, GREEN, PURPLE), strict=False):
        answers = _answers(model, inputs)
        right.plot(tried, answers, color=colour, label=name)
        right.plot(error, _answers(model, (heads + off)[None]), "o", color=colour, markersize=11)
    low, high = head_bounds(heads, head - 1, task.gammas, task.horizon) - heads[head - 1]
    right.axvspan(low, high, color=NEUTRAL, alpha=0.25, linewidth=0, label="some sequence has such heads")
    least, most = cost_bounds(heads + off, task.gammas, task.horizon)
    if np.isfinite(least):
        middle, reach = (least + most) / 2, (most - least) / 2
        right.errorbar(error, middle, reach, color=LIMIT, capsize=14, capthick=3, linewidth=3, zorder=6)
    right.axhline(cost, **DASHED, label="the truth")
    right.set(xlabel=f"error in head {head}", ylabel="reconstructed cost", xlim=(-2, 2))
    legend_below(figure, left, right)
    return figure


def _answers(model, heads):
    with torch.no_grad():
        return model(torch.as_tensor(heads, dtype=torch.float32)).numpy()
