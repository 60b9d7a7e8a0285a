"""Measures how large the reconstruction model must be, and on what noise it should be trained.

`python -m tutorial_lib.studies.reconstruction` makes data/results/reconstruction.csv in about half an hour.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from tutorial_lib.costs.reconstruction import (
    CostReconstruction,
    ReconstructionConfig,
    episode_sums,
    input_noise,
    random_sums,
    train_reconstruction,
)
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.data.sources import SHIPPED_DATA, load_dataset
from tutorial_lib.files import written_whole
from tutorial_lib.studies.paper import TABLE2
from tutorial_lib.tasks import Task, get_task

PATH = SHIPPED_DATA / "results" / "reconstruction.csv"
SIZES = {"linear": (0, 0), "1 x 16": (1, 16), "2 x 64": (2, 64), "3 x 128": (3, 128), "5 x 512": (5, 512)}
"""Hidden layers and their width. The paper has '5 x 512', profile `small` has '2 x 64'."""
NOISES = TABLE2["noise"]
"""Standard deviations of the noise on the inputs, in discounted cost (Table 2)."""
STEPS = 2_000
"""Iterations of Algorithm 1 for every size, with batches of 256."""


def crm_config(size: str, noise: float, noise_rate: float = 0.0, steps: int = STEPS) -> ReconstructionConfig:
    """The options of a reconstruction model with a size and a training noise.

    `size` is a key of `SIZES`, `steps` the number of iterations of Algorithm 1. `noise` is a standard
    deviation in discounted cost, `noise_rate` in cost per step (option `crm_noise_rate`).
    """
    layers, width = SIZES[size]
    return ReconstructionConfig.make("small").changed(
        crm="mlp" if layers else "linear",
        crm_layers=layers,
        crm_width=width,
        crm_steps=steps,
        crm_noise=noise,
        crm_noise_rate=noise_rate,
    )


def errors(
    model: CostReconstruction,
    task: Task,
    dataset: Dataset,
    config: ReconstructionConfig,
    n: int = 20_000,
    seed: int = 1,
) -> dict[str, float]:
    """Root mean squared errors of a model, in unsafe steps per episode, on inputs with the noise of `config`.

    `random` is the error on n new random cost sequences, `episodes` the error on the dataset's episodes.
    """
    generator = torch.Generator().manual_seed(seed)
    std = input_noise(task, config)
    found = {}
    for name, (x, y) in {
        "random": random_sums(task, n, np.random.default_rng(seed)),
        "episodes": episode_sums(dataset, task),
    }.items():
        noisy = torch.as_tensor(x) + std * torch.randn(x.shape, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            rebuilt = model(noisy.float()).double().numpy()
        found[name] = float(np.sqrt(np.mean((rebuilt - y) ** 2)))
    return found


def settings() -> Iterator[tuple[str, str, float, float, list[tuple[float, float]]]]:
    """All settings: (task, size, training noise, its rate, [(test noise, its rate), ...])."""
    tests = [(0.0, 0.0), (0.1, 0.0), (0.0, 0.01)]
    for size in SIZES:
        for noise, rate in tests:
            yield "CarCircle", size, noise, rate, tests
        if size in ("linear", "2 x 64"):
            for noise in NOISES[2:]:
                yield "CarCircle", size, noise, 0.0, [(noise, 0.0)]


def run(
    path: Path | None = PATH,
    chosen: Iterable[tuple[str, str, float, float, list[tuple[float, float]]]] | None = None,
    steps: int = STEPS,
) -> pd.DataFrame:
    """Train and test the models of the chosen settings (default: all).

    Returns one row per model and test noise. After every model the table is written to `path` as CSV, unless
    `path` is None. Errors are in unsafe steps.
    """
    rows = []
    for name, size, noise, rate, tests in chosen or settings():
        task, dataset = get_task(name), load_dataset(name)
        config = crm_config(size, noise, rate, steps)
        model = train_reconstruction(task, config, dataset, progress=False)
        parameters = sum(p.numel() for p in model.parameters())
        for test_noise, test_rate in tests:
            test = dataclasses.replace(config, crm_noise=test_noise, crm_noise_rate=test_rate)
            found = errors(model, task, dataset, test)
            rows.append(
                {
                    "task": name,
                    "size": size,
                    "parameters": parameters,
                    "steps": steps if config.crm == "mlp" else 0,
                    "noise": noise,
                    "noise_rate": rate,
                    "test_noise": test_noise,
                    "test_noise_rate": test_rate,
                    "rmse_random": round(found["random"], 4),
                    "rmse_episodes": round(found["episodes"], 4),
                }
            )
        if path is not None:
            with written_whole(path) as temporary:
                pd.DataFrame(rows).to_csv(temporary, index=False)
    return pd.DataFrame(rows)


if __name__ == "__main__":
    torch.set_num_threads(1)
    run()
