"""The figures of notebook 12: who keeps the limit, the network or the rule that counts."""

import numpy as np

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

_LOOKS: tuple[dict, ...] = (
    dict(color=COST, marker="o"),
    dict(color=REWARD, marker="s"),
    dict(color="#009E73", marker="^", linestyle="-."),
    dict(color="#CC79A7", marker="D", linestyle=":"),
    dict(color="#E69F00", marker="v", linestyle="--"),
    dict(color=NEUTRAL, marker="P"),
    dict(color=LIMIT, marker="X", linestyle=":"),
)
"""One look for each control. Lines that lie on one another differ in their dashes and marks."""


def _looks(names):
    """Returns a look for each name, in the order of the first appearance."""
    return {name: _LOOKS[n % len(_LOOKS)] for n, name in enumerate(dict.fromkeys(names))}


def _as_text(limit: float) -> str:
    return "∞" if np.isinf(limit) else f"{limit:g}"


@one_figure
def cost_so_far(panels: dict, limit: float):
    """Draws the expected cost so far of several agents over the step, with one panel for each way to play.

    `panels` maps a title to a dictionary from an agent's name to its expected costs before each step, (T+1,),
    in unsafe steps. The limit is a dashed line.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 4.4), sharey=True, squeeze=False)
    looks = _looks(name for lines in panels.values() for name in lines)
    words = []
    for ax, (title, lines) in zip(axes[0], panels.items(), strict=True):
        ax.axhline(limit, **DASHED, label="limit")
        for name, costs in lines.items():
            ax.plot(costs, **looks[name], markevery=max(1, len(costs) // 6), markersize=8, label=name)
        ax.set(title=title, xlabel="step")
        words.append(f"{title}: " + ", ".join(f"{name} ends at {x[-1]:.1f}" for name, x in lines.items()))
    axes[0, 0].set_ylabel("expected cost so far")
    legend_below(figure, *axes[0])
    return described(figure, f"Expected cost so far over the step, limit {limit:g}. {'; '.join(words)}.")


@one_figure
def paid_when_told(panels: dict):
    """Draws what is paid under each limit, with one panel per task or agent and one line per control.

    `panels` maps a title to a pair: the limits (n,), of which the last may be infinite, and a dictionary from
    the control's name to the paid costs (n,), in unsafe steps per episode. Limits are equally spaced. A dash
    stands at each finite limit.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 5), squeeze=False)
    looks = _looks(name for _, lines in panels.values() for name in lines)
    for ax, (title, (limits, lines)) in zip(axes[0], panels.items(), strict=True):
        places = np.arange(len(limits))
        finite = np.isfinite(limits)
        ax.hlines(
            np.asarray(limits)[finite], places[finite] - 0.3, places[finite] + 0.3, **DASHED, label="limit"
        )
        for name, paid in lines.items():
            ax.plot(places, paid, **looks[name], markersize=8, label=name)
        ax.set(title=title, xlabel="limit", xticks=places, xticklabels=[_as_text(x) for x in limits])
        ax.set_ylim(bottom=min(0, ax.get_ylim()[0]))
    axes[0, 0].set_ylabel("paid cost of an episode")
    legend_below(figure, *axes[0])
    names = "; ".join(looks)
    return described(
        figure,
        f"Paid cost over the limit, a dash at each limit. The lines are: {names}. "
        f"Panels: {', '.join(panels)}.",
    )


@one_figure
def return_at_paid(panels: dict, best: tuple | None = None):
    """Draws the return over the *paid* cost, with one panel per task or agent and one line per control.

    `panels` maps a title to a dictionary from a control's name to its paid costs and returns, each (n,): one
    mark for each limit. `best` are the costs and returns of the exact optimum, a broad pale line.
    """
    figure, axes = subplots(1, len(panels), figsize=(12, 5), squeeze=False)
    looks = _looks(name for lines in panels.values() for name in lines)
    for ax, (title, lines) in zip(axes[0], panels.items(), strict=True):
        if best is not None:
            ax.plot(*best, color=REWARD, alpha=0.25, linewidth=10, label="optimum at this cost")
        for name, (paid, returns) in lines.items():
            order = np.argsort(paid, kind="stable")
            ax.plot(
                np.asarray(paid)[order], np.asarray(returns)[order], **looks[name], markersize=8, label=name
            )
        ax.set(title=title, xlabel="paid cost of an episode")
    axes[0, 0].set_ylabel("return")
    legend_below(figure, *axes[0])
    names = "; ".join(looks)
    return described(
        figure,
        f"Return over paid cost, a mark for each limit. Higher at the same cost is better. "
        f"The lines are: {names}. Panels: {', '.join(panels)}.",
    )
