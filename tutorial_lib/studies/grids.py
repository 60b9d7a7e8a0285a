"""The table of all studies. A study is one or several grids of training runs.

`c2iql study NAME` runs a study on any number of cores. Module `runs` trains one entry of a grid, module
`cluster` distributes the entries over processes.
"""

import dataclasses
import fnmatch
import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tutorial_lib.agents import ALGORITHMS, get_algorithm
from tutorial_lib.config import Config
from tutorial_lib.data.dataset import DatasetError
from tutorial_lib.data.sources import find_dataset, load_dataset
from tutorial_lib.studies.paper import TABLE2
from tutorial_lib.studies.runs import Runs
from tutorial_lib.tasks import TASKS, Task, get_task

TUNING_SEED = 100
"""The first seed of the runs that options are chosen on. No reported run has such a seed."""


@dataclass(frozen=True)
class Grid:
    """One entry for every combination of task, algorithm and options.

    An algorithm that is trained for one limit is trained for each threshold of the task.
    """

    tasks: tuple[str, ...] = ("CarCircle",)
    algorithms: tuple[str, ...] = ("C2IQL",)
    options: tuple[dict, ...] = ({},)
    """Changes of the profile's options. One agent is trained with each."""
    at_test: tuple[dict, ...] = ({},)
    """Changes of options that only playing reads. Every agent plays its episodes once with each."""
    seeds: int = 3
    """The number of seeds."""
    first_seed: int = 0
    """The first seed. The seeds of reported runs are 0 and up, and those of tuning are `TUNING_SEED` and up.
    The episodes of an evaluation start in states that belong to the seed of the run."""
    profile: str | None = None
    """The profile of these entries. None: the one that `entries` is asked for."""
    limits: Callable[[Task], tuple[float, ...]] | None = None
    """Returns the limits that agents play under. None: the task's thresholds."""


@dataclass(frozen=True)
class Study:
    """A question, and the grids whose results answer it."""

    question: str
    grids: tuple[Grid, ...]
    diagnoses: bool = False
    """Do the results have the columns of `Agent.diagnose`?"""


def unseen(task: Task) -> tuple[float, ...]:
    """Returns limits between the task's own, and one 20% below the smallest."""
    small, middle, high = task.thresholds
    return 0.8 * small, (small + middle) / 2, (middle + high) / 2


def throughout(task: Task) -> tuple[float, ...]:
    """Returns the limits that study `told` tells a policy at every step."""
    return 0.0, *task.thresholds, math.inf


KAPPAS = (0.5, 0.7, 0.9)
SIZES = ({"crm": "linear"}, {"crm_width": 16, "crm_layers": 1}, {"crm_width": 64}, {"crm_width": 256}) + (
    {"crm_width": 512, "crm_layers": 5},
)
TABLE1_ALGORITHMS = tuple(name for name, kind in ALGORITHMS.items() if kind.in_table1)
ABLATIONS = ("C2IQL", "C2IQL w/o CR", "C2IQL w/o CC", "CIQL")
WHO_KEEPS: tuple[dict, ...] = (
    {"tell": "throughout", "margin": 0.0, "candidates": 0},  # the network alone
    {"tell": "switch", "margin": 0.0, "candidates": 0},  # two policies and the rule
    {"infinite_at_test": "never", "margin": 0.0, "candidates": 0},  # the network and the rule of eq. 23
    {"margin": 0.0, "candidates": 0},  # and infinity where the budget covers all steps
    {"candidates": 0},  # and a margin
    {},  # and the brake
)
_SET: dict = {"thresholds": "set", "policy_thresholds": "all"}
_NO_CLOCK: dict = _SET | {"clock": False, "time_limits": "rate", "evaluators": 0}
TAKEN_BACK: tuple[dict, ...] = (
    {},
    {"policy_thresholds": "all"},
    _SET,
    _NO_CLOCK,
    {"price_unit": "return", "unsafe_price": 6.0},
    {"price_unit": "return", "unsafe_price": None},
    {"cost_critics": 1},
    {"evaluated_critic": "highest"},
    {"cost_kappa": None},
    {"kappa_1": 0.7},
    {"crm_noise_rate": 0.0},
    {"normalise_observations": False},
    {"first_guess": "zero"},
)
"""Each takes one departure of the course's recipe back, and what needs it."""
ADDED: tuple[dict, ...] = (
    {},
    {"normalise_observations": True},
    {"first_guess": "data"},
    {"crm_noise_rate": 0.01},
    {"cost_critics": 2},
    {"thresholds_per": "sample"},
    {"zero_threshold": True},
    {"kappa_1": 0.8},
    {"time_limits": "rate"},
    {"unsafe_price": 3.0, "price_unit": "advantage"},
    {"clock": True, "time_limits": "mask"},
    {"clock": True, "time_limits": "mask", "thresholds": "range"},
)
"""Each adds one departure to the algorithm as it is printed."""
TRIED: tuple[dict, ...] = ({"policy_thresholds": "own"}, {"policy_thresholds": "all"})
PLAYED = tuple({"candidates": count, "margin": margin} for count in (0, 64) for margin in (0.0, 0.1))
PAIR = ("BallRun", "CarCircle")  # a short horizon and a long one: the smallest gamma^T is 0.01 and 0.05

STUDIES: dict[str, Study] = {
    "table1": Study(
        "The paper's Table 1: how much reward at how much cost, on every task whose data is shipped?",
        (
            Grid(tuple(TASKS), ("C2IQL",), seeds=5),
            Grid(tuple(TASKS), ("C2IQL",), seeds=5, profile="printed"),
            Grid(tuple(TASKS), tuple(name for name in TABLE1_ALGORITHMS if name != "C2IQL")),
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
        (Grid(options=tuple({"crm_noise": noise, "crm_noise_rate": 0.0} for noise in TABLE2["noise"])),),
        diagnoses=True,
    ),
    "crm-size": Study("How large must the reconstruction model be?", (Grid(options=SIZES),), diagnoses=True),
    "time-limits": Study(
        "What should a time limit mean to the cost critics?",
        (
            Grid(
                PAIR,
                options=tuple(_NO_CLOCK | {"time_limits": kind} for kind in ("rate", "bootstrap", "mask")),
            ),
        ),
    ),
    "thresholds-per": Study(
        "One threshold per sample, or one per batch?",
        (Grid(PAIR, options=tuple(_SET | {"thresholds_per": per} for per in ("sample", "batch"))),),
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
        "Does the agent keep limits that no other study plays under?",
        (Grid(tuple(TASKS), seeds=5, limits=unseen),),
    ),
    "who-keeps": Study(
        "Who keeps the limit: the network, the budget rule, the margin or the brake?",
        (
            Grid(("BallRun", "BallCircle", "CarCircle"), seeds=5, at_test=WHO_KEEPS),
            Grid(("BallRun", "BallCircle", "CarCircle"), ("BC (budget rule)",), seeds=5),
        ),
    ),
    "departures": Study(
        "What does each departure from the printed algorithm do, taken back from the recipe or added alone?",
        (
            Grid(("BallCircle",), options=TAKEN_BACK),
            Grid(("BallCircle",), options=ADDED, profile="printed"),
        ),
    ),
    "told": Study(
        "What is paid when the policy is told one limit at every step, whatever was paid before?",
        (Grid(tuple(TASKS), seeds=5, at_test=({"tell": "throughout"},), limits=throughout),),
    ),
    "tuning": Study(
        "What was tried before the recipe was frozen, on seeds of its own?",
        (Grid(tuple(TASKS), options=TRIED, at_test=PLAYED, first_seed=TUNING_SEED),),
    ),
}


def get_study(name: str) -> Study:
    """The study called `name`. Raises ValueError, which lists the studies that exist."""
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}: the studies are {', '.join(STUDIES)}")
    return STUDIES[name]


def varied_options(study: Study) -> tuple[str, ...]:
    """The names of the options that differ between the entries of a grid. They are columns of the results."""
    varied = []
    for grid in study.grids:
        for changes in (grid.options, grid.at_test):
            names = (name for options in changes for name in options)
            varied += [name for name in names if len({options.get(name) for options in changes}) > 1]
    return tuple(dict.fromkeys(varied))


def options_of(study: Study) -> list[str]:
    """The names of all options that at least one algorithm of the study reads."""
    kinds = [get_algorithm(name).Config for grid in study.grids for name in grid.algorithms]
    return list(dict.fromkeys(field.name for kind in kinds for field in dataclasses.fields(kind)))


def entries(
    study: Study,
    only: str = "*",
    change: Callable[[Config], Config] = lambda config: config,
    profile: str = "small",
    data: str = "shipped",
) -> list[Runs]:
    """The study's entries. With `only`, those whose name has a part that fits this pattern of file names.

    `change` is applied to every configuration, after the profile, the task's options and the grid's. `data`
    says where datasets are, as for `find_dataset`. Tasks without a dataset are left out. Raises DatasetError
    where no task has a dataset, and ValueError where no name fits.
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
                config=change(kind.configure(grid.profile or profile, **options)),
                seeds=tuple(range(grid.first_seed, grid.first_seed + grid.seeds)),
                trained_for=record.thresholds if kind.needs_limit else None,
                limits=grid.limits and grid.limits(record),
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
    """The checksum of the dataset at `path`. It is computed again only when `changed`, a time, differs."""
    return load_dataset(task, path).checksum
