"""The figures of notebook 11: which loss asks which network, and what the agents of several seeds pay."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.colors import to_rgba
from matplotlib.patches import Patch, Rectangle

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

_MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
"""One mark for each run, so that runs can be told apart without colour."""
_LEARNS, _ASKED = "learns", "asked"


@one_figure
def readings(panels: Mapping[str, Mapping[str, Mapping[str, str]]]):
    """Draws which loss asks which network: one panel for each agent, a row per loss, a column per network.

    `panels` maps the name of an agent to its table: `table[loss][network]` is 'learns' where the gradient of
    the loss reaches the network, 'asked' where the loss depends on it without a gradient, and '' elsewhere.
    """
    rows = [max(len(table) for table in panels.values())] * len(panels)
    columns = max(len(row) for table in panels.values() for row in table.values())
    figure, axes = subplots(
        len(panels), 1, figsize=(max(6.0, 0.95 * columns + 2.5), 0.55 * sum(rows) + 1.6 * len(panels) + 0.5),
        squeeze=False,
    )  # fmt: skip
    words = []
    for ax, (name, table) in zip(axes[:, 0], panels.items(), strict=True):
        networks = list(next(iter(table.values())))
        for y, (loss, row) in enumerate(table.items()):
            for x, network in enumerate(networks):
                _draw_cell(ax, x, y, row[network])
            asked = [network for network in networks if row[network] == _ASKED]
            learns = [network for network in networks if row[network] == _LEARNS]
            words.append(f"{name}, {loss}: trains {' and '.join(learns)}, asks {', '.join(asked)}")
        ax.set(xlim=(-0.5, len(networks) - 0.5), ylim=(len(table) - 0.5, -0.5), title=name)
        ax.set_xticks(range(len(networks)), [network.replace(" target", "\ntarget") for network in networks])
        ax.set_yticks(range(len(table)), list(table))
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
    handles = [Patch(color=COST, label="trained by this loss")]
    handles.append(Patch(facecolor=to_rgba(REWARD, 0.35), edgecolor=REWARD, label="asked, and held still"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return described(figure, ". ".join(words) + ".")


def _draw_cell(ax, x: int, y: int, kind: str) -> None:
    """Draws one cell: vermilion where the network learns, pale blue where it is asked, else empty."""
    looks = {_LEARNS: (COST, COST), _ASKED: (to_rgba(REWARD, 0.35), REWARD)}
    fill, edge = looks.get(kind, ("white", "#DDDDDD"))
    ax.add_patch(Rectangle((x - 0.46, y - 0.44), 0.92, 0.88, facecolor=fill, edgecolor=edge, linewidth=1.5))


@one_figure
def certificates(table: pd.DataFrame):
    """Draws what each run pays under each limit, with its interval, and what it predicted.

    `table` is what `scores.certificate` returns. There is one panel for each limit, and one mark for each
    run. Costs are in unsafe steps per episode. The dashed line is the limit.
    """
    limits = sorted(table["threshold"].unique())
    figure, axes = subplots(1, len(limits), figsize=(4 * len(limits), 4.6), sharey=True, squeeze=False)
    words = []
    for ax, limit in zip(axes[0], limits, strict=True):
        part = table[table["threshold"] == limit].sort_values("seed")
        x = np.arange(len(part))
        errors = [part["cost"] - part["cost_low"], part["cost_high"] - part["cost"]]
        looks = {"fmt": "o", "color": COST, "markersize": 9, "capsize": 6}
        ax.errorbar(x - 0.12, part["cost"], errors, label="paid, mean and 95% interval", **looks)
        hollow = {"markerfacecolor": "white", "markersize": 10, "markeredgewidth": 2}
        ax.plot(x + 0.18, part["predicted"], "s", color=REWARD, label="predicted at the first step", **hollow)
        ax.axhline(limit, **DASHED, label="limit")
        ax.set_xticks(x, [f"{seed:g}" for seed in part["seed"]])
        ax.set(title=f"limit {limit:g}", xlabel="seed", xlim=(-0.6, len(part) - 0.4))
        pairs = zip(part["seed"], part["cost"], part["predicted"], strict=True)
        words.append(
            f"limit {limit:g}: "
            + ", ".join(f"seed {s:g} paid {c:.0f}, predicted {p:.0f}" for s, c, p in pairs)
        )
    axes[0, 0].set(ylabel="unsafe steps of an episode", ylim=(0, None))
    legend_below(figure, axes[0, 0])
    return described(figure, "What each run pays and predicted. " + "; ".join(words) + ".")


@one_figure
def named_limits(results: pd.DataFrame, known=()):
    """Draws what each run pays, in the mean over its episodes, against the limit that a user names.

    `results` are raw results. What is paid under an infinite limit is drawn as a dotted line, in the mean
    over the runs. `known` are the limits of Table 1, which are marked on the axis.
    """
    means = results.groupby(["seed", "threshold"])["cost"].mean().reset_index()
    finite = means[np.isfinite(means["threshold"])]
    top = 1.05 * max(finite["threshold"].max(), means["cost"].max())
    figure, ax = subplots(figsize=(9, 6))
    ax.plot([0, top], [0, top], **DASHED, label="paid = limit")
    ax.fill_between([0, top], [0, top], top, color=COST, alpha=0.08, linewidth=0, label="limit broken")
    for mark, (seed, part) in zip(_MARKS * len(means), finite.groupby("seed"), strict=False):
        part = part.sort_values("threshold")
        looks = {"color": COST, "linewidth": 1.2, "markersize": 8, "alpha": 0.85}
        ax.plot(part["threshold"], part["cost"], mark + "-", label=f"seed {seed:g}", **looks)
    free = means[~np.isfinite(means["threshold"])]["cost"]
    if len(free):
        ax.axhline(free.mean(), color=NEUTRAL, linestyle=":", label="paid without a limit, mean")
    for limit in known:
        ax.plot(limit, 0, "^", color=LIMIT, markersize=11, clip_on=False, zorder=5, label="limit of Table 1")
    ax.set(xlim=(0, top), ylim=(0, top), xlabel="limit that a user names", ylabel="paid, mean of an episode")
    legend_below(figure, ax)
    over = finite.groupby("threshold").apply(
        lambda x: f"limit {x.name:g}: {x['cost'].min():.0f} to {x['cost'].max():.0f}", include_groups=False
    )
    words = f" Without a limit they pay {free.mean():.0f} in the mean." if len(free) else ""
    return described(figure, f"Mean paid cost of the runs, from least to most. {'; '.join(over)}.{words}")
