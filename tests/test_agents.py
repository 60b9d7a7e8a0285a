"""The algorithms against Algorithm 2 written out as a loop over transitions, and against tabular solutions.

Networks and reconstruction are evaluated one transition at a time as they are (they have tests of their
own); everything that the paper says about them is written anew here, in plain numbers.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from randoms import random_batch, randomise
from torch.func import functional_call

from tutorial_lib.agents import ALGORITHMS, get_algorithm
from tutorial_lib.config import Config, get_profile
from tutorial_lib.data.dataset import Batch, Dataset
from tutorial_lib.tasks import TASKS
from tutorial_lib.training import train

T, B = 10, 24
TASK = dataclasses.replace(
    TASKS["BallRun"],
    horizon=T,
    obs_dim=3,
    act_dim=2,
    gammas=(0.6, 0.8, 0.9),
    thresholds=(1, 3, 6),
    cost_range=8,
    min_return=-5.0,
    max_return=40.0,
)
CONFIG = Config(
    profile="test",
    kappa_1=0.7,
    kappa_2=0.9,
    gamma=0.8,
    batch_size=B,
    steps=100,
    hidden_width=8,
    hidden_layers=1,
    awr_alpha=0.01,
    crm="mlp",
    crm_width=8,
    crm_layers=1,
    crm_steps=50,
    time_limits="rate",
    reward_time_limits="bootstrap",
    cost_kappa=None,
    cost_critics=2,
    thresholds_per="sample",
    normalise_observations=True,
    shift_rewards=False,
)
LIMIT = 3.0
FAMILY = ("IQL", "CIQL", "C2IQL w/o CR", "C2IQL w/o CC", "C2IQL")  # Algorithm 2, and what it is made of
NETWORK_OF = {  # which network a loss trains
    "value": "value",
    "cost_value": "cost_value",
    "critic": "critics",
    "cost_critic": "cost_critics",
    "policy": "policy",
}


def make_agent(name, seeds=(0,), task=TASK, **changes):
    kind = get_algorithm(name)
    fixed = kind.constrained and not kind.conditioned
    config = dataclasses.replace(CONFIG, **changes)
    return kind(task, config, seeds=seeds, threshold=LIMIT if fixed else None)


def random_limits(seed, runs=1):
    choices = torch.tensor([*map(float, TASK.thresholds), math.inf])
    return choices[torch.randint(4, (runs, B), generator=torch.Generator().manual_seed(seed))]


def give_limits(agent, limits):
    """Let the next update of a conditioned agent see these, (S, B), instead of random ones."""
    left = iter(limits)
    agent.draw_limits = lambda generator, batch_size: next(left)


def one_update(agent, batch, limits=None):
    if agent.conditioned and limits is not None:
        give_limits(agent, limits)
    generators = [torch.Generator().manual_seed(seed) for seed in agent.seeds]
    return {key: value.tolist() for key, value in agent.update(batch, generators).items()}


# --- Algorithm 2 as a loop ---


class Slow:
    """One run of an agent, one transition at a time, in plain numbers."""

    def __init__(self, agent, run=0):
        self.agent, self.run, self.name = agent, run, agent.name
        self.state = {key: value.clone() for key, value in agent.state().items()}

    def call(self, kind, network, *inputs):
        """A network's output for one transition, as nested lists. kind: online or target."""
        prefix = f"{kind}.{network}."
        weights = {k.removeprefix(prefix): v[self.run] for k, v in self.state.items() if k.startswith(prefix)}
        inputs = [torch.tensor([x], dtype=torch.float32) for x in inputs]
        output = functional_call(self.agent.modules[network], weights, tuple(inputs))
        return [x.squeeze(0).tolist() for x in output] if network == "policy" else output.tolist()

    def inputs(self, observation, limit):
        mean, std = self.state["observation_mean"], self.state["observation_std"]
        x = [(o - m) / s for o, m, s in zip(observation, mean.tolist(), std.tolist(), strict=True)]
        if self.name in ("C2IQL", "C2IQL w/o CR"):
            x.append(1.5 if math.isinf(limit) else limit / TASK.cost_range)
        return x

    def cost(self, heads):
        """What is compared with the limit: a whole episode's cost, from one critic's heads."""
        config = self.agent.config
        gammas = TASK.gammas if self.name in ("C2IQL", "C2IQL w/o CC") else [config.gamma]
        if config.time_limits == "rate":
            heads = [q * (1 - g**T) for q, g in zip(heads, gammas, strict=True)]
        if len(gammas) > 1:
            return self.agent.reconstruction(torch.tensor([heads])).item()
        steady = sum(config.gamma**t for t in range(T)) / T  # discounted sum of one unit of cost in T steps
        return heads[0] / steady

    def losses(self, batch, limits):
        config, sums = self.agent.config, {}

        def add(name, value):
            sums[name] = sums.get(name, 0.0) + value / B

        for row, limit in enumerate(limits.tolist()):
            x = Batch(*(field[row].tolist() for field in batch))
            s, s_next = self.inputs(x.observations, limit), self.inputs(x.next_observations, limit)
            a = x.actions
            q = min(k[0] for k in self.call("target", "critics", s, a))
            v = self.call("online", "value", s)[0]
            if self.name != "IQL":
                critics = [k[0] for k in self.call("target", "cost_critics", s, a)]
                cost, q_cost = max((self.cost(heads), heads) for heads in critics)
                stops = x.terminals or (config.time_limits == "mask" and x.timeouts)
                after = self.call("online", "cost_value", s_next)[0]
                gammas = TASK.gammas if len(after) > 1 else [config.gamma]
                backup = [x.costs + (0 if stops else g * c) for g, c in zip(gammas, after, strict=True)]
                if config.recorded_step:
                    cost = max(cost, self.cost(backup))
                if config.unsafe_price is not None:
                    price = config.unsafe_price * self.state["reward_scale"].item() / TASK.cost_range
                    state_cost = self.cost(self.call("online", "cost_value", s)[0])
                    q -= price * (max(cost - limit, 0) - max(state_cost - limit, 0))
                elif cost > limit:
                    q = 0.0
                add("safe_fraction", cost <= limit)
            u = q - v

            def weight(kappa, u=u):
                return 1 - kappa if u < 0 else kappa

            add("value_loss", weight(config.kappa_1) * u * u)
            stops = x.terminals or (config.reward_time_limits == "mask" and x.timeouts)
            y = x.rewards + (0 if stops else config.gamma * self.call("online", "value", s_next)[0])
            add("critic_loss", sum((y - k[0]) ** 2 for k in self.call("online", "critics", s, a)))

            if self.name != "IQL":
                v_cost = self.call("online", "cost_value", s)[0]
                kappa = config.kappa_1 if config.cost_kappa is None else config.cost_kappa
                errors = [(p - q) ** 2 for p, q in zip(q_cost, v_cost, strict=True)]
                add("cost_value_loss", weight(kappa) * sum(errors) / len(errors))
                for heads in self.call("online", "cost_critics", s, a):
                    for now, y in zip(heads[0], backup, strict=True):
                        add("cost_critic_loss", (y - now) ** 2 / len(gammas))

            mean, log_std = self.call("online", "policy", s)
            log_prob = sum(
                -0.5 * ((x - m) / math.exp(z)) ** 2 - z - 0.5 * math.log(2 * math.pi)
                for x, m, z in zip(a, mean, log_std, strict=True)
            )
            if self.name == "IQL":
                w = min(100.0, math.exp(config.awr_alpha * u * 1000 / (TASK.max_return - TASK.min_return)))
            else:
                w = weight(config.kappa_2)
            add("policy_loss", -w * log_prob)
        return sums


OPTIONS = [
    {},
    {"time_limits": "bootstrap"},
    {"time_limits": "mask"},
    {"reward_time_limits": "mask"},
    {"cost_kappa": 0.95},
    {"unsafe_price": 0.5},
    {"recorded_step": True},
    {"recorded_step": True, "unsafe_price": 0.5, "time_limits": "mask"},
    {"cost_critics": 1},
    {"cost_critics": 3},
    {"kappa_1": 0.5, "kappa_2": 0.6, "gamma": 0.7},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("name", FAMILY)
def test_an_updates_losses_are_algorithm_2s(name, options):
    agent = make_agent(name, seeds=(0, 1), **options)
    batch, limits = random_batch(1, runs=2), random_limits(2, runs=2)
    if not agent.conditioned:
        limits = torch.full((2, B), LIMIT)
    for seed in range(50):  # until both kinds of actions are there, or the batch shows nothing
        randomise(agent, seed)
        slow = [Slow(agent, run).losses(Batch(*(x[run] for x in batch)), limits[run]) for run in (0, 1)]
        if all(0.2 < one.get("safe_fraction", 0.5) < 0.8 for one in slow):
            break
    else:
        pytest.fail("no batch with safe and unsafe actions")
    scalars = one_update(agent, batch, limits)
    for run in (0, 1):
        assert {key: scalars[key][run] for key in slow[run]} == pytest.approx(slow[run], rel=1e-4, abs=1e-4)
        assert {f"{loss}_loss" for loss in NETWORK_OF} & scalars.keys() <= slow[run].keys()


class WithoutBoth(get_algorithm("C2IQL")):
    name = "C2IQL w/o both"
    conditioned = reconstructs = False


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_without_its_two_parts_c2iql_is_ciql(options):
    """So an ablation compares what it says, and nothing else; from the first guess of the costs on."""
    config = dataclasses.replace(CONFIG, **options)
    agents = [
        kind(TASK, config, seeds=(0,), threshold=LIMIT) for kind in (WithoutBoth, get_algorithm("CIQL"))
    ]
    data = toy_dataset()
    for agent in agents:
        agent.prepare(data, progress=False)
    for _ in range(3):
        batch = random_batch(1)
        both = [one_update(agent, batch) for agent in agents]
        assert both[1] == {key: pytest.approx(both[0][key], rel=1e-5) for key in both[1]}
    parts, whole = (agent.state() for agent in agents)
    for key, value in whole.items():
        torch.testing.assert_close(value, parts[key], msg=key)


@pytest.mark.parametrize("name", FAMILY)
def test_one_run_takes_the_same_step_as_several(name):
    """The lift over seeds is skipped for one run: the other path must have the same losses."""
    pair, single = make_agent(name, seeds=(0, 1)), make_agent(name)
    randomise(pair)
    state = pair.state()
    single.load_state(state | {k: v[1:] for k, v in state.items() if k.startswith(("online.", "target."))})
    batch, limits = random_batch(1, runs=2), random_limits(2, runs=2)
    both = one_update(pair, batch, limits)
    alone = one_update(single, Batch(*(x[1:] for x in batch)), limits[1:])
    assert both.keys() == alone.keys()
    for key, value in both.items():
        assert value[1:] == pytest.approx(alone[key], rel=1e-4, abs=1e-5), key


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_update_leaves_nothing_behind_but_numbers(name):
    """A graph that the targets kept would grow with every update: three gigabytes in the paper's 400,000."""
    agent = make_agent(name)
    one_update(agent, random_batch(1))
    for parameters in agent.target_parameters.values():
        assert not any(value.requires_grad for value in parameters.values())


@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_in_bfloat16_an_update_is_about_the_same_and_leaves_float32(name, seeds):
    found = {}
    for precision in ("float32", "bfloat16"):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # an untrained reconstruction model draws from it
            agent = make_agent(name, seeds=seeds, precision=precision)
        scalars = one_update(agent, random_batch(1, runs=len(seeds)))
        parameters = [p for group in agent.optimiser.param_groups for p in group["params"]]
        gradients = [p.grad for p in parameters if p.grad is not None]  # CPQ's push rests at first
        assert all(x.dtype == torch.float32 for x in gradients)
        assert all(x.dtype == torch.float32 for x in agent.state().values() if x.is_floating_point())
        found[precision] = scalars, torch.cat([x.flatten() for x in gradients])
    (exact, gradient), (rounded, rounded_gradient) = found.values()
    for key, value in exact.items():
        if key.endswith("_loss"):
            assert rounded[key] == pytest.approx(value, rel=0.05, abs=0.02), key
    assert 1e-4 < (rounded_gradient - gradient).norm() / gradient.norm() < 0.1


def test_the_reconstruction_is_trained_in_float32():
    first, second = (make_agent("C2IQL", precision=precision) for precision in ("float32", "bfloat16"))
    for agent in (first, second):
        agent.prepare(toy_dataset(), progress=False)
    states = (agent.reconstruction.state_dict() for agent in (first, second))
    for one, other in zip(*(state.values() for state in states), strict=True):
        assert torch.equal(one, other)


# --- What each loss reaches ---


@pytest.mark.parametrize("name", FAMILY)
def test_a_loss_reaches_its_own_network_and_no_other(name):
    agent = make_agent(name)
    randomise(agent)
    leaves = {}
    for key, value in agent.state().items():
        kind, _, rest = key.partition(".")
        if kind in ("online", "target"):
            network, _, parameter = rest.partition(".")
            place = network if kind == "online" else f"target_{network}"
            leaves.setdefault(place, {})[parameter] = value[0].clone().requires_grad_()

    def bound(place):
        module = agent.modules[place.removeprefix("target_")]
        return lambda *inputs: functional_call(module, leaves[place], inputs)

    batch = Batch(*(field[0] for field in random_batch(1)))
    net = SimpleNamespace(**{place: bound(place) for place in leaves})
    limits = random_limits(2)[0] if agent.conditioned else torch.full((B,), LIMIT)
    losses, _ = agent.losses(net, batch, limits)
    assert {NETWORK_OF[loss] for loss in losses} == agent.parameters.keys()
    places = [(place, key) for place, parameters in leaves.items() for key in parameters]
    for loss, value in losses.items():
        tensors = [leaves[place][key] for place, key in places]
        gradients = torch.autograd.grad(value, tensors, allow_unused=True, retain_graph=True)
        reached = {p for p, g in zip(places, gradients, strict=True) if g is not None and g.any()}
        assert reached == {(place, key) for place, key in places if place == NETWORK_OF[loss]}, loss


# --- Terminals and time limits ---


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize("cost_limits", ["rate", "bootstrap", "mask"])
@pytest.mark.parametrize("reward_limits", ["bootstrap", "mask"])
def test_which_ends_stop_the_bootstrap(name, cost_limits, reward_limits):
    """A backup that stops at an end does not look at the state after it."""

    def losses(flag, moved):
        agent = make_agent(name, time_limits=cost_limits, reward_time_limits=reward_limits)
        randomise(agent)
        ends = {key: torch.zeros(1, B) for key in ("terminals", "timeouts")}
        if flag:
            ends[flag][:, :5] = 1
        batch = random_batch(1)._replace(**ends)
        batch.next_observations[:, :5] += 3.0 * moved
        return one_update(agent, batch, random_limits(2))

    def looks(flag, loss):
        return losses(flag, True)[loss] != losses(flag, False)[loss]

    assert looks(None, "critic_loss")
    assert not looks("terminals", "critic_loss")
    assert looks("timeouts", "critic_loss") == (reward_limits == "bootstrap")
    if name != "IQL":
        assert looks(None, "cost_critic_loss")
        assert not looks("terminals", "cost_critic_loss")
        assert looks("timeouts", "cost_critic_loss") == (cost_limits != "mask")


# --- Limits ---


@pytest.mark.parametrize("name", ["C2IQL", "C2IQL w/o CR"])
def test_an_infinite_limit_penalises_nothing(name):
    """Costs change nothing then, and the value and critic losses are IQL's on the same networks."""
    infinite = torch.full((1, B), math.inf)
    batch = random_batch(1)

    def update(seed):
        agent = make_agent(name)
        randomise(agent)
        state = agent.state()
        other = torch.Generator().manual_seed(seed)
        for key, value in state.items():
            if "cost" in key or "reconstruction" in key:
                value.copy_(torch.randn(value.shape, generator=other))
        agent.load_state(state)
        changed = batch._replace(costs=(torch.rand(1, B, generator=other) < 0.5).float())
        slow = Slow(agent)
        slow.name = "IQL"
        slow.inputs = lambda o, limit: Slow.inputs(SimpleNamespace(name=name, state=slow.state), o, limit)
        return one_update(agent, changed, infinite), slow.losses(Batch(*(x[0] for x in changed)), infinite[0])

    first, reward_only = update(1)
    second, _ = update(2)
    assert first["safe_fraction"] == [1.0]
    for key in ("value_loss", "critic_loss", "policy_loss", "value_mean"):
        assert first[key] == second[key]
    assert first["cost_value_loss"] != second["cost_value_loss"]
    for key in ("value_loss", "critic_loss"):
        assert first[key] == pytest.approx([reward_only[key]], rel=1e-4)


@pytest.mark.parametrize("name", ["C2IQL", "C2IQL w/o CR"])
def test_thresholds_are_drawn_for_each_sample_or_for_each_batch(name):
    expected = [1.0, 3.0, 6.0, math.inf]
    generator = torch.Generator().manual_seed(0)
    draws = make_agent(name, thresholds_per="sample").draw_limits(generator, 4_000)
    assert draws.shape == (4_000,)
    shares = [(draws == limit).float().mean().item() for limit in expected]
    assert shares == pytest.approx([0.25] * 4, abs=0.03)

    agent, seen = make_agent(name, thresholds_per="batch"), []
    for _ in range(400):
        draws = agent.draw_limits(generator, 16)
        assert draws.shape == (16,) and (draws == draws[0]).all()
        seen.append(draws[0].item())
    assert [seen.count(limit) / 400 for limit in expected] == pytest.approx([0.25] * 4, abs=0.08)


def test_every_run_draws_its_limits_from_its_own_generator():
    agent, seen = make_agent("C2IQL", seeds=(3, 4)), []
    draw = agent.draw_limits
    agent.draw_limits = lambda *args: seen.append(draw(*args)) or seen[-1]
    one_update(agent, random_batch(0, runs=2))
    alone = [make_agent("C2IQL").draw_limits(torch.Generator().manual_seed(seed), B) for seed in (3, 4)]
    assert all(torch.equal(x, y) for x, y in zip(seen, alone, strict=True))
    assert not torch.equal(*seen)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_threshold_is_given_where_it_is_needed_and_nowhere_else(name):
    kind = get_algorithm(name)
    takes_one = name in ("CIQL", "C2IQL w/o CC", "BC-Safe", "CPQ", "CPQ w/ push")
    assert kind(TASK, CONFIG, threshold=0 if takes_one else None).threshold == (0.0 if takes_one else None)
    with pytest.raises(ValueError, match=name):
        kind(TASK, CONFIG, threshold=None if takes_one else 3.0)
    if takes_one:
        for bad in (-1.0, math.nan):
            with pytest.raises(ValueError, match="threshold"):
                kind(TASK, CONFIG, threshold=bad)


def test_unknown_names_are_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="'C3IQL'.*IQL, CIQL, C2IQL w/o CR, C2IQL w/o CC, C2IQL"):
        get_algorithm("C3IQL")
    with pytest.raises(ValueError, match="'huge'.*paper, small"):
        get_profile("huge")
    assert [get_algorithm(name).name for name in ALGORITHMS] == list(ALGORITHMS)


# --- Options ---


def toy_dataset(seed=0, episodes=40):
    rng = np.random.default_rng(seed)
    rows = episodes * T
    return Dataset(
        observations=rng.normal(3, 2, size=(rows, 3)).astype(np.float32),
        next_observations=rng.normal(3, 2, size=(rows, 3)).astype(np.float32),
        actions=rng.uniform(-1, 1, size=(rows, 2)).astype(np.float32),
        rewards=rng.normal(2, 4, size=rows).astype(np.float32),
        costs=(rng.random(rows) < 0.4).astype(np.float32),
        terminals=np.zeros(rows, bool),
        timeouts=np.arange(1, rows + 1) % T == 0,
    )


@pytest.mark.parametrize(
    "options",
    [
        {"crm": "linear"},
        {"crm_noise": 2.0},
        {"crm_steps": 100},
        {"time_limits": "bootstrap"},
        {"time_limits": "mask"},
        {"reward_time_limits": "mask"},
        {"cost_kappa": 0.95},
        {"cost_critics": 1},
        {"thresholds_per": "batch"},
        {"normalise_observations": False},
        {"shift_rewards": True},
        {"kappa_1": 0.6},
        {"kappa_2": 0.6},
        {"gamma": 0.7},
        {"target_tau": 0.5},
        {"precision": "bfloat16"},
    ],
    ids=str,
)
@pytest.mark.filterwarnings("ignore:this CPU takes")  # without units for bfloat16
def test_an_option_changes_what_is_learned(options):
    def last_log(**changes):
        agent = make_agent("C2IQL", **changes)
        log = train(agent, toy_dataset(), steps=8, log_every=1, progress=False)
        return [{k: v for k, v in row.items() if k != "updates_per_second"} for row in log]

    assert last_log() == last_log()
    assert last_log(**options) != last_log()


def test_a_linear_reconstruction_is_linear():
    x, y = torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(0)) * 5
    bends = {}
    for crm in ("linear", "mlp"):
        agent = make_agent("C2IQL", crm=crm)
        agent.prepare(toy_dataset(), progress=False)
        model = agent.reconstruction
        bends[crm] = (model(x) + model(y) - 2 * model((x + y) / 2)).abs().max().item()
    assert bends["linear"] < 1e-3 < 1e-2 < bends["mlp"]


def test_shifted_rewards_start_at_zero():
    data = toy_dataset()
    shifted = dataclasses.replace(data, rewards=data.rewards - data.rewards.min())
    logs = [
        train(make_agent("IQL", shift_rewards=shift), part, steps=3, log_every=1, progress=False)
        for shift, part in ((True, data), (False, shifted))
    ]
    assert [row["critic_loss"] for row in logs[0]] == pytest.approx([row["critic_loss"] for row in logs[1]])


@pytest.mark.parametrize("shift", [False, True])
def test_a_price_is_in_mean_returns_of_the_rewards_that_are_trained_on(shift):
    data, agent = toy_dataset(), make_agent("C2IQL", shift_rewards=shift)
    train(agent, data, steps=1, progress=False)
    rewards = (data.rewards - shift * data.rewards.min()).reshape(-1, T).tolist()
    to_go = [sum(r * 0.8**k for k, r in enumerate(row[t:])) for row in rewards for t in range(T)]
    assert agent.reward_scale.item() == pytest.approx(abs(sum(to_go) / len(to_go)), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "gammas"), [("CIQL", [0.8]), ("C2IQL w/o CR", [0.8]), ("C2IQL", TASK.gammas)]
)
def test_cost_heads_start_at_the_datas_rate_for_ever(name, gammas):
    data, agent = toy_dataset(), make_agent(name, hidden_layers=0)
    agent.prepare(data, progress=False)
    for place, network in (
        (agent.parameters, "cost_value"),
        (agent.parameters, "cost_critics"),
        (agent.target_parameters, "cost_critics"),
    ):
        biases = {key: value[0] * ("bias" in key) for key, value in place[network].items()}
        inputs = torch.ones(1, TASK.obs_dim + agent.conditioned), torch.ones(1, TASK.act_dim)
        found = functional_call(agent.modules[network], biases, inputs[: 1 + ("critics" in network)])
        for heads in found.reshape(-1, len(gammas)).tolist():
            assert heads == pytest.approx([data.costs.mean() / (1 - gamma) for gamma in gammas], rel=1e-5)


# --- A CMDP small enough to solve ---

STATES, ACTIONS = 3, 3
PAIRS = STATES * ACTIONS
GAMMAS, GAMMA, KAPPA = np.array([0.5, 0.6, 0.7]), 0.6, 0.7
WEIGHTS = np.array([0.2, 0.5, 0.8])  # of a reconstruction that is known
TABULAR = dataclasses.replace(
    TASK,
    obs_dim=STATES,
    act_dim=PAIRS,  # an "action" names state and action, so that a linear layer is a table of Q(s, a)
    gammas=tuple(GAMMAS.tolist()),
    thresholds=(0.5, 1, 2),
    max_return=10.0,
    min_return=0.0,
)


class Transitions:
    """Every transition of a random CMDP as often as mu and its dynamics say; some of them are terminal."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        reward, cost = rng.uniform(0.5, 2, PAIRS), rng.random(PAIRS)
        rows = [
            (pair, rng.integers(STATES), rng.random() < 0.15)
            for pair in range(PAIRS)
            for _ in range(rng.integers(2, 6))
        ]
        self.pair, self.next, self.terminal = (np.array(column) for column in zip(*rows, strict=True))
        self.state, self.reward, self.cost = self.pair // ACTIONS, reward[self.pair], cost[self.pair]
        self.visits = np.bincount(self.pair, minlength=PAIRS)

    def batch(self):
        def tensor(x):
            return torch.tensor(np.asarray(x, np.float32))[None]

        return Batch(
            observations=tensor(np.eye(STATES)[self.state]),
            actions=tensor(np.eye(PAIRS)[self.pair]),
            rewards=tensor(self.reward),
            costs=tensor(self.cost),
            next_observations=tensor(np.eye(STATES)[self.next]),
            terminals=tensor(self.terminal),
            timeouts=tensor(np.zeros(len(self.pair))),
        )

    def mean(self, values):
        """Of the rows of each (s, a): (PAIRS,)."""
        return np.bincount(self.pair, values, PAIRS) / self.visits

    def expectile(self, q):
        """V(s), by bisection: it balances kappa E[(q - v)+] and (1 - kappa) E[(v - q)+] under mu."""
        values = np.zeros(STATES)
        for s in range(STATES):
            own = slice(s * ACTIONS, (s + 1) * ACTIONS)
            low, high = q[own].min() - 1, q[own].max() + 1
            for _ in range(60):
                v = (low + high) / 2
                above = KAPPA * (self.visits[own] * np.maximum(q[own] - v, 0)).sum()
                below = (1 - KAPPA) * (self.visits[own] * np.maximum(v - q[own], 0)).sum()
                low, high = (v, high) if above > below else (low, v)
            values[s] = v
        return values

    def evaluate(self, policy):
        """Discounted costs of a policy (PAIRS,) by a linear solve: V_c (STATES, m) and Q_c (PAIRS, m)."""
        step_cost, moves = self.mean(self.cost), np.zeros((PAIRS, STATES))
        for pair, after, terminal in zip(self.pair, self.next, self.terminal, strict=True):
            moves[pair, after] += (not terminal) / self.visits[pair]
        average = np.zeros((STATES, PAIRS))
        average[np.arange(PAIRS) // ACTIONS, np.arange(PAIRS)] = policy
        v = [np.linalg.solve(np.eye(STATES) - g * average @ moves, average @ step_cost) for g in GAMMAS]
        q = [step_cost + g * moves @ x for g, x in zip(GAMMAS, v, strict=True)]
        return np.stack(v, 1), np.stack(q, 1)

    def solve(self, limit, q, q_cost):
        """The fixed point of Algorithm 2, from any start."""
        for _ in range(200):
            cost = (q_cost * (1 - GAMMAS**T)) @ WEIGHTS
            penalised = np.where(cost <= limit, q, 0.0)
            v = self.expectile(penalised)
            weight = np.where(penalised < np.repeat(v, ACTIONS), 1 - KAPPA, KAPPA) * self.visits
            total = np.bincount(np.arange(PAIRS) // ACTIONS, weight)
            policy = weight / np.repeat(total, ACTIONS)
            v_cost, q_cost = self.evaluate(policy)
            q = self.mean(self.reward + GAMMA * (1 - self.terminal) * v[self.next])
        return SimpleNamespace(q=q, v=v, q_cost=q_cost, v_cost=v_cost, cost=cost, penalised=penalised)


class KnownReconstruction(torch.nn.Module):
    def forward(self, discounted):
        return discounted @ torch.tensor(WEIGHTS, dtype=torch.float32)


def tables(agent):
    """The agent's networks at every state and every (s, a), as arrays."""
    s, pairs = torch.eye(STATES), torch.eye(PAIRS)
    at = s.repeat_interleave(ACTIONS, 0)
    with torch.no_grad():
        return SimpleNamespace(
            v=agent.network("value")(s).numpy(),
            v_cost=agent.network("cost_value")(s).numpy(),
            q=agent.network("critics")(at, pairs).numpy(),
            q_cost=agent.network("cost_critics")(at, pairs).numpy(),
        )


@pytest.mark.parametrize("limit", [1.6, math.inf])
def test_the_critics_converge_to_the_solution_of_the_tabular_problem(limit):
    data = Transitions(35)
    solution = data.solve(limit, np.zeros(PAIRS), np.zeros((PAIRS, 3)))
    other_start = data.solve(limit, np.full(PAIRS, 5.0), np.full((PAIRS, 3), 3.0))
    np.testing.assert_allclose(solution.q_cost, other_start.q_cost)  # it has one solution ...
    unsafe = (solution.cost > limit).sum()
    assert unsafe == 0 if limit == math.inf else 1 < unsafe < PAIRS - 1
    if limit < math.inf:  # ... of which nothing hangs on a hair
        assert np.abs(solution.cost - limit).min() > 0.05
    assert np.abs(solution.penalised - np.repeat(solution.v, ACTIONS)).min() > 0.05
    behaviour = data.visits / np.repeat(data.visits.reshape(STATES, ACTIONS).sum(1), ACTIONS)
    assert np.abs(solution.v_cost - data.evaluate(behaviour)[0]).max() > 0.05  # pi_imp is not mu

    agent, batch = None, data.batch()
    for value_lr, critic_lr, steps in ((2e-2, 2e-2, 700), (2e-3, 2e-3, 700)):
        config = dataclasses.replace(
            CONFIG,
            gamma=GAMMA,
            kappa_1=KAPPA,
            hidden_layers=0,
            normalise_observations=False,
            value_lr=value_lr,
            critic_lr=critic_lr,
            target_tau=0.1,
        )
        last, agent = agent, get_algorithm("C2IQL w/o CC")(TABULAR, config, threshold=limit)
        agent.reconstruction = KnownReconstruction()
        if last:
            agent.load_state({k: v for k, v in last.state().items() if not k.startswith("adam.")})
        for _ in range(steps):
            agent.update(batch, [None])
    found = tables(agent)
    close = {"rtol": 0.01, "atol": 0.02}
    np.testing.assert_allclose(found.v, solution.v, **close)
    np.testing.assert_allclose(found.v_cost, solution.v_cost, **close)
    for k in range(2):
        np.testing.assert_allclose(found.q[k], solution.q, **close)
        np.testing.assert_allclose(found.q_cost[k], solution.q_cost, **close)
