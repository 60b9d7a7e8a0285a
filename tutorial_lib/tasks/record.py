"""The tasks as frozen records of what the simulators, the paper and DSRL say about them.

`TASKS` are the eight tasks of the paper's Table 1 and of the course. `MUJOCO_TASKS` are the seven tasks of
Table 6, whose simulator is an optional extra.

Sources of `TASKS`: horizon, dimensions and cost range from the paper's Table 3, discount factors and
thresholds from its Table 5; file names and reference returns from DSRL (Liu et al. 2024, CC BY 4.0). Sources
of `MUJOCO_TASKS`: horizon and dimensions from safety-gymnasium 1.0.0, all else but the following from DSRL.

The paper does not publish the discount factors and the thresholds of its Table 6. So both are chosen here.

- The discount factors follow the rule of the paper's Appendix B.2 for the horizon T: gamma_1^T is about 0.05,
  gamma_2^T about 0.1 and gamma_3^T about 0.2. They have four decimals, because with three the second and the
  third would be equal for T = 1000.
- The thresholds are 20, 40 and 80, the limits under which DSRL and OSRL evaluate these tasks. They are below
  half of the cost range, so that they do not follow the rule that Appendix B.2 has for thresholds.
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
    """The id under which the simulator's package registers the environment with gymnasium."""
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


def _mujoco(name, robot, horizon, dims, cost_range, trajectories, returns, falls=False):
    version = "v1" if name.endswith("Velocity") else "v0"
    return Task(
        name=name,
        family="mujoco",
        robot=robot,
        env_id=f"Safety{name}-{version}",
        horizon=horizon,
        obs_dim=dims[0],
        act_dim=dims[1],
        gammas={500: (0.994, 0.9954, 0.9968), 1000: (0.997, 0.9977, 0.9984)}[horizon],
        thresholds=(20, 40, 80),
        cost_range=cost_range,
        dsrl_file=f"Safety{name}Gymnasium-{version}-{cost_range}-{trajectories}.hdf5",
        min_return=returns[0],
        max_return=returns[1],
        terminates=falls,
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

MUJOCO_TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        #       name, robot                T   (obs, act)  C max  n   (R min, R max)
        _mujoco("PointCircle1", "Point", 500, (28, 2), 200, 1098, (20.067626953125, 61.72819519042969)),
        _mujoco("PointGoal1", "Point", 1000, (60, 2), 100, 2022, (0.01196012764197707, 30.071114857340543)),
        _mujoco("PointPush1", "Point", 1000, (76, 2), 150, 2379, (0.0014001545292344209, 16.518654299293367)),
        _mujoco("PointButton1", "Point", 1000, (76, 2), 200, 2268, (0.008822109034937853, 41.19301568767707)),
        _mujoco(
            "HalfCheetahVelocity", "HalfCheetah", 1000, (17, 6), 250, 2495, (5.7509765625, 2806.93310546875)
        ),
        _mujoco(
            "HopperVelocity", "Hopper", 1000, (11, 3), 250, 2240, (37.05154800415039, 1911.396728515625), True
        ),
        _mujoco(
            "AntVelocity", "Ant", 1000, (27, 8), 250, 2249, (6.1519012451171875, 2976.276611328125), True
        ),
    )
}

DSRL_FRONTIER: dict[str, dict[int, float]] = {
    "BallRun": {0: 440, 20: 450, 50: 900, 80: 1300},
    "CarRun": {0: 570},
    "DroneRun": {0: 410, 50: 500, 100: 660},
    "AntRun": {0: 700, 70: 750, 150: 950},
    "BallCircle": {0: 600, 30: 700, 60: 880},
    "CarCircle": {0: 430, 30: 480, 100: 530},
    "DroneCircle": {0: 680, 40: 780, 90: 990},
    "AntCircle": {0: 260, 75: 350, 130: 450},
    "PointCircle1": {0: 45, 75: 50, 140: 56, 180: 61},
    "PointGoal1": {0: 27, 10: 30, 50: 28, 100: 27},
    # DSRL's plots of PointPush1 and CarPush1 seem to have each other's titles: only so do they fit its
    # constants. These are from the plot with the title CarPush1.
    "PointPush1": {0: 14.5, 45: 16.5, 100: 13, 150: 11},
    "PointButton1": {0: 35, 20: 41, 100: 40, 200: 35},
    "HalfCheetahVelocity": {0: 2700, 100: 2750, 250: 2800},
    "HopperVelocity": {0: 1700, 120: 1750, 250: 1900},
    "AntVelocity": {5: 2700, 50: 2850, 140: 2970, 250: 2850},
}
"""The best returns in DSRL's data at some costs, read off its published plots."""


def all_tasks() -> dict[str, Task]:
    """The fifteen tasks by their names: `TASKS`, then `MUJOCO_TASKS`, installed or not."""
    return TASKS | MUJOCO_TASKS


def get_task(name: str) -> Task:
    """The task called `name`; its gymnasium id works too. Raises ValueError with the nearest names."""
    tasks = all_tasks()
    if name in tasks:
        return tasks[name]
    by_env_id = {task.env_id: task for task in tasks.values()}
    if name in by_env_id:
        return by_env_id[name]
    close = difflib.get_close_matches(name, tasks, n=2, cutoff=0.4)
    hint = f"did you mean {' or '.join(close)}? " if close else ""
    raise ValueError(f"unknown task {name!r}: {hint}the tasks are {', '.join(tasks)}")
