"""Measures how fast `c2iql evaluate` plays episodes, compared with the bare simulator on the same actions."""

import functools
import time
from collections.abc import Callable
from typing import Any

import joblib
import numpy as np
import pandas as pd
from joblib.externals.loky import get_reusable_executor

from tutorial_lib import playing
from tutorial_lib.agents.c2iql import C2IQL
from tutorial_lib.tasks import Task, make_env


def simulation(
    task: Task, workers: int, rounds: int = 3, done: Callable[[], object] = lambda: None
) -> pd.DataFrame:
    """One row per way to play: processes, steps per second, and their share of the bare speed x processes.

    The bare simulator and our environment play the actions of the rollouts' policy, in whole episodes with
    their resets.
    """
    agent = C2IQL(task, C2IQL.configure("small"))
    actions = policy_actions(agent)
    cases = {
        ("bare simulator", 1): lambda: play("bare", task.name, actions),
        ("our environment", 1): lambda: play("ours", task.name, actions),
        ("rollouts", 1): lambda: play_rollouts(agent, 1),
        ("bare simulator", workers): lambda: play_beside("bare", task.name, actions, workers),
        # The warm-up plays this first, as it needs the most memory: joblib replaces processes whose memory
        # grew much since their first job.
        ("rollouts", workers): lambda: play_rollouts(agent, workers),
    }
    speeds = np.zeros((rounds + 1, len(cases)))
    for turn in range(rounds + 1):  # the first, backwards, is a warm-up: it starts processes and simulators
        order = list(enumerate(cases.values()))
        for column, case in order if turn % 2 else reversed(order):
            started = time.perf_counter()
            steps = case()
            speeds[turn, column] = steps / (time.perf_counter() - started)
            done()
    get_reusable_executor().shutdown()  # the next task begins with fresh processes
    rows = []
    for (what, processes), speed in zip(cases, speeds[1:].T, strict=True):
        row = {"what": what, "processes": processes, "steps_per_second": np.median(speed)}
        rows.append(row | {"of_bare": np.median(speed / (speeds[1:, 0] * processes))})
    return pd.DataFrame(rows)


class Recorder(C2IQL):
    """An agent that keeps the actions that it takes."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.taken: list[np.ndarray] = []

    def act(self, *args: Any, **kwargs: Any) -> np.ndarray:
        """The actions (E, act) of the agent, which are also appended to `taken`."""
        self.taken.append(super().act(*args, **kwargs))
        return self.taken[-1]


def policy_actions(agent: C2IQL) -> np.ndarray:
    """The actions (T, E, act) of an untrained agent with the same options in its first E episodes."""
    recorder = Recorder(agent.task, agent.config, agent.seeds)
    playing.rollout(recorder, agent.task.thresholds[0], range(playing.EPISODES_TOGETHER))
    return np.stack(recorder.taken)


def play(kind: str, task_name: str, actions: np.ndarray) -> int:
    """Play every episode of `actions` (T, E, act), one after the other. Returns the number of steps."""
    env = _environment(kind, task_name)
    for seed in range(actions.shape[1]):
        np.random.seed(seed)  # the bare simulator ignores the seed of reset
        env.reset(seed=seed)
        for action in actions[:, seed]:
            env.step(action)
    return actions.shape[0] * actions.shape[1]


def play_beside(kind: str, task_name: str, actions: np.ndarray, workers: int) -> int:
    """Run `play` in several processes at once. Returns the number of steps of all."""
    jobs = [joblib.delayed(play)(kind, task_name, actions)] * workers
    return sum(joblib.Parallel(n_jobs=workers)(jobs))


@functools.lru_cache
def _environment(kind: str, task_name: str) -> Any:
    """The environment of this process: ours, or the bare simulator without gymnasium's wrappers."""
    env = make_env(task_name)
    return env if kind == "ours" else env._sim


def play_rollouts(agent: C2IQL, workers: int) -> int:
    """Play as `c2iql evaluate` does, one job for each worker. Returns the number of steps."""
    episodes = playing.EPISODES_TOGETHER * workers
    return int(playing.evaluate(agent, agent.task.thresholds[:1], episodes, workers)["length"].sum())
