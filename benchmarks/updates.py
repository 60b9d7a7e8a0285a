"""Times what one update takes, and for the library's algorithms each of its parts.

The time does not depend on the values of the data, so the data are random.
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
"""The parts of an update: everything random (`Agent.draw_all`); the cost reconstruction
model; the other networks and the losses; their gradients, with the learning rates and the clipping; Adam's
step, the target networks and the variables."""
PRODUCT, EAGER = "a product of 1024 x 1024", "plain eager C2IQL"
PRODUCT_SIZE = 1024


@dataclass(frozen=True)
class Case:
    """Something to be timed: updates of an algorithm, of the plain version or of a peer; a matrix product."""

    what: str
    task: str
    profile: str = "paper"
    runs: int = 1
    """Seeds trained together."""
    batch: int | None = None
    """None: the profile's."""
    rows: int = 10_000
    """Transitions to sample from."""
    crm: str = "5 x 512"
    """The reconstruction model's layers, in profile `paper`."""
    products: str = "float32"
    """As in training, in either precision; or "default": what PyTorch does if it is not asked."""
    processes: int = 1
    """Of one thread each, at the same time."""

    @property
    def config(self) -> Config:
        """The options of the algorithm; C2IQL's for what is not an algorithm of the library."""
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
    """The processor's time where one thread does the work, else the time on the wall.

    Other programs disturb the processor's time less. (Caches and memory are still shared with them.)
    """
    alone = torch.device(device).type == "cpu" and torch.get_num_threads() == 1
    return time.thread_time if alone else time.perf_counter


def timed(step: Callable[[], object], seconds: float, device: Device = "cpu") -> float:
    """Seconds per call of `step`, over as many as fit, at least one. A GPU is fed ahead, as in training."""
    now, calls = clock(device), 0
    _wait_for(device)
    start = now()
    while not calls or now() - start < seconds:
        step()
        calls += 1
    _wait_for(device)
    return (now() - start) / calls


def flop_of(step: Callable[[], object]) -> float:
    """Floating-point operations of all matrix products in one call, as PyTorch counts them."""
    with FlopCounterMode(display=False) as counter:
        step()
    return counter.get_total_flops()


class OurUpdates:
    """Times the updates of one agent by laps: the time since the last lap is charged to one part."""

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
        """Seconds per update, in all and of each part, over as many updates as fit.

        Every lap waits for a GPU, which training does not do: on a GPU the whole is timed once more, without
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
        """End laps where an update goes on to its next part: around the model, before and after gradients."""
        if isinstance(self.agent, C2IQL) and self.agent.reconstructs:
            self.agent.reconstruction.register_forward_pre_hook(lambda *_: self._lap("networks"))
            self.agent.reconstruction.register_forward_hook(lambda *_: self._lap("reconstruction"))
        adam = self.agent.adam
        adam.register_step_pre_hook(lambda *_: self._lap("backward"))
        clear = adam.zero_grad  # it is called between the losses and their gradients, and has no hook

        def zero_grad(set_to_none: bool = True) -> None:
            self._lap("networks")
            clear(set_to_none)

        adam.zero_grad = zero_grad  # type: ignore[method-assign]

    def _lap(self, part: str) -> None:
        if not self.lapping:
            return
        _wait_for(self.device)
        now = self.now()
        if self.last is not None:
            self.laps[part] += now - self.last
        self.last = now


class Steps:
    """Times calls of a function: the plain version's updates, or a matrix product."""

    def __init__(self, case: Case, device: Device = "cpu"):
        self.device, self.products = device, _setting(case.products)
        self.step = _product(device) if case.what == PRODUCT else _eager_updates(case, device)
        self.flop = flop_of(self.step)

    def measure(self, seconds: float) -> dict[str, float]:
        """Seconds per call."""
        with self.products():
            return {"seconds": timed(self.step, seconds, self.device)}


def _setting(name: str) -> Callable[[], AbstractContextManager]:
    return contextlib.nullcontext if name == "default" else products


def _product(device: Device) -> Callable[[], object]:
    a, b = torch.ones(2, PRODUCT_SIZE, PRODUCT_SIZE, device=device)
    out = torch.empty_like(a)
    return lambda: torch.mm(a, b, out=out)


def _eager_updates(case: Case, device: Device) -> Callable[[], object]:
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
    """`count` transitions of the task's sizes, with rewards and costs of about its scale."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(count, task.obs_dim), (count, task.act_dim), (count,), (count,), (count, task.obs_dim)]
    data = [torch.rand(shape, generator=generator).to(device) for shape in shapes]
    return Batch(*data, *torch.zeros(2, count, device=device))


def _wait_for(device: Device) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)  # calls return before the device has done the work
