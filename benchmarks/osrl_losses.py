"""Compares the losses of COptiDICE with those of OSRL's own code, on the same batches and weights.

    .venv/bin/python -m benchmarks.osrl_losses

Where this library departs from OSRL on purpose (see the file of the algorithm), the comparison is made equal.
All transitions are initial states, nothing is noisy, and the policy's mean is zero, which is the same before
and after tanh. The loss of lambda is not compared, because its limit is another. OSRL's code comes from the
folder of `peers`, which `peers.install` fills.
"""

import sys
import types
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.peers import FOLDER
from tutorial_lib.agents import get_algorithm
from tutorial_lib.data import load_dataset
from tutorial_lib.tasks import get_task

LIMIT = 50.0


def osrl_coptidice() -> Any:
    """Returns OSRL's class COptiDICE. Raises ImportError if OSRL is not installed."""
    loggers = types.ModuleType("fsrl.utils")  # OSRL imports nothing but loggers from package fsrl
    vars(loggers).update(DummyLogger=object, WandbLogger=object)
    sys.modules |= {"fsrl": types.ModuleType("fsrl"), "fsrl.utils": loggers}
    sys.path.append(str(FOLDER))
    from osrl.algorithms import COptiDICE

    return COptiDICE


def copy_potential(theirs: nn.Module, ours: dict[str, Tensor], scale: float) -> None:
    """Copies the two networks of nu, or of chi. Ours return scale (1 + output), and theirs the output."""
    for k, net in enumerate(theirs.q_nets):
        own = [x[0, k].T if name.endswith("weight") else x[0, k, 0] for name, x in ours.items()]
        own[-2], own[-1] = scale * own[-2], scale * (1 + own[-1])
        for place, value in zip(net.parameters(), own, strict=True):
            place.copy_(value)


def copy_agent(model: Any, agent: Any) -> None:
    """Copies all networks of an agent's only run into OSRL's model, except for the policy's hidden layers.

    They do not matter, because the policy's mean is zero and its log-std is the same at all states.
    """
    with torch.no_grad():
        for name in ("nu", "chi"):
            scale = agent.modules[name].networks.scale
            copy_potential(getattr(model, f"{name}_network"), agent.parameters[name], scale)
        model.lmbda.copy_(agent.parameters["multiplier"]["raw"])
        model.tau.copy_(agent.parameters["tau"]["raw"])
        for layer in (model.actor.mu_layer, model.actor.log_std_layer):
            layer.weight.zero_()
            layer.bias.zero_()
        model.actor.log_std_layer.bias.copy_(agent.parameters["policy"]["log_std"][0])


def zero_mean(agent: Any) -> None:
    """Sets the last layer of the policy to zero."""
    *_, weight, bias = agent.parameters["policy"].values()
    with torch.no_grad():
        weight.zero_()
        bias.zero_()


def compare(task_name: str, updates: int = 200) -> dict[str, float]:
    """Returns each number's largest difference over the updates, as a share of OSRL's largest value."""
    task, kind = get_task(task_name), get_algorithm("COptiDICE")
    options = {"hidden_width": 32, "batch_size": 64, "normalise_observations": False}
    agent: Any = kind(task, kind.configure("small", **options), (0,), LIMIT)
    config, data = agent.config, agent.select(load_dataset(task), LIMIT)
    widths = [config.hidden_width] * config.hidden_layers
    sizes = {"a_hidden_sizes": widths, "c_hidden_sizes": widths, "num_nu": 2, "num_chi": 2}
    sizes |= {"cost_limit": LIMIT, "episode_len": task.horizon}
    model = osrl_coptidice()(task.obs_dim, task.act_dim, 1.0, "softchi", 1.0, 0.0, 0.0, **sizes)
    model.setup_optimizers(0.0, 0.0, 0.0)
    tensors, generator = data.tensors("cpu"), torch.Generator().manual_seed(0)
    pairs: dict[str, list[tuple[float, float]]] = {}
    for _ in range(updates):
        zero_mean(agent)
        copy_agent(model, agent)
        batch = agent.draw_all([tensors], [generator])
        batch |= {"first_observations": batch["observations"], "noise": torch.zeros_like(batch["noise"])}
        x = {name: value[0] for name, value in batch.items()}
        ends = torch.maximum(x["terminals"], x["timeouts"])
        fields = (
            x["observations"],
            x["next_observations"],
            x["actions"],
            config.reward_factor * x["rewards"],
        )
        theirs = model.update((*fields, x["costs"], ends, torch.ones_like(ends)))
        theirs = {name.removeprefix("loss/"): value for name, value in theirs.items()}
        ours = {name: value.item() for name, value in agent.update(batch).items()}
        # tau (log mean exp(l / tau) + epsilon) is the weighted mean of l plus tau (epsilon - KL).
        bound = theirs["chi_loss"] + theirs["tau_loss"]
        equal = {"chi_loss": bound, "nu_loss": theirs["nu_loss"], "policy_loss": theirs["actor_loss"]}
        for name, value in (equal | {"multiplier": theirs["lmbda"], "tau": theirs["tau"]}).items():
            pairs.setdefault(name, []).append((ours[name], value))
    largest = {name: max(abs(y) for _, y in found) for name, found in pairs.items()}
    return {name: max(abs(x - y) for x, y in found) / largest[name] for name, found in pairs.items()}


if __name__ == "__main__":
    for number, difference in compare("BallCircle").items():
        print(f"COptiDICE {number:12} largest difference {difference:.1e} of its largest value")
