"""A plain version of C2IQL: one module and one optimiser per network, and a loop over the critics.

The speed of the library is compared with it, and the library's updates are tested against it. The two share
no code. It has one run, and only what profile `paper` needs: the zero penalty, cost heads that are scaled by
1 - gamma^T, and one threshold per transition.
"""

import copy
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tutorial_lib.agents.c2iql import C2IQLConfig
from tutorial_lib.data.dataset import Batch
from tutorial_lib.tasks import Task


def network(inputs: int, width: int, layers: int, outputs: int) -> nn.Sequential:
    """A network of `layers` hidden layers with `width` ReLU units each, and a linear output."""
    sizes = [inputs] + layers * [width]
    net: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:], strict=True):
        net += [nn.Linear(a, b), nn.ReLU()]
    return nn.Sequential(*net, nn.Linear(sizes[-1], outputs))


class EagerC2IQL:
    """One run of Algorithm 2. As in the library, the value of an output o is scale (1 + o).

    Raises ValueError for options that it does not have.
    """

    def __init__(self, task: Task, config: C2IQLConfig, device: torch.device | str = "cpu"):
        if config.unsafe_price is not None or config.recorded_step or config.time_limits != "rate":
            raise ValueError("the plain version has only the zero penalty and time_limits='rate'")
        self.task, self.config, self.updates = task, config, 0
        obs, act, m = task.obs_dim + 1, task.act_dim, len(task.gammas)
        size = config.hidden_width, config.hidden_layers
        nets = {"value": [network(obs, *size, 1)], "cost_value": [network(obs, *size, m)]}
        nets["critics"] = [network(obs + act, *size, 1) for _ in range(2)]
        nets["cost_critics"] = [network(obs + act, *size, m) for _ in range(config.cost_critics)]
        nets["policy"] = [network(obs, *size, act)]
        self.nets = {name: nn.ModuleList(members).to(device) for name, members in nets.items()}
        self.log_std = nn.Parameter(torch.zeros(act, device=device))
        self.targets = {name: copy.deepcopy(self.nets[name]) for name in ("critics", "cost_critics")}
        self.crm = network(m, config.crm_width, config.crm_layers, 1).requires_grad_(False).to(device)
        self.crm_mean, self.crm_whiten = torch.zeros(m, device=device), torch.eye(m, device=device)
        rates = {"value": config.value_lr, "cost_value": config.value_lr, "policy": config.policy_lr}
        self.optimisers = {}
        for name, members in self.nets.items():
            parameters = [*members.parameters(), *([self.log_std] if name == "policy" else [])]
            self.optimisers[name] = torch.optim.Adam(parameters, lr=rates.get(name, config.critic_lr))
        self.gammas = torch.tensor(task.gammas, device=device)
        self.scale = task.max_return / task.horizon / 2 / (1 - config.gamma)
        self.cost_scale = task.thresholds[1] / task.horizon / (1 - self.gammas)
        self.mean, self.std = (f(task.obs_dim, device=device) for f in (torch.zeros, torch.ones))

    def network_input(self, observations: Tensor, limits: Tensor) -> Tensor:
        """The networks' input (B, obs + 1) for observations (B, obs) and limits (B,)."""
        code = torch.where(torch.isinf(limits), torch.tensor(1.5), limits / self.task.cost_range)
        return torch.cat([(observations - self.mean) / self.std, code[:, None]], dim=1)

    def reconstruct(self, q_cost: Tensor) -> Tensor:
        """The cost of an episode, (B,), from discounted costs (B, m): lines 6 to 8."""
        x = q_cost * (1 - self.gammas**self.task.horizon)
        return self.crm((x - self.crm_mean) @ self.crm_whiten)[:, 0] * self.task.horizon

    def losses(self, batch: Batch, limits: Tensor) -> dict[str, Tensor]:
        """The losses of Algorithm 2 by the name of the network, for B transitions and their limits (B,)."""
        c, a = self.config, batch.actions
        s = self.network_input(batch.observations, limits)
        s_next = self.network_input(batch.next_observations, limits)
        sa = torch.cat([s, a], dim=1)
        with torch.no_grad():  # lines 6 to 10, and the targets of lines 15 to 18
            q_costs = [self.cost_scale * (1 + net(sa)) for net in self.targets["cost_critics"]]
            costs = [self.reconstruct(q_cost) for q_cost in q_costs]
            q_cost, cost = q_costs[0], costs[0]
            for other_q, other_cost in zip(q_costs[1:], costs[1:], strict=True):
                q_cost = torch.where((other_cost > cost)[:, None], other_q, q_cost)
                cost = torch.maximum(cost, other_cost)
            q = torch.minimum(*(self.scale * (1 + net(sa)[:, 0]) for net in self.targets["critics"]))
            q = torch.where(cost <= limits, q, torch.tensor(0.0))
            v_next = self.scale * (1 + self.nets["value"][0](s_next)[:, 0])
            v_cost_next = self.cost_scale * (1 + self.nets["cost_value"][0](s_next))
            ends = batch.terminals
            if c.reward_time_limits == "mask":
                ends = torch.maximum(ends, batch.timeouts)
            target = batch.rewards + c.gamma * (1 - ends) * v_next
            cost_target = batch.costs[:, None] + self.gammas * (1 - batch.terminals[:, None]) * v_cost_next

        v = self.scale * (1 + self.nets["value"][0](s)[:, 0])
        u = q - v
        negative = (u < 0).float()
        weight = (c.kappa_1 - negative).abs()
        v_cost = self.cost_scale * (1 + self.nets["cost_value"][0](s))
        mean, log_std = torch.tanh(self.nets["policy"][0](s)), self.log_std.clamp(-5, 2)
        density = -0.5 * ((a - mean) / log_std.exp()) ** 2 - log_std - 0.5 * math.log(2 * math.pi)
        return {
            "value": (weight * u**2).mean(),
            "cost_value": (weight[:, None] * (q_cost - v_cost) ** 2).mean(),
            "critics": sum(
                F.mse_loss(self.scale * (1 + net(sa)[:, 0]), target) for net in self.nets["critics"]
            ),
            "cost_critics": sum(
                F.mse_loss(self.cost_scale * (1 + net(sa)), cost_target) for net in self.nets["cost_critics"]
            ),
            "policy": -((c.kappa_2 - negative).abs() * density.sum(1)).mean(),
        }

    def update(self, batch: Batch, limits: Tensor) -> dict[str, float]:
        """Change every network once, on B transitions and their limits (B,). Returns the losses."""
        c, losses = self.config, self.losses(batch, limits)
        cosine = 0.5 * (1 + math.cos(math.pi * self.updates / c.updates))
        self.optimisers["policy"].param_groups[0]["lr"] = c.policy_lr * cosine
        for name, loss in losses.items():
            self.optimisers[name].zero_grad()
            loss.backward()
            self.optimisers[name].step()
        with torch.no_grad():
            for name, target in self.targets.items():
                for old, new in zip(target.parameters(), self.nets[name].parameters(), strict=True):
                    old.copy_((1 - c.target_tau) * old + c.target_tau * new)
        self.updates += 1
        return {name: loss.item() for name, loss in losses.items()}
