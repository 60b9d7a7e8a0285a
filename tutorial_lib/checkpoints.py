"""Reads and writes the files of agents: agents that act, and checkpoints to continue training from."""

import contextlib
import csv
import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from tutorial_lib.agents import Agent, get_algorithm
from tutorial_lib.config import Config
from tutorial_lib.files import sort_metadata, written_whole
from tutorial_lib.tasks import Task, get_task

CHECKPOINT = "checkpoint.safetensors"
"""The file of a run's folder from which training continues."""
METRICS = "metrics.csv"
"""The file of a run's folder with the log of its training."""
NEWER_OPTIONS: dict[str, Any] = {
    "thresholds": "set", "infinite_share": 0.15, "zero_share": 0.1, "episode_share": 0.5,
    "clock": False, "price_unit": "return", "evaluated_critic": "highest", "evaluators": 0, "tell": "left",
    "first_guess": "data", "policy_thresholds": "all", "margin": 0.0, "candidates": 0,
}  # fmt: skip
"""The options that the shipped agents' files do not name yet, and what these agents were trained with."""
DAMAGED = (
    OSError,
    SafetensorError,
    KeyError,
    TypeError,
    ValueError,
    RuntimeError,
    OverflowError,
    MemoryError,
)
"""The errors that a damaged or invented file can cause while it is read."""


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
        sort_metadata(temporary)


class Header(NamedTuple):
    """What the file of an agent says of its runs."""

    kind: type[Agent]
    task: Task
    config: Config
    seeds: tuple[int, ...]
    limits: tuple[float, ...] | None
    data: str | None
    """The checksum of the dataset that the runs were trained on."""


def load_header(path: Path) -> Header:
    """Returns what the file of an agent says of its runs, without reading its tensors.

    Raises TrainingError if there is no such file, if it is not the file of an agent, or if it is damaged.
    """
    with _refusing(path), safe_open(path, "pt") as file:
        return _parsed(file.metadata() or {})


def load_agent(path: Path | str, device: torch.device | str = "cpu") -> Agent:
    """Returns the agent of a file that `save_agent` or `save_checkpoint` wrote, ready to act.

    The sizes in the header are compared with the tensors before memory is taken for them, and every tensor
    must be finite. Raises TrainingError if there is no such file, if it is not the file of an agent, or if it
    is damaged.
    """
    return _read(Path(path), device)[0]


def _read(path: Path, device: torch.device | str = "cpu") -> tuple[Agent, dict[str, torch.Tensor]]:
    """Returns the agent of a file, and the file's tensors. Raises TrainingError as `load_agent` does."""
    with _refusing(path):
        with safe_open(path, "pt") as file:
            names = file.keys()
            header = _parsed(file.metadata() or {})
            _check_sizes(header, {name: file.get_slice(name).get_shape() for name in names})
            # Copies: otherwise the file stays mapped, and Windows cannot replace it.
            tensors = {name: file.get_tensor(name).clone() for name in names}
            tensors = _one_model_per_run(tensors, len(header.seeds))
        for name, tensor in tensors.items():
            if not tensor.isfinite().all():
                raise ValueError(f"{name} has values that are NaN or infinite")
        kind, task, config, seeds, limits, data = header
        agent = kind(task, config, seeds=seeds, limits=limits, device=device)
        _check_names(agent, tensors)
        agent.load_state(tensors)
        for parameter, moments in agent.adam.state.items():
            shapes = {name: tuple(value.shape) for name, value in moments.items()}
            own = tuple(parameter.shape)
            if shapes != {"step": (), "exp_avg": own, "exp_avg_sq": own}:
                raise ValueError(f"adam.* has {shapes} for a tensor of shape {own}")
        agent.data_checksum = data
    return agent, tensors


def _one_model_per_run(tensors: dict[str, torch.Tensor], runs: int) -> dict[str, torch.Tensor]:
    """Returns the tensors of a file with a reconstruction model for every run, where it has one for all.

    The shipped agents' files have one.
    """
    now = {}
    for name, value in tensors.items():
        if name.startswith("reconstruction."):
            kind = "buffer" if name.endswith((".mean", ".whiten")) else "online"
            name, value = f"{kind}.{name}", value.expand(runs, *value.shape).clone()
        now[name] = value
    return now


@contextlib.contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turns every error of a file that is not the file of an agent into one line."""
    if path.is_dir():
        raise TrainingError(f"{path}: is a folder: name the agent.safetensors in it")
    if not path.exists():
        raise TrainingError(f"{path}: no such file: train an agent with `c2iql train`")
    if not path.is_file():  # a pipe would be waited for
        raise TrainingError(f"{path}: is not an ordinary file")
    try:
        yield
    except DAMAGED as error:
        reason = " ".join(str(error).split()) or type(error).__name__  # messages can have several lines
        raise TrainingError(
            f"{path}: this is not an agent of this version, or it is damaged: train it again ({reason[:300]})"
        ) from error


def _parsed(metadata: dict[str, str]) -> Header:
    """Returns the header in a file's metadata.

    Raises ValueError for a missing or an unknown entry, and for a value that an agent cannot have.
    """
    if set(metadata) != {"task", "algorithm", "config", "seeds", "limits", "data"}:
        raise ValueError(f"the header has the entries {', '.join(sorted(metadata)) or 'of no agent'}")
    kind, task = get_algorithm(metadata["algorithm"]), get_task(metadata["task"])
    options, seeds, limits, data = (
        json.loads(metadata[key]) for key in ("config", "seeds", "limits", "data")
    )
    if not isinstance(options, dict) or not isinstance(seeds, list) or not isinstance(data, str | None):
        raise ValueError("the header has an entry of another type")
    own = {field.name for field in dataclasses.fields(kind.Config)}
    options = {name: value for name, value in NEWER_OPTIONS.items() if name in own} | options
    if odd := sorted(own ^ set(options)):  # a default in a missing option's place might not be what it was
        raise ValueError(f"these options are missing or unknown: {', '.join(map(repr, odd))}")
    if not all(type(seed) is int and 0 <= seed < 2**63 for seed in seeds):
        raise ValueError("seeds must be whole numbers of at most 63 bits")
    if not (
        limits is None or isinstance(limits, list) and all(type(limit) in (int, float) for limit in limits)
    ):
        raise ValueError("limits must be numbers")
    of_runs = None if limits is None else tuple(limits)
    return Header(kind, task, kind.Config(**options), tuple(seeds), of_runs, data)


def _check_sizes(header: Header, shapes: dict[str, list[int]]) -> None:
    """Raises ValueError if the agent of the header is larger than the tensors in its file."""
    runs, room = len(header.seeds), 0
    for name, shape in shapes.items():
        of_runs = name.startswith(("online.", "buffer.", "variable."))
        if of_runs and shape[:1] != [runs]:
            raise ValueError(f"{name} has shape {tuple(shape)} for {runs} seeds")
        if of_runs or name.startswith("reconstruction."):  # a shipped agent's
            room += math.prod(shape) // (runs if of_runs else 1)
    # Twice, because an algorithm may replace a network of its base class.
    kind, task, config, seeds, limits, _ = header
    if kind.count_parameters(task, config, seeds, limits, most=2 * room) > 2 * room:
        raise ValueError("its networks are larger than the tensors in the file")


def _check_names(agent: Agent, tensors: dict[str, torch.Tensor]) -> None:
    """Raises ValueError for a tensor that the agent does not have, or that has another type of numbers."""
    own = agent.state()
    for name, tensor in tensors.items():
        if name in own and tensor.dtype != own[name].dtype:
            raise ValueError(f"{name} has numbers of type {tensor.dtype}")
        if name not in own and not name.startswith(("adam.", "generator.")):
            raise ValueError(f"{name} is no tensor of {agent.name}")
    if tensors["updates"].shape != () or tensors["updates"] < 0:
        raise ValueError("updates must be one number, 0 or more")


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

    A run can have more updates than before where this changes none of the updates that it has made. Raises
    TrainingError if the checkpoint is of another run or of other data, or if a file is missing or damaged.
    """
    path = run_dir / CHECKPOINT
    saved, tensors = _read(path)
    _check_same_run(agent, saved, path)
    try:
        log = _read_log(run_dir / METRICS, saved.updates)
        whole = set(saved.state()) | {f"generator.{run}" for run in range(len(generators))}
        if missing := sorted(whole - set(tensors)):
            raise ValueError(f"{missing[0]} is missing")
        trained = [of for name, of in saved.parameters.items() if name not in saved.fixed]
        if saved.updates and len(saved.adam.state) < sum(map(len, trained)):
            raise ValueError("adam.* is incomplete")
        for run, generator in enumerate(generators):
            generator.set_state(tensors[f"generator.{run}"])
        agent.load_state(tensors)
    except (*DAMAGED, csv.Error) as error:
        reason = " ".join(str(error).split())
        raise TrainingError(
            f"{run_dir}: {CHECKPOINT} or {METRICS} is missing or damaged: choose another folder ({reason})"
        ) from error
    return log


def _check_same_run(agent: Agent, saved: Agent, path: Path) -> None:
    """Raises TrainingError if the agent cannot continue from the saved one."""
    before, now = saved.config.updates, agent.config.updates
    mine = (agent.task, agent.name, agent.config, agent.seeds, agent.limits)
    if mine != (saved.task, saved.name, saved.config.changed(updates=now), saved.seeds, saved.limits):
        raise TrainingError(
            f"{path}: is of another run (task, algorithm, options or seeds): choose another folder (--out)"
        )
    if saved.data_checksum not in (None, agent.data_checksum):
        raise TrainingError(f"{path}: was trained on other data: choose another folder (--out)")
    if before != now and any(rates.cosine for rates in agent.rates.values()):
        raise TrainingError(
            f"{path}: is of another run: a learning rate of {agent.name} decays to zero over its {before} "
            f"updates, and is larger from the first in a run of {now}: choose another folder (--out)"
        )
    if saved.updates > now:
        raise TrainingError(f"{path}: has made {saved.updates} updates already, more than {now}")


def _read_log(path: Path, updates: int) -> list[dict]:
    """Returns the rows of a log up to an update."""
    with open(path, newline="") as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    whole = {"seed", "update"}
    return [
        {key: int(value) if key in whole else value for key, value in row.items()}
        for row in rows
        if row["update"] <= updates
    ]
