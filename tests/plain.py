"""One run of an agent as plain PyTorch: modules with parameters of their own, torch's Adam, and loops.

Nothing here is lifted, stacked or lent: what the agent computes for all of its runs at once must equal this.
"""

import copy
import math
from types import SimpleNamespace

import torch


class Plain:
    """A copy of run number `run` of an agent, which `update` changes as the agent should change it."""

    def __init__(self, agent, run=0):
        self.agent, self.run = agent, run
        state = {key: value[run].clone() for key, value in agent.state().items() if _is_of_runs(key)}
        self.online = {name: self._module(name, "online", state) for name in agent.modules}
        self.targets = {name: self._module(name, "target", state) for name in agent.targets}
        self.variables = {name: state[f"variable.{name}"] for name in agent.variables}
        self.rates = {name: agent.optimiser(name) for name in self.online}
        groups = [
            {"params": list(net.parameters()), "weight_decay": self.rates[name].weight_decay}
            for name, net in self.online.items()
        ]
        self.adam = torch.optim.AdamW(groups, lr=1.0, foreach=False)
        self.updates = agent.updates

    def _module(self, name, kind, state):
        module = copy.deepcopy(self.agent.modules[name])
        for key, value in module.named_parameters():
            value.data = state[f"{kind}.{name}.{key}"].clone()
        for key, value in module.named_buffers():
            value.data = state[f"buffer.{name}.{key}"].clone()
        return module

    @property
    def net(self):
        """What `losses` sees. Frozen networks give their inputs a gradient, and their parameters none."""
        frozen = {name: copy.deepcopy(self.online[name]).requires_grad_(False) for name in self.agent.frozen}
        parts = self.online | {f"target_{name}": module for name, module in self.targets.items()}
        parts |= {f"frozen_{name}": module for name, module in frozen.items()}
        return SimpleNamespace(**parts, **self.variables)

    def losses(self, batch):
        """The losses by name, with their graph, and the other scalars."""
        return self.agent.losses(self.net, SimpleNamespace(**batch))

    def update(self, batch):
        """One update on the run's batch. Returns its scalars."""
        losses, scalars = self.losses(batch)
        scalars = {f"{name}_loss": loss for name, loss in losses.items()} | scalars
        self.adam.zero_grad()
        sum(losses.values()).backward()
        for group, (name, rates) in zip(self.adam.param_groups, self.rates.items(), strict=True):
            group["lr"] = self._learning_rate(rates)
            if rates.clip is not None:
                torch.nn.utils.clip_grad_norm_(self.online[name].parameters(), rates.clip)
        self.adam.step()
        scalars = {name: value.detach() for name, value in scalars.items()}
        with torch.no_grad():
            for name, target in self.targets.items():
                tau = self.agent.tau(name)
                for old, new in zip(target.parameters(), self.online[name].parameters(), strict=True):
                    old.copy_((1 - tau) * old + tau * new)
            self.variables |= self.agent.step(self.net, SimpleNamespace(**batch), scalars)
        self.updates += 1
        return scalars

    def _learning_rate(self, rates):
        """At this update, which is number 0, 1, ..."""
        rate, updates = rates.lr, self.agent.config.updates
        if rates.cosine:
            rate *= (1 + math.cos(math.pi * self.updates / updates)) / 2
        if rates.warm_up and self.updates < rates.warm_up:
            rate *= (self.updates + 1) / rates.warm_up
        return rate

    def state(self):
        """Its tensors by the names that the agent has for them."""
        parts = {"online": self.online, "target": self.targets}
        tensors = {
            f"{kind}.{name}.{key}": value.detach()
            for kind, nets in parts.items()
            for name, net in nets.items()
            for key, value in net.named_parameters()
        }
        buffers = {
            f"buffer.{name}.{key}": value
            for name, net in self.online.items()
            for key, value in net.named_buffers()
        }
        return tensors | buffers | {f"variable.{name}": value for name, value in self.variables.items()}


def _is_of_runs(key):
    return key.startswith(("online.", "buffer.", "target.", "variable."))
