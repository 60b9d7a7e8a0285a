"""Updates of other libraries, the peers, timed in a process of their own.

That process can import packages which the project does not install. The peers use the project's PyTorch, and
everything else comes from a folder of their own. Each one gets the same batch again and again: sampling is
not part of its time, but it is part of ours. The peers have the paper's widths and batch size. All their
other options are those of their own examples.
"""

import functools
import json
import os
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.updates import Case, Device, flop_of, random_transitions, timed
from tutorial_lib.config import Config
from tutorial_lib.tasks import Task, get_task

FOLDER = Path("runs/bench/peers")
PACKAGES = (
    "osrl-lib==0.1.0",
    "d3rlpy==2.8.1",
    # What d3rlpy needs and the project does not have. OSRL's own requirements, which pin an old PyTorch, are
    # not installed.
    *("gym==0.26.2", "gym_notices", "structlog", "colorama", "dataclasses-json", "marshmallow"),
    *("typing-inspect", "mypy-extensions", "scikit-learn", "narwhals", "threadpoolctl"),
)


def install(folder: Path = FOLDER) -> None:
    """Install the peers (60 MB) into a folder with pip. Raises ValueError with pip's last line."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--upgrade"]
    done = subprocess.run([*command, "--target", folder, *PACKAGES], capture_output=True, text=True)
    if done.returncode:
        reason = (done.stderr.strip() or "pip failed").splitlines()[-1]
        raise ValueError(f"the peers cannot be installed: {reason}")


class Peer:
    """Times the updates of a peer. Raises ValueError, with the reason, if the peer does not run."""

    def __init__(self, case: Case, device: Device = "cpu", folder: Path = FOLDER):
        self.asked = {"what": case.what, "task": case.task, "profile": case.profile, "device": str(device)}
        self.process = _process(Path(folder).absolute())
        self.flop = self._ask(0)["flop"]

    def measure(self, seconds: float) -> dict[str, float]:
        """Seconds per update."""
        return {"seconds": self._ask(seconds)["seconds"]}

    def _ask(self, seconds: float) -> dict[str, float]:
        """The answer of the peers' process. Raises ValueError."""
        pipes = self.process.stdin, self.process.stdout
        assert pipes[0] and pipes[1]  # _process opened both
        try:
            print(json.dumps(self.asked | {"seconds": seconds}), file=pipes[0], flush=True)
            answer = json.loads(pipes[1].readline() or '{"error": "its process died"}')
        except BrokenPipeError:
            answer = {"error": "its process died"}
        if "error" in answer:
            reason = f"{self.asked['what']}: not measured ({answer['error']})"
            raise ValueError(f"{reason}; `python -m benchmarks --full --peers` installs it")
        return answer


@functools.cache
def _process(folder: Path) -> subprocess.Popen:
    """The process that runs all peers. It ends when its input ends, which is at the end of this process."""
    path = [str(folder), str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    threads = str(torch.get_num_threads())
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-m", __name__],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path), "OMP_NUM_THREADS": threads},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


# --- In the peers' process ---


def osrl(name: str, task: Task, config: Config, device: str) -> Callable[[], object]:
    """A function that makes one update of OSRL's CPQ or BCQ-Lag: its trainer's step, without a logger."""

    class Logger:
        def store(self, **scalars: object) -> None:
            pass

    # OSRL imports nothing but loggers from package fsrl, which needs many other packages.
    loggers = types.ModuleType("fsrl.utils")
    vars(loggers).update(DummyLogger=Logger, WandbLogger=Logger)
    sys.modules |= {"fsrl": types.ModuleType("fsrl"), "fsrl.utils": loggers}
    from osrl import algorithms

    widths = config.hidden_layers * [config.hidden_width]
    sizes: dict[str, object] = {
        "a_hidden_sizes": widths,
        "c_hidden_sizes": widths,
        "vae_hidden_sizes": 400,
        "beta": 0.5,
    }
    if name == "CPQ":
        sizes |= {"num_q": 2, "num_qc": 2}  # BCQ-Lag has pairs of critics by default
    options = sizes | {"episode_len": task.horizon, "device": device}
    model = getattr(algorithms, name)(task.obs_dim, task.act_dim, 1.0, **options)
    trainer = getattr(algorithms, f"{name}Trainer")(model, None, Logger(), device=device)
    x = random_transitions(task, config.batch_size, device)
    batch = (x.observations, x.next_observations, x.actions, x.rewards, x.costs, x.terminals)
    return lambda: trainer.train_one_step(*batch)


def d3rlpy(task: Task, config: Config, device: str) -> Callable[[], object]:
    """A function that makes one update of d3rlpy's IQL, on a batch of NumPy arrays as in its own loop."""
    from d3rlpy.algos import IQLConfig
    from d3rlpy.dataset import TransitionMiniBatch
    from d3rlpy.models.encoders import VectorEncoderFactory

    encoder = VectorEncoderFactory(config.hidden_layers * [config.hidden_width])
    names = ("actor_encoder_factory", "critic_encoder_factory", "value_encoder_factory")
    options = IQLConfig(batch_size=config.batch_size, **dict.fromkeys(names, encoder))
    algorithm = options.create(device="cuda:0" if device == "cuda" else "cpu:0")
    algorithm.create_impl((task.obs_dim,), task.act_dim)
    x = random_transitions(task, config.batch_size)
    s, s_next, a = (field.numpy() for field in (x.observations, x.next_observations, x.actions))
    column = np.ones((config.batch_size, 1), np.float32)
    batch = TransitionMiniBatch(s, a, x.rewards[:, None].numpy(), s_next, a, 0 * column, column, [])
    return lambda: algorithm.update(batch)


PEERS: dict[str, Callable[..., Callable[[], object]]] = {
    "OSRL's CPQ": functools.partial(osrl, "CPQ"),
    "OSRL's BCQ-Lag": functools.partial(osrl, "BCQL"),
    "d3rlpy's IQL": d3rlpy,
}


@functools.cache
def _step(what: str, task: str, profile: str, device: str) -> tuple[Callable[[], object], float]:
    """The function that makes one update of a peer, and its FLOP per call. They are made once."""
    step = PEERS[what](get_task(task), Case(what, task, profile).config, device)
    return step, flop_of(step)


def main() -> None:
    """Read requests, one line of JSON each, and print one line of JSON for each.

    A request says what to time and for how long. The answer has the FLOP and seconds per update, or the
    error.
    """
    answers, sys.stdout = sys.stdout, sys.stderr  # what a peer prints must not be among the answers
    for line in sys.stdin:
        asked = json.loads(line)
        seconds = asked.pop("seconds")
        try:
            step, flop = _step(**asked)
            answer: dict[str, Any] = {"flop": flop, "seconds": timed(step, seconds, asked["device"])}
        except Exception as error:  # a peer may raise anything
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
