"""The figures of the notebook that writes C2IQL from an empty file: a plot that moves, and what breaks."""

from collections.abc import Sequence

import numpy as np
from IPython.display import clear_output, display

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

_LOOKS = ((REWARD, "o"), (NEUTRAL, "s"), (COST, "^"), (LIMIT, "D"))


class LivePlot:
    """A plot of a training run that is drawn anew at each call of `add`, in the place of the last one.

    It shows the return, the paid cost and the predicted cost of episodes over the number of updates, with one
    line for each limit. After the training it is one static figure, which the notebook stores.

    Args:
        limits: the limits under which the agent plays, in unsafe steps per episode, at most four.
        updates: the number of updates of the whole run. It is the end of the horizontal axis.

    Raises ValueError for more than four limits.
    """

    def __init__(self, limits: Sequence[float], updates: int):
        if len(limits) > len(_LOOKS):
            raise ValueError(f"{len(limits)} limits: at most {len(_LOOKS)} lines can be told apart")
        self.limits, self.updates = tuple(limits), updates
        self.rows: list[tuple[int, np.ndarray]] = []

    def add(self, update: int, returns, paid, predicted) -> None:
        """Adds what was played after `update` updates, and draws.

        `returns`, `paid` and `predicted` are means over episodes, one for each limit.
        """
        row = np.array([returns, paid, predicted], float)
        if row.shape != (3, len(self.limits)):
            raise ValueError(f"one number per limit is expected, not the shape {row.shape[1:]}")
        self.rows.append((update, row))
        clear_output(wait=True)
        display(self.figure())

    def figure(self):
        """Returns the figure of what was added so far."""
        return training_curves(
            [n for n, _ in self.rows], np.stack([row for _, row in self.rows]), self.limits, self.updates
        )


@one_figure
def training_curves(updates, rows, limits: Sequence[float], end: int):
    """Draws return, paid cost and predicted cost over the number of updates, with one line per limit.

    `updates` are (n,), and `rows` are (n, 3, limits). `end` is the end of the horizontal axis. A dashed line
    marks each finite limit in the panels of the costs.
    """
    rows = np.asarray(rows, float)
    figure, axes = subplots(1, 3, figsize=(12, 4.2))
    titles = "return", "paid cost", "predicted cost"
    for panel, (ax, title) in enumerate(zip(axes, titles, strict=True)):
        for column, limit in enumerate(limits):
            colour, marker = _LOOKS[column]
            ax.plot(
                updates,
                rows[:, panel, column],
                marker + "-",
                color=colour,
                markersize=6,
                label=f"limit {limit:g}",
            )
            if panel and np.isfinite(limit):
                ax.axhline(limit, color=colour, linestyle=(0, (4, 2)), linewidth=1.2)
        ax.set(title=title, xlabel="updates", xlim=(0, 1.03 * end))
        ax.locator_params(axis="x", nbins=4)
    top = 1.08 * max(rows[:, 1:].max(), *(limit for limit in limits if np.isfinite(limit)), 1.0)
    for ax in axes[1:]:
        ax.set(ylim=(0, top), ylabel="unsafe steps")
    axes[0].set_title(f"return, update {updates[-1]} of {end}")
    legend_below(figure, axes[0])
    last = "; ".join(
        f"limit {limit:g}: return {r:.0f}, paid {c:.0f}, predicted {p:.0f}"
        for limit, (r, c, p) in zip(limits, rows[-1].T, strict=True)
    )
    return described(
        figure,
        f"Three panels over the number of updates: return, paid cost and predicted cost. At the end: {last}.",
    )


@one_figure
def broken_parts(measured: dict, strict: float, loose: float):
    """Draws what each broken agent earns and pays when it is told a strict and a loose limit.

    `measured` maps the name of an agent to its returns and paid costs, both (2,), told `strict` and `loose`.
    The dashed line is the strict limit. If the two marks of an agent coincide, it ignores the limit.
    """
    names = list(measured)
    figure, axes = subplots(1, 2, figsize=(12, 1.6 + 0.55 * len(names)), sharey=True)
    for panel, (ax, title) in enumerate(zip(axes, ("return", "paid cost in unsafe steps"), strict=True)):
        for row, name in enumerate(names):
            low, high = np.asarray(measured[name], float)[panel]
            ax.plot([low, high], [row, row], color=NEUTRAL, linewidth=2, zorder=1)
            for value, colour, marker, words in (
                (low, REWARD, "o", f"told {strict:g}"),
                (high, COST, "^", f"told {loose:g}"),
            ):
                ax.plot(value, row, marker, color=colour, markersize=10, label=words)
        ax.set(title=title, yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.5, -0.5))
    axes[1].axvline(strict, **DASHED, label="strict limit")
    axes[1].set_xlim(left=0)
    legend_below(figure, axes[1])
    words = "; ".join(
        f"{name}: return {r[0]:.0f} and {r[1]:.0f}, paid {c[0]:.0f} and {c[1]:.0f}"
        for name, (r, c) in measured.items()
    )
    return described(
        figure, f"Return and paid cost of each agent, told {strict:g} and told {loose:g}. {words}."
    )
