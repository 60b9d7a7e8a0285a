"""The training loop: sample, update, log, checkpoint, resume. It knows algorithms only by their interface."""

import time
from collections.abc import Callable
from pathlib import Path

import torch
from tqdm.auto import tqdm

from tutorial_lib.agents import Agent
from tutorial_lib.checkpoints import CHECKPOINT, TrainingError, resume, save_checkpoint
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.matmul import products, warn_where_bfloat16_is_slow


def train(
    agent: Agent,
    dataset: Dataset,
    updates: int | None = None,
    run_dir: Path | None = None,
    log_every: int = 250,
    checkpoint_every: int = 2_500,
    on_checkpoint: Callable[[Agent], object] | None = None,
    progress: bool = True,
) -> list[dict]:
    """Train all runs of `agent` until it has made `updates` updates (default: its config's). Returns the log.

    With a `run_dir`, scalars go to metrics.csv, and everything that is needed to continue goes to
    checkpoint.safetensors, every `checkpoint_every` updates. Called again on the same folder, it continues
    from there, bit for bit on the same machine. Each run draws from a generator of its own, seeded by its
    seed, so its batches do not depend on which runs train beside it. Raises TrainingError when a loss is NaN
    or infinite.
    """
    updates = agent.config.updates if updates is None else updates
    generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
    agent.data_checksum = dataset.checksum
    resumes = run_dir is not None and (run_dir / CHECKPOINT).exists()
    log = resume(agent, generators, run_dir) if resumes and run_dir else []
    if agent.config.precision == "bfloat16" and agent.device.type == "cpu":
        warn_where_bfloat16_is_slow()
    selected = _select(agent, dataset)
    with products():
        if not (resumes or agent.updates):
            agent.prepare(selected, progress)
            if run_dir:  # a reconstruction model can take longer than all updates
                save_checkpoint(agent, generators, log, run_dir)
        tensors = {id(part): part.tensors(agent.device) for part in selected}
        data = [tensors[id(part)] for part in selected]
        bar = tqdm(
            total=updates,
            initial=agent.updates,
            desc=agent.name,
            unit="update",
            disable=not progress,
            mininterval=0.5,
        )
        started, first = time.perf_counter(), agent.updates
        while agent.updates < updates:
            scalars = agent.update(agent.draw_all(data, generators))
            bar.update()
            last = agent.updates == updates
            logs = last or agent.updates % log_every == 0
            saves = run_dir and (last or agent.updates % checkpoint_every == 0)
            if logs or saves:  # what is not finite must not reach a checkpoint either
                rows = _rows(agent, scalars, (agent.updates - first) / (time.perf_counter() - started))
                _check_finite(rows)
            if logs:
                log += rows
                bar.set_postfix(_summary(scalars))
            if saves and run_dir:
                save_checkpoint(agent, generators, log, run_dir)
                if on_checkpoint:
                    on_checkpoint(agent)
    bar.close()
    agent.check(log)
    return log


def _select(agent: Agent, dataset: Dataset) -> list[Dataset]:
    """What each run learns from; runs with the same limit share it."""
    limits = agent.limits or (float("inf"),) * len(agent.seeds)
    of_limit = {limit: agent.select(dataset, limit) for limit in dict.fromkeys(limits)}
    return [of_limit[limit] for limit in limits]


def _rows(agent: Agent, scalars: dict[str, torch.Tensor], speed: float) -> list[dict]:
    """One row per run: which, when, how fast, and every scalar."""
    values = {name: value.tolist() for name, value in scalars.items()}
    return [
        {"seed": seed, "update": agent.updates, "updates_per_second": round(speed, 2)}
        | {name: value[run] for name, value in values.items()}
        for run, seed in enumerate(agent.seeds)
    ]


def _check_finite(rows: list[dict]) -> None:
    for row in rows:
        for name, value in row.items():
            if value - value != 0:  # NaN and both infinities
                raise TrainingError(
                    f"{name} is {value} at update {row['update']} of seed {row['seed']}: "
                    "the last checkpoint is kept; try a smaller learning rate, look for outliers in the data"
                )


def _summary(scalars: dict[str, torch.Tensor]) -> dict[str, str]:
    """What the progress bar shows: the losses and the safe fraction, averaged over the runs."""
    shown = {
        name: value for name, value in scalars.items() if name.endswith("_loss") or name == "safe_fraction"
    }
    return {name.removesuffix("_loss"): f"{value.mean():.3g}" for name, value in shown.items()}


# --- Files ---
