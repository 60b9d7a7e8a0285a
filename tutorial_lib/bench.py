"""What this machine can do: `c2iql bench` measures training and simulation in about a minute.

Machines are noisy, so everything is measured in turns, several times, and medians are reported; a ratio is
the median of the ratios of measurements that stand side by side. Numbers depend on what else is running.
"""

import functools
import time
from collections.abc import Callable

import joblib
import numpy as np
import pandas as pd
import torch
from tqdm.auto import tqdm

from tutorial_lib import evaluation
from tutorial_lib.algorithms import get_algorithm
from tutorial_lib.config import PROFILES, get_profile
from tutorial_lib.datasets import Batch, sample_batch
from tutorial_lib.envs import make_env
from tutorial_lib.tasks import Task

PARTS = ("sampling", "reconstruction", "networks", "backward", "optimiser")
"""The parts of an update: batch and limits; the cost reconstruction model; the other networks and the
losses, forward; gradients; Adam's step with the learning rate, and the target networks."""


def bench(
    task: Task, workers: int | None = None, rounds: int = 3, seconds: float = 0.6, device="cpu"
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Both tables, `training` and `simulation`. A measurement of training lasts `seconds` or one update."""
    workers = workers or joblib.cpu_count()  # the cores that this process may use
    trainings = [(profile, runs) for profile in PROFILES for runs in (1, 3)]
    with tqdm(total=(rounds + 1) * (len(trainings) + 5), desc="measuring", leave=False) as bar:
        return (
            training(task, trainings, rounds, seconds, device, bar.update),
            simulation(task, workers, rounds, bar.update),
        )


# --- Training ---


def training(
    task: Task,
    cases: list[tuple[str, int]],
    rounds: int = 3,
    seconds: float = 0.6,
    device="cpu",
    done: Callable[[], object] = lambda: None,
) -> pd.DataFrame:
    """One row per case (profile, runs trained together): updates per second, each part's share of the time.

    Real updates of C2IQL on random transitions: how long they take does not depend on what they hold.
    `hours` is what the profile's number of updates would take, without its reconstruction model.
    """
    data = _random_transitions(task, 10_000, device)
    stopwatches = [_Updates(task, profile, runs, data, device) for profile, runs in cases]
    times = np.zeros((rounds + 1, len(cases), len(PARTS)))  # seconds per update
    for turn in range(rounds + 1):
        for case, stopwatch in enumerate(stopwatches):
            times[turn, case] = stopwatch.measure(seconds if turn else 0)  # the first turn is a warm-up
            done()
    rows = []
    for (profile, runs), parts in zip(cases, times[1:].swapaxes(0, 1), strict=True):
        speed = float(np.median(1 / parts.sum(1)))
        shares = np.median(parts / parts.sum(1, keepdims=True), axis=0)
        row = {"profile": profile, "runs": runs, "updates_per_second": speed}
        row |= {"hours": get_profile(profile).steps / speed / 3600}
        rows.append(row | dict(zip(PARTS, shares / shares.sum(), strict=True)))
    return pd.DataFrame(rows)


class _Updates:
    """Times the updates of one agent by laps: everything since the last lap is charged to one part."""

    def __init__(self, task: Task, profile: str, runs: int, data: Batch, device):
        agent = get_algorithm("C2IQL")(task, get_profile(profile), seeds=range(runs), device=device)
        self.agent, self.data, self.device = agent, data, torch.device(device)
        self.generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
        self.laps = dict.fromkeys(PARTS, 0.0)
        agent._total = self._around(agent._total, "sampling", "networks")
        model = agent.reconstruction
        model.forward = self._around(model.forward, "networks", "reconstruction")
        agent.optimiser.step = self._around(agent.optimiser.step, "backward", "optimiser")

    def measure(self, seconds: float) -> list[float]:
        """Seconds per update of each part, over as many updates as fit."""
        self.laps, updates = dict.fromkeys(PARTS, 0.0), 0
        self._lap("sampling")
        self.laps["sampling"] = 0.0
        while not updates or sum(self.laps.values()) < seconds:
            batch = sample_batch(self.data, self.agent.config.batch_size, self.generators)
            self.agent.update(batch, self.generators)
            self._lap("optimiser")
            updates += 1
        return [self.laps[part] / updates for part in PARTS]

    def _around(self, function, before: str, inside: str):
        """The function, which charges the time until it is called to one part and its own to another."""

        def timed(*args, **kwargs):
            self._lap(before)
            result = function(*args, **kwargs)
            self._lap(inside)
            return result

        return timed

    def _lap(self, part: str) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)  # calls return before the device has done the work
        now = time.perf_counter()
        self.laps[part] += now - getattr(self, "last", now)
        self.last = now


def _random_transitions(task: Task, count: int, device) -> Batch:
    generator = torch.Generator().manual_seed(0)
    obs, act = (task.obs_dim,), (task.act_dim,)
    shapes = {"observations": obs, "next_observations": obs, "actions": act}
    values = {f: torch.rand(count, *shapes.get(f, ()), generator=generator) for f in Batch._fields}
    flags = {field: (values[field] < 0.01).float() for field in ("terminals", "timeouts")}
    return Batch(**{field: value.to(device) for field, value in (values | flags).items()})


# --- Simulation ---


def simulation(
    task: Task, workers: int, rounds: int = 3, done: Callable[[], object] = lambda: None
) -> pd.DataFrame:
    """One row per way to step: processes, steps per second, and the share of bare simulator x processes.

    Bare simulator and our environment play the same actions, those of the rollouts' policy, in whole episodes
    with their resets.
    """
    agent = get_algorithm("C2IQL")(task, get_profile("small"))
    actions = _actions(agent)
    cases = {
        ("bare simulator", 1): lambda: _play("bare", task.name, actions),
        ("our environment", 1): lambda: _play("ours", task.name, actions),
        ("rollouts", 1): lambda: _rollouts(agent, 1),
        ("rollouts", workers): lambda: _rollouts(agent, workers),
        ("bare simulator", workers): lambda: _play_beside("bare", task.name, actions, workers),
    }
    speeds = np.zeros((rounds + 1, len(cases)))
    for turn in range(rounds + 1):  # the first turn is a warm-up: processes start, simulators are built
        order = list(enumerate(cases.values()))
        for column, case in order if turn % 2 else reversed(order):
            started = time.perf_counter()
            steps = case()
            speeds[turn, column] = steps / (time.perf_counter() - started)
            done()
    rows = []
    for (what, processes), speed in zip(cases, speeds[1:].T, strict=True):
        row = {"what": what, "processes": processes, "steps_per_second": np.median(speed)}
        rows.append(row | {"of_bare": np.median(speed / (speeds[1:, 0] * processes))})
    return pd.DataFrame(rows)


def _actions(agent) -> np.ndarray:
    """What the policy does in the first episodes: (T, E, act)."""
    taken, act = [], agent.act
    agent.act = lambda *inputs: taken.append(act(*inputs)) or taken[-1]
    evaluation.rollout(agent, agent.task.thresholds[0], range(evaluation.EPISODES_TOGETHER))
    del agent.act
    return np.stack(taken)


def _play(kind: str, task_name: str, actions: np.ndarray) -> int:
    """Play every episode of `actions` (T, E, act), one after the other; returns the number of steps."""
    env = _environment(kind, task_name)
    for seed in range(actions.shape[1]):
        np.random.seed(seed)  # all that the bare simulator heeds
        env.reset(seed=seed)
        for action in actions[:, seed]:
            env.step(action)
    return actions.shape[0] * actions.shape[1]


def _play_beside(kind: str, task_name: str, actions: np.ndarray, workers: int) -> int:
    """`_play` in several processes at once: what the machine gives when its cores are shared."""
    jobs = [joblib.delayed(_play)(kind, task_name, actions)] * workers
    return sum(joblib.Parallel(n_jobs=workers)(jobs))


@functools.lru_cache
def _environment(kind: str, task_name: str):
    """Each process keeps its own. The bare simulator is what gymnasium.make gives, without its wrappers."""
    env = make_env(task_name)
    return env if kind == "ours" else env._sim


def _rollouts(agent, workers: int) -> int:
    """As `c2iql evaluate` does it, one job for each worker; returns the number of steps."""
    episodes = evaluation.EPISODES_TOGETHER * workers
    return int(evaluation.evaluate(agent, agent.task.thresholds[:1], episodes, workers)["length"].sum())
