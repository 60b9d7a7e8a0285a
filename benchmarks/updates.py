"""Times what one update takes, ours by its parts. What data hold does not matter, so they are random."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.eager import EagerC2IQL
from tutorial_lib.agents import get_algorithm
from tutorial_lib.config import Config, get_profile
from tutorial_lib.data.dataset import Batch, sample_batch
from tutorial_lib.matmul import products
from tutorial_lib.tasks import Task, get_task

PARTS = ("sampling", "reconstruction", "networks", "backward", "optimiser")
"""The parts of an update: batch and limits; the cost reconstruction model; the other networks and the
losses, forward; gradients; Adam's step with the learning rate, and the target networks."""
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
        config = get_profile(self.profile)
        if self.products == "bfloat16":
            config = replace(config, precision="bfloat16")
        if self.profile == "paper":
            layers, width = map(int, self.crm.split(" x "))
            config = replace(config, crm_layers=layers, crm_width=width)
        return config if self.batch is None else replace(config, batch_size=self.batch)


def clock(device="cpu") -> Callable[[], float]:
    """The processor's time where one thread does the work, so that what else runs counts less; else
    the wall's.

    (On a busy machine caches and memory are still shared.)
    """
    alone = torch.device(device).type == "cpu" and torch.get_num_threads() == 1
    return time.thread_time if alone else time.perf_counter


def timed(step: Callable[[], object], seconds: float, device="cpu") -> float:
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
    """Times the updates of one agent by laps: everything since the last lap is charged to one part."""

    def __init__(self, case: Case, device="cpu"):
        kind, task = get_algorithm(case.what), get_task(case.task)
        threshold = task.thresholds[1] if kind.constrained and not kind.conditioned else None
        agent = kind(task, case.config, seeds=range(case.runs), threshold=threshold, device=device)
        self.agent, self.device = agent, torch.device(device)
        self.products = _setting(case.products)
        self.data = random_transitions(task, case.rows, device)
        self.generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
        self.now, self.last, self.lapping = clock(device), None, True
        self.laps = dict.fromkeys(PARTS, 0.0)
        self.flop = flop_of(self._update)
        agent._total = self._around(agent._total, "sampling", "networks")
        if hasattr(agent, "reconstruction"):
            model = agent.reconstruction
            model.forward = self._around(model.forward, "networks", "reconstruction")
        agent.optimiser.step = self._around(agent.optimiser.step, "backward", "optimiser")

    def measure(self, seconds: float) -> dict[str, float]:
        """Seconds per update, in all and of each part, over as many updates as fit.

        Every lap waits for a GPU, which training does not: there the whole is timed once more, without laps.
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

    def _update(self):
        batch = sample_batch(self.data, self.agent.config.batch_size, self.generators)
        self.agent.update(batch, self.generators)

    def _around(self, function, before: str, inside: str):
        """The function, which charges the time until it is called to one part and its own to another."""

        def measured(*args, **kwargs):
            self._lap(before)
            result = function(*args, **kwargs)
            self._lap(inside)
            return result

        return measured

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

    def __init__(self, case: Case, device="cpu"):
        self.device, self.products = device, _setting(case.products)
        self.step = _product(device) if case.what == PRODUCT else _eager_updates(case, device)
        self.flop = flop_of(self.step)

    def measure(self, seconds: float) -> dict[str, float]:
        """Seconds per call."""
        with self.products():
            return {"seconds": timed(self.step, seconds, self.device)}


def _setting(name: str) -> Callable:
    return contextlib.nullcontext if name == "default" else products


def _product(device) -> Callable[[], object]:
    a, b = torch.ones(2, PRODUCT_SIZE, PRODUCT_SIZE, device=device)
    out = torch.empty_like(a)
    return lambda: torch.mm(a, b, out=out)


def _eager_updates(case: Case, device) -> Callable[[], object]:
    task, config = get_task(case.task), case.config
    agent, data = EagerC2IQL(task, config, device), random_transitions(task, case.rows, device)
    limits = torch.tensor([*task.thresholds, float("inf")], device=device)

    def step():
        rows = torch.randint(case.rows, (config.batch_size,)).to(device)
        drawn = limits[torch.randint(len(limits), (config.batch_size,)).to(device)]
        agent.update(Batch(*(x[rows] for x in data)), drawn)

    return step


def random_transitions(task: Task, count: int, device="cpu") -> Batch:
    """`count` transitions of the task's sizes, with rewards and costs of about its scale."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(count, task.obs_dim), (count, task.act_dim), (count,), (count,), (count, task.obs_dim)]
    data = [torch.rand(shape, generator=generator).to(device) for shape in shapes]
    return Batch(*data, *torch.zeros(2, count, device=device))


def _wait_for(device) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)  # calls return before the device has done the work
