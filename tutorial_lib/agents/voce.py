"""VOCE: the policy is fitted to its own actions, reweighted so that they earn more and keep the limit.

Sources: Guan et al. 2023 (VOCE), whose public code has the settings of profile `paper`; Liu et al. 2022
(CVPO) and Abdolmaleki et al. 2018 (MPO) for the two steps; Kumar et al. 2020 (CQL) for the penalty.

E-step: of all distributions over n sampled actions of the target policy whose Kullback-Leibler divergence
from it is at most 0.1, on average over the states, the best has the highest mean Q_r and a mean Q_c of at
most L~ (eq. 2). Its weights are softmax((Q_r - lambda Q_c) / eta), and a dual problem gives eta and lambda.
M-step: the policy, a Gaussian with a full covariance, maximises the weighted likelihood of these actions.

The critics are penalised for actions unlike the recorded ones, as in CQL. In VOCE's code the penalty of Q_c
is that of Q_r with the sign of the random actions changed. So random and recorded actions come to look
costly, and the policy's own actions cheap, where pessimism would want the opposite. We keep the code's form.

Departures:

1. An update makes one M-step. In VOCE's code it makes six on the same batch, with the same weights.
2. The dual problem is solved at each update anew, to four digits. In VOCE's code SLSQP makes at most 10 steps
   from the last solution. If no weights keep the limit, lambda is nearly 1,000 here: only the cost counts.
3. Critics see actions that are clamped to [-1, 1], as the simulator does. VOCE's code does not clamp them.
4. The target of the cost critics ends where the robot fell, and the cost after a step is clamped to what is
   possible, as in CPQ. In VOCE's code it never ends and is not clamped.
5. Rewards are multiplied by 0.1, as OSRL does for its algorithms. VOCE was published for other tasks.
6. The penalties of Q_r and Q_c compare the same actions, of which each draws its own in VOCE's code.
7. All networks step at once. In VOCE's code Q_r steps first, then Q_c and the policy.
8. In profile `small`, target_tau is 0.1: the updates are so few, a tenth of other algorithms', as in Table 7.

Measured: on BallCircle at a limit of 50 (profile `small` with a width of 64 and batches of 128, one trial
with seed 0 only), the normalised reward and cost of 5 episodes were 0.58 / 1.12. Lambda was zero: the
weighted Q_c fell to 4.6, where L~ is 21.7: it was far too low. No logged penalty was above 3.7.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, reward_guess
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import COUNT, NOT_NEGATIVE, POSITIVE, Config
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.data.dataset import Batch
from tutorial_lib.networks import Critics, mlp

LARGEST_MULTIPLIER = 1000.0
"""The largest lambda, in multiplied reward per cost."""


@dataclass(frozen=True)
class VOCEConfig(CriticConfig):
    """The options of VOCE."""

    updates: Annotated[int, COUNT] = 40_000
    """The number of gradient updates of a run (Table 7)."""
    policy_lr: Annotated[float, NOT_NEGATIVE] = 2e-3
    """Adam's learning rate for the policy, as in VOCE's code."""
    reward_factor: Annotated[float, POSITIVE] = 0.1
    """The factor of all rewards, as in OSRL. Lambda, eta and the gap of Q_r are in multiplied reward."""
    samples: Annotated[int, COUNT] = 32
    """The number of the target policy's actions per state that the E-step reweights, as in VOCE's code."""
    divergence: Annotated[float, POSITIVE] = 0.1
    """The largest mean divergence of the weights from equal ones, in nats, as in VOCE's code."""
    compared: Annotated[int, COUNT] = 10
    """The number of random actions, of the policy's at s and of its at s' that the penalties compare with the
    recorded action, as in VOCE's code."""
    penalty_gap: Annotated[float, NOT_NEGATIVE] = 10.0
    """The value of a penalty above which its weight rises, in the unit of the critic, as in VOCE's code."""

    profiles = {"small": {"updates": 1200, "policy_lr": 2e-3}}


class GaussianPolicy(nn.Module):
    """pi(a | s): a Gaussian whose mean and covariance depend on the state. The covariance is full."""

    SMALLEST_STD = 0.007

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.act_dim = act_dim
        self.net = mlp(obs_dim, config.hidden_width, config.hidden_layers, act_dim + act_dim**2)

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean (B, act), the action in the simulator, and the Cholesky factor (B, act, act)."""
        mean, entries = self.net(observations).split([self.act_dim, self.act_dim**2], -1)
        entries = entries.unflatten(-1, (self.act_dim, self.act_dim))  # above the diagonal: not used
        diagonal = F.softplus(entries.diagonal(dim1=-2, dim2=-1)) + self.SMALLEST_STD
        return 2 * torch.sigmoid(mean) - 1, entries.tril(-1) + torch.diag_embed(diagonal)


def sampled(noise: Tensor, mean: Tensor, factor: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean + factor noise, (n, B, act), and its log-density (n, B), for normal noise (n, B, act)."""
    actions = mean + (factor @ noise.unsqueeze(-1)).squeeze(-1)
    return actions, _log_density(noise.square().sum(-1), factor)


def log_prob(actions: Tensor, mean: Tensor, factor: Tensor) -> Tensor:
    """Returns log N(actions; mean, factor factor^T), (n, B).

    The actions are (n, B, act), the mean is (B, act), and the Cholesky factor is (B, act, act).
    """
    differences = (actions - mean).permute(1, 2, 0)  # (B, act, n)
    noise = torch.linalg.solve_triangular(factor, differences, upper=False)
    return _log_density(noise.square().sum(1).T, factor)


def _log_density(squares: Tensor, factor: Tensor) -> Tensor:
    """Returns the log-density (n, B) of samples of which |noise|^2 is (n, B)."""
    diagonal = factor.diagonal(dim1=-2, dim2=-1)  # (B, act)
    return -0.5 * (squares + diagonal.shape[-1] * math.log(2 * math.pi)) - diagonal.log().sum(-1)


def temperature(values: Tensor, divergence: float, steps: int = 3) -> Tensor:
    """Returns the eta for which softmax(values / eta) diverges by `divergence` from equal weights, ().

    The values are (n, B). The divergence, a mean over B, falls with eta. It is var / (2 eta^2) for a large
    eta. Newton's method starts from there, in log eta and log divergence, where this law is a line.
    """
    centred = values - values.mean(0)
    eta = (centred.square().mean() / (2 * divergence)).sqrt().clamp(min=1e-6)
    for _ in range(steps):
        x = centred / eta
        weights = torch.softmax(x, 0)
        mean = (weights * x).sum(0)
        kl = ((mean - torch.logsumexp(x, 0)).mean() + math.log(len(x))).clamp(min=1e-9)
        variance = (weights * x.square()).sum(0).mean() - mean.square().mean()  # minus d kl / d log eta
        change = torch.log(kl / divergence) * kl / variance.clamp(min=1e-9)
        eta = (eta * change.clamp(-1, 1).exp()).clamp(min=1e-6)
    return eta


def solve_dual(q: Tensor, cost: Tensor, limit: Tensor, divergence: float) -> tuple[Tensor, Tensor]:
    """Returns the eta > 0 and lambda >= 0 with the lowest value of the dual problem, both ().

    It is g = divergence eta + lambda limit + eta mean log mean exp((q - lambda cost) / eta), with the inner
    mean over n and the outer one over B. q and cost are (n, B). g is convex, and its slope in lambda at the
    best eta is the limit minus the weighted mean cost. Newton's method finds the slope's root. Where a step
    would leave the interval of lambda, it is halved.
    """
    low = multiplier = torch.zeros_like(limit)
    high = low + LARGEST_MULTIPLIER
    for _ in range(12):
        values = q - multiplier * cost
        x = (values - values.mean(0)) / (eta := temperature(values, divergence))
        weights = torch.softmax(x, 0)
        slope = limit - (weights * cost).sum(0).mean()
        low, high = torch.where(slope < 0, multiplier, low), torch.where(slope < 0, high, multiplier)

        # The curvature in lambda where eta follows it: (var c - cov(c, x)^2 / var x) / eta.
        c, x = (z - (weights * z).sum(0) for z in (cost, x))
        c_c, c_x, x_x = ((weights * product).sum(0).mean() for product in (c * c, c * x, x * x))
        newton = multiplier - slope * eta / (c_c - c_x.square() / x_x.clamp(min=1e-9)).clamp(min=1e-9)
        inside = (low <= newton) & (newton <= high)
        multiplier = torch.where(inside, newton, (low + high) / 2)
    return temperature(q - multiplier * cost, divergence), multiplier


class PenaltyWeights(nn.Module):
    """The weights of the penalties of Q_r and of Q_c, above zero. They start at one."""

    def __init__(self):
        super().__init__()
        self.log = nn.Parameter(torch.zeros(2))

    def forward(self) -> Tensor:
        """Returns both weights, (2,)."""
        return self.log.exp()


def penalised(
    target: Tensor, q: Tensor, compared: Tensor, weight: Tensor, gap: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the loss of k critics, that of the weight of their penalty, and their mean penalty, all ().

    The penalty of a critic is mean_B (log sum_j exp(compared_j) - q). The weight rises while it is above the
    gap. `target` is (B,), q of the recorded actions is (k, B), and `compared` is (k, j, B).
    """
    penalty = (torch.logsumexp(compared, 1) - q).mean(1)  # (k,)
    loss = losses.td_loss(target, q) + weight.detach() * penalty.sum()
    return loss, weight * (gap - penalty.detach().mean()), penalty.mean()


def values_of(critics: nn.Module, s: Tensor, actions: Tensor) -> Tensor:
    """Returns Q (k, n, B) of states (B, inputs) and of n actions each, (n, B, act), clamped to [-1, 1]."""
    q = critics(s.repeat(len(actions), 1), actions.clamp(-1, 1).flatten(0, 1))  # (k, n B)
    return q.unflatten(1, actions.shape[:2])


class VOCE(CriticAgent):
    """VOCE for one finite limit L. Raises ValueError for an infinite limit."""

    name = "VOCE"
    Config = VOCEConfig
    config: VOCEConfig
    needs_limit = True
    targets = ("critics", "cost_critics", "policy")
    scalars = {
        "critic_loss": "squared error of the Q_r and their weighted penalty, summed over both critics",
        "cost_critic_loss": "squared error of the Q_c and their weighted penalty, summed over both critics",
        "weights_loss": "minus the weight of each penalty times what the penalty is above its gap, summed",
        "policy_loss": "minus the weighted log-likelihood of the target policy's actions",
        "penalty": "mean penalty of the Q_r, in multiplied reward",
        "cost_penalty": "mean penalty of the Q_c, in discounted cost",
        "eta": "temperature of the weights, in multiplied reward",
        "multiplier": "lambda, the price of a cost, in multiplied reward",
        "weighted_cost": "mean Q_c of the weighted actions, in discounted cost, which L~ bounds",
    }

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if float("inf") in (self.limits or ()):
            raise ValueError(f"{self.name} needs a finite limit: under an infinite one no cost has a price")

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        sizes = task.obs_dim, task.act_dim
        reward = config.reward_factor * reward_guess(task, config)
        cost = average_threshold(task.typical_limit, config.gamma, task.horizon)
        return super().build() | {
            "critics": Critics(*sizes, config, reward),
            "cost_critics": Critics(*sizes, config, cost),
            "weights": PenaltyWeights(),
            "policy": GaussianPolicy(*sizes, config),
        }

    def optimiser(self, name: str) -> Rates:
        if name == "policy":
            return Rates(self.config.policy_lr, clip=0.01)  # the bound of VOCE's code
        return Rates(self.config.critic_lr)

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also uniformly random actions, and normal noise for the policy's actions at s and at s'.

        They are (compared, B, act). The first action at s' is also the next action of the targets. The noise
        for the target policy's actions at s is (samples, B, act).
        """
        config, act = self.config, self.task.act_dim
        size = config.compared, config.batch_size, act
        return super().draw(data, generator, limit) | {
            "random": 2 * torch.rand(size, generator=generator) - 1,
            "noise": torch.randn(size, generator=generator),
            "next_noise": torch.randn(size, generator=generator),
            "sample_noise": torch.randn(config.samples, *size[1:], generator=generator),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)
        of_networks, scalars = self.critic_losses(net, batch, s, s_next)

        # E-step: the weights of the target policy's actions.
        limit = average_threshold(batch.limit[0], self.config.gamma, self.task.horizon)
        with torch.no_grad():
            target = net.target_policy(s)
            actions = sampled(batch.sample_noise, *target)[0]  # (n, B, act)
            q = values_of(net.target_critics, s, actions).amin(0)  # (n, B)
            cost = values_of(net.target_cost_critics, s, actions).amin(0)
            eta, multiplier = solve_dual(q, cost, limit, self.config.divergence)
            weights = torch.softmax((q - multiplier * cost) / eta, 0)

        # M-step: the likelihood with a new mean, and with a new covariance.
        mean, factor = net.policy(s)
        likelihood = log_prob(actions, mean, target[1]) + log_prob(actions, target[0], factor)
        policy_loss = -(weights * likelihood).sum(0).mean()
        scalars |= {"eta": eta, "multiplier": multiplier, "weighted_cost": (weights * cost).sum(0).mean()}
        return of_networks | {"policy": policy_loss}, scalars

    def critic_losses(self, net: Networks, batch: Fields, s: Tensor, s_next: Tensor) -> tuple[dict, dict]:
        """Returns the losses of the critics and of the weights of their penalties, and scalars, by name."""
        config, n = self.config, self.config.compared
        with torch.no_grad():
            own, log_own = sampled(batch.noise, *net.policy(s))
            own_next, log_next = sampled(batch.next_noise, *net.policy(s_next))
            log_random = torch.full_like(log_own, -self.task.act_dim * math.log(2))  # uniform in the box
            log_density = torch.cat([log_random, log_next, log_own])  # (3n, B)
            actions = torch.cat([batch.actions.unsqueeze(0), batch.random, own_next, own])
            q_next = values_of(net.target_critics, s_next, own_next[:1]).amin((0, 1))  # (B,)
            cost_next = values_of(net.target_cost_critics, s_next, own_next[:1]).amin((0, 1))
        most = self.task.max_step_cost / (1 - config.gamma)  # the largest cost at every step
        rewards, mask = config.reward_factor * batch.rewards, self.reward_mask(batch)
        target = losses.td_target(rewards, config.gamma, q_next, mask)
        cost_next, mask = cost_next.clamp(0, most), 1 - batch.terminals
        cost_target = losses.td_target(batch.costs, config.gamma, cost_next, mask)

        q = values_of(net.critics, s, actions)  # (2, 1 + 3n, B)
        compared, gap = q[:, 1:] - log_density, config.penalty_gap
        weight, cost_weight = net.weights().unbind()
        critic, weight_loss, penalty = penalised(target, q[:, 0], compared, weight, gap)

        q = values_of(net.cost_critics, s, actions)
        compared = q[:, 1:] - log_density
        compared = torch.cat([-compared[:, :n], compared[:, n:]], 1)  # the sign of the random actions
        cost_critic, loss, cost_penalty = penalised(cost_target, q[:, 0], compared, cost_weight, gap)
        of_critics = {"critic": critic, "cost_critic": cost_critic, "weights": weight_loss + loss}
        return of_critics, {"penalty": penalty, "cost_penalty": cost_penalty}
