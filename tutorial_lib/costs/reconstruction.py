"""The cost reconstruction model (Algorithm 1) predicts an undiscounted cost from m discounted costs.

It is trained on sums over the dataset's episodes and over random 0/1 sequences. Its baseline is linear least
squares on the same data, which is nearly exact on inputs without noise. But without noise in the training
inputs, both models learn large weights of alternating sign, which amplify the critics' errors.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from torch import Tensor, nn
from tqdm.auto import trange

from tutorial_lib.config import NOT_NEGATIVE, Config
from tutorial_lib.costs.discounting import cost_sequences, discounted_sums, random_cost_sequences
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.networks import Output, in_float32, mlp
from tutorial_lib.tasks import Task

POOL = 60_000
"""The number of random sequences. They are drawn once, because to draw new ones for every batch would take
longer than to learn from them."""


@dataclass(frozen=True)
class ReconstructionConfig(Config):
    """The options of the cost reconstruction model (Appendix B.2)."""

    crm: Literal["mlp", "linear"] = "mlp"
    """The kind of reconstruction model. 'linear' is the least-squares baseline on the same data and noise."""
    crm_width: Annotated[int, NOT_NEGATIVE] = 512
    """The number of units of each of its hidden layers."""
    crm_layers: Annotated[int, NOT_NEGATIVE] = 5
    """The number of its hidden layers. With 0, it is a linear network, which is trained."""
    crm_steps: Annotated[int, NOT_NEGATIVE] = 1_000_000
    """The number of iterations of Algorithm 1. The paper counts epochs, but random data have no epochs. With
    5 layers of 512 units, a million iterations need twice the arithmetic of all updates. On whitened inputs,
    20,000 iterations with 3 layers of 128 units are enough (`data/README.md`, "Profile `paper`")."""
    crm_noise: Annotated[float, NOT_NEGATIVE] = 0.1
    """The standard deviation of the noise on the model's inputs, in discounted cost."""
    crm_noise_rate: Annotated[float, NOT_NEGATIVE] = 0.0
    """The standard deviation of a second noise, in cost per step: input i gets crm_noise_rate / (1 -
    gamma_i), in discounted cost. The paper has no such noise. The model should be trained for the error that
    the critics make. After some thousand updates this is about 0.01, ten times what `crm_noise=0.1` covers,
    and the model's weights, which alternate in sign, amplify it."""

    profiles = {
        "small": {"crm_width": 64, "crm_layers": 2, "crm_steps": 5_000, "crm_noise_rate": 0.01},
        "printed": {"crm_width": 64, "crm_layers": 2, "crm_steps": 5_000},
    }

    def __post_init__(self):
        super().__post_init__()
        if self.crm == "mlp" and self.crm_width == 0:
            raise ValueError("crm_width is 0, and must be 1 or more where crm is not 'linear'")


class CostReconstruction(nn.Module):
    """R^c of eq. 21, which predicts an undiscounted cost from m discounted costs.

    Once scaled, the m discounted sums of one sequence are nearly equal, and all information is in their small
    differences. So the inputs are whitened first: on the noisy training data they have mean zero and variance
    one, and are uncorrelated. Then the same network learns in thousands of steps, and not in a million.
    """

    mean: Tensor
    """The mean of the inputs, (m,), in discounted cost."""
    whiten: Tensor
    """The matrix that makes the inputs uncorrelated with variance one, (m, m)."""

    def __init__(self, task: Task, config: ReconstructionConfig):
        super().__init__()
        m = len(task.gammas)
        self.horizon = task.horizon
        self.register_buffer("mean", torch.zeros(m))
        self.register_buffer("whiten", torch.eye(m))
        self.net = Output(m, 1) if config.crm == "linear" else mlp(m, config.crm_width, config.crm_layers, 1)

    def forward(self, discounted: Tensor) -> Tensor:
        """Returns undiscounted costs (...,), in unsafe steps, of discounted costs (..., m)."""
        whitened = in_float32(lambda x: (x - self.mean) @ self.whiten, discounted)  # needs all digits
        return self.net(whitened).squeeze(-1) * self.horizon


def episode_sums(dataset: Dataset, task: Task) -> tuple[np.ndarray, np.ndarray]:
    """Returns discounted sums (episodes, m) and sums (episodes,) of the dataset's costs (line 3)."""
    costs = cost_sequences(dataset, task.horizon)
    return discounted_sums(costs, task.gammas), costs.sum(1)


def random_sums(task: Task, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns discounted sums (n, m) and sums (n,) of random 0/1 sequences (Algorithm 1, lines 9-12).

    A third of the sequences is of each kind: 'uniform', 'block' and 'beta'.
    """
    parts = [
        random_cost_sequences(kind, -(-n // 3), task.horizon, rng) for kind in ("uniform", "block", "beta")
    ]
    costs = np.concatenate(parts)[rng.permutation(3 * -(-n // 3))[:n]]
    return discounted_sums(costs, task.gammas), costs.sum(1)


def input_noise(task: Task, config: ReconstructionConfig) -> Tensor:
    """Returns the standard deviations of the noise on the m inputs, (m,), in discounted cost."""
    rate = config.crm_noise_rate / (1 - torch.tensor(task.gammas, dtype=torch.float64))
    return (config.crm_noise**2 + rate**2).sqrt()


def _training_sums(
    task: Task, dataset: Dataset, rng: np.random.Generator, device: torch.device | str
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Returns discounted sums (n, m), sums and weights (n,), and the number of the dataset's, which come
    first.

    The weights of the dataset's episodes and those of the random sequences sum to 1/2 each.
    """
    sums = [episode_sums(dataset, task), random_sums(task, POOL, rng)]
    x, y = (
        torch.as_tensor(np.concatenate(part), dtype=torch.float64).to(device)
        for part in zip(*sums, strict=True)
    )
    half = [torch.full((len(part),), 0.5 / len(part), dtype=torch.float64) for _, part in sums]
    return x, y, torch.cat(half).to(device), len(sums[0][1])


def _whiten(model: CostReconstruction, x: Tensor, share: Tensor, noise_std: Tensor) -> None:
    """Sets the mean and the whitening matrix of inputs x (n, m) with weights `share` (n,) and this noise."""
    model.mean.copy_(share @ x)
    centred = x - share @ x
    covariance = centred.mT @ (share[:, None] * centred) + torch.diag(noise_std.square())
    model.whiten.copy_(torch.linalg.inv(torch.linalg.cholesky(covariance)).mT)


def _solve(model: CostReconstruction, x: Tensor, y: Tensor, share: Tensor) -> None:
    """Sets a linear model's weights to the least-squares solution for inputs x (n, m) and sums y (n,).

    With whitened inputs, least squares is a mean, and the noise in the covariance is a ridge penalty.
    """
    with torch.no_grad():
        white = (x - share @ x) @ model.whiten.to(x)
        weight, bias = model.net.parameters()
        weight.copy_((share * (y - share @ y) / model.horizon) @ white)
        bias.copy_(share @ y / model.horizon)


def train_reconstruction(
    task: Task,
    config: ReconstructionConfig,
    dataset: Dataset,
    seed: int = 0,
    device: torch.device | str = "cpu",
    progress: bool = True,
) -> CostReconstruction:
    """Returns a reconstruction model, trained by Algorithm 1 or, if `crm` is 'linear', by least squares.

    One half of every batch are episodes of the dataset, and the other half are random sequences.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = CostReconstruction(task, config).to(device)
    x, y, share, boundary = _training_sums(task, dataset, rng, device)
    noise_std = input_noise(task, config).to(x)
    _whiten(model, x, share, noise_std)
    if config.crm == "linear":
        _solve(model, x, y, share)
        return model.requires_grad_(False)

    x, y = x.float(), y.float()
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.crm_steps)
    for _ in trange(config.crm_steps, desc="cost reconstruction", disable=not progress, leave=False):
        ends = ((0, boundary), (boundary, len(y)))
        rows = torch.cat(
            [torch.randint(*end, (config.batch_size // 2,), generator=generator) for end in ends]
        )
        noise = torch.randn(len(rows), x.shape[1], generator=generator)
        rows, noise = (draw.to(device, non_blocking=True) for draw in (rows, noise))
        noise = noise_std.float() * noise
        loss = (model(x[rows] + noise) - y[rows]).square().mean() / task.horizon**2  # lines 7 and 14
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model.requires_grad_(False)


def reconstruction_error(
    model: CostReconstruction, task: Task, config: ReconstructionConfig, dataset: Dataset, seed: int = 1
) -> float:
    """Returns the root of the model's mean squared error, in unsafe steps per episode.

    The inputs have the noise that the model was trained for. As in training, the episodes of the dataset and
    10,000 new random sequences count for one half each.
    """
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    noise = input_noise(task, config).float()
    errors = []
    for x, y in (episode_sums(dataset, task), random_sums(task, 10_000, rng)):
        noisy = torch.as_tensor(x).float() + noise * torch.randn(x.shape, generator=generator)
        with torch.no_grad():
            found = model(noisy.to(model.mean)).cpu()
        errors.append((found - torch.as_tensor(y).float()).square().mean().item())
    return float(np.mean(errors)) ** 0.5
