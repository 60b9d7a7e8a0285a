"""COptiDICE: it reweights the recorded transitions to those of the best safe policy, and clones them.

Sources: Lee et al. 2022 (COptiDICE), whose sections 3 and 4 have the formulas below; the file `coptidice.py`
of OSRL, whose settings are used in profile `paper`.

The occupancy d of a policy is its normalised discounted distribution of (s, a). The policy sought maximises
E_d[r] - alpha D_f(d || d_data) among those with E_d[c] <= the limit. A dual problem in nu(s) and lambda >= 0
gives the ratio w = d / d_data, and the policy clones the recorded actions with weight w. Because w is an
estimate, its cost is judged pessimistically: chi and tau give the highest cost of all distributions whose
Kullback-Leibler divergence from the data is at most `cost_radius`.

Departures:

1. The cost is compared with a limit of the same unit. OSRL compares E_d[c], a cost per step of at most one,
   with L~, a sum over the episode (21.7 on BallCircle at L = 50), so there lambda can only decay. Here the
   mean of c with the weights w is compared with L / T. This mean does not depend on the mass of d, which is
   wrong while nu is. (nu cannot see the time. So the last step of an episode gets a weight near zero, and the
   mass of d is one, as if episodes never ended.)
2. In profile `small` all learning rates are 1e-3. With OSRL's 1e-4, Adam can move lambda from 1.31 to 0.60 at
   most in 12,000 updates, whatever the limit is.
3. Every update draws B initial states, as in the publication. OSRL uses the initial states among the B
   transitions, which are about one in 200, and weighs each of them with 200. An initial state is drawn as
   that of a random transition's episode, so longer episodes count more where the robot can fall.
4. The loss of chi and tau is the upper bound of the publication, tau (log mean exp(l / tau) + epsilon). The
   loss of OSRL's tau has the same gradient. OSRL's chi minimises the weighted mean of l, and its gradient
   goes through the weights, too.
5. The likelihood is that of a Gaussian around the mean action that is played. In OSRL it is that of the
   Gaussian before tanh, and so a cloned action of 0.9 is played as tanh(0.9) = 0.72. The standard deviation
   does not depend on the state, as in IQL.
6. The cloned actions get no noise. It would change the policy's standard deviation, which is not played.
7. All networks step at once. In OSRL nu steps after chi, and the policy sees the new nu.

Measured: on BallCircle at a limit of 50 (profile `small`, one trial with seed 0 only) COptiDICE had a
normalised reward and cost of 0.76 / 0.95. There lambda fell to 0.02, because the recorded steps cost 0.20 on
average and the limit is 0.25 per step. On CarCircle at a limit of 50 (8,000 of the 12,000 updates) it had
0.69 / 1.51. There lambda settled near 0.35, where the weighted recorded steps cost about as much as the
limit, 0.17 per step, and the cloned policy costs more than the steps that it clones.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tutorial_lib import losses
from tutorial_lib.agents.agent import Agent
from tutorial_lib.agents.critic import cost_guess, goes_on
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import COUNT, NOT_NEGATIVE, POSITIVE, SHARE, Config
from tutorial_lib.data.dataset import Batch
from tutorial_lib.networks import Critics, Policy, gaussian_log_prob


@dataclass(frozen=True)
class COptiDICEConfig(Config):
    """The options of COptiDICE."""

    policy_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Adam's learning rate for the policy, as in OSRL."""
    critic_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Adam's learning rate for nu and chi, as in OSRL."""
    scalar_lr: Annotated[float, NOT_NEGATIVE] = 1e-4
    """Adam's learning rate for lambda and tau, as in OSRL."""
    gamma: Annotated[float, SHARE] = 0.99
    """The discount factor of reward and cost, as in OSRL."""
    reward_factor: Annotated[float, POSITIVE] = 0.1
    """The factor of all rewards, as in OSRL. `alpha` and lambda have the unit of the multiplied reward."""
    alpha: Annotated[float, POSITIVE] = 0.5
    """The price of the divergence D_f from the data, in multiplied reward per step, as in OSRL."""
    cost_radius: Annotated[float, NOT_NEGATIVE] = 0.01
    """The radius epsilon, in nats, of the distributions among which the highest cost is taken, as in OSRL."""
    values: Annotated[int, COUNT] = 2
    """The number of networks of nu, and of chi, of which the lowest value counts, as in OSRL."""
    state_noise: Annotated[float, NOT_NEGATIVE] = 0.1
    """The standard deviation of the noise on the normalised observations that the policy clones at, as in
    OSRL."""

    profiles = {"small": {"critic_lr": 1e-3, "scalar_lr": 1e-3}}  # "Departures", point 2


class Potential(nn.Module):
    """nu(s) or chi(s): the lowest of k networks."""

    def __init__(self, obs_dim: int, config: COptiDICEConfig, scale: float):
        super().__init__()
        self.networks = Critics(obs_dim, 0, config, scale, k=config.values)

    def forward(self, observations: Tensor) -> Tensor:
        """Returns the value (B,) of observations (B, obs)."""
        return self.networks(observations, observations[..., :0]).amin(0)  # critics of no action


class PositiveNumber(nn.Module):
    """A trained number above zero: softplus of one parameter. It starts at softplus(1) = 1.31."""

    def __init__(self):
        super().__init__()
        self.raw = nn.Parameter(torch.ones(()))

    def forward(self) -> Tensor:
        """Returns the number, ()."""
        return F.softplus(self.raw)


def density_ratio(e: Tensor, alpha: float) -> Tensor:
    """Returns w = (f')^-1(e / alpha), the ratio d / d_data of the dual's solution, with the shape of e.

    f is the soft chi-square: w log w - w + 1 below one, and (w - 1)^2 / 2 above. So w is exp(e / alpha) for
    e < 0 and 1 + e / alpha otherwise. It is never negative.
    """
    y = e / alpha
    return torch.where(y < 0, y.clamp(max=0).exp(), 1 + y)  # clamp: an infinite exp has the gradient NaN


def dual_loss(nu_first: Tensor, e: Tensor, alpha: float, gamma: float) -> Tensor:
    """Returns (1 - gamma) mean nu(s_0) + mean(w e - alpha f(w)), with w of `density_ratio`, ().

    nu_first and e are (B,). The second mean is alpha f*(e / alpha), with the conjugate f*(y) = exp(y) - 1 for
    y < 0, and y + y^2 / 2 otherwise.
    """
    assert nu_first.shape == e.shape, (nu_first.shape, e.shape)
    y = e / alpha
    conjugate = torch.where(y < 0, y.clamp(max=0).expm1(), y + 0.5 * y.square())
    return (1 - gamma) * nu_first.mean() + alpha * conjugate.mean()


def cost_bound(cost: Tensor, tau: Tensor, radius: float) -> Tensor:
    """Returns tau (log mean exp(cost / tau) + radius), (), for costs (B,).

    Its minimum over tau is the highest mean of `cost` under weights whose divergence from uniform ones is at
    most `radius`.
    """
    return tau * (torch.logsumexp(cost / tau, 0) - torch.log(torch.ones_like(cost).sum()) + radius)


class COptiDICE(Agent):
    """COptiDICE for one finite limit L. Raises ValueError for an infinite limit."""

    name = "COptiDICE"
    Config = COptiDICEConfig
    config: COptiDICEConfig
    needs_limit = True
    scalars = {
        "nu_loss": "what nu minimises: the dual problem for this lambda, in multiplied reward per step",
        "chi_loss": "upper bound of the cost per step, which chi and tau minimise",
        "multiplier_loss": "lambda times what is left of the limit, per step",
        "policy_loss": "minus the weighted log-likelihood of the recorded actions",
        "multiplier": "lambda, the price of a cost, in multiplied reward",
        "tau": "the temperature of the weights with which the cost is bounded",
        "cost_per_step": "pessimistic estimate of the cost per step, which is compared with L / T",
        "weight_mean": "mean of w: the mass of the occupancy d",
    }

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if float("inf") in (self.limits or ()):
            raise ValueError(f"{self.name} needs a finite limit: with an infinite one lambda has no solution")

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        reward = config.reward_factor * 0.5 * task.max_return / task.horizon
        return super().build() | {
            "nu": Potential(task.obs_dim, config, reward / (1 - config.gamma)),
            "chi": Potential(task.obs_dim, config, *cost_guess(task, (config.gamma,))),
            "multiplier": PositiveNumber(),
            "tau": PositiveNumber(),
            "policy": Policy(task.obs_dim, task.act_dim, config),
        }

    def optimiser(self, name: str) -> Rates:
        config = self.config
        rates = {"policy": config.policy_lr, "multiplier": config.scalar_lr, "tau": config.scalar_lr}
        return Rates(rates.get(name, config.critic_lr))

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also initial states and noise for the policy's observations, both (B, obs)."""
        batch, size = super().draw(data, generator, limit), self.config.batch_size
        rows = torch.randint(len(data.rewards), (size,), generator=generator).to(data.rewards.device)
        first = rows - data.timesteps[rows].long()  # the rows of an episode stand together and in order
        noise = torch.randn(size, self.task.obs_dim, generator=generator)
        return batch | {"first_observations": data.observations[first], "noise": noise}

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, mask = self.config, goes_on(batch, "mask")
        states = torch.cat([batch.first_observations, batch.observations, batch.next_observations])
        states = self.network_input(net, states, batch.limit)  # (3 B, obs)
        multiplier, tau = net.multiplier(), net.tau()

        # nu: the dual problem, with e = r - lambda c + gamma nu(s') - nu(s).
        nu_first, nu, nu_next = net.nu(states).chunk(3)
        reward = config.reward_factor * batch.rewards - multiplier.detach() * batch.costs
        e = losses.td_target(reward, config.gamma, nu_next, mask) - nu
        nu_loss = dual_loss(nu_first, e, config.alpha, config.gamma)
        w = density_ratio(e, config.alpha).detach()

        # chi and tau: the upper bound of E_d[c], with l = (1 - gamma) chi(s_0) + w (c + gamma chi(s') - chi).
        chi_first, chi, chi_next = net.chi(states).chunk(3)
        surplus = losses.td_target(batch.costs, config.gamma, chi_next, mask) - chi
        cost = (1 - config.gamma) * chi_first + w * surplus
        chi_loss = cost_bound(cost, tau, config.cost_radius)

        # lambda: it rises while the cost is above the limit.
        weight = w * torch.softmax(cost / tau, 0).detach()  # (B,), pessimistic
        cost_per_step = (weight * batch.costs).sum() / weight.sum().clamp(min=1e-8)
        multiplier_loss = multiplier * (batch.limit.mean() / self.task.horizon - cost_per_step)

        # The policy clones with weight w.
        s = states.chunk(3)[1] + config.state_noise * batch.noise
        policy_loss = losses.policy_loss(w, gaussian_log_prob(batch.actions, *net.policy(s)))

        of_networks = {"nu": nu_loss, "chi": chi_loss, "multiplier": multiplier_loss, "policy": policy_loss}
        return of_networks, {
            "multiplier": multiplier,
            "tau": tau,
            "cost_per_step": cost_per_step,
            "weight_mean": w.mean(),
        }
