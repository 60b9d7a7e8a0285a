"""Compares losses and multipliers of BCQ-Lag and BEAR-Lag with those of OSRL's own code, update by update.

    .venv/bin/python -m benchmarks.osrl_lagrangian

Both get the same weights, batch and random numbers. Where this library departs from OSRL on purpose, the
comparison is made equal: no terminals, ReLU in OSRL's perturbation network, no first guesses, one pair of
critics. In these first updates no cost after a step is outside the bounds that only this library has. OSRL's
code comes from the folder of `peers`, which `peers.install` fills.
"""

import sys
import types
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.peers import FOLDER
from tutorial_lib.agents import get_algorithm
from tutorial_lib.data import load_dataset
from tutorial_lib.tasks import get_task

OPTIONS = {"hidden_width": 32, "batch_size": 64, "normalise_observations": False}
QUEUE: list[Tensor] = []
"""The random numbers that OSRL's code gets, in the order in which it asks for them."""


def import_osrl() -> Any:
    """Returns OSRL's package, whose random numbers come from `QUEUE`. Raises ImportError if it is missing."""
    loggers = types.ModuleType("fsrl.utils")
    vars(loggers).update(DummyLogger=object, WandbLogger=object)
    sys.modules |= {"fsrl": types.ModuleType("fsrl"), "fsrl.utils": loggers}
    sys.path.append(str(FOLDER))
    import osrl.algorithms
    import osrl.common.net

    torch.randn = lambda *_, **__: QUEUE.pop(0)  # type: ignore[assignment]
    torch.randn_like = lambda *_, **__: QUEUE.pop(0)  # type: ignore[assignment]
    torch.distributions.Normal.rsample = lambda self, *_: self.loc + self.scale * QUEUE.pop(0)  # type: ignore
    return osrl


def by_state(x: Tensor) -> Tensor:
    """Returns n numbers per state, (n, B, size), in OSRL's order, (B n, size)."""
    return x.transpose(0, 1).flatten(0, 1)


def linear_layers(module: nn.Module) -> list[nn.Linear]:
    """Returns a network's linear layers in their order."""
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def copy_layers(theirs: list[nn.Linear], ours: dict[str, Tensor]) -> None:
    """Copies weights (out, in) and biases, layer by layer."""
    values = iter(ours.values())
    with torch.no_grad():
        for layer in theirs:
            layer.weight.copy_(next(values))
            layer.bias.copy_(next(values))


def copy_critics(theirs: nn.Module, ours: dict[str, Tensor], scale: float) -> None:
    """Copies both critics of one kind. Ours return scale (1 + output), and theirs the output."""
    for k, nets in enumerate((theirs.q1_nets, theirs.q2_nets)):
        own = [x[k].T if name.endswith("weight") else x[k, 0] for name, x in ours.items()]
        own[-2], own[-1] = scale * own[-2], scale * (1 + own[-1])
        copy_layers(linear_layers(nets[0]), dict(enumerate(own)))  # type: ignore[arg-type]


def copy_agent(model: Any, agent: Any) -> None:
    """Copies all networks and target networks of an agent's only run into OSRL's model."""
    for online, suffix in ((True, ""), (False, "_old")):
        of = agent.parameters if online else agent.target_parameters
        own = {name: {key: x[0].detach() for key, x in net.items()} for name, net in of.items()}
        scale = 0.1 * agent.modules["critics"].scale
        copy_critics(getattr(model, f"critic{suffix}"), own["critics"], scale)
        scale = agent.modules["cost_critics"].scale
        copy_critics(getattr(model, f"cost_critic{suffix}"), own["cost_critics"], scale)
        actor, policy = getattr(model, f"actor{suffix}"), own["policy"]
        layers = linear_layers(actor)
        if hasattr(actor, "mu_layer"):
            policy = split_last(policy)
            layers = [*linear_layers(actor.net), actor.mu_layer, actor.log_std_layer]
        copy_layers(layers, policy)
        if online:
            vae, encoder = model.vae, split_last(own["encoder"])
            copy_layers([vae.e1, vae.e2, vae.mean, vae.log_std], encoder)
            copy_layers([vae.d1, vae.d2, vae.d3], own["decoder"])


def split_last(layers: dict[str, Tensor]) -> dict[str, Tensor]:
    """Returns the layers with the two halves of the last one's outputs as two layers."""
    *rest, weight, bias = layers.values()
    halves = zip(weight.chunk(2), bias.chunk(2), strict=True)
    return dict(enumerate([*rest, *(x for pair in halves for x in pair)]))  # type: ignore[arg-type]


def make_model(osrl: Any, name: str, agent: Any, limit: float) -> Any:
    """Returns OSRL's model of an algorithm, with an agent's sizes, and optimisers that change nothing."""
    config, task = agent.config, agent.task
    widths = [config.hidden_width] * config.hidden_layers
    vae_width = round(config.vae_width * config.hidden_width)
    sizes = {"a_hidden_sizes": widths, "c_hidden_sizes": widths, "vae_hidden_sizes": vae_width}
    options = sizes | {"beta": 0.5, "cost_limit": limit, "episode_len": task.horizon}
    rates: tuple[float, ...] = (0.0, 0.0, 0.0)
    if name == "BEAR-Lag":
        options |= {"start_update_policy_step": 0}
        rates += (config.alpha_lr,)
    kind = osrl.algorithms.BCQL if name == "BCQ-Lag" else osrl.algorithms.BEARL
    model = kind(task.obs_dim, task.act_dim, 1.0, **options)
    if name == "BCQ-Lag":
        for actor in ("actor", "actor_old"):
            arguments = task.obs_dim, task.act_dim, widths, nn.ReLU, config.phi
            setattr(model, actor, osrl.common.net.MLPGaussianPerturbationActor(*arguments))
    model.setup_optimizers(*rates)
    return model


def their_update(name: str, model: Any, x: SimpleNamespace) -> dict[str, float]:
    """What OSRL logs in one update of the same batch and random numbers, by our names."""
    if name == "BCQ-Lag":
        next_draw, draws = by_state(x.next_latents), [x.latents]
    else:
        next_draw, draws = by_state(x.next_noise), [x.latents.transpose(0, 1), by_state(x.noise)]
    QUEUE.extend([x.latent_noise, next_draw, next_draw, *draws])
    s, s_next, a = x.observations, x.next_observations, x.actions
    logged = model.vae_loss(s, a)[1] | model.critic_loss(s, s_next, a, 0.1 * x.rewards, x.timeouts)[1]
    logged |= model.cost_critic_loss(s, s_next, a, x.costs, x.timeouts)[1] | model.actor_loss(s)[1]
    assert not QUEUE
    names = {"vae_loss": "loss_vae", "critic_loss": "critic_loss", "cost_critic_loss": "cost_critic_loss"}
    names |= {"policy_loss": "actor_loss", "multiplier": "lagrangian"}
    if name == "BEAR-Lag":
        names |= {"mmd": "mmd_loss"}
    return {ours: logged[f"loss/{theirs}"] for ours, theirs in names.items()}


def compare(osrl: Any, name: str, task_name: str, updates: int = 40) -> Iterator[tuple[str, float]]:
    """Yields each number's largest difference over the updates, as a share of OSRL's largest value."""
    task, kind = get_task(task_name), get_algorithm(name)
    data, limit = load_dataset(task), float(task.thresholds[0])
    agent: Any = kind(task, kind.configure("small", **OPTIONS), (0,), limit)
    selected = agent.select(data, limit)
    agent.prepare([selected], progress=False)
    model, generator = make_model(osrl, name, agent, limit), torch.Generator().manual_seed(0)
    tensors = selected.tensors("cpu")
    ours, theirs = [], []
    for _ in range(updates):
        randn = torch.randn
        torch.randn = RANDN
        batch = agent.draw_all([tensors], [generator])
        torch.randn = randn
        batch["terminals"].zero_()
        copy_agent(model, agent)
        theirs.append(their_update(name, model, SimpleNamespace(**{k: v[0] for k, v in batch.items()})))
        own = {key: value.item() for key, value in agent.update(batch).items()}
        ours.append(own | {"critic_loss": own["critic_loss"] / 100})  # OSRL's rewards are a tenth
    for key in theirs[0]:
        largest = max(abs(x[key]) for x in theirs)
        yield key, max(abs(x[key] - y[key]) for x, y in zip(ours, theirs, strict=True)) / largest


RANDN = torch.randn

if __name__ == "__main__":
    package = import_osrl()
    for algorithm in ("BCQ-Lag", "BEAR-Lag"):
        for found, difference in compare(package, algorithm, "BallCircle"):
            print(f"{algorithm:9} {found:17} largest difference {difference:.1e} of its largest value")
