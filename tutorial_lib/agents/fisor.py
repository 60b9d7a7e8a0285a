"""FISOR: feasibility-guided safe offline RL. A diffusion policy that is safe where it can be, at any reward.

Sources: Zheng et al. 2024 (FISOR), whose public code has the settings of profile `paper`; Ho et al. 2020 for
the diffusion model (DDPM); Hansen-Estruch et al. 2023 (IDQL) for its network and noise schedule.

The constraint is hard: no step may ever cost anything, so FISOR takes no limit. With h = 25 at a step that
costs and h = -1 at one that does not, Q_h(s, a) is the discounted maximum of h along the future, and V_h(s)
is nearly its minimum over the recorded actions. A state is feasible if V_h <= 0. The policy learns recorded
actions with weights. At feasible states the weight rises with the advantage in reward, and it is zero where
Q_h > 0. At other states it rises as Q_h falls. Of 16 sampled actions the one with the least Q_h is played.

Departures:

1. The policy that acts is not a moving average, and its learning rate decays to zero along a half cosine over
   the run. In FISOR's code it is a moving average with a step of 0.001, and the cosine is three times as long
   as the run.
2. The policy learns from the same batch as the critics. In FISOR's code it makes two gradient steps per
   update, each on 1024 transitions, and the critics make one step on 256.
3. The policy has no dropout. (FISOR's code has 0.1.) A diffusion step enters as one trained vector per step.
   In FISOR's code it enters as Fourier features with a network of their own.
4. Q_h of the sampled actions is that of the critics. In FISOR's code it is that of their targets.
5. The rewards stay as they are, and the advantage is multiplied by T / (max_return - min_return) of the task.
   In FISOR's code the rewards are multiplied, and the range is that of the returns in the data.
6. All networks step at once. In FISOR's code the policy steps first, then V, Q, V_h and Q_h.

Measured: on BallCircle (profile `small`, 6,000 of its 12,000 updates, one trial with seed 0 only) FISOR had a
normalised reward and cost of 0.01 / 0.00, and of 0.03 / 0.00 with one candidate. It hardly moves, because V_h
was still far too high: 8% of the recorded states counted as feasible, and the share was rising. The median of
V_h in the episodes without any cost was 10.8, and should be below zero.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tutorial_lib import losses
from tutorial_lib.agents.critic import CriticAgent, CriticConfig, reward_guess
from tutorial_lib.agents.player import Player
from tutorial_lib.agents.seeds import Fields, Networks, Rates
from tutorial_lib.config import COUNT, NOT_NEGATIVE, SHARE
from tutorial_lib.data.dataset import Batch
from tutorial_lib.networks import Critics, Output, Value

SAFE = -1.0
"""h of a step that costs nothing."""


@dataclass(frozen=True)
class FISORConfig(CriticConfig):
    """The options of FISOR."""

    critic_lr: Annotated[float, NOT_NEGATIVE] = 3e-4
    """Adam's learning rate for V, Q, V_h and Q_h, as in FISOR's code."""
    reward_expectile: Annotated[float, SHARE] = 0.9
    """The expectile of V, as in FISOR's code."""
    feasibility_expectile: Annotated[float, SHARE] = 0.9
    """The weight of actions with Q_h < V_h in the loss of V_h, as in FISOR's code. That of other actions is
    one minus this."""
    unsafe_step: Annotated[float, NOT_NEGATIVE] = 25.0
    """The value h of a step that costs, as in FISOR's code. That of a step that costs nothing is -1."""
    reward_factor: Annotated[float, NOT_NEGATIVE] = 3.0
    """The factor of the advantage in the weights at feasible states, as in FISOR's code. The advantage is in
    the unit in which returns have the range T."""
    feasibility_factor: Annotated[float, NOT_NEGATIVE] = 5.0
    """The factor of V_h - Q_h in the weights at other states, as in FISOR's code."""
    diffusion_steps: Annotated[int, COUNT] = 5
    """The number of steps in which the policy turns noise into an action, as in FISOR's code."""
    blocks: Annotated[int, COUNT] = 3
    """The number of residual blocks of the policy, as in FISOR's code. Their width is `hidden_width`."""
    candidates: Annotated[int, COUNT] = 16
    """The number of sampled actions of which the one with the least Q_h is played, as in FISOR's code."""

    profiles = {"small": {"critic_lr": 1e-3}}


# --- The diffusion model ---


def noise_schedule(steps: int) -> Tensor:
    """Returns alpha_t of the steps t = 1, ..., (steps,): the share of the variance that a step keeps.

    alpha_t = exp(-b_min / n - (b_max - b_min) (2 t - 1) / (2 n^2)) for n steps, with b_min = 0.1 and
    b_max = 10. This is the variance-preserving schedule of IDQL. After the last step exp(-5.05) is left.
    """
    t = torch.arange(1, steps + 1)
    return torch.exp(-0.1 / steps - 9.9 * (2 * t - 1) / (2 * steps**2))


def denoise(
    predict: Callable[[Tensor, int], Tensor], noise: Tensor, alphas: Tensor, bound: float = math.inf
) -> Tensor:
    """Returns samples (..., act) of the data that the diffusion model `predict` has learned.

    `predict(x, step)` returns the noise (..., act) in x (..., act) after `step`, counted from zero. `noise`
    is standard normal, (steps, ..., act), and the samples start at the first of it. Each step goes to the
    mean (x - (1 - alpha_t) / sqrt(1 - alpha_1 ... alpha_t) predict(x, t)) / sqrt(alpha_t). All steps but the
    last add noise of the variance 1 - alpha_t (Ho et al. 2020, algorithm 2). After each step x is clamped to
    [-bound, bound].
    """
    kept = alphas.cumprod(0)
    x = noise[0]
    for number, step in enumerate(reversed(range(len(alphas))), start=1):
        alpha = alphas[step]
        x = (x - (1 - alpha) / (1 - kept[step]).sqrt() * predict(x, step)) / alpha.sqrt()
        if step > 0:
            x = x + (1 - alpha).sqrt() * noise[number]
        x = x.clamp(-bound, bound)
    return x


class Block(nn.Module):
    """A residual block: LayerNorm, a layer four times as wide, and a layer back."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.wide, self.back = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Returns x plus the block's output, (..., width)."""
        return x + self.back(F.mish(self.wide(self.norm(x))))


class NoisePredictor(nn.Module):
    """The diffusion policy: a network that predicts the noise in an action at a state."""

    def __init__(self, obs_dim: int, act_dim: int, config: FISORConfig):
        super().__init__()
        width = config.hidden_width
        self.first = nn.Linear(obs_dim + act_dim, width)
        self.step = nn.Embedding(config.diffusion_steps, width)
        self.blocks = nn.ModuleList(Block(width) for _ in range(config.blocks))
        self.last = Output(width, act_dim)

    def forward(self, observations: Tensor, actions: Tensor, step: Tensor) -> Tensor:
        """Returns the noise (..., act) in actions (..., act) at observations (..., obs) after steps (...)."""
        x = self.first(torch.cat([observations, actions], -1)) + self.step(step)
        for block in self.blocks:
            x = block(x)
        return self.last(F.mish(x))


# --- Feasibility ---


def feasibility_target(h: Tensor, gamma: float, next_value: Tensor, mask: Tensor) -> Tensor:
    """Returns (1 - gamma) h + gamma max(h, V_h(s')), or h where nothing follows (mask 0). All are (B,)."""
    return h + gamma * mask * (next_value - h).clamp(min=0)


def action_weight(
    advantage: Tensor, v_h: Tensor, q_h: Tensor, reward_factor: float, feasibility_factor: float
) -> Tensor:
    """Returns the weight of a recorded action, (B,), from its advantage in reward, V_h(s) and Q_h(s, a).

    At a feasible state (V_h <= 0) it is min(exp(reward_factor advantage), 100) if Q_h <= 0, and zero
    otherwise. At other states it is min(exp(feasibility_factor (V_h - Q_h)), 150).
    """
    feasible = torch.where(q_h <= 0, losses.awr_weight(advantage, reward_factor), 0.0)
    other = torch.exp(feasibility_factor * (v_h - q_h)).clamp(max=150.0)
    return torch.where(v_h <= 0, feasible, other)


# --- The agent ---


class SamplingPlayer(Player):
    """A player that samples actions with the random numbers of each episode's seed."""

    agent: "FISOR"

    def __init__(
        self, agent: "FISOR", limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0
    ):
        super().__init__(agent, limits, run)
        self.generators = [np.random.default_rng(seed) for seed in seeds]

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Returns the safest of the sampled actions, (E, act), at observations (E, obs)."""
        config = self.agent.config
        shape = config.diffusion_steps, config.candidates, self.agent.task.act_dim
        noise = np.stack([generator.normal(size=shape) for generator in self.generators], 2)
        return self.agent.sample(observations, noise, self.run)


class FISOR(CriticAgent):
    """FISOR. It takes no limit, because it seeks a policy that never pays a cost."""

    name = "FISOR"
    Config = FISORConfig
    config: FISORConfig
    targets = ("critics", "feasibility_critics")
    at_test = ("candidates",)
    scalars = {
        "value_loss": "expectile loss of V",
        "critic_loss": "squared error of the Q, summed over the ensemble",
        "feasibility_value_loss": "reversed expectile loss of V_h",
        "feasibility_critic_loss": "squared error of the Q_h, summed over the ensemble",
        "policy_loss": "weighted squared error of the predicted noise",
        "feasible_fraction": "share of recorded states with V_h <= 0",
        "weight_mean": "mean weight of the recorded actions",
        "value_mean": "mean of V, in discounted reward",
    }

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.alphas = noise_schedule(self.config.diffusion_steps).to(self.device)
        self.kept = self.alphas.cumprod(0)  # (steps,), the share of an action's variance after each step

    def build(self) -> dict[str, nn.Module | Tensor]:
        task, config = self.task, self.config
        sizes, scale = (task.obs_dim, task.act_dim), reward_guess(task, config)
        return super().build() | {
            "value": Value(task.obs_dim, config, scale),
            "critics": Critics(*sizes, config, scale),
            "feasibility_value": Value(task.obs_dim, config, SAFE),
            "feasibility_critics": Critics(*sizes, config, SAFE),
            "policy": NoisePredictor(*sizes, config),
        }

    def optimiser(self, name: str) -> Rates:
        return Rates(self.config.policy_lr, cosine=True) if name == "policy" else super().optimiser(name)

    def draw(self, data: Batch, generator: torch.Generator, limit: float) -> dict[str, Tensor]:
        """Returns also a diffusion step (B,) and standard normal noise (B, act) for each action."""
        size, steps = self.config.batch_size, self.config.diffusion_steps
        return super().draw(data, generator, limit) | {
            "step": torch.randint(steps, (size,), generator=generator),
            "noise": torch.randn(size, self.task.act_dim, generator=generator),
        }

    def losses(self, net: Networks, batch: Fields) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        config, a, mask = self.config, batch.actions, self.reward_mask(batch)
        s = self.network_input(net, batch.observations, batch.limit)
        s_next = self.network_input(net, batch.next_observations, batch.limit)

        # V and Q: IQL.
        q, v = net.target_critics(s, a).amin(0), net.value(s)
        value_loss = losses.expectile_loss(q, v, config.reward_expectile)
        target = losses.td_target(batch.rewards, config.gamma, net.value(s_next), mask)
        critic_loss = losses.td_loss(target, net.critics(s, a))

        # V_h and Q_h: the lower the better, so the expectile is reversed, and the highest critic counts.
        q_h, v_h = net.target_feasibility_critics(s, a).amax(0), net.feasibility_value(s)
        feasibility_value_loss = losses.expectile_loss(q_h, v_h, 1 - config.feasibility_expectile)
        h = torch.where(batch.costs > 0, config.unsafe_step, SAFE)
        target = feasibility_target(h, config.gamma, net.feasibility_value(s_next), mask)
        feasibility_critic_loss = losses.td_loss(target, net.feasibility_critics(s, a))

        # The policy: the noise in a recorded action, with the action's weight.
        advantage = (q - v) * self.task.horizon / (self.task.max_return - self.task.min_return)
        weight = action_weight(advantage, v_h, q_h, config.reward_factor, config.feasibility_factor).detach()
        kept = self.kept[batch.step].unsqueeze(-1)  # (B, 1)
        noisy = kept.sqrt() * a + (1 - kept).sqrt() * batch.noise
        error = (net.policy(s, noisy, batch.step) - batch.noise).square().sum(-1)  # (B,)
        policy_loss = (weight * error).mean()

        of_networks = {"value": value_loss, "critic": critic_loss, "policy": policy_loss}
        of_networks |= {"feasibility_value": feasibility_value_loss}
        of_networks |= {"feasibility_critic": feasibility_critic_loss}
        return of_networks, {
            "feasible_fraction": (v_h <= 0).float().mean(),
            "weight_mean": weight.mean(),
            "value_mean": v.mean(),
        }

    def sample(self, observations: np.ndarray, noise: np.ndarray, run: int = 0) -> np.ndarray:
        """Returns, of n sampled actions, the one with the least Q_h, (E, act), at observations (E, obs).

        `noise` is standard normal, (steps, n, E, act).
        """
        with torch.no_grad():
            net, x, n = self.networks(run), self._tensor(observations), noise.shape[1]
            s = self.network_input(net, x, x[:, 0]).expand(n, -1, -1)  # (n, E, obs)

            def predict(actions: Tensor, step: int) -> Tensor:
                return net.policy(s, actions, torch.tensor(step, device=self.device))

            actions = denoise(predict, self._tensor(noise), self.alphas, bound=1.0)  # (n, E, act)
            q_h = net.feasibility_critics(s.flatten(0, 1), actions.flatten(0, 1)).amax(0).view(n, -1)
            best = q_h.argmin(0)  # (E,)
            return actions[best, torch.arange(len(best), device=self.device)].cpu().numpy()

    def act(self, observations: np.ndarray, limits: np.ndarray, run: int = 0) -> np.ndarray:
        """Returns the actions (E, act) of zero noise. A player samples them."""
        shape = self.config.diffusion_steps, 1, len(observations), self.task.act_dim
        return self.sample(observations, np.zeros(shape), run)

    def player(self, limits: Sequence[float] | np.ndarray, seeds: Sequence[int], run: int = 0) -> Player:
        return SamplingPlayer(self, limits, seeds, run)
