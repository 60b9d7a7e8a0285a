"""Agents in the simulator: rollouts under the budget rule, and the raw results of an evaluation."""

import functools
from typing import NamedTuple

import joblib
import numpy as np
import pandas as pd
import torch

from tutorial_lib.agents import Agent
from tutorial_lib.costs.conditioning import check_threshold, nearest_threshold, rescaled_budget
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
    conditions: np.ndarray
    """(T, E): the threshold that the policy was given at each step (NaN: the policy takes none)"""
    positions: np.ndarray
    """(T, E, 2): where the robot was, in metres"""
    lengths: np.ndarray
    """(E,): steps until the robot fell or the horizon was reached"""
    predicted_costs: np.ndarray
    """(E,): the cost that the critics expected at the first step (NaN: they cannot tell)"""


def condition(agent: Agent, limit: np.ndarray, spent: np.ndarray, t: int) -> np.ndarray:
    """The threshold that a conditioned agent is given at step t: eq. 23, then the nearest of its set."""
    task, config = agent.task, agent.config
    if config.time_limits == "mask":  # its critics speak of the remaining cost: do not rescale the budget
        budget = limit - spent
    else:
        budget = rescaled_budget(limit, spent, t, task.horizon)
    chosen = nearest_threshold(
        budget, task, with_infinite=config.infinite_at_test == "nearest", with_zero=config.zero_threshold
    )
    if config.infinite_at_test == "covered":
        chosen = np.where(limit - spent >= task.horizon - t, np.inf, chosen)
    return chosen


def rollout(agent: Agent, limits, seeds, run: int = 0) -> Rollout:
    """Play one episode per seed with run number `run`'s mean action, all at once, each under its limit."""
    task, count = agent.task, len(seeds)
    limits = np.array([check_threshold(limit) for limit in np.broadcast_to(limits, count)])
    envs = _environments(task.name, count)
    observations = np.stack([env.reset(seed=int(seed))[0] for env, seed in zip(envs, seeds, strict=True)])
    rewards, costs = np.zeros((2, task.horizon, count))
    conditions = np.full((task.horizon, count), np.nan)
    positions = np.zeros((task.horizon, count, 2))
    lengths = np.full(count, task.horizon)
    alive = np.ones(count, bool)
    for t in range(task.horizon):
        if agent.conditioned:
            conditions[t] = condition(agent, limits, costs.sum(0), t)
        if t == 0:
            predicted = agent.predicted_cost(
                observations, conditions[0] if agent.conditioned else limits, run
            )
        actions = agent.act(observations, conditions[t], run)
        for e in np.flatnonzero(alive):
            observations[e], rewards[t, e], terminated, _, info = envs[e].step(actions[e])
            costs[t, e] = info["cost"]
            positions[t, e] = envs[e].position
            if terminated:
                alive[e], lengths[e] = False, t + 1
        if not alive.any():
            break
    return Rollout(rewards, costs, conditions, positions, lengths, predicted)


def evaluate(agent: Agent, thresholds=None, episodes: int = 10, workers: int = 1, seeds=None) -> pd.DataFrame:
    """Raw results: one row per run, threshold and episode, by default under the task's three thresholds.

    The episodes of a seed start alike under every threshold. More workers give the same rows, sooner.
    `seeds`: only these of the agent's runs. Raises ValueError for a limit that the agent was not trained
    for and cannot be told.
    """
    own = agent.task.thresholds if agent.threshold is None else [agent.threshold]
    thresholds = own if thresholds is None else thresholds
    if agent.threshold is not None and set(thresholds) != set(own):
        raise ValueError(
            f"{agent.name} was trained for the limit {agent.threshold:g}, and can be told no other"
        )
    jobs = [
        (run, threshold, range(first, min(first + EPISODES_TOGETHER, episodes)))
        for run, seed in enumerate(agent.seeds)
        if seeds is None or seed in seeds
        for threshold in thresholds
        for first in range(0, episodes, EPISODES_TOGETHER)
    ]
    frames = joblib.Parallel(n_jobs=workers)(joblib.delayed(_evaluate_job)(agent, *job) for job in jobs)
    return pd.concat(frames, ignore_index=True)


def _evaluate_job(agent: Agent, run: int, threshold: float, episodes: range) -> pd.DataFrame:
    seed, threads = agent.seeds[run], torch.get_num_threads()
    torch.set_num_threads(1)  # small products: more threads are slower, and the workers are the cores
    try:
        played = rollout(agent, threshold, [1000 * (seed + 1) + episode for episode in episodes], run)
    finally:
        torch.set_num_threads(threads)
    return pd.DataFrame(
        {
            "task": agent.task.name,
            "algorithm": agent.name,
            "profile": agent.config.profile,
            "seed": seed,
            "threshold": threshold,
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
