"""The figures of cost reconstruction: the weights of the heads, and the effects of noise, model size, time
limits and critics that have not settled.
"""

import numpy as np
import torch
from matplotlib import ticker

from tutorial_lib.course.undiscounting import cost_bounds, head_bounds, steady_heads, weight_curve
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
    parts.set_ylabel("weight of a cost in the sum")
    legend_below(figure, parts, whole)
    text = (
        "Left: falling curves with weights of alternating sign. Right: their sum stays near 1 up to step"
        f" {horizon}, and is far from zero beyond it."
    )
    return described(figure, text)


@one_figure
def weight_curves(curves: dict, horizon: int):
    """Draws the weight of a cost at each step, with one line per name of `curves`, and the line at 1.

    Each curve is (steps,), and the steps beyond the time limit are grey.
    """
    figure, ax = subplots(figsize=(12, 4.8))
    styles = ((REWARD, "-"), (COST, "--"), (GREEN, "-."), (PURPLE, ":"))
    for (name, curve), (colour, style) in zip(curves.items(), styles, strict=False):
        ax.plot(curve, style, color=colour, label=name)
    steps = max(map(len, curves.values()))
    ax.axhline(1, **DASHED, label="undiscounted")
    if steps > horizon:
        ax.axvspan(horizon, steps, color=NEUTRAL, alpha=0.2, linewidth=0, label="beyond the time limit")
    ax.set(xlabel="step", ylabel="weight of a cost in the sum", xlim=(0, steps))
    legend_below(figure, ax)
    ends = "; ".join(f"{name}: from {c[0]:.2f} to {c[horizon - 1]:.2f}" for name, c in curves.items())
    return described(figure, f"The weight of a cost over the steps of an episode. {ends}.")


@one_figure
def table2(noises, curves: dict):
    """Draws training losses (MSE) over the noise on the inputs, with one line per name of `curves`.

    The first line is the paper's. The noise 0 stands at the left end of the logarithmic axis.
    """
    figure, ax = subplots(figsize=(12, 5))
    place = np.where(np.asarray(noises) == 0, 0.05, noises)
    styles = zip((LIMIT, REWARD, COST, GREEN), ("-o", "--s", "-.^", ":D"), strict=True)
    for (name, losses), (colour, style) in zip(curves.items(), styles, strict=False):
        ax.plot(place, losses, style, color=colour, markersize=8, label=name)
    ax.set(xscale="log", yscale="log", xlabel="noise on the inputs (standard deviation)")
    ax.set_ylabel("MSE (squared unsafe steps)")
    ax.set_xticks(place, [f"{noise:g}" for noise in noises])
    ax.xaxis.set_minor_locator(ticker.NullLocator())
    legend_below(figure, ax)
    ends = "; ".join(f"{name}: from {v[0]:.2g} to {v[-1]:.3g}" for name, v in curves.items())
    return described(figure, f"Training losses over the noise on the inputs. {ends}.")


@one_figure
def model_sizes(table, trained: dict):
    """Draws the error of each model size, with one panel per test noise and one marker per training noise.

    `table` is the table of `reconstruction_study`. `trained` maps the name of a training noise to its (noise,
    noise_rate). Each marker is the error on random sequences. All panels have the same scale.
    """
    tests = {"clean inputs": (0.0, 0.0), "noise 0.1": (0.1, 0.0), "0.01 cost per step": (0.0, 0.01)}
    figure, axes = subplots(1, len(tests), figsize=(12, 5.2), sharey=True)
    sizes = list(dict.fromkeys(table["size"]))
    for ax, (title, (noise, rate)) in zip(axes, tests.items(), strict=True):
        part = table[(table["test_noise"] == noise) & (table["test_noise_rate"] == rate)]
        for shift, (name, (own, own_rate)), marker, colour in zip(
            (-0.2, 0, 0.2), trained.items(), "o^s", (REWARD, COST, GREEN), strict=False
        ):
            found = part[(part["noise"] == own) & (part["noise_rate"] == own_rate)].set_index("size")
            errors = found["rmse_random"].reindex(sizes)
            style = {"linestyle": "", "marker": marker, "markersize": 10, "color": colour}
            ax.plot(np.arange(len(sizes)) + shift, errors, label=f"trained on {name}", **style)
        ax.set_xticks(range(len(sizes)), [size.replace(" ", "") for size in sizes], rotation=45)
        ax.set(title=f"tested on\n{title}", yscale="log")
        ax.grid(axis="y", color=NEUTRAL, alpha=0.3)
        ax.set_yticks((0.5, 1, 2, 5, 10, 20, 50, 100), ("0.5", "1", "2", "5", "10", "20", "50", "100"))
        ax.yaxis.set_minor_locator(ticker.NullLocator())
    axes[0].set_ylabel("error in unsafe steps (RMS)")
    legend_below(figure, axes[0])
    return described(
        figure, "The error of five model sizes, trained on three kinds of noise, tested on each."
    )


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
    means = [f"{word}: {np.mean([r[word] for r in ratios.values()]):.2f}" for word in words]
    return described(
        figure, f"Reconstructed cost divided by the true cost, mean of tasks. {'; '.join(means)}."
    )


@one_figure
def settling(updates, curves, truth: float):
    """Draws the reconstructed cost over the updates of the critics, with one line per model.

    The dashed line is the true cost.
    """
    figure, ax = subplots(figsize=(12, 5.2))
    styles = zip(("-", "--", ":", "-."), (REWARD, COST, GREEN, PURPLE), strict=True)
    for (name, values), (style, colour) in zip(curves.items(), styles, strict=False):
        ax.plot(updates, values, style, color=colour, label=name)
    ax.axhline(truth, **DASHED, label="the truth")
    ax.set(xlabel="updates", ylabel="reconstructed cost (unsafe steps)", xlim=(0, max(updates)))
    ax.xaxis.set_major_formatter("{x:,.0f}")
    legend_below(figure, ax)
    ends = "; ".join(f"{name}: from {v[0]:.0f} to {v[-1]:.0f}" for name, v in curves.items())
    return described(figure, f"The reconstructed cost over the updates. {ends}; truth {truth:g}.")


@one_figure
def met_by_critics(answers: dict, truth: float):
    """Draws a histogram of the costs that each model reconstructs from a critic's heads, one panel per model.

    `answers` maps a name to costs (n,). The dashed line is the mean cost of a recorded episode.
    """
    figure, axes = subplots(
        len(answers), 1, figsize=(12, 1.3 + 1.9 * len(answers)), sharex=True, squeeze=False
    )
    low = min(-20.0, *(np.quantile(costs, 0.02) for costs in answers.values()))
    high = max(2 * truth, *(np.quantile(costs, 0.98) for costs in answers.values()))
    for ax, (name, costs), colour in zip(axes[:, 0], answers.items(), (REWARD, COST, GREEN), strict=False):
        ax.hist(np.clip(costs, low, high), np.linspace(low, high, 60), color=colour, alpha=0.8)
        ax.axvline(truth, **DASHED, label="mean cost of a recorded episode")
        ax.set_title(
            f"{name}: mean {np.mean(costs):.0f}, standard deviation {np.std(costs):.0f}", fontsize=14
        )
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
    axes[-1, 0].set_xlabel("reconstructed cost of an episode (unsafe steps)")
    legend_below(figure, axes[0, 0])
    words = "; ".join(f"{n}: mean {np.mean(c):.0f}, deviation {np.std(c):.0f}" for n, c in answers.items())
    return described(figure, f"Histograms of costs reconstructed from a critic. {words}; truth {truth:.0f}.")


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
    text = (
        f"Left: the heads, with head {head} off by {error:+.2f}. Right: the reconstructed cost over that"
        f" error, for each model. Some sequence has such heads for errors from {low:.2f} to {high:.2f} alone."
    )
    return described(figure, text)


def _answers(model, heads):
    with torch.no_grad():
        return model(torch.as_tensor(heads, dtype=torch.float32)).numpy()
