"""The patients of notebook 16: small agents of safe offline RL, each with one planted fault.

**If you want to diagnose them, do not read on:** the end of this file says which patient has which fault.

All of them learn from recorded episodes of the laps of notebook 9, where the cost and the return of a policy
are exact. `admit` trains a patient, or the same patient with one repair. To repair a fault that a patient
does not have changes nothing, because the code was right there already.
"""

import dataclasses
import functools

import numpy as np
import torch

from tutorial_lib import networks, training
from tutorial_lib.agents import BCBudget
from tutorial_lib.agents.player import CountingPlayer
from tutorial_lib.course import laps, table_agents, tabular
from tutorial_lib.course.table_agents import GAMMA, HORIZON, WORLD, Rows, record, recordings
from tutorial_lib.data.dataset import Dataset

FAULTS = {
    "terminal": "The end of the recording (time limit) is treated as a terminal: nothing follows it.",
    "discounted": "A discounted sum of costs is compared with the limit of an episode.",
    "sign": "Q_r is negative, and the penalty still replaces the value of an unsafe action with zero.",
    "broadcast": "A loss subtracts arrays of the shapes (B,) and (B, 1).",
    "target": "The target network never moves from its first weights.",
    "budget": "The budget that the agent is told is never counted down.",
    "normalised": "Costs are shifted and scaled to mean 0 and variance 1, as rewards often are.",
    "late": "The cost of each step is recorded one row late.",
}
"""What can be wrong with a patient, by the name of the fault."""


@dataclasses.dataclass(frozen=True)
class Patient:
    """A trained agent, with everything that can be measured on it. A field is None where it has no such part.

    There are n limits (or n situations), T steps, S states, A actions and B recorded rows. Costs are in
    unsafe steps.
    """

    number: int
    repaired: str | None
    """The name of the fault that was looked for and repaired, or None."""
    limits: np.ndarray
    """(n,): the limits under which it played. In patient 3, the steps of its situations."""
    predicted: np.ndarray
    """(n,): what it predicted that an episode (or what remains of one) costs. NaN if it predicts nothing."""
    paid: np.ndarray
    """(n,): what an episode (or what remains of one) costs in truth, in expectation."""
    rows: Rows
    """The recordings as its learner reads them."""
    targets: np.ndarray
    """(B, ...): the targets of its last regression, and"""
    fitted: np.ndarray
    """(B, ...): what it answers to them."""
    returns: np.ndarray | None = None
    """(n,): the expected return of an episode."""
    by_step: np.ndarray | None = None
    """(n, T): the expected cost of each step."""
    told: np.ndarray | None = None
    """(n, T): the limit that the policy is told at each step, in expectation."""
    policies: np.ndarray | None = None
    """(n, S, A): its policy for each limit."""
    q_reward: np.ndarray | None = None
    """(n, S, A): its Q_r."""
    q_cost: np.ndarray | None = None
    """(n, S, A): the cost of an episode that begins with an action, as it predicts it."""
    worth: np.ndarray | None = None
    """(n, S, A): what its policy maximises: Q_r after the penalty."""
    next_values: np.ndarray | None = None
    """(B,): the part of each target of the cost that stands for what follows the step."""


def _table_patient(number: int, repaired: str | None, kind: type[table_agents.TableAgent], limits) -> Patient:
    """Returns a patient that keeps tables, with a policy for each limit."""
    agent = kind(recordings())
    fits = [agent.fit(limit) for limit in limits]
    played = [laps.follow_one(fit.policy) for fit in fits]
    means = np.stack([x.chances @ np.arange(HORIZON + 1) for x in played])
    rows, last = agent.rows, fits[-1]
    where = rows.states.ravel(), rows.actions.ravel()
    q_cost = agent.values(last.policy, agent.cost)
    v_cost = (last.policy * q_cost).sum(1)
    follows = GAMMA * v_cost[rows.next_states.ravel()] * agent.goes_on(rows).ravel()
    return Patient(
        number, repaired, np.array(limits, float),
        predicted=np.array([agent.start(fit.policy, fit.q_cost) for fit in fits]),
        paid=np.array([x.cost for x in played]), rows=rows,
        targets=rows.costs.ravel() + follows, fitted=q_cost[where], next_values=follows,
        returns=np.array([x.reward for x in played]), by_step=np.diff(means),
        policies=np.stack([fit.policy for fit in fits]), q_reward=np.stack([fit.q_reward for fit in fits]),
        q_cost=np.stack([fit.q_cost for fit in fits]), worth=np.stack([fit.worth for fit in fits]),
    )  # fmt: skip


class Predictor(torch.nn.Module):
    """V_c(s, t): the remaining cost of an episode, for states as indices (B,) and steps (B,)."""

    def __init__(self, squeeze: bool):
        super().__init__()
        self.net, self.squeeze = networks.mlp(len(WORLD.initial) + 1, 32, 2, 1), squeeze

    def forward(self, states: np.ndarray, steps: np.ndarray) -> torch.Tensor:
        """Returns the remaining cost, (B,), or (B, 1) if the last axis is not squeezed."""
        inputs = np.concatenate([np.eye(len(WORLD.initial))[states], steps[:, None] / HORIZON], 1)
        cost = 10 * self.net(torch.as_tensor(inputs, dtype=torch.float32))
        return cost.squeeze(-1) if self.squeeze else cost


def _predicting_patient(number: int, repaired: str | None, broken: bool, situations: int = 60) -> Patient:
    """Returns a patient that predicts the remaining cost of one recorded policy, and chooses no action."""
    rows = record((20,), 200)
    to_go = rows.costs[:, ::-1].cumsum(1)[:, ::-1].ravel()
    states, steps = rows.states.ravel(), np.tile(np.arange(HORIZON), len(rows.states))
    targets = torch.as_tensor(to_go.copy(), dtype=torch.float32)
    rng = np.random.default_rng(0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = Predictor(squeeze=not broken)
    optimiser = torch.optim.Adam(model.parameters(), 5e-3)
    for _ in range(600):
        pick = rng.integers(len(states), size=256)
        loss = (targets[pick] - model(states[pick], steps[pick])).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    shown = rng.choice(np.flatnonzero(steps <= 90), situations, replace=False)
    with torch.no_grad():
        fitted = model(states, steps).numpy().astype(float).reshape(-1)
    policy = 0.75 * laps.policies((20,))[20.0] + 0.25 / 4
    truth = [np.zeros(len(WORLD.initial))]  # V_T; then backwards, one step at a time
    for _ in range(HORIZON):
        truth.append((policy * (WORLD.costs + WORLD.transitions @ truth[-1])).sum(1))
    paid = np.array(truth)[HORIZON - steps[shown], states[shown]]
    return Patient(
        number, repaired, steps[shown].astype(float), predicted=fitted[shown], paid=paid, rows=rows,
        targets=to_go, fitted=fitted,
    )  # fmt: skip


class ForgetfulPlayer(CountingPlayer):
    """Fault 'budget': it counts the steps, and forgets what they cost."""

    def see(self, rewards: np.ndarray, costs: np.ndarray) -> None:
        self.t += 1


class ForgetfulCloning(BCBudget):
    """The library's BC (budget rule) with a player that forgets."""

    name = "BC (forgetful)"

    def player(self, limits, seeds, run: int = 0) -> CountingPlayer:
        return ForgetfulPlayer(self, limits, run)


ONE_HOT_TASK = dataclasses.replace(laps.TASK, obs_dim=len(WORLD.initial), act_dim=WORLD.rewards.shape[1])
"""The laps as a task of the library: the observation is one-hot, and so is the action, with 0.8 for 1."""
ONE_HOT = 0.8


def _dataset(rows: Rows) -> Dataset:
    """Returns the recordings as a dataset of the library."""
    sizes = WORLD.rewards.shape
    state, act = np.eye(sizes[0], dtype=np.float32), ONE_HOT * (2 * np.eye(sizes[1], dtype=np.float32) - 1)
    s, a, then = rows.states.ravel(), rows.actions.ravel(), rows.next_states.ravel()
    reward, cost = (x.ravel().astype(np.float32) for x in (rows.rewards, rows.costs))
    return Dataset(state[s], state[then], act[a], reward, cost, rows.terminals.ravel(), rows.timeouts.ravel())


def _cloner(kind: type[BCBudget]) -> BCBudget:
    """Returns an agent of the library, trained on the recordings in some seconds."""
    options = kind.configure(updates=1500, hidden_width=32, normalise_observations=False, policy_lr=5e-3)
    agent = kind(ONE_HOT_TASK, options)
    training.train(agent, _dataset(recordings()), progress=False)
    return agent


def _chances(mean: np.ndarray) -> np.ndarray:
    """Returns the probabilities (..., A) that a mean of one-hot actions (..., A) stands for."""
    chances = ((mean.astype(float) / ONE_HOT + 1) / 2).clip(1e-6)
    return chances / chances.sum(-1, keepdims=True)


def _budget_patient(number: int, repaired: str | None, kind: type[BCBudget], limits) -> Patient:
    """Returns a patient that clones under a budget. What it is told is read from its player."""
    agent, spent = _cloner(kind), np.arange(HORIZON + 1.0)
    states, played, told = np.eye(len(WORLD.initial)), [], []
    for limit in limits:
        says = np.zeros((HORIZON, HORIZON + 1))  # at each step, after each cost so far
        for cost in range(HORIZON + 1):
            player = agent.player([limit], [0])
            player.see(np.zeros(1), np.full(1, float(cost)))
            says[:, cost] = player.told

        def policy(t: int, says=says) -> np.ndarray:
            means = agent.act(np.tile(states, (len(spent), 1)), np.repeat(says[t], len(states)), 0, t)
            return _chances(means).reshape(len(spent), *WORLD.rewards.shape)

        played.append(tabular.follow(WORLD, HORIZON, policy))
        told.append((played[-1].chances[:-1] * says).sum(1))
    rows = recordings()
    data = _dataset(rows)
    left = rows.costs[:, ::-1].cumsum(1)[:, ::-1]
    fitted = np.concatenate(
        [agent.act(states[rows.states[:, t]], left[:, t], 0, t) for t in range(0, HORIZON, 10)]
    )
    targets = np.concatenate(
        [data.actions.reshape(*rows.states.shape, -1)[:, t] for t in range(0, HORIZON, 10)]
    )
    return Patient(
        number, repaired, np.array(limits, float), predicted=np.full(len(limits), np.nan),
        paid=np.array([x.cost for x in played]), rows=rows, targets=targets, fitted=fitted,
        returns=np.array([x.reward for x in played]), told=np.array(told),
        by_step=np.diff([x.chances @ spent for x in played]),
    )  # fmt: skip


_TABLES: dict[int, tuple[type, type, tuple[float, ...]]] = {
    1: (table_agents.ComparesDiscounted, table_agents.TableAgent, (5, 10, 15, 20, 25)),
    2: (table_agents.KeepsSign, table_agents.ZeroPenalty, (27, 30, 35, 40, 45)),
    5: (table_agents.EndsAtTimeLimits, table_agents.TableAgent, (10, 15, 20, 25, 30)),
    6: (table_agents.ReadsLate, table_agents.TableAgent, (5, 10, 20, 30, 40)),
}
"""The faulty class, the healthy class and the limits of the patients that keep tables."""
PATIENTS = {1: "discounted", 2: "sign", 3: "broadcast", 4: "budget", 5: "terminal", 6: "late"}
"""The fault of each patient."""


@functools.cache
def admit(number: int, repair: str | None = None) -> Patient:
    """Returns a patient after its training. With `repair`, this one part of its code is written correctly.

    `repair` is a name in `FAULTS`. Raises ValueError for an unknown number or name.
    """
    if number not in PATIENTS:
        raise ValueError(f"there is no patient {number!r}: the patients are {', '.join(map(str, PATIENTS))}")
    if repair is not None and repair not in FAULTS:
        raise ValueError(f"unknown fault {repair!r}: the faults are {', '.join(FAULTS)}")
    broken = repair != PATIENTS[number]
    if number == 3:
        return _predicting_patient(number, repair, broken)
    if number == 4:
        kind = ForgetfulCloning if broken else BCBudget
        return _budget_patient(number, repair, kind, (10, 15, 20, 25, 30))
    sick, healthy, limits = _TABLES[number]
    return _table_patient(number, repair, sick if broken else healthy, limits)
