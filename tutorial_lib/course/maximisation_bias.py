"""The bias of maxima over learned values, on a bandit and with small critics on a shipped dataset."""

import copy
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from tutorial_lib.config import Config
from tutorial_lib.data.dataset import Dataset, sample_batch
from tutorial_lib.losses import expectile_loss, td_loss, td_target
from tutorial_lib.networks import ActionDecoder, ActionEncoder, Critics, Value, latent_kl, vae_loss
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


def play_greedy(
    critic: Critic, task: Task, gamma: float = 0.99, seed: int = 0, points: int = 21
) -> tuple[float | None, float]:
    """Play one episode with the action of highest Q among a grid of `points` values per component in [-1, 1].

    Returns the highest Q at the first step, and the discounted sum of the rewards of the episode.
    """
    line = torch.linspace(-1, 1, points)
    grid = torch.cartesian_prod(*[line] * task.act_dim)
    env = make_env(task)
    observation, _ = env.reset(seed=seed)
    claim, earned = None, 0.0
    for t in range(task.horizon):
        with torch.no_grad():
            q = critic.q(torch.tensor(observation).expand(len(grid), -1), grid)
        claim = q.max().item() if claim is None else claim
        observation, reward, terminated, *_ = env.step(grid[q.argmax()].numpy())
        earned += gamma**t * reward
        if terminated:
            break
    env.close()
    return claim, earned


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
