"""The cost reconstruction model (Algorithm 1): m discounted sums in, the undiscounted sum out.

Whole-episode sums of the dataset and of random 0/1 sequences are its training data. Its baseline is
linear least squares on the same data, which is nearly exact on clean inputs; the noise on the inputs
keeps either from answering with large weights of alternating sign that amplify the critics' errors.
"""

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import trange

from tutorial_lib.config import Config
from tutorial_lib.datasets import Dataset
from tutorial_lib.discounting import discounted_sums, random_cost_sequences
from tutorial_lib.networks import mlp
from tutorial_lib.tasks import Task


class CostReconstruction(nn.Module):
    """R^c of eq. 21: discounted costs (..., m) to an undiscounted cost (...,).

    Inputs are divided by the largest possible discounted sum and the output multiplied by T, so that
    the network works on numbers of order one.
    """

    def __init__(self, task: Task, config: Config):
        super().__init__()
        gammas = torch.tensor(task.gammas, dtype=torch.float64)
        self.register_buffer("scale", ((1 - gammas**task.horizon) / (1 - gammas)).float())
        self.horizon = task.horizon
        if config.crm == "linear":
            self.net = nn.Linear(len(task.gammas), 1)
        else:
            self.net = mlp(len(task.gammas), config.crm_width, config.crm_layers, 1)

    def forward(self, discounted: Tensor) -> Tensor:
        return self.net(discounted / self.scale).squeeze(-1) * self.horizon


def episode_sums(dataset: Dataset, task: Task) -> tuple[np.ndarray, np.ndarray]:
    """Algorithm 1's line 3: discounted sums (episodes, m) and sums (episodes,) of the dataset's costs."""
    costs = np.zeros((dataset.num_episodes, task.horizon), np.float32)
    for row, start, end in zip(costs, dataset.starts, dataset.ends, strict=True):
        row[: end - start] = dataset.costs[start:end]  # an episode cut short costs nothing more
    return discounted_sums(costs, task.gammas), costs.sum(1)


def random_sums(task: Task, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Lines 9-12: sums of n random sequences, a third each of uniform, block and Beta-shaped times."""
    parts = [
        random_cost_sequences(kind, -(-n // 3), task.horizon, rng) for kind in ("uniform", "block", "beta")
    ]
    costs = np.concatenate(parts)[rng.permutation(3 * -(-n // 3))[:n]]
    return discounted_sums(costs, task.gammas), costs.sum(1)


def train_reconstruction(
    task: Task, config: Config, dataset: Dataset, seed: int = 0, device="cpu", progress: bool = True
) -> CostReconstruction:
    """Algorithm 1. Half of every batch are the dataset's episodes, half random sequences."""
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = CostReconstruction(task, config).to(device)
    data = [torch.as_tensor(x, dtype=torch.float32, device=device) for x in episode_sums(dataset, task)]
    pool = [torch.as_tensor(x, dtype=torch.float32, device=device) for x in random_sums(task, 60_000, rng)]
    if config.crm == "linear":
        return _fit_linear(model, data, pool, config.crm_noise)

    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.crm_steps)
    half = config.batch_size // 2
    for _ in trange(config.crm_steps, desc="cost reconstruction", disable=not progress, leave=False):
        rows = [torch.randint(len(y), (half,), generator=generator).to(device) for _, y in (data, pool)]
        x = torch.cat([data[0][rows[0]], pool[0][rows[1]]])
        y = torch.cat([data[1][rows[0]], pool[1][rows[1]]])
        noise = config.crm_noise * torch.randn(x.shape, generator=generator).to(device)
        loss = (model(x + noise) - y).square().mean() / task.horizon  # lines 7 and 14 in one step
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model.requires_grad_(False)


def _fit_linear(model: CostReconstruction, data, pool, noise: float) -> CostReconstruction:
    """Least squares in closed form; noise on the inputs is a ridge penalty of its variance."""
    x, y = (torch.cat(pair).double() for pair in zip(data, pool, strict=True))
    weight_of_row = torch.cat([torch.full((len(p[1]),), 0.5 / len(p[1])) for p in (data, pool)]).to(x)
    features = torch.cat([x / model.scale, torch.ones_like(x[:, :1])], 1)
    ridge = torch.diag(torch.cat([(noise / model.scale).square(), model.scale.new_zeros(1)]).double())
    gram = features.mT @ (features * weight_of_row[:, None]) + ridge
    solution = torch.linalg.solve(gram, features.mT @ (y / model.horizon * weight_of_row))
    with torch.no_grad():
        model.net.weight.copy_(solution[None, :-1])
        model.net.bias.copy_(solution[-1:])
    return model.requires_grad_(False)
