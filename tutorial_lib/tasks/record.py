"""The tasks as frozen records: what the simulator, the paper and DSRL each say about them.

Sources: horizon, dimensions and cost range from the paper's Table 3, discount factors and thresholds
from its Table 5; file names and reference returns from DSRL (Liu et al. 2024, CC BY 4.0).
"""

import difflib
from dataclasses import dataclass


@dataclass(frozen=True)
class Task:
    """One constrained task.

    `gammas` are the m = 3 cost discount factors of Table 5, in rising order; `thresholds` its small,
    middle and high limits on the undiscounted cost of an episode (a count of unsafe steps).
    `min_return` and `max_return` are DSRL's constants: normalised scores divide by them, so that
    scores compare across datasets. `terminates` tells whether a robot can end an episode early.
    """

    name: str
    env_id: str
    horizon: int
    obs_dim: int
    act_dim: int
    gammas: tuple[float, ...]
    thresholds: tuple[float, ...]
    cost_range: float
    dsrl_file: str
    min_return: float
    max_return: float
    terminates: bool

    @property
    def cost_limit_names(self) -> dict[float, str]:
        """The paper's words for its thresholds, e.g. {30: 'small', 50: 'middle', 70: 'high'}."""
        return dict(zip(self.thresholds, ("small", "middle", "high"), strict=True))


def _bullet(name, horizon, dims, gammas, thresholds, cost_range, trajectories, returns, terminates=False):
    return Task(
        name=name,
        env_id=f"Safety{name}-v0",
        horizon=horizon,
        obs_dim=dims[0],
        act_dim=dims[1],
        gammas=gammas,
        thresholds=thresholds,
        cost_range=cost_range,
        # DSRL names a file by its largest cost and its number of trajectories.
        dsrl_file=f"Safety{name}-v0-{cost_range}-{trajectories}.hdf5",
        min_return=returns[0],
        max_return=returns[1],
        terminates=terminates,
    )


_MEDIUM = (0.985, 0.99, 0.993)
_LONG = (0.99, 0.993, 0.995)

TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        #       name           T    (obs, act) gammas           thresholds     C max  n    (R min, R max)
        _bullet("BallRun", 100, (7, 2), (0.95, 0.96, 0.97), (30, 50, 70), 80, 940, (26.3398, 1327.4456)),
        _bullet("CarRun", 200, (7, 2), _MEDIUM, (10, 20, 40), 40, 651, (204.2873, 574.6533)),
        _bullet("DroneRun", 200, (17, 4), _MEDIUM, (30, 70, 110), 140, 1990, (10.5570, 682.8330), True),
        _bullet("AntRun", 200, (33, 8), _MEDIUM, (30, 70, 110), 150, 1816, (0.00177, 955.4819), True),
        _bullet("BallCircle", 200, (8, 2), _MEDIUM, (30, 50, 70), 80, 886, (0.38312, 881.4634)),
        _bullet("CarCircle", 300, (8, 2), _LONG, (30, 50, 70), 100, 1450, (3.48442, 534.3061)),
        _bullet("DroneCircle", 300, (18, 4), _LONG, (30, 50, 70), 100, 1923, (207.7942, 996.3892), True),
        _bullet("AntCircle", 500, (34, 8), _LONG, (40, 100, 160), 200, 5728, (0.01770, 460.7092), True),
    )
}

DSRL_FRONTIER = {
    "BallRun": {0: 440, 20: 450, 50: 900, 80: 1300},
    "CarRun": {0: 570},
    "DroneRun": {0: 410, 50: 500, 100: 660},
    "AntRun": {0: 700, 70: 750, 150: 950},
    "BallCircle": {0: 600, 30: 700, 60: 880},
    "CarCircle": {0: 430, 30: 480, 100: 530},
    "DroneCircle": {0: 680, 40: 780, 90: 990},
    "AntCircle": {0: 260, 75: 350, 130: 450},
}
"""The best returns in DSRL's data at some costs, read off its published plots."""


def get_task(name: str) -> Task:
    """The task called `name`; its gymnasium id works too. Raises ValueError with the nearest names."""
    if name in TASKS:
        return TASKS[name]
    by_env_id = {task.env_id: task for task in TASKS.values()}
    if name in by_env_id:
        return by_env_id[name]
    close = difflib.get_close_matches(name, TASKS, n=2, cutoff=0.4)
    hint = f"did you mean {' or '.join(close)}? " if close else ""
    raise ValueError(f"unknown task {name!r}: {hint}the tasks are {', '.join(TASKS)}")
