"""Studies: grids of training runs as a table. `c2iql study NAME` runs one, on any number of cores.

What a cell of the grid is stands in `cells`, how cells are spread over processes in `engine`.
"""

import dataclasses
import fnmatch
import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tutorial_lib.agents import get_algorithm
from tutorial_lib.config import Config, get_profile
from tutorial_lib.data.dataset import DatasetError
from tutorial_lib.data.sources import find_dataset, load_dataset
from tutorial_lib.studies.runs import Cell
from tutorial_lib.tasks import TASKS, get_task


@dataclass(frozen=True)
class Grid:
    """All combinations of its tasks, algorithms and options; algorithms that need a threshold get each."""

    tasks: tuple[str, ...] = ("CarCircle",)
    algorithms: tuple[str, ...] = ("C2IQL",)
    options: tuple[dict, ...] = ({},)
    """Changes to the profile, one agent each."""
    at_test: tuple[dict, ...] = ({},)
    """Changes to the profile that only acting looks at: every agent plays under each."""
    seeds: int = 3
    limits: tuple[float, ...] | None = None
    """What conditioned agents are told when they play; None: the task's three thresholds."""


@dataclass(frozen=True)
class Study:
    """A question, and the grids that answer it."""

    question: str
    grids: tuple[Grid, ...]


KAPPAS = (0.5, 0.7, 0.9)
NOISES = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 4.0)
SIZES = ({"crm": "linear"}, {"crm_width": 16, "crm_layers": 1}, {"crm_width": 64}, {"crm_width": 256}) + (
    {"crm_width": 512, "crm_layers": 5},
)
ABLATIONS = ("C2IQL", "C2IQL w/o CR", "C2IQL w/o CC", "CIQL")
PAIR = ("BallRun", "CarCircle")  # a short horizon and a long one: the smallest gamma^T is 0.01 and 0.05

OWN_OPTIONS = {
    "DroneRun": {"time_limits": "mask"},
    "AntRun": {"unsafe_price": 20.0},
    "DroneCircle": {"cost_critics": 1},
    "AntCircle": {"unsafe_price": 200.0, "crm_noise_rate": 0.05},
}
"""What a task changes in the profile. DroneRun's agents stayed near the many that never exceed the speed
limit, at a normalised reward of 0.61 under a limit of 110; with masked time limits they have 0.70. One
action of an ant's gait hardly shows in its cost: at profile `small`'s price of 6 an agent paid 43 under
AntRun's limit of 30, and 98 under AntCircle's of 40. On AntCircle the critics' heads differ mostly by error,
and a reconstruction model that is told so (with the price, five seeds) made that 55. On DroneCircle the
highest of two cost critics expects 52, 59 and 69 under the three limits, and 5, 9 and 11 are paid (study
ablations); one alone expects 20, 29 and 34, and 22, 32 and 36 are paid, for 0.05 more of reward."""

SLOW_TARGETS = {"target_tau": 0.01}
"""For an actor that asks about its own actions: on BallCircle at 50, CPQ had a normalised reward and
cost of 0.57 / 0.96 with it, and 0.26 / 0.49 with profile `small`'s 0.1 (seed 0 alone, not kept)."""

STUDIES: dict[str, Study] = {
    "table1": Study(
        "The paper's Table 1: how much reward at how much cost, on every task whose data is shipped?",
        (
            *(Grid((task,), ("C2IQL",), (OWN_OPTIONS.get(task, {}),), seeds=5) for task in TASKS),
            Grid(tuple(TASKS), ("BC-All", "BC-Safe")),
            Grid(tuple(TASKS), ("CPQ",), (SLOW_TARGETS,)),
        ),
    ),
    "ablations": Study(
        "Figures 3 and 7: what do cost reconstruction and constraint conditioning each add?",
        (Grid(("CarCircle", "BallCircle", "DroneCircle"), ABLATIONS),),
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
        (Grid(options=tuple({"crm_noise": noise, "crm_noise_rate": 0.0} for noise in NOISES)),),
    ),
    "crm-size": Study("How large must the reconstruction model be?", (Grid(options=SIZES),)),
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
                options=tuple(OWN_OPTIONS.get(task, {}) | {"precision": p} for p in ("float32", "bfloat16")),
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


def cells(
    study: Study,
    only: str = "*",
    change: Callable[[Config], Config] = lambda config: config,
    profile: str = "small",
    data: str = "shipped",
) -> list[Cell]:
    """The study's cells whose name fits the pattern `only` (as of file names, anywhere in it).

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
            checksum = _checksum(task, path, path.stat().st_mtime_ns)
            kind = get_algorithm(algorithm)
            fixed = kind.constrained and not kind.conditioned
            config = change(dataclasses.replace(get_profile(profile), **options))
            for threshold in get_task(task).thresholds if fixed else (None,):
                cell = Cell(
                    task=task,
                    algorithm=algorithm,
                    config=config,
                    threshold=threshold,
                    seeds=tuple(range(grid.seeds)),
                    limits=grid.limits,
                    at_test=grid.at_test,
                    label=",".join(f"{name}={value}" for name, value in options.items()),
                    columns=columns,
                    checksum=checksum,
                    data=data,
                )
                made[cell.name] = cell
    if missing and not made:
        raise missing
    chosen = [cell for name, cell in made.items() if fnmatch.fnmatchcase(name, f"*{only}*")]
    if not chosen:
        raise ValueError(f"no cell fits {only!r}: the cells are {', '.join(made)}")
    return chosen


@functools.lru_cache
def _checksum(task: str, path: Path, changed: int) -> str:
    """Of a dataset, read once for as long as its file does not change."""
    return load_dataset(task, path).checksum
