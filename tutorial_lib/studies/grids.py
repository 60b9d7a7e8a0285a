"""Studies: grids of training runs as a table. `c2iql study NAME` runs one, on any number of cores.

What one entry of a grid is stands in `runs`, how entries are spread over processes in `cluster`.
"""

import fnmatch
import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tutorial_lib.agents import ALGORITHMS, get_algorithm
from tutorial_lib.config import Config
from tutorial_lib.data.dataset import DatasetError
from tutorial_lib.data.sources import find_dataset, load_dataset
from tutorial_lib.studies.paper import TABLE2
from tutorial_lib.studies.runs import Runs
from tutorial_lib.tasks import TASKS, get_task


@dataclass(frozen=True)
class Grid:
    """All combinations of its tasks, algorithms and options; algorithms that are trained for one limit get
    each."""

    tasks: tuple[str, ...] = ("CarCircle",)
    algorithms: tuple[str, ...] = ("C2IQL",)
    options: tuple[dict, ...] = ({},)
    """Changes to the profile, one agent each."""
    at_test: tuple[dict, ...] = ({},)
    """Changes to the profile that only acting looks at: every agent plays under each."""
    seeds: int = 3
    limits: tuple[float, ...] | None = None
    """The limits that agents play under; None: the task's own."""


@dataclass(frozen=True)
class Study:
    """A question, and the grids that answer it."""

    question: str
    grids: tuple[Grid, ...]
    diagnoses: bool = False
    """Do the results have what agents say of themselves, e.g. the error of a reconstruction model?"""


KAPPAS = (0.5, 0.7, 0.9)
SIZES = ({"crm": "linear"}, {"crm_width": 16, "crm_layers": 1}, {"crm_width": 64}, {"crm_width": 256}) + (
    {"crm_width": 512, "crm_layers": 5},
)
TABLE1_ALGORITHMS = tuple(name for name, kind in ALGORITHMS.items() if kind.in_table1)
ABLATIONS = ("C2IQL", "C2IQL w/o CR", "C2IQL w/o CC", "CIQL")
PAIR = ("BallRun", "CarCircle")  # a short horizon and a long one: the smallest gamma^T is 0.01 and 0.05

STUDIES: dict[str, Study] = {
    "table1": Study(
        "The paper's Table 1: how much reward at how much cost, on every task whose data is shipped?",
        (
            Grid(tuple(TASKS), ("C2IQL",), seeds=5),
            Grid(tuple(TASKS), tuple(name for name in TABLE1_ALGORITHMS if name != "C2IQL")),
        ),
    ),
    "ablations": Study(
        "Figures 3 and 7: what do cost reconstruction and constraint conditioning each add?",
        (
            Grid(("CarCircle", "BallCircle"), ABLATIONS),
            Grid(("DroneCircle",), ABLATIONS, ({"cost_critics": 2},)),  # one critic is this task's own option
        ),
    ),
    "kappas": Study(
        "Figure 4: what do the two expectiles do?",
        (
            Grid(
                options=tuple({"kappa_1": k1, "kappa_2": k2} for k1, k2 in itertools.product(KAPPAS, KAPPAS))
            ),
        ),
    ),
    "crm-noise": Study(
        "Table 2: how much noise should the reconstruction model be trained with?",
        (Grid(options=tuple({"crm_noise": noise, "crm_noise_rate": 0.0} for noise in TABLE2["noise"])),),
        diagnoses=True,
    ),
    "crm-size": Study("How large must the reconstruction model be?", (Grid(options=SIZES),), diagnoses=True),
    "time-limits": Study(
        "What should a time limit mean to the cost critics?",
        (Grid(PAIR, options=tuple({"time_limits": kind} for kind in ("rate", "bootstrap", "mask"))),),
    ),
    "thresholds-per": Study(
        "One threshold per sample, or one per batch?",
        (Grid(PAIR, options=({"thresholds_per": "sample"}, {"thresholds_per": "batch"})),),
    ),
    "cost-critics": Study(
        "One cost critic, or the one of two that expects the most cost?",
        (Grid(PAIR, options=({"cost_critics": 1}, {"cost_critics": 2})),),
    ),
    "precision": Study(
        "Does it matter that hidden layers multiply in bfloat16?",
        tuple(
            Grid(
                (task,),
                options=tuple({"precision": p} for p in ("float32", "bfloat16")),
                seeds=5,
            )
            for task in ("BallRun", "BallCircle", "CarCircle", "AntCircle")
        ),
    ),
    "infinite-at-test": Study(
        "When should the policy be told that nothing limits it any more?",
        (
            Grid(
                ("BallRun", "BallCircle", "CarCircle"),
                at_test=tuple({"infinite_at_test": rule} for rule in ("covered", "nearest", "never")),
            ),
        ),
    ),
    "unseen-limits": Study(
        "Does the agent keep limits that it was never trained on?", (Grid(limits=(25.0, 40.0, 60.0)),)
    ),
}


def get_study(name: str) -> Study:
    """The study called `name`, or ValueError that lists those there are."""
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}: the studies are {', '.join(STUDIES)}")
    return STUDIES[name]


def varied_options(study: Study) -> tuple[str, ...]:
    """The options that differ between the cells of a grid: columns of the study's results."""
    varied = []
    for grid in study.grids:
        for changes in (grid.options, grid.at_test):
            names = (name for options in changes for name in options)
            varied += [name for name in names if len({options.get(name) for options in changes}) > 1]
    return tuple(dict.fromkeys(varied))


def entries(
    study: Study,
    only: str = "*",
    change: Callable[[Config], Config] = lambda config: config,
    profile: str = "small",
    data: str = "shipped",
) -> list[Runs]:
    """The study's entries whose name fits the pattern `only` (as of file names, anywhere in it).

    `change` is applied to every configuration last. Tasks without a dataset are left out. Raises DatasetError
    where no task has one, ValueError where no name fits.
    """
    columns, made, missing = varied_options(study), {}, None
    for grid in study.grids:
        for task, algorithm, options in itertools.product(grid.tasks, grid.algorithms, grid.options):
            try:
                path = find_dataset(task, data)
            except DatasetError as error:
                missing = error
                continue
            kind, record = get_algorithm(algorithm), get_task(task)
            runs = Runs(
                task=task,
                algorithm=algorithm,
                config=change(kind.configure(profile, record, **options)),
                seeds=tuple(range(grid.seeds)),
                trained_for=record.thresholds if kind.needs_limit else None,
                limits=grid.limits,
                at_test=grid.at_test,
                label=",".join(f"{name}={value}" for name, value in options.items()),
                columns=columns,
                diagnoses=study.diagnoses,
                checksum=_checksum(task, path, path.stat().st_mtime_ns),
                data=data,
            )
            made[runs.name] = runs
    if missing and not made:
        raise missing
    chosen = [runs for name, runs in made.items() if fnmatch.fnmatchcase(name, f"*{only}*")]
    if not chosen:
        raise ValueError(f"no entry fits {only!r}: the entries are {', '.join(made)}")
    return chosen


@functools.lru_cache
def _checksum(task: str, path: Path, changed: int) -> str:
    """Of a dataset, read once for as long as its file does not change."""
    return load_dataset(task, path).checksum
