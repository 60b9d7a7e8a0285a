"""The figures of penalties and implicit policies: critics outside the data, and the effect of a limit."""

import functools

import numpy as np

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


@one_figure
def outside_data(grid, estimates, truth, recorded, limit: float):
    """Draws the costs (k, G) that k critics predict for the actions on `grid` (G,), beside the truth (G,).

    The left panel shows every critic, and the range of the recorded actions is grey. The right panel shows
    the share of critics that call an action safe.
    """
    grid, estimates, truth, recorded = (np.asarray(x) for x in (grid, estimates, truth, recorded))
    figure, (left, right) = subplots(1, 2, figsize=(12, 4.6))
    for ax in (left, right):
        ax.axvspan(recorded.min(), recorded.max(), color=NEUTRAL, alpha=0.15, label="recorded actions")
        ax.set(xlabel="action", xlim=(grid[0], grid[-1]))
        ax.locator_params(axis="x", nbins=5)
    for row, line in enumerate(estimates):
        left.plot(grid, line, color=COST, alpha=0.45, linewidth=1.2, label="" if row else "a critic")
    left.plot(grid, truth, color=LIMIT, label="truth")
    left.axhline(limit, **DASHED, label="limit")
    left.set(title="expected cost", ylabel="unsafe steps", ylim=(0, 1.1 * truth.max()))
    right.plot(grid, (estimates <= limit).mean(0), color=COST, linewidth=7, alpha=0.6)
    right.plot(grid, truth <= limit, color=LIMIT, linewidth=2)
    right.set(title="called safe", ylabel="share of critics; truth", ylim=(-0.03, 1.05))
    legend_below(figure, left)
    return described(
        figure,
        "Left: the expected cost of an action, as predicted by twenty critics and in truth. The lines agree "
        "where actions were recorded. On the right the truth jumps over the limit and most critics do not. "
        "Right: the share of critics that call an action safe.",
    )


@one_figure
def ood_detector(divergences: dict):
    """Draws the KL divergences of a VAE's encoder for recorded and for random actions.

    `divergences` is {task: (recorded, random)}, and both arrays are (n,). A quarter of all these actions lie
    to the right of the dashed line. CPQ would call this quarter out of distribution if it had these actions.
    """
    figure, axes = subplots(1, len(divergences), figsize=(12, 4.4), squeeze=False)
    for ax, (name, (recorded, random)) in zip(axes[0], divergences.items(), strict=True):
        both = np.concatenate([recorded, random])
        bins = np.geomspace(np.quantile(both, 0.005), np.quantile(both, 0.998), 40)
        ax.hist(recorded, bins, color=REWARD, alpha=0.55, label="recorded actions")
        ax.hist(random, bins, color=COST, alpha=0.55, label="random actions")
        ax.axvline(np.quantile(both, 0.75), **DASHED, label="upper quarter: 'outside'")
        ax.set(xscale="log", title=name, xlabel="KL divergence of the code")
    axes[0, 0].set_ylabel("number of actions")
    legend_below(figure, axes[0, 0])
    return described(
        figure,
        "Histograms of the KL divergence for recorded and for random actions, which overlap. A dashed line "
        f"marks the upper quarter of all. Panels: {', '.join(divergences)}.",
    )


@one_figure
def against_truth(truth, values: dict):
    """Draws values by some formulas, {label: (n,)}, against the true values (n,).

    A correct value lies on the diagonal.
    """
    figure, ax = subplots(figsize=(8, 5))
    end = 1.05 * np.max(truth)
    ax.plot([0, end], [0, end], color=NEUTRAL, linewidth=1.5, label="right")
    for (label, found), colour, marker in zip(values.items(), (REWARD, COST, LIMIT), "ovs", strict=False):
        ax.plot(truth, found, marker, color=colour, markersize=5, alpha=0.5, label=label)
    ax.set(xlabel="$V_c$ of $\\pi_{imp}$, by a linear solve", ylabel="by the formula")
    ax.set(xlim=(0, end), ylim=(0, None))
    legend_below(figure, ax)
    return described(
        figure, f"Values by formulas over their true values, with the diagonal. Shown: {', '.join(values)}."
    )


@one_figure
def values_by_state(values: dict):
    """Draws a value for every state, {label: (S,)}, with a different marker for each label."""
    figure, ax = subplots(figsize=(12, 4))
    styles = zip(values.items(), (LIMIT, REWARD, COST), ("D", "o", "_"), (11, 9, 26), strict=False)
    for (label, row), colour, marker, size in styles:
        ax.plot(row, marker, color=colour, markersize=size, markeredgewidth=3 if marker == "_" else 0)
        ax.plot([], [], marker, color=colour, markersize=10, markeredgewidth=3, label=label)
    ax.set(xlabel="state", ylabel="$V_c$", xticks=range(len(row)))
    ax.set_ylim(0, 1.12 * max(np.max(row) for row in values.values()))
    legend_below(figure, ax)
    return described(figure, f"One value for each state. Shown: {', '.join(values)}.")


@one_figure
def flips(histories: dict, limit: float):
    """Draws the Q_c of one action over the iterations of CIQL, with one panel per title.

    `histories` maps a title to the values (n,). The marks are orange where the action is unsafe.
    """
    figure, axes = subplots(1, len(histories), figsize=(12, 4.2), sharey=True, squeeze=False)
    for ax, (title, row) in zip(axes[0], histories.items(), strict=True):
        steps, row = np.arange(len(row)), np.asarray(row)
        ax.plot(steps, row, color=NEUTRAL, linewidth=1)
        for unsafe, colour, label in ((False, REWARD, "called safe"), (True, COST, "called unsafe")):
            here = (row > limit) == unsafe
            ax.plot(steps[here], row[here], "o", color=colour, markersize=5, label=label)
        ax.axhline(limit, **DASHED, label=r"limit $\tilde L$")
        ax.set(title=title, xlabel="iteration")
    axes[0, 0].set_ylabel("$Q_c$ of the risky action")
    legend_below(figure, axes[0, 0])
    return described(
        figure,
        "Q_c of the risky action over the iterations. It crosses the dashed limit again and again, and "
        f"changes from safe to unsafe each time. Panels: {', '.join(histories)}.",
    )


@one_figure
def cost_of_limits(limits, costs: dict, ylabel: str = "cost of the implicit policy"):
    """Draws the costs of policies, {label: (n,)}, that were trained for each of `limits` (n,).

    A NaN means that the iteration did not settle, and the line has a gap there. A policy below the dashed
    line keeps its limit. The marks become smaller from line to line, so that equal lines can be seen.
    """
    figure, ax = subplots(figsize=(11, 4.8))
    ax.plot([0, limits[-1]], [0, limits[-1]], **DASHED, label="cost = limit")
    looks = ((REWARD, "o", 11), (NEUTRAL, "s", 7), (COST, "^", 4))
    for (label, row), (colour, marker, size) in zip(costs.items(), looks, strict=False):
        ax.plot(limits, row, marker + "-", color=colour, markersize=size, linewidth=1.5, label=label)
    ax.set(xlabel=r"limit $\tilde L$ (discounted)", ylabel=ylabel)
    ax.set_xlim(0, 1.02 * limits[-1])
    ax.set_ylim(0, 1.1 * max(np.nanmax(row) for row in costs.values()))
    legend_below(figure, ax)
    return described(
        figure, f"The {ylabel} over the limit, with the line where both are equal: {'; '.join(costs)}."
    )


@one_figure
def penalised_state(q_reward, q_cost, behaviour, limit: float, kappa: float, price: float | None = None):
    """Draws eqs. 11 to 17 in one state with A actions: the penalty, V_r and the implicit policy.

    The arrays q_reward, q_cost and behaviour are (A,). With a `price`, an unsafe action is worth its Q_r
    minus the price of its cost beyond the limit, and not zero. Raises ValueError unless kappa is in (0, 1).
    """
    if not 0 < kappa < 1:
        raise ValueError(f"kappa must lie in (0, 1), not {kappa}")
    q_reward, q_cost, behaviour = (np.asarray(x, float) for x in (q_reward, q_cost, behaviour))
    unsafe = q_cost > limit
    priced = q_reward - (price or 0.0) * (q_cost - limit)
    q = np.where(unsafe, 0.0 if price is None else priced, q_reward)
    v = tabular.expectile(behaviour[None], q[None], kappa)
    weight = functools.partial(tabular.expectile_weight, kappa=kappa)
    policy = tabular.implicit_policy(behaviour[None], q[None], v, weight)[0]
    actions = np.arange(len(q))
    colours = np.where(unsafe, COST, REWARD)
    figure, axes = subplots(1, 3, figsize=(12, 4.4))
    axes[0].bar(actions, q_cost, color=colours)
    axes[0].axhline(limit, **DASHED, label="limit")
    axes[0].set(title="$Q_c$", ylim=(0, 1.15 * q_cost.max()))
    axes[1].bar(actions, q_reward, fill=False, edgecolor=NEUTRAL, linewidth=1.5, label="before the penalty")
    axes[1].bar(actions, q, color=colours)
    axes[1].plot(actions[unsafe], q[unsafe], "_", color=COST, markersize=22, markeredgewidth=5)
    axes[1].axhline(v[0], color=LIMIT, label="$V_r$")
    axes[1].set(title=f"$Q_{{r|c}}$ and $V_r$ = {v[0]:.1f}")
    axes[2].bar(actions, behaviour, fill=False, edgecolor=NEUTRAL, linewidth=1.5, label=r"$\mu$")
    axes[2].bar(actions, policy, width=0.5, color=colours)
    axes[2].set(title=f"$\\pi_{{imp}}$: $V_c$ = {policy @ q_cost:.1f}, $\\mu$: {behaviour @ q_cost:.1f}")
    axes[1].bar([0], [0], color=REWARD, label="safe")
    axes[1].bar([0], [0], color=COST, label="unsafe")
    for ax in axes:
        ax.set(xlabel="action", xticks=actions, xticklabels=[chr(ord("a") + i) for i in actions])
    legend_below(figure, *axes)
    return described(
        figure,
        f"One state with {len(q)} actions under the limit {limit:g}. Left: their costs. Middle: what each is "
        f"worth after the penalty, and V_r = {v[0]:.1f}. Right: the behaviour and the implicit policy, which "
        f"costs {policy @ q_cost:.1f}.",
    )
