"""Measures the time of one update, and for the library's algorithms the time of each of its parts.

The time does not depend on the values of the data. So the data are random.
"""

import contextlib
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.eager import EagerC2IQL
from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.agents.c2iql import C2IQL, C2IQLConfig
from tutorial_lib.config import Config
from tutorial_lib.costs.reconstruction import ReconstructionConfig
from tutorial_lib.data.dataset import Batch
from tutorial_lib.matmul import products
from tutorial_lib.tasks import Task, get_task

Device = torch.device | str
PARTS = ("sampling", "reconstruction", "networks", "backward", "optimiser")
"""The parts of an update: everything random (`Agent.draw_all`); the cost reconstruction model; the other
networks and the losses; the gradients, with the learning rates and the clipping; Adam's step, the target
networks and the variables."""
PRODUCT, EAGER = "a product of 1024 x 1024", "plain eager C2IQL"
PRODUCT_SIZE = 1024


@dataclass(frozen=True)
class Case:
    """What is timed: updates of an algorithm, of the plain version or of a peer, or a matrix product."""

    what: str
    """The name of the algorithm or the peer, `EAGER`, or `PRODUCT`."""
    task: str
    """The name of the task whose sizes are used."""
    profile: str = "paper"
    runs: int = 1
    """The number of seeds that are trained together."""
    batch: int | None = None
    """The batch size. None: the profile's."""
    rows: int = 10_000
    """The number of transitions to sample from."""
    crm: str = "5 x 512"
    """The layers of the reconstruction model in profile `paper`."""
    products: str = "float32"
    """The multiplication: "float32" or "bfloat16" as in training, or "default", which is PyTorch's own."""
    processes: int = 1
    """The number of processes at the same time, with one thread each."""

    @property
    def config(self) -> Config:
        """The options of the algorithm. What is no algorithm of the library has the options of C2IQL."""
        config = ALGORITHMS.get(self.what, C2IQL).configure(self.profile)
        changes: dict[str, Any] = {}
        if self.products == "bfloat16":
            changes["precision"] = "bfloat16"
        if self.profile == "paper" and isinstance(config, ReconstructionConfig):
            changes["crm_layers"], changes["crm_width"] = map(int, self.crm.split(" x "))
        if self.batch is not None:
            changes["batch_size"] = self.batch
        return config.changed(**changes)


def clock(device: Device = "cpu") -> Callable[[], float]:
    """The function that tells the time in seconds: CPU time where one thread does the work, else real time.

    Other programs change CPU time less than real time. (Caches and memory are still shared with them.)
    """
    alone = torch.device(device).type == "cpu" and torch.get_num_threads() == 1
    return time.thread_time if alone else time.perf_counter


def timed(step: Callable[[], object], seconds: float, device: Device = "cpu") -> float:
    """Seconds per call of `step`, a mean over the calls that fit into `seconds`, at least one.

    On a GPU, calls are queued without waiting for results, as in training.
    """
    now, calls = clock(device), 0
    _wait_for(device)
    start = now()
    while not calls or now() - start < seconds:
        step()
        calls += 1
    _wait_for(device)
    return (now() - start) / calls


def flop_of(step: Callable[[], object]) -> float:
    """The number of floating-point operations of all matrix products in one call, as PyTorch counts them."""
    with FlopCounterMode(display=False) as counter:
        step()
    return counter.get_total_flops()


class OurUpdates:
    """Times the updates of one agent and their parts.

    At the end of each part, `_lap` adds the time since its last call to that part.
    """

    def __init__(self, case: Case, device: Device = "cpu"):
        kind, task = ALGORITHMS[case.what], get_task(case.task)
        limits = task.typical_limit if kind.needs_limit else None
        self.agent = kind(task, case.config, seeds=range(case.runs), limits=limits, device=device)
        self.device, self.products = torch.device(device), _setting(case.products)
        self.data = [random_transitions(task, case.rows, device)] * case.runs
        self.generators = [torch.Generator().manual_seed(seed) for seed in self.agent.seeds]
        self.now, self.lapping = clock(device), True
        self.last: float | None = None
        self.laps = dict.fromkeys(PARTS, 0.0)
        self.flop = flop_of(self._update)
        self._mark_laps()

    def measure(self, seconds: float) -> dict[str, float]:
        """Seconds per update and per part, means over the updates that fit into `seconds`.

        Every lap waits for a GPU, but training does not. So on a GPU the whole update is timed again without
        laps.
        """
        self.laps, updates, self.last = dict.fromkeys(PARTS, 0.0), 0, None
        with self.products():
            self._lap("sampling")
            while not updates or sum(self.laps.values()) < seconds:
                self._update()
                self._lap("optimiser")
                updates += 1
            parts = {part: self.laps[part] / updates for part in PARTS}
            whole = sum(parts.values())
            if self.device.type != "cpu":
                self.lapping = False
                whole = timed(self._update, seconds, self.device)
                self.lapping = True
        return {"seconds": whole} | parts

    def _update(self) -> None:
        batch = self.agent.draw_all(self.data, self.generators)
        self._lap("sampling")
        self.agent.update(batch)

    def _mark_laps(self) -> None:
        """Make an update call `_lap` around the model, before the gradients and after them."""
        if isinstance(self.agent, C2IQL) and self.agent.reconstructs:
            model = self.agent._borrowers["reconstruction"].module
            model.register_forward_pre_hook(lambda *_: self._lap("networks"))
            model.register_forward_hook(lambda *_: self._lap("reconstruction"))
        adam = self.agent.adam
        adam.register_step_pre_hook(lambda *_: self._lap("backward"))
        clear = adam.zero_grad  # it is called between the losses and their gradients, and has no hook

        def zero_grad(set_to_none: bool = True) -> None:
            self._lap("networks")
            clear(set_to_none)

        adam.zero_grad = zero_grad  # type: ignore[method-assign]

    def _lap(self, part: str) -> None:
        """Add the time since the last call to this part."""
        if not self.lapping:
            return
        _wait_for(self.device)
        now = self.now()
        if self.last is not None:
            self.laps[part] += now - self.last
        self.last = now


class Steps:
    """Times calls of one function: an update of the plain version, or a matrix product."""

    def __init__(self, case: Case, device: Device = "cpu"):
        self.device, self.products = device, _setting(case.products)
        self.step = _product(device) if case.what == PRODUCT else _eager_updates(case, device)
        self.flop = flop_of(self.step)

    def measure(self, seconds: float) -> dict[str, float]:
        """Seconds per call."""
        with self.products():
            return {"seconds": timed(self.step, seconds, self.device)}


def _setting(name: str) -> Callable[[], AbstractContextManager]:
    """The context manager for a value of `Case.products`."""
    return contextlib.nullcontext if name == "default" else products


def _product(device: Device) -> Callable[[], object]:
    """A function that multiplies two large float32 matrices."""
    a, b = torch.ones(2, PRODUCT_SIZE, PRODUCT_SIZE, device=device)
    out = torch.empty_like(a)
    return lambda: torch.mm(a, b, out=out)


def _eager_updates(case: Case, device: Device) -> Callable[[], object]:
    """A function that samples a batch and makes one update of the plain version."""
    task, config = get_task(case.task), case.config
    assert isinstance(config, C2IQLConfig)
    agent, data = EagerC2IQL(task, config, device), random_transitions(task, case.rows, device)
    limits = torch.tensor([*task.thresholds, float("inf")], device=device)

    def step() -> None:
        rows = torch.randint(case.rows, (config.batch_size,)).to(device)
        drawn = limits[torch.randint(len(limits), (config.batch_size,)).to(device)]
        agent.update(Batch(*(x[rows] for x in data)), drawn)

    return step


def random_transitions(task: Task, count: int, device: Device = "cpu") -> Batch:
    """`count` transitions with the task's sizes, whose values are uniform in [0, 1). None ends an episode."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(count, task.obs_dim), (count, task.act_dim), (count,), (count,), (count, task.obs_dim)]
    data = [torch.rand(shape, generator=generator).to(device) for shape in shapes]
    return Batch(*data, *torch.zeros(5, count, device=device))


def _wait_for(device: Device) -> None:
    """Wait until a GPU has finished all calls."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)  # a call returns before the GPU has finished
