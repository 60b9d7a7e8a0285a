"""The tasks as frozen records of what the simulator, the paper and DSRL say about them.

Sources: horizon, dimensions and cost range from the paper's Table 3, discount factors and thresholds
from its Table 5; file names and reference returns from DSRL (Liu et al. 2024, CC BY 4.0).
"""

import difflib
from dataclasses import dataclass

from tutorial_lib.tasks.scene import CIRCLE, RUN, Scene


@dataclass(frozen=True)
class Task:
    """One constrained task. Two records are equal where all their fields are.

    Raises ValueError where the numbers of `thresholds` and of `limit_names` differ.
    """

    name: str
    """The task's name in this library, e.g. 'BallRun'."""
    family: str
    """Which simulator plays it: a key of `tutorial_lib.tasks.SIMULATORS`."""
    robot: str
    """What moves, e.g. 'Ball'."""
    env_id: str
    """The environment's id in gymnasium's registry."""
    horizon: int
    """T: an episode has at most so many steps."""
    obs_dim: int
    act_dim: int
    gammas: tuple[float, ...]
    """The m cost discount factors, in rising order (Table 5: m = 3)."""
    thresholds: tuple[float, ...]
    """The limits on the undiscounted cost of an episode, in rising order (Table 5 has three)."""
    cost_range: float
    """The largest cost of an episode in DSRL's data (Table 3)."""
    dsrl_file: str
    """The name of DSRL's dataset."""
    min_return: float
    max_return: float
    """DSRL's constants: a normalised return is (return - min_return) / (max_return - min_return). They are
    the same for every dataset of the task, so that scores compare across datasets."""
    terminates: bool
    """Whether the robot can fall, which ends an episode before the horizon."""
    max_step_cost: float = 1.0
    """The largest cost of a step. With 1.0 the cost of an episode is at most its number of steps."""
    limit_names: tuple[str, ...] = ("small", "middle", "high")
    """One word for each of `thresholds`. The default are the paper's words."""
    scene: Scene | None = None
    """The place that figures draw. None: the environment has no `position`, and there is nothing to draw."""

    def __post_init__(self):
        if len(self.limit_names) != len(self.thresholds):
            raise ValueError(
                f"{self.name} has {len(self.thresholds)} thresholds and {len(self.limit_names)} limit_names: "
                "give one name for each"
            )

    @property
    def cost_limit_names(self) -> dict[float, str]:
        """The words for the thresholds, e.g. {30: 'small', 50: 'middle', 70: 'high'}."""
        return dict(zip(self.thresholds, self.limit_names, strict=True))

    @property
    def typical_limit(self) -> float:
        """The middle threshold. Where their number is even, it is the lower of the two in the middle."""
        return self.thresholds[(len(self.thresholds) - 1) // 2]


def scene_of(task: Task) -> Scene:
    """The scene of a task. Raises ValueError for a task that has none."""
    if task.scene is None:
        raise ValueError(f"{task.name} has no scene: there are no positions to draw")
    return task.scene


def _bullet(robot, scene, horizon, dims, gammas, thresholds, cost_range, trajectories, returns, falls=False):
    name = robot + scene.name
    return Task(
        name=name,
        family="bullet",
        robot=robot,
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
        terminates=falls,
        scene=scene,
    )


_MEDIUM = (0.985, 0.99, 0.993)
_LONG = (0.99, 0.993, 0.995)

TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        #       robot, scene     T    (obs, act) gammas         thresholds     C max  n    (R min, R max)
        _bullet("Ball", RUN, 100, (7, 2), (0.95, 0.96, 0.97), (30, 50, 70), 80, 940, (26.3398, 1327.4456)),
        _bullet("Car", RUN, 200, (7, 2), _MEDIUM, (10, 20, 40), 40, 651, (204.2873, 574.6533)),
        _bullet("Drone", RUN, 200, (17, 4), _MEDIUM, (30, 70, 110), 140, 1990, (10.5570, 682.8330), True),
        _bullet("Ant", RUN, 200, (33, 8), _MEDIUM, (30, 70, 110), 150, 1816, (0.00177, 955.4819), True),
        _bullet("Ball", CIRCLE, 200, (8, 2), _MEDIUM, (30, 50, 70), 80, 886, (0.38312, 881.4634)),
        _bullet("Car", CIRCLE, 300, (8, 2), _LONG, (30, 50, 70), 100, 1450, (3.48442, 534.3061)),
        _bullet("Drone", CIRCLE, 300, (18, 4), _LONG, (30, 50, 70), 100, 1923, (207.7942, 996.3892), True),
        _bullet("Ant", CIRCLE, 500, (34, 8), _LONG, (40, 100, 160), 200, 5728, (0.01770, 460.7092), True),
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
