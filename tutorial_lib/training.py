"""The training loop. It samples, updates, logs, saves checkpoints and resumes.

It uses only the interface that all algorithms share.
"""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm.auto import tqdm

from tutorial_lib.agents import Agent
from tutorial_lib.checkpoints import CHECKPOINT, TrainingError, resume, save_checkpoint
from tutorial_lib.data.dataset import Batch, Dataset
from tutorial_lib.files import held
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
    """Trains all runs of `agent` until it has made `updates` updates, and returns the log.

    The default of `updates` is the agent's own option. The log has one row per run every `log_every` updates.
    If `run_dir` is given, every `checkpoint_every` updates the log is written to metrics.csv there, and
    everything that is needed to continue to checkpoint.safetensors; then `on_checkpoint` is called. A later
    call with the same folder continues from the checkpoint, and on the same machine its numbers are equal to
    the bit. With a larger option `updates` a finished run continues, too, if no learning rate decays over the
    run: a cosine over more updates has other values from the first update on.

    Each run has its own generator, seeded with the run's seed, so its batches do not depend on the runs that
    train beside it. The folder is locked while it trains. Raises TrainingError if a logged number is NaN or
    infinite, or if the folder holds another run, and BlockingIOError if another process trains in it.
    """
    with held(run_dir) if run_dir else contextlib.nullcontext():
        return _train(agent, dataset, updates, run_dir, log_every, checkpoint_every, on_checkpoint, progress)


def _train(
    agent: Agent,
    dataset: Dataset,
    updates: int | None,
    run_dir: Path | None,
    log_every: int,
    checkpoint_every: int,
    on_checkpoint: Callable[[Agent], object] | None,
    progress: bool,
) -> list[dict]:
    """Trains as `train` does, in a folder that is locked."""
    updates = agent.config.updates if updates is None else updates
    generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
    agent.data_checksum = dataset.checksum
    resumes = run_dir is not None and (run_dir / CHECKPOINT).exists()
    log = resume(agent, generators, run_dir) if resumes and run_dir else []
    if agent.config.precision == "bfloat16" and agent.device.type == "cpu":
        warn_where_bfloat16_is_slow()
    record = _Record(agent, generators, log, run_dir, log_every, checkpoint_every, on_checkpoint)
    selected = _select(agent, dataset)
    with products():
        if not (resumes or agent.updates):
            agent.prepare(selected, progress)
            record.save()  # training the reconstruction model can take longer than all updates
        data = _tensors(selected, agent.device)
        bar = tqdm(total=updates, initial=agent.updates, unit="update", mininterval=0.5, disable=not progress)
        with bar:  # closed also after an error, so that the message stands on a line of its own
            bar.set_description(agent.name)
            record.start_clock()
            while agent.updates < updates:
                scalars = agent.update(agent.draw_all(data, generators))
                bar.update()
                if record.after_update(scalars, last=agent.updates == updates):
                    bar.set_postfix(_summary(scalars))
    agent.check(log)
    return log


@dataclass
class _Record:
    """Keeps the log of a training, and writes its checkpoints if it has a folder."""

    agent: Agent
    generators: list[torch.Generator]
    log: list[dict]
    run_dir: Path | None
    log_every: int
    checkpoint_every: int
    on_checkpoint: Callable[[Agent], object] | None

    def start_clock(self) -> None:
        """Starts the clock for the log's updates per second."""
        self.started, self.first_update = time.perf_counter(), self.agent.updates

    def after_update(self, scalars: dict[str, torch.Tensor], last: bool) -> bool:
        """Logs and saves if it is time to. Returns whether it logged."""
        logs = last or self.agent.updates % self.log_every == 0
        saves = self.run_dir is not None and (last or self.agent.updates % self.checkpoint_every == 0)
        if logs or saves:  # a checkpoint must hold finite numbers only
            made = self.agent.updates - self.first_update
            rows = _rows(self.agent, scalars, made / (time.perf_counter() - self.started))
        if logs:
            self.log += rows
        if saves:
            self.save()
            if self.on_checkpoint:
                self.on_checkpoint(self.agent)
        return logs

    def save(self) -> None:
        """Writes the checkpoint, if there is a folder for it."""
        if self.run_dir:
            save_checkpoint(self.agent, self.generators, self.log, self.run_dir)


def _select(agent: Agent, dataset: Dataset) -> list[Dataset]:
    """Returns the data that each run learns from. Runs with the same limit share one dataset."""
    limits = agent.limits or (float("inf"),) * len(agent.seeds)
    of_limit = {limit: agent.select(dataset, limit) for limit in dict.fromkeys(limits)}
    return [of_limit[limit] for limit in limits]


def _tensors(selected: list[Dataset], device: torch.device) -> list[Batch]:
    """Returns each run's data on the device. Runs that share a dataset share its tensors."""
    tensors = {id(part): part.tensors(device) for part in selected}
    return [tensors[id(part)] for part in selected]


def _rows(agent: Agent, scalars: dict[str, torch.Tensor], speed: float) -> list[dict]:
    """Returns one row per run: its seed (and limit), the update, the updates per second, and every scalar.

    Raises TrainingError if a scalar is NaN or infinite.
    """
    values, rows = {name: value.tolist() for name, value in scalars.items()}, []
    for run, seed in enumerate(agent.seeds):
        which = {"seed": seed} | ({"limit": agent.limits[run]} if agent.limits else {})
        of_run = {name: value[run] for name, value in values.items()}
        for name, value in of_run.items():
            if not math.isfinite(value):
                words = " and ".join(f"{key} {number:g}" for key, number in which.items())
                raise TrainingError(
                    f"{name} is {value} at update {agent.updates} of {words}: the last checkpoint is kept; "
                    "try a smaller learning rate, or look for outliers in the data"
                )
        rows.append(which | {"update": agent.updates, "updates_per_second": round(speed, 2)} | of_run)
    return rows


def _summary(scalars: dict[str, torch.Tensor]) -> dict[str, str]:
    """Returns what the progress bar shows: the losses and the safe fraction, averaged over the runs."""
    shown = {
        name: value for name, value in scalars.items() if name.endswith("_loss") or name == "safe_fraction"
    }
    return {name.removesuffix("_loss"): f"{value.mean():.3g}" for name, value in shown.items()}
