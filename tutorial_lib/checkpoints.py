"""Files of agents: an agent to use, and a checkpoint from which training goes on."""

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


METRICS = "metrics.csv"


class TrainingError(ValueError):
    """Training cannot go on: what happened, when, and what to try."""


def save_agent(agent: Agent, path: Path) -> None:
    """An agent to use: its networks, without what only training needs. Atomic."""
    _save(agent, path, {k: v for k, v in agent.state().items() if not k.startswith(("adam.", "target."))})


def _save(agent: Agent, path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Tensors, with what is needed to build their agent again in the file's header."""
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


def load_agent(path: Path | str, device="cpu") -> Agent:
    """The agent that `save_agent` wrote. Raises TrainingError for a file that is not one, or is damaged."""
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
        reason = " ".join(str(error).split())  # PyTorch's take several lines
        raise TrainingError(
            f"{path}: not an agent of this version, or damaged: train it again ({reason})"
        ) from error
    return agent


def save_checkpoint(agent: Agent, generators: list[torch.Generator], log: list[dict], run_dir: Path) -> None:
    """metrics.csv first, then the checkpoint that vouches for it: a kill in between loses nothing."""
    states = {f"generator.{run}": generator.get_state() for run, generator in enumerate(generators)}
    with written_whole(run_dir / METRICS) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(log[0]) if log else ["update"])
        writer.writeheader()
        writer.writerows(log)
    _save(agent, run_dir / CHECKPOINT, agent.state() | states)


def resume(agent: Agent, generators: list[torch.Generator], run_dir: Path) -> list[dict]:
    """Bring agent and generators to the state of the folder's checkpoint; returns the log up to there."""
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
