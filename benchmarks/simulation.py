"""How fast episodes are played: by `c2iql evaluate`, and by the bare simulator with the same actions."""

import functools
import time
from collections.abc import Callable

import joblib
import numpy as np
import pandas as pd
from joblib.externals.loky import get_reusable_executor

from tutorial_lib import playing
from tutorial_lib.agents import get_algorithm
from tutorial_lib.config import get_profile
from tutorial_lib.tasks import Task, make_env


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
        ("bare simulator", workers): lambda: _play_beside("bare", task.name, actions, workers),
        # Played first, as joblib replaces processes that come to need much more memory than at first.
        ("rollouts", workers): lambda: _rollouts(agent, workers),
    }
    speeds = np.zeros((rounds + 1, len(cases)))
    for turn in range(rounds + 1):  # the first, backwards, warms up: processes start, simulators are built
        order = list(enumerate(cases.values()))
        for column, case in order if turn % 2 else reversed(order):
            started = time.perf_counter()
            steps = case()
            speeds[turn, column] = steps / (time.perf_counter() - started)
            done()
    get_reusable_executor().shutdown()  # the next task's processes begin without this one's simulators
    rows = []
    for (what, processes), speed in zip(cases, speeds[1:].T, strict=True):
        row = {"what": what, "processes": processes, "steps_per_second": np.median(speed)}
        rows.append(row | {"of_bare": np.median(speed / (speeds[1:, 0] * processes))})
    return pd.DataFrame(rows)


def _actions(agent) -> np.ndarray:
    """What the policy does in the first episodes: (T, E, act)."""
    taken, act = [], agent.act
    agent.act = lambda *inputs: taken.append(act(*inputs)) or taken[-1]
    playing.rollout(agent, agent.task.thresholds[0], range(playing.EPISODES_TOGETHER))
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
    episodes = playing.EPISODES_TOGETHER * workers
    return int(playing.evaluate(agent, agent.task.thresholds[:1], episodes, workers)["length"].sum())
