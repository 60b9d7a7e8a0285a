"""Tables of speed from the files that `python -m benchmarks --full` wrote."""

from pathlib import Path

import pandas as pd

from benchmarks.cases import SMALL_CRM, TASKS
from benchmarks.peers import PEERS
from benchmarks.updates import EAGER, PARTS, PRODUCT
from tutorial_lib.data.sources import SHIPPED_DATA
from tutorial_lib.tasks import get_task

FOLDER = SHIPPED_DATA / "results" / "bench"
FILES = {name: f"{name}.csv" for name in ("machine", "updates", "simulation")}
NOT_RUN = "*Not measured: `python -m benchmarks --full` does it.*"
OURS, SMALL = "C2IQL", f"C2IQL, its reconstruction model {SMALL_CRM}"
ROUNDED, BOTH = "C2IQL in bfloat16", f"C2IQL in bfloat16, its reconstruction model {SMALL_CRM}"
NAMES = {  # the names of the table's rows, and what they measure: (what, products, crm)
    "C2IQL": (OURS, "float32", "5 x 512"),
    SMALL: (OURS, "float32", SMALL_CRM),
    ROUNDED: (OURS, "bfloat16", "5 x 512"),
    BOTH: (OURS, "bfloat16", SMALL_CRM),
    "C2IQL, PyTorch's default products": (OURS, "default", "5 x 512"),
    "plain eager C2IQL, our products": (EAGER, "float32", "5 x 512"),
    EAGER: (EAGER, "default", "5 x 512"),
    "our IQL": ("IQL", "float32", "5 x 512"),
    "our CPQ, with its push": ("CPQ w/ push", "float32", "5 x 512"),
    **{name: (name, "default", "5 x 512") for name in PEERS},
}


def load(name: str, folder: Path | None = None) -> pd.DataFrame | None:
    """The table in one of the files, or None where nothing was measured."""
    path = (folder or FOLDER) / FILES[name]
    return pd.read_csv(path) if path.exists() else None


def with_shares(updates: pd.DataFrame) -> pd.DataFrame:
    """The same rows with `share`: FLOP per second over that of the float32 product in the same round."""
    product = updates[(updates["what"] == PRODUCT) & (updates["products"] == "float32")]
    rate = (product["flop"] / product["seconds"]).set_axis(product["round"])
    return updates.assign(share=updates["flop"] / updates["seconds"] / updates["round"].map(rate))


def part_shares(updates: pd.DataFrame) -> pd.DataFrame:
    """The share of each part in the sum of the parts, for each row."""
    parts = updates[list(PARTS)]
    return parts.div(parts.sum(axis=1), axis=0)


def seconds(updates: pd.DataFrame, **case: object) -> pd.Series:
    """The seconds per update of one case by round. Empty where it was not measured."""
    return _select(updates, case).set_index("round")["seconds"]


def case_of(name: str) -> dict:
    """The values of columns that select the rows of one of `NAMES`."""
    return dict(zip(("what", "products", "crm"), NAMES[name], strict=True))


def ratios(updates: pd.DataFrame, slow: dict, fast: dict) -> pd.Series:
    """How many times faster `fast` is than `slow`, by round. Empty or NaN where one was not measured."""
    return seconds(updates, **slow) / seconds(updates, **fast)


def yardsticks(updates: pd.DataFrame) -> pd.DataFrame:
    """One row per name in `NAMES`, in profile `paper`: updates/s, share, ratio to the plain version."""
    rows = []
    parts = {task: with_shares(updates[updates["group"] == f"yardsticks {task}"]) for task in TASKS}
    for name in NAMES:
        case, row = case_of(name), {"profile `paper`": name}
        for task, part in parts.items():
            own = _select(part, case)
            if not len(own):
                row |= {f"{task}: updates/s": "not measured"}
                continue
            row.setdefault("GFLOP", f"{own['flop'].iloc[0] / 1e9:.1f}")
            row[f"{task}: updates/s"] = f"{1 / own['seconds'].median():.1f}"
            row[f"{task}: share"] = f"{own['share'].median():.0%}"
            row[f"{task}: x plain"] = f"{ratios(part, case_of(EAGER), case).median():.2f}"
        rows.append(row)
    columns = ["profile `paper`", "GFLOP"]
    columns += [f"{task}: {x}" for task in TASKS for x in ("updates/s", "share", "x plain")]
    return pd.DataFrame(rows).reindex(columns=columns)


def marks(updates: pd.DataFrame) -> pd.DataFrame:
    """The aims, and the ratios of one measurement, as median (lowest to highest) over its rounds."""
    ours, small, plain, peer = map(case_of, (OURS, SMALL, EAGER, "OSRL's CPQ"))
    aims = {
        "arithmetic, against that of one large product": ("0.8", None),
        f"x plain eager, with a reconstruction model of {SMALL_CRM}": ("2.2", (plain, small)),
        "x plain eager, with the same model": ("", (plain, ours)),
        f"x OSRL's CPQ, with a model of {SMALL_CRM}": ("10", (peer, small)),
        "x plain eager, in bfloat16": ("5, with AMX", (plain, case_of(ROUNDED))),
        f"x plain eager, in bfloat16 with a model of {SMALL_CRM}": ("", (plain, case_of(BOTH))),
        f"x OSRL's CPQ, in bfloat16 with a model of {SMALL_CRM}": ("", (peer, case_of(BOTH))),
    }
    rows = []
    for aim, (wanted, pair) in aims.items():
        row = {"mark": aim, "aim": wanted}
        for task in TASKS:
            part = with_shares(updates[updates["group"] == f"yardsticks {task}"])
            row[task] = _in_words(ratios(part, *pair) if pair else _select(part, ours)["share"])
        rows.append(row)
    both = updates[updates["group"] == "processes"]
    most = both["processes"].max()
    alone, together = ({"processes": count} for count in (1, most))
    rows.append({"mark": "two processes on two cores, x one", "aim": "1.9"})
    rows[-1][TASKS[0]] = _in_words(ratios(both, alone, together) if most == 2 else pd.Series())
    seeds = updates[updates["group"] == "seeds"]
    for profile in ("paper", "small"):
        found = ratios(seeds, {"profile": profile, "runs": 5}, {"profile": profile, "runs": 1})
        row = {"mark": f"cost of five seeds together, x one, profile `{profile}`", "aim": "at most 4"}
        rows.append(row | {TASKS[0]: _in_words(found)})
    return pd.DataFrame(rows)


def by_algorithm(updates: pd.DataFrame) -> pd.DataFrame:
    """Updates per second: one row per algorithm, one column per profile and task."""
    part = updates[updates["group"] == "algorithms"]
    speed = 1 / part.groupby(["what", "profile", "task"], sort=False)["seconds"].median()
    table = speed.unstack(["profile", "task"])
    table.columns = [f"`{profile}`, {task}" for profile, task in table.columns]
    return table.map("{:.1f}".format).rename_axis("updates/s").reset_index()


def by_precision(updates: pd.DataFrame) -> pd.DataFrame:
    """Updates per second in both precisions and their ratio, by profile and number of seeds."""
    rows = []
    part = updates[updates["group"] == "precision"]
    for (profile, runs), own in part.groupby(["profile", "runs"], sort=False):
        slow, fast = ({"products": precision} for precision in ("float32", "bfloat16"))
        speeds = (f"{1 / seconds(own, **case).median():.1f}" for case in (slow, fast))
        row = {"updates/s": profile, "seeds": runs} | dict(zip(("float32", "bfloat16"), speeds, strict=True))
        rows.append(row | {"x float32": _in_words(ratios(own, slow, fast))})
    return pd.DataFrame(rows)


def by_part(updates: pd.DataFrame) -> pd.DataFrame:
    """The share of each part in the time of an update, by profile and number of seeds."""
    part = updates[updates["group"] == "seeds"]
    shares = part_shares(part).groupby([part["profile"], part["runs"]], sort=False)
    table = shares.median().map("{:.0%}".format).reset_index()
    return table.rename(columns={"runs": "seeds"})


def growth(updates: pd.DataFrame) -> pd.DataFrame:
    """Milliseconds per update as seeds, batch, dataset or tasks grow, and the ratio of last to first.

    Tasks are trained one after the other. Their ratio is that of the sum to the largest task, AntCircle.
    """
    rows = []
    for group, column in (("seeds", "runs"), ("batch", "batch"), ("rows", "rows")):
        part = updates[updates["group"] == group]
        for profile, own in part.groupby("profile", sort=False):
            sizes = own[column].unique()
            words = [f"{size:,}: {seconds(own, **{column: size}).median() * 1e3:.3g}" for size in sizes]
            last = ratios(own, {column: sizes[-1]}, {column: sizes[0]}).median()
            times = f"{sizes[-1] / sizes[0]:g} x as many cost {last:.2f} x"
            row = {"what grows": group, "profile": profile, "ms per update": "; ".join(words)}
            rows.append(row | {"growth": times})
    for profile, own in updates[updates["group"] == "tasks"].groupby("profile", sort=False):
        table = own.pivot(index="round", columns="task", values="seconds")[own["task"].unique()]
        words = [f"{task}: {time * 1e3:.3g}" for task, time in table.median().items()]
        times = (table.sum(axis=1) / table[TASKS[0]]).median()
        row = {"what grows": "tasks", "profile": profile, "ms per update": "; ".join(words)}
        rows.append(row | {"growth": f"all {len(words)} cost {times:.2f} x {TASKS[0]}"})
    return pd.DataFrame(rows)


def rollouts(simulation: pd.DataFrame) -> pd.DataFrame:
    """Seconds per evaluation episode, and the speed as a share of the bare simulator's."""
    table = simulation.assign(horizon=simulation["task"].map(lambda name: get_task(name).horizon))
    table["s per episode"] = (table["horizon"] / table["steps_per_second"]).map("{:.3f}".format)
    table["of the bare simulator"] = table["of_bare"].map("{:.0%}".format)
    table["steps/s"] = table["steps_per_second"].map("{:.0f}".format)
    return table[["task", "what", "processes", "steps/s", "s per episode", "of the bare simulator"]]


def circumstances(machine: pd.DataFrame) -> str:
    """One sentence about the machine and its software."""
    return ", ".join(f"{what} {value}" for what, value in machine.to_numpy()) + "."


def _select(updates: pd.DataFrame, case: dict) -> pd.DataFrame:
    """The rows whose columns have these values."""
    for column, value in case.items():
        updates = updates[updates[column] == value]
    return updates


def _in_words(found: pd.Series) -> str:
    """The median (lowest to highest) as text."""
    found = found.dropna()
    return f"{found.median():.2f} ({found.min():.2f} to {found.max():.2f})" if len(found) else "not measured"
