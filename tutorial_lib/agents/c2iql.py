"""C2IQL (Algorithm 2): CIQL with reconstructed costs and with the cost limit as an input of every network.

Its two ablations are the classes below it, each one switch away.
"""

import torch

from tutorial_lib import losses as L
from tutorial_lib.agents.agent import Agent, cost_guess, reward_guess
from tutorial_lib.costs.conditioning import encode, threshold_set
from tutorial_lib.costs.discounting import average_threshold
from tutorial_lib.costs.reconstruction import CostReconstruction, train_reconstruction
from tutorial_lib.networks import Critics, Policy, Value, gaussian_log_prob


class C2IQL(Agent):
    """Algorithm 2. The names of its lines stand beside the code that does them."""

    name = "C2IQL"
    targets = ("critics", "cost_critics")
    conditioned = True
    can_price = True
    reconstructs = True

    def __init__(self, task, config, *args, **kwargs):
        self.cost_gammas = task.gammas if self.reconstructs else (config.gamma,)
        super().__init__(task, config, *args, **kwargs)
        self.gammas = torch.tensor(self.cost_gammas, device=self.device)  # (m,)
        if self.reconstructs:  # untrained until `prepare` or `load_state`
            with torch.random.fork_rng(devices=[]):
                self.reconstruction = CostReconstruction(task, config).to(self.device).requires_grad_(False)

    def build(self):
        task, config = self.task, self.config
        inputs = task.obs_dim + self.conditioned
        scale = reward_guess(task, config)
        cost_scale = cost_guess(task, self.cost_gammas)
        return {
            "value": Value(inputs, config, scale),
            "cost_value": Value(inputs, config, cost_scale),
            "critics": Critics(inputs, task.act_dim, config, scale),
            "cost_critics": Critics(inputs, task.act_dim, config, cost_scale, k=config.cost_critics),
            "policy": Policy(inputs, task.act_dim, config),
        }

    def prepare(self, dataset, progress=True):
        super().prepare(dataset, progress)
        if self.reconstructs:  # one model, which all runs share
            self.reconstruction = train_reconstruction(
                self.task, self.config, dataset, device=self.device, progress=progress
            )
        self.guess_costs(dataset)

    def draw_limits(self, generator, batch_size):
        """Line 5. Paper silent on 'per batch' or 'per sample': per sample has the lower variance."""
        if not self.conditioned:
            return super().draw_limits(generator, batch_size)
        choices = threshold_set(self.task, with_zero=self.config.zero_threshold)
        choices = torch.as_tensor(choices, dtype=torch.float32)
        draws = batch_size if self.config.thresholds_per == "sample" else 1
        return choices[torch.randint(len(choices), (draws,), generator=generator)].expand(batch_size)

    def network_input(self, observations, limit):
        observations = super().network_input(observations, limit)
        if not self.conditioned:
            return observations
        return torch.cat([observations, encode(limit, self.task).unsqueeze(-1)], -1)

    def episode_cost(self, q_cost):
        """Lines 6 to 8: discounted costs (..., m) as the cost of a whole episode, (...,)."""
        horizon, gammas = self.task.horizon, self.gammas
        if self.config.time_limits == "rate":  # bootstrapped for ever: keep the first T steps' share
            q_cost = q_cost * (1 - gammas**horizon)
        if self.reconstructs:
            return self.reconstruction(q_cost)
        return q_cost.squeeze(-1) / average_threshold(1.0, self.config.gamma, horizon)  # L~ / L, eq. 2

    def losses(self, net, batch, limit):
        config, a = self.config, batch.actions
        s = self.network_input(batch.observations, limit)
        s_next = self.network_input(batch.next_observations, limit)  # the same limit: it stands for a rate

        # Lines 6-8: cost reconstruction. Of the ensemble, the critic that expects the most cost counts.
        q_cost = net.target_cost_critics(s, a)  # (k, B, m)
        cost, worst = self.episode_cost(q_cost).max(0)  # (B,)
        q_cost = q_cost.take_along_dim(worst[None, :, None], 0).squeeze(0)  # (B, m)

        # Line 18: its target, here already: what the recorded step expects. (Eq. 16 prints V_c(s), not s'.)
        mask = self.cost_mask(batch)[:, None]
        cost_target = L.td_target(batch.costs[:, None], self.gammas, net.cost_value(s_next), mask)
        if config.recorded_step:
            cost = torch.maximum(cost, self.episode_cost(cost_target.detach()))

        # Lines 9-10: constraint penalisation.
        q_reward = net.target_critics(s, a).amin(0)
        v_cost = net.cost_value(s)  # (B, m)
        q = self.penalised_q(q_reward, cost, v_cost, limit)

        # Lines 11-12: value function.
        v = net.value(s)
        value_loss = L.expectile_loss(q, v, config.kappa_1)

        # Lines 13-14: cost value function, under the implicit policy of the line above.
        weight = L.expectile_weight(q - v, config.evaluated_kappa)
        cost_value_loss = L.cost_value_loss(weight, q_cost, v_cost)

        # Lines 15-16: Q-value function.
        target = L.td_target(batch.rewards, config.gamma, net.value(s_next), self.reward_mask(batch))
        critic_loss = L.td_loss(target, net.critics(s, a))

        # Lines 17-18: cost Q-value function, every gamma_i at once.
        cost_critic_loss = L.td_loss(cost_target, net.cost_critics(s, a))

        # Lines 19-20: policy extraction.
        weight = L.expectile_weight(q - v, config.kappa_2)
        policy_loss = L.policy_loss(weight, gaussian_log_prob(a, *net.policy(s)))

        losses = {
            "value": value_loss,
            "cost_value": cost_value_loss,
            "critic": critic_loss,
            "cost_critic": cost_critic_loss,
            "policy": policy_loss,
        }
        return losses, {
            "safe_fraction": (cost <= limit).float().mean(),
            "cost_mean": cost.mean(),
            "value_mean": v.mean(),
            "negative_q": (q_reward < 0).float().mean(),
        }

    def predicted_cost(self, observations, limit, run=0):
        with torch.no_grad():
            s = self.network_input(self._tensor(observations), self._tensor(limit))
            action, _ = self.network("policy", run)(s)
            return self.episode_cost(self.network("cost_critics", run)(s, action)).amax(0).cpu().numpy()

    def state(self):
        if not self.reconstructs:
            return super().state()
        model = {f"reconstruction.{key}": value for key, value in self.reconstruction.state_dict().items()}
        return super().state() | model

    def load_state(self, tensors):
        prefix = "reconstruction."
        super().load_state(tensors)
        if not self.reconstructs:
            return
        model = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
        self.reconstruction.load_state_dict(model)


class C2IQLWithoutCR(C2IQL):
    """Without cost reconstruction (Section 4.2): one discount factor, and L~ as the limit."""

    name = "C2IQL w/o CR"
    reconstructs = False


class C2IQLWithoutCC(C2IQL):
    """Without constraint conditioning (Section 4.2): trained for one threshold, which no network sees."""

    name = "C2IQL w/o CC"
    conditioned = False
