"""Networks for one run; every one takes a leading batch axis B and returns values (B,) or heads (B, m)."""

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tutorial_lib.config import Config


def in_float32(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """function(x) in float32, also where `Config.precision` has products rounded to bfloat16."""
    if not torch.is_autocast_enabled(x.device.type):
        return function(x)
    with torch.autocast(x.device.type, enabled=False):
        return function(x.float())


class Output(nn.Linear):
    """A network's last layer, exact: its values are subtracted and compared, and 8 bits would be too few."""

    def forward(self, x: Tensor) -> Tensor:
        return in_float32(super().forward, x)


def mlp(inputs: int, width: int, layers: int, outputs: int) -> nn.Sequential:
    """`layers` hidden layers of `width` ReLU units, and a linear output."""
    sizes = [inputs] + [width] * layers
    hidden = [
        m for i, o in zip(sizes, sizes[1:], strict=False) for m in (nn.Linear(i, o), nn.ReLU(inplace=True))
    ]
    return nn.Sequential(*hidden, Output(sizes[-1], outputs))


def _heads(scale: float | tuple[float, ...]) -> int:
    return len(scale) if isinstance(scale, tuple) else 1


@functools.cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Made once: to copy numbers to a GPU at every call is to wait for it at every call."""
    return torch.tensor(values, device=device)


def _scaled(output: Tensor, scale: float | tuple[float, ...]) -> Tensor:
    """scale (1 + output): (..., m) with m scales, or (..., 1) with one, squeezed to (...,)."""
    if isinstance(scale, tuple):
        return (1 + output) * _constant(scale, output.device)
    return (1 + output.squeeze(-1)) * scale


class Value(nn.Module):
    """V(s): observations (B, obs) to (B,), or with m scales to m heads (B, m) (eq. 22).

    The network's output o is read as scale (1 + o), where `scale` is a first guess of the values: the
    network learns numbers of order one, and heads of different discount start out in agreement. (From
    zero, a head needs about 1 / (tau (1 - gamma)) updates to fill up, the slowest longest, and meanwhile
    the reconstruction, which lives on the heads' differences, is far too low.)
    """

    def __init__(self, obs_dim: int, config: Config, scale: float | tuple[float, ...]):
        super().__init__()
        self.scale = scale
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, _heads(scale))

    def forward(self, observations: Tensor) -> Tensor:
        return _scaled(self.net(observations), self.scale)


class EnsembleLinear(nn.Module):
    """k linear layers as one batched product: (k, B, in) to (k, B, out), initialised like nn.Linear."""

    def __init__(self, k: int, inputs: int, outputs: int):
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(k, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(k, 1, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, x, self.weight)


class Critics(nn.Module):
    """k independent Q(s, a): (B, obs) and (B, act) to (k, B), with m scales to m heads (k, B, m) (eq. 22)."""

    def __init__(
        self, obs_dim: int, act_dim: int, config: Config, scale: float | tuple[float, ...], k: int = 2
    ):
        super().__init__()
        self.k, self.scale = k, scale
        sizes = [obs_dim + act_dim] + [config.hidden_width] * config.hidden_layers + [_heads(scale)]
        self.layers = nn.ModuleList(EnsembleLinear(k, i, o) for i, o in zip(sizes, sizes[1:], strict=False))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        x = torch.cat([observations, actions], -1).expand(self.k, -1, -1)
        for layer in self.layers[:-1]:
            x = F.relu(layer(x), inplace=True)
        return _scaled(in_float32(self.layers[-1], x), self.scale)


class Policy(nn.Module):
    """pi(a | s): a Gaussian with a tanh mean (B, act) and a log-std that no state changes, as in IQL."""

    LOG_STD = (-5.0, 2.0)

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, act_dim)
        self.log_std = nn.Parameter(torch.zeros(act_dim))

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """The mean action (B, act), which is what runs in the simulator, and the log-std (act,)."""
        return torch.tanh(self.net(observations)), self.log_std.clamp(*self.LOG_STD)


def gaussian_log_prob(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """log N(actions; mean, exp(log_std)), (B,), summed over the dimensions of the action; not squashed."""
    z = (actions - mean) * torch.exp(-log_std)
    return (-0.5 * z.square() - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)


class SquashedPolicy(nn.Module):
    """tanh of a Gaussian whose mean and log-std both depend on the state, as in SAC and OSRL's baselines."""

    LOG_STD = (-20.0, 2.0)

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, 2 * act_dim)

    def forward(self, observations: Tensor, noise: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        """The action that standard normal noise (..., B, act) stands for, and the log-std (B, act).

        Without noise it is tanh of the mean (B, act), which is what runs in the simulator.
        """
        mean, log_std = self.net(observations).chunk(2, -1)
        log_std = log_std.clamp(*self.LOG_STD)
        return torch.tanh(mean + log_std.exp() * noise), log_std


class ActionEncoder(nn.Module):
    """One half of a conditional VAE: q(z | s, a), a Gaussian over latents of twice the action's size."""

    LOG_STD = (-4.0, 15.0)

    def __init__(self, obs_dim: int, act_dim: int, width: int, layers: int):
        super().__init__()
        self.net = mlp(obs_dim + act_dim, width, layers, 4 * act_dim)

    def forward(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-std of the latent, both (B, 2 act)."""
        mean, log_std = self.net(torch.cat([observations, actions], -1)).chunk(2, -1)
        return mean, log_std.clamp(*self.LOG_STD)


class ActionDecoder(nn.Module):
    """The other half: the action (B, act), within (-1, 1), that a latent (B, 2 act) stands for in a state."""

    def __init__(self, obs_dim: int, act_dim: int, width: int, layers: int):
        super().__init__()
        self.net = mlp(obs_dim + 2 * act_dim, width, layers, act_dim)

    def forward(self, observations: Tensor, latents: Tensor) -> Tensor:
        return torch.tanh(self.net(torch.cat([observations, latents], -1)))


def latent_kl(mean: Tensor, log_std: Tensor) -> Tensor:
    """KL divergence of N(mean, exp(log_std)) from N(0, 1), the mean over the latent's dimensions: (...,)."""
    return 0.5 * (mean.square() + (2 * log_std).exp() - 2 * log_std - 1).mean(-1)


def vae_loss(
    encoder: ActionEncoder, decoder: ActionDecoder, s: Tensor, a: Tensor, noise: Tensor, kl_weight: float
) -> Tensor:
    """Mean squared error of the decoded actions, and `kl_weight` times the KL divergence of the latent, ().

    States s (B, obs), actions a (B, act), standard normal noise (B, 2 act).
    """
    mean, log_std = encoder(s, a)
    decoded = decoder(s, mean + log_std.exp() * noise)
    return (decoded - a).square().mean() + kl_weight * latent_kl(mean, log_std).mean()
