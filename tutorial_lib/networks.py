"""The networks of one run: values, critics, policies and a VAE of actions.

Every network takes inputs with a leading batch axis B. A network of values returns (B,), or (B, m) for m cost
heads.
"""

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tutorial_lib.config import Config


def in_float32(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Returns function(x), computed in float32 also where `Config.precision` is bfloat16."""
    if not torch.is_autocast_enabled(x.device.type):
        return function(x)
    with torch.autocast(x.device.type, enabled=False):
        return function(x.float())


class Output(nn.Linear):
    """The last layer of a network, which always computes in float32.

    Its values are subtracted and compared, and the 8-bit mantissas of bfloat16 would be too few for that.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Returns the outputs (..., outputs) of inputs (..., inputs)."""
        return in_float32(super().forward, x)


def mlp(inputs: int, width: int, layers: int, outputs: int) -> nn.Sequential:
    """Returns a network of `layers` hidden layers of `width` ReLU units each, and a linear output layer."""
    sizes = [inputs] + [width] * layers
    hidden = [
        m for i, o in zip(sizes, sizes[1:], strict=False) for m in (nn.Linear(i, o), nn.ReLU(inplace=True))
    ]
    return nn.Sequential(*hidden, Output(sizes[-1], outputs))


def _heads(scale: float | tuple[float, ...]) -> int:
    return len(scale) if isinstance(scale, tuple) else 1


@functools.cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Returns a tensor that is made only once: every copy from the CPU would wait for the GPU."""
    return torch.tensor(values, device=device)


def _scaled(output: Tensor, scale: float | tuple[float, ...]) -> Tensor:
    """Returns scale (1 + output): (..., m) for m scales; for one scale (..., 1) is squeezed to (...,)."""
    if isinstance(scale, tuple):
        return (1 + output) * _constant(scale, output.device)
    return (1 + output.squeeze(-1)) * scale


class Value(nn.Module):
    """V(s): a network that returns a value for each observation, or m heads for m scales (eq. 22).

    The network's output o gives the value scale (1 + o), where `scale` is a first guess of the value, in
    discounted reward or discounted cost. So the network learns numbers of order one, and heads with different
    discount factors agree at the start. (If they started at zero, a head would need about
    1 / (tau (1 - gamma)) updates to reach its value, and the head with the largest gamma would need the most.
    Until then the reconstruction, which depends on the differences of the heads, would be far too low.)
    """

    def __init__(self, obs_dim: int, config: Config, scale: float | tuple[float, ...]):
        super().__init__()
        self.scale = scale
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, _heads(scale))

    def forward(self, observations: Tensor) -> Tensor:
        """Returns V (B,), or m heads (B, m), of observations (B, obs)."""
        return _scaled(self.net(observations), self.scale)


class EnsembleLinear(nn.Module):
    """k linear layers that are computed as one batched product and initialised like nn.Linear."""

    def __init__(self, k: int, inputs: int, outputs: int):
        super().__init__()
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(k, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(k, 1, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        """Returns outputs (k, B, out) of inputs (k, B, in)."""
        return torch.baddbmm(self.bias, x, self.weight)


class Critics(nn.Module):
    """k independent critics Q(s, a), each with one value, or with m heads for m scales (eq. 22)."""

    def __init__(
        self, obs_dim: int, act_dim: int, config: Config, scale: float | tuple[float, ...], k: int = 2
    ):
        super().__init__()
        self.k, self.scale = k, scale
        sizes = [obs_dim + act_dim] + [config.hidden_width] * config.hidden_layers + [_heads(scale)]
        self.layers = nn.ModuleList(EnsembleLinear(k, i, o) for i, o in zip(sizes, sizes[1:], strict=False))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Returns Q (k, B), or m heads (k, B, m), of observations (B, obs) and actions (B, act)."""
        x = torch.cat([observations, actions], -1).expand(self.k, -1, -1)
        for layer in self.layers[:-1]:
            x = F.relu(layer(x), inplace=True)
        return _scaled(in_float32(self.layers[-1], x), self.scale)


class Policy(nn.Module):
    """pi(a | s): a Gaussian with a tanh mean and a log-std that does not depend on the state, as in IQL."""

    LOG_STD = (-5.0, 2.0)

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, act_dim)
        self.log_std = nn.Parameter(torch.zeros(act_dim))

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean action (B, act), which is the action in the simulator, and the log-std (act,)."""
        return torch.tanh(self.net(observations)), self.log_std.clamp(*self.LOG_STD)


def gaussian_log_prob(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Returns log N(actions; mean, exp(log_std)), (B,), summed over the dimensions of the action.

    Actions and mean are (B, act), and log_std is (act,). The Gaussian is not squashed.
    """
    z = (actions - mean) * torch.exp(-log_std)
    return (-0.5 * z.square() - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)


class SquashedPolicy(nn.Module):
    """pi(a | s): tanh of a Gaussian whose mean and log-std depend on the state, as in SAC and in OSRL."""

    LOG_STD = (-20.0, 2.0)

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, 2 * act_dim)

    def forward(self, observations: Tensor, noise: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        """Returns tanh(mean + std noise), (..., B, act), for standard normal noise, and the log-std (B, act).

        Without noise the action is tanh(mean), (B, act), which is the action in the simulator.
        """
        mean, log_std = self.net(observations).chunk(2, -1)
        log_std = log_std.clamp(*self.LOG_STD)
        return torch.tanh(mean + log_std.exp() * noise), log_std


class ActionEncoder(nn.Module):
    """q(z | s, a), the encoder of a conditional VAE: a Gaussian over latents z of dimension 2 act."""

    LOG_STD = (-4.0, 15.0)

    def __init__(self, obs_dim: int, act_dim: int, width: int, layers: int):
        super().__init__()
        self.net = mlp(obs_dim + act_dim, width, layers, 4 * act_dim)

    def forward(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean and the log-std of the latent, both (B, 2 act)."""
        mean, log_std = self.net(torch.cat([observations, actions], -1)).chunk(2, -1)
        return mean, log_std.clamp(*self.LOG_STD)


class ActionDecoder(nn.Module):
    """The decoder of a conditional VAE, which turns a state and a latent into an action."""

    def __init__(self, obs_dim: int, act_dim: int, width: int, layers: int):
        super().__init__()
        self.net = mlp(obs_dim + 2 * act_dim, width, layers, act_dim)

    def forward(self, observations: Tensor, latents: Tensor) -> Tensor:
        """Returns actions (B, act) within (-1, 1) of observations (B, obs) and latents (B, 2 act)."""
        return torch.tanh(self.net(torch.cat([observations, latents], -1)))


def latent_kl(mean: Tensor, log_std: Tensor) -> Tensor:
    """Returns KL(N(mean, exp(log_std)) || N(0, 1)), (...,), averaged over the dimensions of the latent."""
    return 0.5 * (mean.square() + (2 * log_std).exp() - 2 * log_std - 1).mean(-1)


def vae_loss(
    encoder: ActionEncoder, decoder: ActionDecoder, s: Tensor, a: Tensor, noise: Tensor, kl_weight: float
) -> Tensor:
    """Returns the decoded actions' mean squared error plus `kl_weight` times the latent's KL divergence, ().

    The states s are (B, obs), the actions a are (B, act), and the standard normal noise is (B, 2 act).
    """
    mean, log_std = encoder(s, a)
    decoded = decoder(s, mean + log_std.exp() * noise)
    return (decoded - a).square().mean() + kl_weight * latent_kl(mean, log_std).mean()
