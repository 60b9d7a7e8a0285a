"""The bias of maxima over learned values, on a bandit and with small critics on a shipped dataset."""

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from tutorial_lib.config import Config
from tutorial_lib.data.dataset import Dataset, sample_batch
from tutorial_lib.losses import awr_weight, expectile_loss, policy_loss, td_loss, td_target
from tutorial_lib.networks import (
    ActionDecoder,
    ActionEncoder,
    Critics,
    Policy,
    Value,
    gaussian_log_prob,
    latent_kl,
    vae_loss,
)
from tutorial_lib.tasks import Task, make_env


def bandit_value(action: ArrayLike) -> np.ndarray:
    """The true mean reward of actions in [-1, 1], in their shape: 1 + a if a < 0.3, and -1 otherwise."""
    return np.where(np.asarray(action) < 0.3, 1.0 + np.asarray(action), -1.0)


def bandit_logs(rng: np.random.Generator, n: int = 40, noise: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """n recorded actions between -0.6 and 0.2, where none is bad, and their rewards with noise; both (n,)."""
    actions = np.clip(rng.normal(-0.2, 0.15, n), -0.6, 0.2)
    return actions, bandit_value(actions) + rng.normal(0, noise, n)


class Critic:
    """Two Q networks, their Polyak averages (the target networks), and V: the library's networks, but narrow.

    The output of every network starts near `scale`. Observations are standardised with the mean and the
    standard deviation of the dataset's.
    """

    def __init__(self, dataset: Dataset, scale: float, width: int = 64, seed: int = 0) -> None:
        obs, act, config = dataset.observations.shape[1], dataset.actions.shape[1], Config(hidden_width=width)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.critics = Critics(obs, act, config, scale)
            self.value = Value(obs, config, scale)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.scale = scale
        self.mean = torch.tensor(dataset.observations.mean(0))
        self.std = torch.tensor(dataset.observations.std(0)) + 1e-3

    def twins(self, observations: Tensor, actions: Tensor, networks: Critics | None = None) -> Tensor:
        """Both Q(s, a), (2, ...), for observations (..., obs) and actions (..., act)."""
        s, a = (self.observed(observations).flatten(0, -2), actions.flatten(0, -2))
        return (networks or self.critics)(s, a).unflatten(1, actions.shape[:-1])

    def q(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The smaller of both Q(s, a), (...)."""
        return self.twins(observations, actions).amin(0)

    def target_q(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The smaller Q(s, a) of both target networks, (...). Backups and V use this value."""
        return self.twins(observations, actions, self.target_critics).amin(0)

    def v(self, observations: Tensor) -> Tensor:
        """V(s), (B,), for observations (B, obs)."""
        return self.value(self.observed(observations))

    @torch.no_grad()
    def awr_weights(self, dataset: Dataset, alpha: float) -> Tensor:
        """The weights min(exp(alpha (Q - V)), 100) of eq. 8 of all recorded steps, (n,)."""
        data = dataset.tensors()
        parts = zip(data.observations.split(8192), data.actions.split(8192), strict=True)
        return torch.cat([awr_weight(self.target_q(s, a) - self.v(s), alpha) for s, a in parts])

    def observed(self, observations: Tensor) -> Tensor:
        """The standardised observations, in the same shape."""
        return (observations - self.mean) / self.std


class Course(NamedTuple):
    """A trained critic, and its mean Q(s, a) of recorded actions, `q` (k,), after `updates` (k,)."""

    updates: np.ndarray
    q: np.ndarray
    critic: Critic


def train_critic(
    dataset: Dataset,
    next_value: Callable[[Critic, Tensor, torch.Generator], Tensor],
    kappa: float = 0.7,
    gamma: float = 0.99,
    updates: int = 1200,
    seed: int = 0,
    learning_rate: float = 1e-3,
    tau: float = 0.2,
) -> Course:
    """Train Q towards r + gamma m next_value(critic, s', generator), and V towards the kappa-expectile of Q.

    The mask m is 0 after terminals and, as by default in this project, after time limits. The Polyak step
    `tau` of the target networks is 40 times IQL's, so that wrong values show within a minute. Batches have
    256 transitions. The mean Q is recorded every 20 updates.
    """
    data, generator = dataset.tensors(), torch.Generator().manual_seed(seed)
    critic = Critic(dataset, scale=1 / (1 - gamma), seed=seed)
    online = [*critic.critics.parameters(), *critic.value.parameters()]
    optimiser = torch.optim.Adam(online, learning_rate)
    notes = []
    for update in range(updates + 1):
        batch = sample_batch(data, 256, generator)
        with torch.no_grad():
            mask = (1 - batch.terminals) * (1 - batch.timeouts)
            following = next_value(critic, batch.next_observations, generator)
            target = td_target(batch.rewards, gamma, following, mask)
            now = critic.target_q(batch.observations, batch.actions)
        q = critic.twins(batch.observations, batch.actions)
        if update % 20 == 0:
            notes.append((update, q.detach().mean().item()))
        loss = td_loss(target, q) + expectile_loss(now, critic.v(batch.observations), kappa)
        optimiser.zero_grad()
        (loss / critic.scale**2).backward()
        optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                list(critic.target_critics.parameters()), list(critic.critics.parameters()), tau
            )
    at, q = np.array(notes).T
    return Course(at, q, critic)


Act = Callable[[Tensor], Tensor]
"""A way to act: it returns an action (act,) for an observation (obs,)."""


def greedy(q: Callable[[Tensor, Tensor], Tensor], act_dim: int, points: int = 21) -> Act:
    """Returns the way to act that takes the action of highest Q among a grid of all actions.

    The grid has `points` values per component in [-1, 1]. `q` returns Q (n,) for observations (n, obs) and
    actions (n, act).
    """
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, points)] * act_dim)
    return lambda observation: grid[q(observation.expand(len(grid), -1), grid).argmax()]


def fit_policy(
    dataset: Dataset, weights: Tensor, updates: int = 1000, seed: int = 0, learning_rate: float = 1e-3
) -> Act:
    """Returns a way to act that is fitted to the recorded actions by weighted maximum likelihood.

    `weights` are (n,), one per recorded step: those of eq. 8, or ones for plain imitation. The policy is a
    Gaussian, and the way to act is its mean. Batches have 256 steps.
    """
    data, generator = dataset.tensors(), torch.Generator().manual_seed(seed)
    mean, std = data.observations.mean(0), data.observations.std(0) + 1e-3
    sizes = data.observations.shape[1], data.actions.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = Policy(*sizes, Config(hidden_width=64))
    optimiser = torch.optim.Adam(policy.parameters(), learning_rate)
    for _ in range(updates):
        rows = torch.randint(len(weights), (256,), generator=generator)
        log_prob = gaussian_log_prob(data.actions[rows], *policy((data.observations[rows] - mean) / std))
        optimiser.zero_grad()
        policy_loss(weights[rows], log_prob).backward()
        optimiser.step()
    return lambda observation: policy(((observation - mean) / std)[None])[0][0]


@torch.no_grad()
def promised_and_earned(
    q: Callable[[Tensor, Tensor], Tensor], act: Act, task: Task, seeds: Sequence[int], gamma: float = 0.99
) -> tuple[float, float]:
    """Plays one episode per seed, and returns what Q promised and what was earned, as means over them.

    The promise is Q(s, a) at the first step, for the action that is taken there. What was earned is the
    discounted sum of the rewards of the episode. `q` takes observations (1, obs) and actions (1, act).
    """
    env, found = make_env(task), []
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        promised = earned = 0.0
        for t in range(task.horizon):
            now = torch.as_tensor(observation)
            action = act(now)
            promised = q(now[None], action[None]).item() if t == 0 else promised
            observation, reward, terminated, *_ = env.step(action.numpy())
            earned += gamma**t * reward
            if terminated:
                break
        found.append((promised, earned))
    env.close()
    promise, worth = np.mean(found, axis=0)
    return float(promise), float(worth)


def latent_divergences(
    dataset: Dataset, updates: int = 400, width: int = 200, n: int = 2000, seed: int = 0
) -> tuple[np.ndarray, ...]:
    """The KL divergences of CPQ's VAE for recorded actions, and for random actions in the same states.

    Both are (n,). The random actions are uniform in [-1, 1]. The VAE has made `updates` with its own loss,
    with batches of 256. The VAE can detect actions outside the data only if their divergences are larger.
    """
    data, generator = dataset.tensors(), torch.Generator().manual_seed(seed)
    s = (data.observations - data.observations.mean(0)) / (data.observations.std(0) + 1e-3)
    a, sizes = data.actions, (s.shape[1], data.actions.shape[1])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoder, decoder = ActionEncoder(*sizes, width, 2), ActionDecoder(*sizes, width, 2)
    optimiser = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], 1e-3)
    for _ in range(updates):
        rows = torch.randint(len(s), (256,), generator=generator)
        noise = torch.randn(256, 2 * sizes[1], generator=generator)
        optimiser.zero_grad()
        vae_loss(encoder, decoder, s[rows], a[rows], noise, kl_weight=0.5).backward()
        optimiser.step()
    rows = torch.randint(len(s), (n,), generator=generator)
    random = 2 * torch.rand(n, sizes[1], generator=generator) - 1
    with torch.no_grad():
        return tuple(latent_kl(*encoder(s[rows], x)).numpy() for x in (a[rows], random))
