"""The figures of notebooks 3 and 4: the bias of a maximum, expectiles, and implicit policies."""

import numpy as np
from matplotlib import ticker

from tutorial_lib.course.maximisation_bias import bandit_logs, bandit_value
from tutorial_lib.course.tabular import expectile
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

STAR = {"marker": "*", "markersize": 20, "linestyle": "none", "color": COST, "markeredgecolor": LIMIT}
THIN = DASHED | {"linewidth": 1.5}


@one_figure
def two_maxima(seed: int = 0, arms: int = 20, degree: int = 2):
    """Draws two bandits in which the maximum of the estimates is too high.

    The first bandit has equally good actions with noisy estimates. The second has one continuous action, and
    the figure shows fits to recordings that cover a narrow range of it.
    """
    rng = np.random.default_rng(seed)
    figure, (noise, support) = subplots(1, 2, figsize=(12, 4.8), width_ratios=(2, 3))
    estimates = rng.normal(size=arms)
    noise.plot(estimates, "o", color=NEUTRAL, label="estimate")
    noise.plot(estimates.argmax(), estimates.max(), label="what the maximum promises", **STAR)
    noise.axhline(0, color=REWARD, label="truth")
    noise.set(title="noise: every action is worth 0", xlabel="action", ylabel="mean reward", xticks=[])

    grid = np.linspace(-1, 1, 401)
    actions, rewards = bandit_logs(rng)
    for line in range(6):
        x, y = (actions, rewards) if line == 0 else bandit_logs(rng)
        fit = np.polyval(np.polyfit(x, y, degree), grid)
        support.plot(grid, fit, color=COST, linewidth=1.5, alpha=0.5, label="fits of logs like these")
        support.plot(grid[fit.argmax()], fit.max(), **STAR)
    support.plot(actions, rewards, "o", color=NEUTRAL, markersize=6, label="recorded", zorder=3)
    support.plot(grid, bandit_value(grid), color=REWARD)
    support.axvspan(actions.min(), actions.max(), color=NEUTRAL, alpha=0.15, linewidth=0)
    support.set(
        title="no support: few actions were recorded", xlabel="action", ylim=(-1.5, 5.6), xlim=(-1.05, 1.05)
    )
    legend_below(figure, noise, support)
    return described(
        figure,
        f"Left: {arms} noisy estimates of actions that are all worth 0; a star marks the largest. Right: "
        "six parabolas are fitted to rewards that were recorded for a narrow range of actions; a star marks "
        "the maximum of each. Most stars lie outside of this range, and some lie far beyond the cliff where "
        "the true reward falls to -1.",
    )


@one_figure
def promises_over_data(sizes, found: dict):
    """Draws what actions promise and what they are worth, over the number of records, one panel per rule.

    `found` is {title: (repeats, len(sizes), 2)}: promise and truth of each repetition. Lines are medians, and
    the bands hold the middle half of the repetitions.
    """
    figure, axes = subplots(1, len(found), figsize=(12, 4.6), sharey=True, squeeze=False)
    looks = ("promised", NEUTRAL, "o"), ("worth", REWARD, "s")
    for ax, (title, values) in zip(axes[0], found.items(), strict=True):
        for (label, colour, marker), series in zip(looks, np.moveaxis(values, 2, 0), strict=True):
            low, middle, high = np.quantile(series, (0.25, 0.5, 0.75), axis=0)
            ax.plot(sizes, middle, color=colour, marker=marker, markersize=9, label=label)
            ax.fill_between(sizes, low, high, color=colour, alpha=0.2, linewidth=0)
        ax.set(title=title, xscale="log", xlabel="recorded steps", xticks=sizes)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_locator(ticker.NullLocator())
    axes[0, 0].set_ylabel("reward of the chosen action")
    legend_below(figure, axes[0, 0])
    middles = {title: np.median(values, axis=0) for title, values in found.items()}
    ends = "; ".join(
        f"{title}: from {first[0]:.1f} promised and {first[1]:.1f} earned to {last[0]:.1f} and {last[1]:.1f}"
        for title, (first, *_, last) in middles.items()
    )
    return described(figure, f"Promise and truth from {sizes[0]} to {sizes[-1]} recorded steps. {ends}.")


@one_figure
def courses(panels: dict):
    """Draws the mean Q of recorded actions over the updates, on a log scale, with one panel per title.

    `panels` is {title: ({label: (updates, q)}, achieved, ceiling)}. The curve with the label "maximum" is
    orange. Dashed lines show the largest value that was achieved and the value that no policy can exceed.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 5.4), sharex=True, sharey=True, squeeze=False)
    for ax, (title, (found, achieved, ceiling)) in zip(axes[0], panels.items(), strict=True):
        blues = iter(np.linspace(1, 0.45, max(len(found) - 1, 1)))
        widths = iter((2.5, 3.5, 4.5))
        for label, (updates, q) in found.items():
            if label == "maximum":
                ax.plot(updates, q, label=label, color=COST, linestyle="--")
            else:
                ax.plot(updates, q, label=label, color=REWARD, alpha=next(blues), linewidth=next(widths))
        labels = ((achieved, "achieved", "top", -4), (ceiling, "ceiling", "bottom", 4))
        for level, words, va, offset in labels:
            ax.axhline(level, **THIN)
            place = {"xy": (0.01, level), "xycoords": ("axes fraction", "data"), "xytext": (0, offset)}
            ax.annotate(words, va=va, textcoords="offset points", fontsize=13, **place)
        ax.set(title=title, xlabel="updates", yscale="log")
        ax.xaxis.set_major_locator(ticker.MaxNLocator(4))
        ax.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 3)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_locator(ticker.NullLocator())
    axes[0, 0].set_ylabel("mean Q of recorded actions\n(discounted reward)")
    legend_below(figure, *axes[0])
    last = "; ".join(
        f"{title}: " + ", ".join(f"{label} {q[-1]:.0f}" for label, (_, q) in found.items())
        + f", achieved {achieved:.0f}, ceiling {ceiling:.0f}"
        for title, (found, achieved, ceiling) in panels.items()
    )  # fmt: skip
    return described(figure, f"Mean Q of recorded actions over the updates of training. At the end, {last}.")


@one_figure
def promises_kept(found: dict):
    """Draws what a robot's critic promised and what the robot earned, on a log scale, a pair of bars per row.

    `found` is {words: (promised, earned)}, in discounted reward. A bar of less than 1 has the length 1.
    """
    figure, ax = subplots(figsize=(11, 1.3 + 0.95 * len(found)))
    rows = np.arange(len(found))[::-1]
    for column, (label, colour) in enumerate((("promised", NEUTRAL), ("earned", REWARD))):
        values = np.array([pair[column] for pair in found.values()])
        places = rows + 0.2 - 0.4 * column
        ax.barh(places, np.maximum(values, 1), 0.38, color=colour, label=label)
        for place, value in zip(places, values, strict=True):
            ax.text(1.08 * max(value, 1), place, f"{value:.0f}", va="center")
    ax.set(xscale="log", xlabel="discounted reward of an episode", yticks=rows, xlim=(1, None))
    ax.set_yticklabels(found)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.margins(x=0.12)
    legend_below(figure, ax)
    shown = "; ".join(f"{words}: {p:.0f} promised, {e:.0f} earned" for words, (p, e) in found.items())
    return described(figure, f"What critics promised at the start, and what the robots earned. {shown}.")


@one_figure
def expectile_of(actions, q, kappa: float):
    """Draws the recorded actions (n,) of one state with their Q (n,), and the kappa-expectile V of this Q.

    The left panel names the weight of the actions on each side of V. The right panel draws V for every kappa.
    """
    actions, values = np.asarray(actions, float), np.asarray(q, float)[None]
    mu = np.full(values.shape, 1 / values.size)
    level, mean, best = expectile(mu, values, kappa)[0], values.mean(), values.max()
    figure, (left, right) = subplots(1, 2, figsize=(12, 4.8), sharey=True, width_ratios=(3, 2))
    better = values[0] >= level
    sides = ((~better, "v", NEUTRAL, "worse", 1 - kappa), (better, "^", REWARD, "better", kappa))
    for side, marker, colour, words, weight in sides:
        label = f"{words} than V: weight {weight:.3g}"
        left.plot(actions[side], values[0, side], marker, color=colour, markersize=8, alpha=0.7, label=label)
    grid = np.linspace(0.01, 0.999, 100)
    right.plot(grid, [expectile(mu, values, k)[0] for k in grid], color=LIMIT)
    right.plot(kappa, level, "o", color=REWARD, markersize=12)
    for ax in (left, right):
        ax.axhline(level, color=LIMIT, label="V, the expectile")
        ax.axhline(mean, **THIN, label="mean")
        ax.axhline(best, color=COST, linewidth=1.5, label="best recorded")
    left.set(title=f"kappa = {kappa:g}: V = {level:.2f}", xlabel="recorded action", ylabel="Q of one state")
    right.set(title="V for every kappa", xlabel="kappa")
    legend_below(figure, left)
    return described(
        figure,
        f"Left: {values.size} recorded actions of one state and their Q. The mean is {mean:.2f}, the best "
        f"is {best:.2f}, and the expectile for kappa {kappa:g} is {level:.2f}. Right: the expectile rises "
        "with kappa from the worst to the best recorded Q and never passes it.",
    )


@one_figure
def implicit_policies(actions, mu, q, found: dict):
    """Draws implicit policies over one continuous action, and their ratio to the recorded policy over Q - V.

    `found` is {name: (V, policy)}. The arrays actions, mu, q and each policy are (n,). Each name has a
    column. Above are the densities, scaled to a largest value of 1, and below is pi_imp / mu on a log axis.
    """
    figure, axes = subplots(2, len(found), figsize=(12, 7), sharex="row", sharey="row", squeeze=False)
    lowest = 0.0
    for (above, below), (name, (v, policy)) in zip(axes.T, found.items(), strict=True):
        grey = {"color": NEUTRAL, "alpha": 0.4, "linewidth": 0}
        above.fill_between(actions, mu / mu.max(), **grey, label="recorded policy")
        above.plot(actions, policy / policy.max(), color=REWARD, label="implicit policy")
        above.set(title=name, xlabel="action")
        u, ratio = np.asarray(q) - v, np.asarray(policy) / mu
        lowest = min(lowest, u.min())
        order = u.argsort()
        below.plot(u[order], ratio[order], color=REWARD)
        below.axvline(0, color=LIMIT, linestyle="--", linewidth=1.5, label="V")
        below.axhline(1, color=NEUTRAL, linewidth=1.5)
        below.set(xlabel="u = Q - V", yscale="log", ylim=(0.03, 30))
        below.yaxis.set_major_formatter("{x:g}")
    axes[0, 0].set(ylabel="density,\nscaled to 1")
    axes[1, 0].set(ylabel="weight: implicit /\nrecorded policy")
    legend_below(figure, *axes[:, 0])
    return described(
        figure,
        f"Implicit policies of {', '.join(found)}. Above: the recorded policy and each implicit policy over "
        "the action. Below: the ratio of both over Q - V, on a logarithmic scale.",
    )


@one_figure
def hidden_policies(kappas, rewards, costs, levels: dict, limit: float):
    """Draws V_r at the start, (k,), and the cost of its implicit policy, (k,), over 1 - kappa.

    `levels` maps a name to a value of V_r, and a dashed line shows each. `limit` is a limit on the cost.
    """
    figure, (left, right) = subplots(1, 2, figsize=(12, 5), sharex=True)
    x = 1 - np.asarray(kappas)
    left.plot(x, rewards, "o-", color=REWARD, label="V_r of IQL")
    for (words, level), colour in zip(levels.items(), (NEUTRAL, LIMIT, COST), strict=True):
        left.axhline(level, color=colour, linestyle=":", linewidth=2.5, label=words)
    right.plot(x, costs, "s-", color=COST, label="cost of its hidden policy")
    right.axhline(limit, **DASHED, label=f"limit {limit:g}")
    left.set(xscale="log", xlabel="1 - kappa", ylabel="V_r at the start\n(discounted reward)")
    right.set(xlabel="1 - kappa", ylabel="V_c at the start\n(discounted cost)", ylim=(0, None))
    left.invert_xaxis()
    left.xaxis.set_major_formatter("{x:g}")
    legend_below(figure, left, right)
    named = ", ".join(f"{words} {level:.2f}" for words, level in levels.items())
    return described(
        figure,
        f"Left: V_r at the start rises from {rewards[0]:.2f} to {rewards[-1]:.2f} as kappa grows from "
        f"{kappas[0]:g} to {kappas[-1]:g}. Levels: {named}. Right: the discounted cost of the policy behind "
        f"this V_r goes from {costs[0]:.2f} to {costs[-1]:.2f}; the limit is {limit:g}.",
    )
