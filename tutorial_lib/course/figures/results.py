"""The figures of training and evaluation: learning curves, scores, and predicted against paid cost."""

import csv
from pathlib import Path

import numpy as np
from matplotlib import ticker

from tutorial_lib.scores import summarise, with_scores
from tutorial_lib.style import COST, DASHED, LIMIT, NEUTRAL, REWARD, legend_below, one_figure, subplots

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


@one_figure
def learning_curves(log, names=tuple(CURVES)):
    """Draws scalars of a run over its updates, with one panel per scalar and one line per seed.

    Squared errors have a logarithmic scale. `log` is the value that `training.train` returns, or the path of
    a metrics.csv.
    """
    rows = _read_log(log)
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure, axes = subplots(lines, columns, figsize=(4 * columns, 2.8 * lines), sharex=True, squeeze=False)
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


@one_figure
def scores(results):
    """Draws return and cost per threshold: a dot per episode and the 95% bootstrap interval of the mean."""
    table = summarise(results)
    place = {threshold: x for x, threshold in enumerate(sorted(table["threshold"]))}
    episodes = with_scores(results)
    figure, axes = subplots(1, 2, figsize=(12, 4.4))
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


@one_figure
def predicted_against_paid(results):
    """Draws the cost that the critics predict at the first step and the paid cost, a panel per limit.

    Each dot is an episode.
    """
    limits = sorted(results["threshold"].unique())
    figure, axes = subplots(
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
    legend_below(figure, axes[0, 0])
    return figure
