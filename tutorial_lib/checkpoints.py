"""Reads and writes the files of agents: agents that act, and checkpoints to continue training from."""

import csv
import dataclasses
import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from tutorial_lib.agents import Agent, get_algorithm
from tutorial_lib.files import written_whole
from tutorial_lib.tasks import get_task

CHECKPOINT = "checkpoint.safetensors"
"""The file of a run's folder from which training continues."""
METRICS = "metrics.csv"
"""The file of a run's folder with the log of its training."""


class TrainingError(ValueError):
    """Training cannot continue. The message says what happened and what to do."""


def save_agent(agent: Agent, path: Path) -> None:
    """Writes an agent that can act: its networks and variables, without the tensors that only training needs.

    The file is written as a whole or not at all. Raises OSError if it cannot be written.
    """
    _save(agent, path, {k: v for k, v in agent.state().items() if not k.startswith(("adam.", "target."))})


def _save(agent: Agent, path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Writes tensors to a file whose header has everything that is needed to build their agent again."""
    header = {
        "task": agent.task.name,
        "algorithm": agent.name,
        "config": json.dumps(dataclasses.asdict(agent.config)),
        "seeds": json.dumps(agent.seeds),
        "limits": json.dumps(agent.limits),
        "data": json.dumps(agent.data_checksum),
    }
    with written_whole(path) as temporary:
        save_file({k: value.cpu().contiguous() for k, value in tensors.items()}, temporary, metadata=header)


def load_agent(path: Path | str, device: torch.device | str = "cpu") -> Agent:
    """Returns the agent of a file that `save_agent` or `save_checkpoint` wrote, ready to act.

    Raises TrainingError if there is no such file, if it is not the file of an agent, or if it is damaged.
    """
    path = Path(path)
    if path.is_dir():
        raise TrainingError(f"{path}: is a folder: name the agent.safetensors in it")
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  (not a mapping)
        kind = get_algorithm(header["algorithm"])
        agent = kind(
            get_task(header["task"]),
            kind.Config(**json.loads(header["config"])),
            seeds=json.loads(header["seeds"]),
            limits=json.loads(header["limits"]),
            device=device,
        )
        agent.load_state(tensors)
        agent.data_checksum = json.loads(header.get("data", "null"))
    except FileNotFoundError:
        raise TrainingError(f"{path}: no such file: train an agent with `c2iql train`") from None
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())  # PyTorch's messages can have several lines
        raise TrainingError(
            f"{path}: this is not an agent of this version, or it is damaged: train it again ({reason})"
        ) from error
    return agent


def save_checkpoint(agent: Agent, generators: list[torch.Generator], log: list[dict], run_dir: Path) -> None:
    """Writes the log to metrics.csv, and then everything that training needs to checkpoint.safetensors.

    In this order nothing is lost if the process is killed between the two. `generators` has one generator per
    run. Raises OSError if a file cannot be written.
    """
    states = {f"generator.{run}": generator.get_state() for run, generator in enumerate(generators)}
    with written_whole(run_dir / METRICS) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(log[0]) if log else ["update"])
        writer.writeheader()
        writer.writerows(log)
    _save(agent, run_dir / CHECKPOINT, agent.state() | states)


def resume(agent: Agent, generators: list[torch.Generator], run_dir: Path) -> list[dict]:
    """Gives agent and generators the state of the folder's checkpoint, and returns the log up to that update.

    Raises TrainingError if the checkpoint is of another run or of other data, or if a file is missing or
    damaged.
    """
    path = run_dir / CHECKPOINT
    saved = load_agent(path)
    mine = (agent.task, agent.name, agent.config, agent.seeds, agent.limits)
    if mine != (saved.task, saved.name, saved.config, saved.seeds, saved.limits):
        raise TrainingError(
            f"{path}: is of another run (task, algorithm, options or seeds): choose another folder (--out)"
        )
    if saved.data_checksum not in (None, agent.data_checksum):
        raise TrainingError(f"{path}: was trained on other data: choose another folder (--out)")
    try:
        with safe_open(path, "pt") as file:
            agent.load_state({key: file.get_tensor(key) for key in file.keys()})  # noqa: SIM118
            for run, generator in enumerate(generators):
                generator.set_state(file.get_tensor(f"generator.{run}"))
        with open(run_dir / METRICS, newline="") as file:
            rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    except (OSError, SafetensorError, TypeError, ValueError) as error:
        raise TrainingError(
            f"{run_dir}: {CHECKPOINT} or {METRICS} is missing or damaged: choose another folder ({error})"
        ) from error
    whole = {"seed", "update"}
    return [
        {k: int(v) if k in whole else v for k, v in row.items()}
        for row in rows
        if row["update"] <= agent.updates
    ]
