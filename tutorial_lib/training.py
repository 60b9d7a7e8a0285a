"""The training loop: sample, update, log, checkpoint, resume. It knows algorithms only by their interface."""

import dataclasses
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from tqdm.auto import tqdm

from tutorial_lib.agents import Agent
from tutorial_lib.checkpoints import CHECKPOINT, TrainingError, resume, save_checkpoint
from tutorial_lib.data.dataset import Batch, Dataset, sample_batch
from tutorial_lib.matmul import products, warn_where_bfloat16_is_slow


def train(
    agent: Agent,
    dataset: Dataset,
    steps: int | None = None,
    run_dir: Path | None = None,
    log_every: int = 250,
    checkpoint_every: int = 2_500,
    on_checkpoint: Callable[[Agent], None] | None = None,
    progress: bool = True,
) -> list[dict]:
    """Train all runs of `agent` until it has made `steps` updates (default: its config's). Returns the log.

    With a `run_dir`, scalars go to metrics.csv and everything needed to go on to checkpoint.safetensors,
    every `checkpoint_every` updates; called again on the same folder, it continues from there, bit for bit
    on the same machine. Each run samples with a generator of its own, seeded by its seed, so its batches
    do not depend on which seeds train beside it. Raises TrainingError when a loss is NaN or infinite.
    """
    steps = agent.config.steps if steps is None else steps
    generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
    agent.data_checksum = dataset.checksum
    resumes = run_dir is not None and (run_dir / CHECKPOINT).exists()
    log = resume(agent, generators, run_dir) if resumes else []
    dataset = agent.select_episodes(dataset)
    if agent.config.shift_rewards:
        dataset = dataclasses.replace(dataset, rewards=dataset.rewards - dataset.rewards.min())
    if agent.config.precision == "bfloat16" and agent.device.type == "cpu":
        warn_where_bfloat16_is_slow()
    with products():
        if not (resumes or agent.updates):
            agent.prepare(dataset, progress)
            if run_dir:  # a reconstruction model can take longer than all updates
                save_checkpoint(agent, generators, log, run_dir)
        data = _training_data(dataset, agent)
        bar = tqdm(
            total=steps,
            initial=agent.updates,
            desc=agent.name,
            unit="update",
            disable=not progress,
            mininterval=0.5,
        )
        started, first = time.perf_counter(), agent.updates
        while agent.updates < steps:
            batch = sample_batch(data, agent.config.batch_size, generators)
            scalars = agent.update(batch, generators)
            bar.update()
            last = agent.updates == steps
            logs = last or agent.updates % log_every == 0
            saves = run_dir and (last or agent.updates % checkpoint_every == 0)
            if logs or saves:  # what is not finite must not reach a checkpoint either
                rows = _rows(agent, scalars, (agent.updates - first) / (time.perf_counter() - started))
                _check_finite(rows)
            if logs:
                log += rows
                bar.set_postfix(_summary(scalars))
            if saves:
                save_checkpoint(agent, generators, log, run_dir)
                if on_checkpoint:
                    on_checkpoint(agent)
    bar.close()
    _warn_of_negative_q(agent, log)
    return log


def _warn_of_negative_q(agent: Agent, log: list[dict]) -> None:
    share = max((row.get("negative_q", 0.0) for row in log[-len(agent.seeds) :]), default=0.0)
    priced = agent.can_price and agent.config.unsafe_price is not None
    if share > 0.01 and not priced and not agent.config.shift_rewards:
        warnings.warn(
            f"{share:.0%} of Q_r are negative: the zero penalty rewards unsafe actions there; "
            f"try shift_rewards=True{', or an unsafe_price' if agent.can_price else ''}",
            stacklevel=3,
        )


def _training_data(dataset: Dataset, agent: Agent) -> Batch:
    data = dataset.tensors(agent.device)
    # A Gaussian policy with a tanh mean cannot reach an action of exactly one: IQL clips a hair inside.
    return data._replace(actions=data.actions.clamp(-1 + 1e-5, 1 - 1e-5))


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
