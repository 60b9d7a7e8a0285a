"""The figure of speed: updates per second of each library, and the time of seeds that train together."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from benchmarks.cases import TASKS
from benchmarks.peers import PEERS
from benchmarks.tables import NAMES, OURS, case_of, ratios, seconds
from benchmarks.updates import EAGER
from tutorial_lib.studies.figures import or_not_run
from tutorial_lib.style import DASHED, NEUTRAL, REWARD, one_figure, subplots

PEER = "#E69F00"


@or_not_run
@one_figure
def speed(updates: pd.DataFrame) -> Figure:
    """Draws updates per second, and the time per update against the number of seeds.

    `updates` are the raw rows that `python -m benchmarks --full` wrote.
    """
    figure, (left, right) = subplots(1, 2, figsize=(12, 5.5), width_ratios=(3, 2))
    part = updates[updates["group"] == f"yardsticks {TASKS[0]}"]
    rates = {name: 1 / seconds(part, **case_of(name)).median() for name in NAMES}
    rates = {name: rate for name, rate in rates.items() if np.isfinite(rate)}
    colours = {EAGER: NEUTRAL, "plain eager C2IQL, our products": NEUTRAL} | dict.fromkeys(PEERS, PEER)
    left.barh(list(rates), list(rates.values()), color=[colours.get(name, REWARD) for name in rates])
    for place, rate in enumerate(rates.values()):
        left.annotate(f" {rate:.1f}", (rate, place), va="center")
    left.invert_yaxis()
    left.margins(x=0.12)
    left.set(xlabel="updates per second", title=f"{TASKS[0]}'s sizes, profile paper, one thread")

    part = updates[updates["group"] == "seeds"]
    counts = sorted(part["runs"].unique())
    for profile, marker in (("paper", "o"), ("small", "s")):
        own = part[(part["profile"] == profile) & (part["what"] == OURS)]
        costs = [ratios(own, {"runs": count}, {"runs": counts[0]}).median() for count in counts]
        looks = {"marker": marker, "color": REWARD, "alpha": 1 if profile == "paper" else 0.5}
        right.plot(counts, costs, **looks, label=f"profile {profile}")
    right.plot(counts, counts, **DASHED, label="one after the other")
    right.set(xlabel="seeds trained together", ylabel="time per update, x one seed", xticks=counts)
    right.set(title="Seeds together", ylim=(0, 1.4 * max(counts)))
    right.legend()
    return figure
