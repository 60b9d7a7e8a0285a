"""Agents in the simulator: rollouts under the budget rule, and the raw results of an evaluation."""

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
"""Episodes that share one process and one call of the policy. Results do not depend on the number of
workers because it is fixed: a product of matrices may round a row differently in a batch of another size."""


class Rollout(NamedTuple):
    """E episodes of at most T steps, step by step; after an episode's end its rows are zero."""

    rewards: np.ndarray
    """(T, E)"""
    costs: np.ndarray
    """(T, E), 0 or 1"""
    told: np.ndarray
    """(T, E): the limit that the policy was told at each step (NaN: the policy takes none)"""
    positions: np.ndarray
    """(T, E, 2): where the robot was, in metres"""
    lengths: np.ndarray
    """(E,): steps until the robot fell or the horizon was reached"""
    predicted_costs: np.ndarray
    """(E,): the cost that the critics expected at the first step (NaN: they cannot tell)"""


def rollout(agent: Agent, limits, seeds: Sequence[int], run: int = 0) -> Rollout:
    """Play one episode per seed with run number `run`, all at once, each under its limit."""
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
        told[t], actions = player.told, player.act(observations)
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
) -> pd.DataFrame:
    """Raw results: one row per run, limit and episode, by default under the task's own limits.

    The episodes of a seed start alike under every limit. More workers give the same rows, sooner. `seeds`:
    only the runs with these seeds. Raises ValueError for a limit that the agent was not trained for and
    cannot be told.
    """
    jobs = [
        (run, limit, range(first, min(first + EPISODES_TOGETHER, episodes)))
        for run, seed in enumerate(agent.seeds)
        if seeds is None or seed in seeds
        for limit in _limits_of(agent, run, limits)
        for first in range(0, episodes, EPISODES_TOGETHER)
    ]
    frames = joblib.Parallel(n_jobs=workers)(joblib.delayed(_evaluate_job)(agent, *job) for job in jobs)
    return pd.concat(frames, ignore_index=True)


def _limits_of(agent: Agent, run: int, limits: Sequence[float] | None) -> Sequence[float]:
    """The limits that a run plays under: those asked for, its own, or the task's."""
    if agent.limits is None:
        return agent.task.thresholds if limits is None else limits
    if limits is not None and set(limits) != set(agent.limits):
        own = ", ".join(f"{limit:g}" for limit in dict.fromkeys(agent.limits))
        raise ValueError(f"{agent.name} was trained for the limit {own}, and can be told no other")
    return [agent.limits[run]]


def _evaluate_job(agent: Agent, run: int, limit: float, episodes: range) -> pd.DataFrame:
    seed, threads = agent.seeds[run], torch.get_num_threads()
    torch.set_num_threads(1)  # small products: more threads are slower, and the workers are the cores
    try:
        played = rollout(agent, limit, [1000 * (seed + 1) + episode for episode in episodes], run)
    finally:
        torch.set_num_threads(threads)
    return pd.DataFrame(
        {
            "task": agent.task.name,
            "algorithm": agent.name,
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
    """Building a simulator takes longer than playing an episode of some tasks: each process keeps its own."""
    return [make_env(task_name) for _ in range(count)]


# --- Scores ---
