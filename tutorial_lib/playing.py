"""Plays agents in the simulator, episode by episode, and returns the raw results of an evaluation."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import joblib
import numpy as np
import pandas as pd
import torch

from tutorial_lib.agents import Agent
from tutorial_lib.costs.conditioning import check_limit
from tutorial_lib.tasks import make_env

EPISODES_TOGETHER = 10
"""The number of episodes that share one process and one call of the policy. It is fixed, so that results do
not depend on the number of workers: a matrix product can round differently in a batch of another size."""
HELD_OUT_STARTS = 10_000_000
"""What is added to the seeds of the episodes whose first states nothing was chosen on."""


class Rollout(NamedTuple):
    """E episodes of at most T steps. Rewards, costs and positions are zero after the end of an episode."""

    rewards: np.ndarray
    """(T, E): the reward of each step."""
    costs: np.ndarray
    """(T, E): the cost of each step, 0 or 1."""
    told: np.ndarray
    """(T, E): the limit that the policy was told at each step. It is NaN if the policy takes none."""
    positions: np.ndarray
    """(T, E, 2): the position of the robot after each step, in metres."""
    lengths: np.ndarray
    """(E,): the number of steps until the robot fell or the horizon was reached."""
    predicted_costs: np.ndarray
    """(E,): the cost of the episode that the critics predicted at its first step, or NaN."""


def rollout(
    agent: Agent, limits: float | Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0
) -> Rollout:
    """Plays one episode per seed, all at once, with the run number `run` of the agent.

    `limits` is one limit for all episodes, or one per episode, (E,), in cost per episode. Raises ValueError
    for a limit that is negative or NaN.
    """
    task, count = agent.task, len(seeds)
    limits = np.array([check_limit(limit) for limit in np.broadcast_to(limits, count)])
    player, envs = agent.player(limits, seeds, run), _environments(task.name, count)
    observations = np.stack([env.reset(seed=int(seed))[0] for env, seed in zip(envs, seeds, strict=True)])
    rewards, costs = np.zeros((2, task.horizon, count))
    told = np.full((task.horizon, count), np.nan)
    positions = np.zeros((task.horizon, count, 2))
    lengths, alive = np.full(count, task.horizon), np.ones(count, bool)
    predicted = player.predicted_cost(observations)
    for t in range(task.horizon):
        actions = player.act(observations)
        told[t] = player.told
        for e in np.flatnonzero(alive):
            observations[e], rewards[t, e], terminated, _, info = envs[e].step(actions[e])
            costs[t, e] = info["cost"]
            if task.scene is not None:
                positions[t, e] = envs[e].position
            if terminated:
                alive[e], lengths[e] = False, t + 1
        player.see(rewards[t], costs[t])
        if not alive.any():
            break
    return Rollout(rewards, costs, told, positions, lengths, predicted)


def evaluate(
    agent: Agent,
    limits: Sequence[float] | None = None,
    episodes: int = 10,
    workers: int = 1,
    seeds: Sequence[int] | None = None,
    held_out: bool = False,
) -> pd.DataFrame:
    """Returns the raw results: one row per run, limit and episode.

    The default limits are those that a run was trained for, or else the task's own. The episodes of a run
    start in the same states under every limit. With `held_out`, they start in states that no other evaluation
    plays. The rows do not depend on the number of workers. With `seeds`, only the runs with these seeds play.
    Raises ValueError for a limit that is negative, or that the agent was not trained for and cannot be told.
    """
    jobs = [
        (run, limit, range(first, min(first + EPISODES_TOGETHER, episodes)), held_out)
        for run, seed in enumerate(agent.seeds)
        if seeds is None or seed in seeds
        for limit in _limits_of(agent, run, limits)
        for first in range(0, episodes, EPISODES_TOGETHER)
    ]
    frames = joblib.Parallel(n_jobs=workers)(joblib.delayed(_evaluate_job)(agent, *job) for job in jobs)
    return pd.concat(frames, ignore_index=True)


def _limits_of(agent: Agent, run: int, limits: Sequence[float] | None) -> Sequence[float]:
    """Returns the limits that a run plays under: those asked for, its own, or the task's."""
    if agent.limits is None:
        return agent.task.thresholds if limits is None else limits
    if limits is not None and set(limits) != set(agent.limits):
        own = ", ".join(f"{limit:g}" for limit in dict.fromkeys(agent.limits))
        raise ValueError(f"{agent.name} was trained for the limit {own}, and can be told no other")
    return [agent.limits[run]]


def _evaluate_job(agent: Agent, run: int, limit: float, episodes: range, held_out: bool) -> pd.DataFrame:
    seed, threads = agent.seeds[run], torch.get_num_threads()
    first = 1000 * (seed + 1) + (HELD_OUT_STARTS if held_out else 0)
    torch.set_num_threads(1)  # the products are small: more threads are slower
    try:
        played = rollout(agent, limit, [first + episode for episode in episodes], run)
    finally:
        torch.set_num_threads(threads)
    return pd.DataFrame(
        {
            "task": agent.task.name,
            "algorithm": agent.label,
            "profile": agent.config.profile,
            "seed": seed,
            "threshold": limit,
            "episode": list(episodes),
            "return": played.rewards.sum(0),
            "cost": played.costs.sum(0),
            "length": played.lengths,
            "predicted_cost": played.predicted_costs,
            "updates": agent.updates,
        }
    )


@functools.lru_cache(maxsize=2)
def _environments(task_name: str, count: int):
    """Returns the process's own simulators, which it keeps.

    For some tasks, building a simulator takes longer than playing an episode.
    """
    return [make_env(task_name) for _ in range(count)]
