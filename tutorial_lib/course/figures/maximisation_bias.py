"""The figures of notebook 3: the bias of a maximum, expectiles, and implicit policies."""

import numpy as np
from matplotlib import ticker

from tutorial_lib.course.maximisation_bias import bandit_logs, bandit_value
from tutorial_lib.course.tabular import expectile
from tutorial_lib.style import COST, DASHED, LIMIT, NEUTRAL, REWARD, legend_below, one_figure, subplots

STAR = {"marker": "*", "markersize": 20, "linestyle": "none", "color": COST, "markeredgecolor": LIMIT}


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
    return figure


@one_figure
def courses(panels: dict):
    """Draws the mean Q of recorded actions over the updates, on a log scale, with one panel per title.

    `panels` is {title: ({label: maximisation_bias.Course}, achieved, ceiling)}. The curve with the label
    "maximum" is orange. Dashed lines show the value that was achieved and the value that no policy can
    exceed.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 5.4), sharey=True, squeeze=False)
    for ax, (title, (found, achieved, ceiling)) in zip(axes[0], panels.items(), strict=True):
        blues = iter(np.linspace(0.55, 1, max(len(found) - 1, 1)))
        for label, course in found.items():
            look = {"color": COST} if label == "maximum" else {"color": REWARD, "alpha": next(blues)}
            ax.plot(course.updates, course.q, label=label, **look)
        labels = ((achieved, "achieved", "top", -4), (ceiling, "ceiling", "bottom", 4))
        for level, words, va, offset in labels:
            ax.axhline(level, **DASHED | {"linewidth": 1.5})
            place = {"xy": (0.01, level), "xycoords": ("axes fraction", "data"), "xytext": (0, offset)}
            ax.annotate(words, va=va, textcoords="offset points", fontsize=13, **place)
        ax.set(title=title, xlabel="updates", yscale="log")
        ax.xaxis.set_major_locator(ticker.MaxNLocator(4))
        ax.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 3)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_locator(ticker.NullLocator())
    axes[0, 0].set_ylabel("mean Q of recorded actions")
    legend_below(figure, *axes[0])
    return figure


@one_figure
def expectile_of(values, kappa: float):
    """Draws a distribution of Q (n,) with its kappa-expectile, and the expectile for every kappa.

    The left panel also names the weight of the values on each side of the expectile.
    """
    values = np.asarray(values, float)[None]
    mu = np.full(values.shape, 1 / values.size)
    level = expectile(mu, values, kappa)[0]
    figure, (left, right) = subplots(1, 2, figsize=(12, 4.6))
    worse, better = values[values < level], values[values >= level]
    left.hist(
        [worse, better],
        bins=np.histogram_bin_edges(values, 40),
        stacked=True,
        color=[NEUTRAL, REWARD],
        label=[f"worse: weight {1 - kappa:.3g}", f"better: weight {kappa:.3g}"],
    )
    left.axvline(level, color=LIMIT, label="expectile")
    left.axvline(values.mean(), **DASHED | {"linewidth": 1.5}, label="mean")
    left.axvline(values.max(), color=COST, linewidth=1.5, label="best recorded")
    left.set(title=f"kappa = {kappa:g}: V = {level:.1f}", xlabel="Q of recorded actions", yticks=[])

    grid = np.linspace(0.01, 0.999, 100)
    curve = [expectile(mu, values, k)[0] for k in grid]
    right.plot(grid, curve, color=LIMIT)
    right.plot(kappa, level, "o", color=REWARD, markersize=12)
    right.axhline(values.max(), color=COST, linewidth=1.5)
    right.axhline(values.mean(), **DASHED | {"linewidth": 1.5})
    right.set(title="V over kappa", xlabel="kappa")
    legend_below(figure, left)
    return figure


@one_figure
def implicit_policies(actions, mu, q, found: dict):
    """Draws implicit policies over one continuous action, with Q and V above and the policies below.

    `found` is {name: (V, policy)}. The arrays actions, mu, q and each policy are (n,). The two panels of a
    column share the action axis.
    """
    figure, axes = subplots(2, len(found), figsize=(12, 6), sharex=True, sharey="row", squeeze=False)
    for (above, below), (name, (v, policy)) in zip(axes.T, found.items(), strict=True):
        above.plot(actions, q, color=LIMIT, label="Q")
        above.axhline(v, color=REWARD, linestyle="--", label="V")
        below.fill_between(
            actions, mu / mu.max(), color=NEUTRAL, alpha=0.4, linewidth=0, label="recorded policy"
        )
        below.plot(actions, policy / policy.max(), color=REWARD, label="implicit policy")
        above.set(title=name)
        below.set(xlabel="action", yticks=[])
    axes[1, 0].set_ylabel("scaled to 1")
    legend_below(figure, *axes[:, 0])
    return figure


@one_figure
def towards_the_maximum(kappas, values, levels: dict):
    """Draws V of the start state, (k,), over 1 - kappa, as kappa approaches 1.

    `levels` maps a name to a value, and a dashed line shows each value.
    """
    figure, ax = subplots(figsize=(11, 4.6))
    ax.plot(1 - np.asarray(kappas), values, "o-", color=REWARD, label="V of IQL")
    for level, (words, colour) in zip(
        levels.values(), zip(levels, (NEUTRAL, LIMIT, COST), strict=False), strict=True
    ):
        ax.axhline(level, color=colour, linestyle="--", linewidth=2, label=words)
    ax.set(xscale="log", xlabel="1 - kappa", ylabel="V at the start")
    ax.invert_xaxis()
    legend_below(figure, ax)
    return figure
