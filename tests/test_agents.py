"""IQL, CIQL and C2IQL against Algorithm 2 written out as a loop, and against tabular solutions.

Networks and reconstruction are evaluated one transition at a time as they are (they have tests of their
own); everything that the paper says about them is written anew here, in plain numbers.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from randoms import of_run, random_batch, random_data, randomise
from torch.func import functional_call

from tutorial_lib.agents import ALGORITHMS, get_algorithm
from tutorial_lib.agents.implicit import ConstrainedConfig
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
OPTIONS = {  # each algorithm takes those that it reads
    "profile": "test",
    "kappa_1": 0.7,
    "kappa_2": 0.9,
    "gamma": 0.8,
    "batch_size": B,
    "updates": 100,
    "hidden_width": 8,
    "hidden_layers": 1,
    "awr_alpha": 0.01,
    "crm_width": 8,
    "crm_layers": 1,
    "crm_steps": 50,
    "reward_time_limits": "bootstrap",
}
LIMIT = 3.0
FAMILY = ("IQL", "CIQL", "C2IQL w/o CR", "C2IQL w/o CC", "C2IQL")  # Algorithm 2, and what it is made of
CONDITIONED = ("C2IQL", "C2IQL w/o CR")


def reads(kind, option):
    return option in [field.name for field in dataclasses.fields(kind.Config)]


def make_agent(kind, seeds=(0,), task=TASK, limit=LIMIT, **changes):
    """An agent of a class, or of a name. A change that it does not read is an error."""
    kind = get_algorithm(kind) if isinstance(kind, str) else kind
    fixed = {option: value for option, value in OPTIONS.items() if reads(kind, option)}
    return kind(task, kind.Config(**fixed | changes), seeds=seeds, limits=limit if kind.needs_limit else None)


def random_limits(seed, runs=1):
    choices = torch.tensor([*map(float, TASK.thresholds), math.inf])
    return choices[torch.randint(4, (runs, B), generator=torch.Generator().manual_seed(seed))]


def batch_for(agent, seed=1):
    """Random transitions, under random limits where the agent is told one."""
    limits = {"limit": random_limits(2, len(agent.seeds))} if agent.name in CONDITIONED else {}
    return random_batch(agent, seed, **limits)


def one_update(agent, batch):
    return {key: value.tolist() for key, value in agent.update(batch).items()}


# --- Algorithm 2 as a loop ---


class Slow:
    """One run of an agent, one transition at a time, in plain numbers."""

    def __init__(self, agent, run=0):
        self.agent, self.run, self.name = agent, run, agent.name
        self.state = {key: value.clone() for key, value in agent.state().items()}

    def variable(self, name):
        return self.state[f"variable.{name}"][self.run].tolist()

    def call(self, kind, network, *inputs):
        """A network's output for one transition, as nested lists. kind: online or target."""
        prefix = f"{kind}.{network}."
        weights = {k.removeprefix(prefix): v[self.run] for k, v in self.state.items() if k.startswith(prefix)}
        inputs = [torch.tensor([x], dtype=torch.float32) for x in inputs]
        output = functional_call(self.agent.modules[network], weights, tuple(inputs))
        return [x.squeeze(0).tolist() for x in output] if network == "policy" else output.tolist()

    def inputs(self, observation, limit, t=0.0):
        mean, std = self.variable("observation_mean"), self.variable("observation_std")
        x = [(o - m) / s for o, m, s in zip(observation, mean, std, strict=True)]
        if self.name in CONDITIONED:
            x.append(1.5 if math.isinf(limit) else limit / TASK.cost_range)
            if self.agent.config.clock:
                x.append(t / T)
        return x

    def cost(self, heads, t=0):
        """What is compared with the limit: an episode's cost from step t on, from one critic's heads."""
        config = self.agent.config
        if self.name in ("C2IQL", "C2IQL w/o CC"):
            if config.time_limits == "rate":
                heads = [q * (1 - g**T) for q, g in zip(heads, TASK.gammas, strict=True)]
            return self.agent.networks(self.run).reconstruction(torch.tensor([heads])).item()
        # Q_c <= L~ (eq. 2), where L~ is the discounted sum of a cost of L / T in each of T steps.
        steps = T - t if getattr(config, "clock", False) else T
        return heads[0] / (sum(config.gamma**t for t in range(steps)) / steps)

    def cost_of(self, x, s, a, s_next):
        """The heads that line 17 asks for, those that V_c learns, and the episode's cost that counts."""
        config = self.agent.config
        critics = [k[0] for k in self.call("target", "cost_critics", s, a)]
        t = int(x.timesteps)
        cost, q_cost = max((self.cost(heads, t), heads) for heads in critics)
        if config.evaluated_critic == "mean":
            q_cost = [sum(heads) / len(critics) for heads in zip(*critics, strict=True)]
        stops = x.terminals or (config.time_limits == "mask" and x.timeouts)
        after = self.call("online", "cost_value", s_next)[0]
        gammas = TASK.gammas if len(after) > 1 else [config.gamma]
        backup = [x.costs + (0 if stops else g * c) for g, c in zip(gammas, after, strict=True)]
        return backup, q_cost, max(cost, self.cost(backup, t)) if config.recorded_step else cost

    def penalised(self, q, cost, state_cost, limit):
        """Eq. 11, or a price per unit of cost beyond the limit."""
        config = self.agent.config
        if config.unsafe_price is None:
            return q if cost <= limit else 0.0
        unit = self.variable("reward_scale") / TASK.cost_range
        if config.price_unit == "advantage":
            unit = self.variable("exchange_rate")
        price = config.unsafe_price * unit
        return q - price * (max(cost - limit, 0) - max(state_cost - limit, 0))

    def log_prob(self, s, a):
        mean, log_std = self.call("online", "policy", s)
        return sum(
            -0.5 * ((x - m) / math.exp(z)) ** 2 - z - 0.5 * math.log(2 * math.pi)
            for x, m, z in zip(a, mean, log_std, strict=True)
        )

    def evaluation_error(self, k, x, s, a, s_next):
        """By how much evaluator k errs about the rest of the episode, in cost ranges."""

        def rest(kind, inputs, action, t):
            return self.call(kind, "evaluators", inputs, action)[k][0] * (T - t) * TASK.max_step_cost

        after = rest("target", s_next, self.call("online", "policy", s_next)[0], x.timesteps + 1)
        target = x.costs if x.terminals or x.timeouts else x.costs + after
        return (target - rest("online", s, a, x.timesteps)) / TASK.cost_range

    def losses(self, batch):
        config, sums = self.agent.config, {}
        finite = zip(batch["limit"].tolist(), batch["costs_to_go"].tolist(), strict=True)
        owns = sum(math.isinf(limit) or limit == cost for limit, cost in finite) / B
        self.untouched = []  # both advantages of each action for which nothing is paid

        def add(name, value):
            sums[name] = sums.get(name, 0.0) + value / B

        for row, limit in enumerate(batch["limit"].tolist()):
            x = Batch(**{field: batch[field][row].tolist() for field in Batch._fields})
            left = max(limit - x.costs, 0.0) if getattr(config, "clock", False) else limit
            s = self.inputs(x.observations, limit, x.timesteps)
            s_next = self.inputs(x.next_observations, left, x.timesteps + 1)
            a = x.actions
            q = min(k[0] for k in self.call("target", "critics", s, a))
            v = self.call("online", "value", s)[0]
            if self.name != "IQL":
                backup, q_cost, cost = self.cost_of(x, s, a, s_next)
                state_cost = self.cost(self.call("online", "cost_value", s)[0], int(x.timesteps))
                keeps = cost <= limit and state_cost <= limit
                if math.isinf(limit) if self.name in CONDITIONED else keeps:
                    self.untouched.append((q - self.call("online", "value", s)[0], cost - state_cost))
                q = self.penalised(q, cost, state_cost, limit)
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
                        add("cost_critic_loss", (y - now) ** 2 / len(backup))
                w = weight(config.kappa_2)
            else:
                w = min(100.0, math.exp(config.awr_alpha * u * 1000 / (TASK.max_return - TASK.min_return)))
            own = math.isinf(limit) or limit == x.costs_to_go
            if getattr(config, "policy_thresholds", "all") == "own":
                w *= own / owns
            add("policy_loss", -w * self.log_prob(s, a))
            for k in range(getattr(config, "evaluators", 0)):
                add("evaluators_loss", self.evaluation_error(k, x, s, a, s_next) ** 2)
        if getattr(config, "price_unit", "") == "advantage" and config.unsafe_price is not None:
            spreads = np.std(self.untouched, axis=0) if self.untouched else (0.0, 0.0)
            sums |= dict(zip(("reward_spread", "cost_spread"), spreads, strict=True))
        return sums


VARIANTS = [
    {},
    {"time_limits": "bootstrap"},
    {"time_limits": "mask"},
    {"reward_time_limits": "mask"},
    {"cost_kappa": 0.95},
    {"unsafe_price": 0.5},
    {"recorded_step": True},
    {"recorded_step": True, "unsafe_price": 0.5, "time_limits": "mask"},
    {"unsafe_price": 0.5, "price_unit": "advantage"},
    {"clock": True, "time_limits": "mask"},
    {"clock": True, "time_limits": "mask", "unsafe_price": 0.5, "price_unit": "advantage"},
    {"clock": True, "time_limits": "mask", "thresholds": "range", "policy_thresholds": "own"},
    {"clock": True, "time_limits": "mask", "evaluators": 1},
    {"clock": True, "time_limits": "mask", "evaluators": 2, "evaluated_critic": "mean"},
    {"cost_critics": 1},
    {"cost_critics": 3},
    {"cost_critics": 3, "evaluated_critic": "mean"},
    {"kappa_1": 0.5, "kappa_2": 0.6, "gamma": 0.7},
    {"kappa_1": 0.5, "gamma": 0.7, "awr_alpha": 0.03},
]
PAIRS_THAT_FIT = [
    (name, options) for name in FAMILY for options in VARIANTS
    if all(reads(get_algorithm(name), option) for option in options)
]  # fmt: skip


@pytest.mark.parametrize(("name", "options"), PAIRS_THAT_FIT, ids=str)
def test_an_updates_losses_are_algorithm_2s(name, options):
    agent = make_agent(name, seeds=(0, 1), **options)
    batch = batch_for(agent)
    for seed in range(50):  # until both kinds of actions are there, or the batch shows nothing
        randomise(agent, seed)
        slow = [Slow(agent, run).losses(of_run(batch, run)) for run in (0, 1)]
        if all(0.2 < one.get("safe_fraction", 0.5) < 0.8 for one in slow):
            break
    else:
        pytest.fail("no batch with safe and unsafe actions")
    scalars = one_update(agent, batch)
    for run in (0, 1):
        assert {key: scalars[key][run] for key in slow[run]} == pytest.approx(slow[run], rel=1e-4, abs=1e-4)
        assert {key for key in scalars if key.endswith("_loss")} <= slow[run].keys()


class WithoutBoth(get_algorithm("C2IQL")):
    name = "C2IQL w/o both"
    Config = ConstrainedConfig
    needs_limit = True
    conditioned = reconstructs = False


@pytest.mark.parametrize("options", [v for v in VARIANTS if not {"awr_alpha", "clock"} & set(v)], ids=str)
def test_without_its_two_parts_c2iql_is_ciql(options):
    """So an ablation compares what it says, and nothing else; from the first guess of the costs on."""
    agents = [make_agent(kind, **options) for kind in (WithoutBoth, get_algorithm("CIQL"))]
    data = toy_dataset()
    for agent in agents:
        agent.prepare([data], progress=False)
    batch = random_batch(agents[0])
    for _ in range(3):
        both = [one_update(agent, batch) for agent in agents]
        assert both[1] == {key: pytest.approx(both[0][key], rel=1e-5) for key in both[1]}
    parts, whole = (agent.state() for agent in agents)
    for key, value in whole.items():
        torch.testing.assert_close(value, parts[key], msg=key)


def test_the_reconstruction_is_trained_in_float32():
    first, second = (make_agent("C2IQL", precision=precision) for precision in ("float32", "bfloat16"))
    for agent in (first, second):
        agent.prepare([toy_dataset()], progress=False)
    for kind in ("parameters", "buffers"):
        one, other = (getattr(agent, kind)["reconstruction"] for agent in (first, second))
        assert one and all(torch.equal(one[name], other[name]) for name in one)


def test_every_seed_has_a_reconstruction_model_of_its_own():
    """Alone and beside others, a run has the same one. Runs that differ in their limit share it."""
    data, seeds = toy_dataset(), (3, 5)
    together = make_agent("C2IQL", seeds=seeds)
    alone = [make_agent("C2IQL", seeds=(seed,)) for seed in seeds]
    limits = make_agent("C2IQL w/o CC", seeds=(5, 5), limit=(10.0, 20.0))
    for agent in (together, *alone, limits):
        agent.prepare([data] * len(agent.seeds), progress=False)
    for kind in ("parameters", "buffers"):
        both, same = (getattr(agent, kind)["reconstruction"] for agent in (together, limits))
        for name, of_runs in both.items():
            for run, agent in enumerate(alone):
                assert torch.equal(of_runs[run], getattr(agent, kind)["reconstruction"][name][0])
            assert torch.equal(same[name], of_runs[1].expand_as(same[name]))
    weights = together.parameters["reconstruction"]["net.0.weight"]
    assert not torch.equal(weights[0], weights[1])
    before = weights.clone()
    one_update(together, random_batch(together))
    assert torch.equal(weights, before)


def test_values_start_at_the_data_or_at_zero():
    """One layer without its first bias: at the zero input a network's output is its last bias alone."""
    data = toy_dataset()
    for guess, cost in (("data", float(data.costs.mean()) / (1 - TASK.gammas[0])), ("zero", 0.0)):
        agent = make_agent("CIQL", first_guess=guess, gamma=TASK.gammas[0], hidden_layers=0)
        agent.prepare([data], progress=False)
        net, zero = agent.networks(0), torch.zeros(1, 3)
        action = torch.zeros(1, agent.task.act_dim)
        assert net.cost_value(zero).item() == pytest.approx(cost, abs=1e-5)
        assert net.target_cost_critics(zero, action).flatten().tolist() == pytest.approx([cost] * 2, abs=1e-5)
        if guess == "zero":
            assert net.value(zero).item() == pytest.approx(0, abs=1e-5)


# --- Terminals and time limits ---


@pytest.mark.parametrize(
    ("name", "cost_limits"),
    [("IQL", None)] + [(name, kind) for name in FAMILY[1:] for kind in ("rate", "bootstrap", "mask")],
)
@pytest.mark.parametrize("reward_limits", ["bootstrap", "mask"])
def test_which_ends_stop_the_bootstrap(name, cost_limits, reward_limits):
    """A backup that stops at an end does not look at the state after it."""
    options = {"reward_time_limits": reward_limits} | ({"time_limits": cost_limits} if cost_limits else {})

    def losses(flag, moved):
        agent = make_agent(name, **options)
        randomise(agent)
        batch = batch_for(agent)
        for key in ("terminals", "timeouts"):
            batch[key] = torch.zeros(1, B)
            batch[key][:, :5] = key == flag
        batch["next_observations"][:, :5] += 3.0 * moved
        return one_update(agent, batch)

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


@pytest.mark.parametrize("name", CONDITIONED)
def test_an_infinite_limit_penalises_nothing(name):
    """Costs change nothing then, and the value and critic losses are IQL's on the same networks."""

    def update(seed):
        agent = make_agent(name)
        randomise(agent)
        state = agent.state()
        other = torch.Generator().manual_seed(seed)
        for key, value in state.items():
            if "cost" in key or "reconstruction" in key:
                value.copy_(torch.randn(value.shape, generator=other))
        agent.load_state(state)
        costs = (torch.rand(1, B, generator=other) < 0.5).float()
        batch = random_batch(agent, limit=torch.full((1, B), math.inf), costs=costs)
        slow = Slow(agent)
        told = slow.inputs
        slow.name, slow.agent = "IQL", SimpleNamespace(modules=agent.modules, config=make_agent("IQL").config)
        slow.inputs = lambda observation, limit, t=0.0: [*told(observation, limit), 1.5]  # infinity's code
        return one_update(agent, batch), slow.losses(of_run(batch, 0))

    first, reward_only = update(1)
    second, _ = update(2)
    assert first["safe_fraction"] == [1.0]
    for key in ("value_loss", "critic_loss", "policy_loss", "value_mean"):
        assert first[key] == second[key]
    assert first["cost_value_loss"] != second["cost_value_loss"]
    for key in ("value_loss", "critic_loss"):
        assert first[key] == pytest.approx([reward_only[key]], rel=1e-4)


def limits_drawn(agent, generator):
    return agent.draw(random_data(0), generator, math.inf)["limit"]


@pytest.mark.parametrize("name", CONDITIONED)
def test_thresholds_are_drawn_for_each_sample_or_for_each_batch(name):
    expected = [1.0, 3.0, 6.0, math.inf]
    generator = torch.Generator().manual_seed(0)
    draws = limits_drawn(make_agent(name, thresholds_per="sample", batch_size=4_000), generator)
    assert draws.shape == (4_000,)
    shares = [(draws == limit).float().mean().item() for limit in expected]
    assert shares == pytest.approx([0.25] * 4, abs=0.03)

    agent, seen = make_agent(name, thresholds_per="batch"), []
    for _ in range(400):
        draws = limits_drawn(agent, generator)
        assert draws.shape == (B,) and (draws == draws[0]).all()
        seen.append(draws[0].item())
    assert [seen.count(limit) / 400 for limit in expected] == pytest.approx([0.25] * 4, abs=0.08)

    with_zero = limits_drawn(make_agent(name, zero_threshold=True, batch_size=4_000), generator)
    assert (with_zero == 0).float().mean().item() == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("clock", [False, True])
@pytest.mark.parametrize("name", CONDITIONED)
def test_thresholds_can_come_from_a_range_and_from_the_episodes(name, clock):
    options = {"infinite_share": 0.2, "zero_share": 0.3, "episode_share": 0.4, "batch_size": 4_000}
    more = {"clock": True, "time_limits": "mask"} if clock else {}
    agent = make_agent(name, thresholds="range", **options, **more)
    rng = np.random.default_rng(0)
    fields = {"timesteps": np.arange(200) % T, "costs_to_go": 0.5 + rng.integers(1, 9, 200) / 10}
    data = random_data(0)._replace(**{key: torch.tensor(x, dtype=torch.float32) for key, x in fields.items()})
    drawn = agent.draw(data, torch.Generator().manual_seed(0), math.inf)
    limits, costs, times = (drawn[key].numpy() for key in ("limit", "costs_to_go", "timesteps"))
    own = np.isclose(limits, costs if clock else costs * T / (T - times), rtol=1e-5)
    infinite, zero = np.isinf(limits), limits == 0
    uniform = limits[~(own | infinite | zero)]
    shares = [part.mean() for part in (infinite, zero, own)]
    assert shares == pytest.approx([0.2, 0.3, 0.2], abs=0.03)  # of the half that is left, 0.4
    counts, _ = np.histogram(uniform, 4, (0, TASK.cost_range))
    assert counts.sum() == len(uniform) and counts / len(uniform) == pytest.approx([0.25] * 4, abs=0.05)


def test_the_exchange_rate_follows_the_ratio_of_the_spreads():
    agent = make_agent("C2IQL", unsafe_price=3.0, price_unit="advantage")
    agent.prepare([toy_dataset()], progress=False)
    scale = agent.variables["reward_scale"].item()
    assert agent.variables["exchange_rate"].item() == pytest.approx(scale / TASK.cost_range)
    randomise(agent)
    before = agent.variables["exchange_rate"].item()
    scalars = one_update(agent, batch_for(agent))
    (reward,), (cost,) = scalars["reward_spread"], scalars["cost_spread"]
    assert reward > 0 and cost > 0
    expected = before + 0.01 * (reward / cost - before)
    assert agent.variables["exchange_rate"].item() == pytest.approx(expected, rel=1e-5)
    unsafe = random_batch(agent, limit=torch.full((1, B), -1e6))  # every action is priced: nothing to measure
    scalars, before = one_update(agent, unsafe), agent.variables["exchange_rate"].item()
    assert scalars["cost_spread"] == [0.0] and agent.variables["exchange_rate"].item() == before


def test_a_clock_needs_limits_on_the_remaining_cost():
    with pytest.raises(ValueError, match="clock=True needs time_limits='mask'"):
        make_agent("C2IQL", clock=True)


def test_a_policy_of_own_thresholds_learns_nothing_from_other_rows():
    options = {"clock": True, "time_limits": "mask", "thresholds": "range"}
    with pytest.raises(ValueError, match="policy_thresholds='own' needs thresholds='range' and clock=True"):
        make_agent("C2IQL", policy_thresholds="own")
    few = torch.arange(B) < 3
    for kind, same in (("own", True), ("all", False)):
        states = []
        for others in (-0.5, 0.5):  # the actions of the rows that pay something else than they are told
            agent = make_agent("C2IQL", policy_thresholds=kind, **options)
            agent.prepare([toy_dataset()], progress=False)
            batch = random_batch(agent, limit=torch.full((1, B), 4.5))
            costs = torch.where(few, 4.5, 2.0)[None]
            actions = torch.where(few[None, :, None], batch["actions"], others)
            one_update(agent, batch | {"costs_to_go": costs, "actions": actions})
            states.append(agent.state())
        policy = [key for key in states[0] if key.startswith("online.policy.")]
        assert policy
        assert all(torch.equal(states[0][key], states[1][key]) for key in policy) == same


def test_evaluators_need_a_clock():
    with pytest.raises(ValueError, match="need clock=True"):
        make_agent("C2IQL", evaluators=1)


def test_controls_tell_one_limit_throughout_or_switch_between_two():
    observations, cost = np.zeros((5, TASK.obs_dim), np.float32), np.array([2.0, 0.0, 0.0, 5.0, 0.0])
    small, middle, high = TASK.thresholds  # 1, 3 and 6
    limits = np.array([2.5, 0.0, 1e9, 5.0, math.inf])
    for options, throughout in (
        ({"thresholds": "range"}, [2.5, 0.0, TASK.cost_range, 5.0, math.inf]),
        ({"zero_threshold": False}, [middle, small, high, high, math.inf]),
    ):
        zero = throughout[1]
        agent = make_agent("C2IQL", **options)
        for tell, first, second in (
            ("throughout", throughout, throughout),
            (
                "switch",
                [math.inf, zero, math.inf, math.inf, math.inf],
                [math.inf, zero, math.inf, zero, math.inf],
            ),
        ):
            player = agent.playing_with(tell=tell).player(limits, range(5))
            player.act(observations)
            assert player.told.tolist() == first
            player.see(np.zeros(5), cost)
            assert player.told.tolist() == second


def played_by_hand(agent, observation, limit, t):
    """The action that is played, its predicted cost, and whether it is the policy's mean."""
    slow, noise = Slow(agent), torch.randn(6, 2, generator=torch.Generator().manual_seed(0))
    s = slow.inputs(observation, limit, t)
    mean, log_std = slow.call("online", "policy", s)
    found = []
    for row in [[0.0, 0.0], *noise.tolist()]:
        action = [m + z * math.exp(d) for m, z, d in zip(mean, row, log_std, strict=True)]
        action = [min(max(x, -1.0), 1.0) for x in action]
        shares = [k[0] for k in slow.call("online", "evaluators", s, action)]
        found.append((max(shares) * (T - t) * TASK.max_step_cost, action))
    cost, action = min(found)
    if 20 * limit <= TASK.cost_range and found[0][0] > limit and cost <= 0.8 * found[0][0]:
        return action, cost, action is found[0][1]
    return found[0][1], found[0][0], True


def test_an_agent_brakes_when_nothing_is_left_and_braking_helps():
    agent = make_agent("C2IQL", clock=True, time_limits="mask", evaluators=2, candidates=6)
    randomise(agent, 3)
    observations = np.random.default_rng(0).normal(size=(40, TASK.obs_dim)).astype(np.float32)
    limits = np.resize([0.0, 0.3, 2.0, math.inf], 40)  # the cost range is 8: the first two are nearly zero
    means = {}
    for t in (0, 3):
        actions = agent.act(observations, limits, 0, t)
        costs = agent.predicted_cost(observations, limits, 0, t)
        for row, (observation, limit) in enumerate(zip(observations, limits, strict=True)):
            action, cost, is_mean = played_by_hand(agent, observation, limit, t)
            assert actions[row] == pytest.approx(action, abs=1e-5)
            assert costs[row] == pytest.approx(cost, rel=1e-4)
            means.setdefault(limit, set()).add(is_mean)
    assert means == {0.0: {True, False}, 0.3: {True, False}, 2.0: {True}, math.inf: {True}}
    large = np.full(40, 2.0)
    without = agent.playing_with(candidates=0)
    assert np.array_equal(without.act(observations, large), agent.act(observations, large))
    assert not np.allclose(without.act(observations, limits), agent.act(observations, limits))


@pytest.mark.parametrize("name", CONDITIONED)
def test_with_a_clock_the_policy_sees_the_time(name):
    agent = make_agent(name, clock=True, time_limits="mask")
    randomise(agent)
    observations, limits = np.zeros((2, 3), np.float32), np.array([1.0, 6.0])
    at = [agent.act(observations, limits, 0, t) for t in (0, 5)]
    assert not np.allclose(*at)
    player = agent.player(limits, [0, 1])
    assert player.act(observations) == pytest.approx(at[0])
    for _ in range(5):
        player.see(np.zeros(2), np.zeros(2))
    assert player.act(observations) == pytest.approx(agent.act(observations, player.told, 0, 5))


def test_every_run_draws_from_its_own_generator_and_under_its_own_limit():
    data = [random_data(0)] * 2
    for agent in (make_agent("C2IQL", (3, 4)), make_agent("CIQL", (3, 4), limit=(1.0, 6.0))):
        together = agent.draw_all(data, [torch.Generator().manual_seed(seed) for seed in (3, 4)])
        for run, limit in enumerate(agent.limits or (math.inf, math.inf)):
            alone = agent.draw(data[0], torch.Generator().manual_seed(3 + run), limit)
            assert all(torch.equal(together[key][run], alone[key]) for key in alone)
        assert not torch.equal(*together["limit"]) and not torch.equal(*together["rewards"])


def test_these_algorithms_are_trained_for_one_limit_and_these_for_none():
    limited = {"CIQL", "C2IQL w/o CC", "BC-Safe", "CPQ", "CPQ w/ push"}
    free = {"IQL", "C2IQL w/o CR", "C2IQL", "BC-All"}
    assert {name for name in limited | free if ALGORITHMS[name].needs_limit} == limited


def test_unknown_names_are_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="'C3IQL'.*IQL, CIQL, C2IQL w/o CR, C2IQL w/o CC, C2IQL"):
        get_algorithm("C3IQL")
    with pytest.raises(ValueError, match="'huge'.*paper, small"):
        get_algorithm("C2IQL").configure("huge")
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
        log = train(agent, toy_dataset(), updates=8, log_every=1, progress=False)
        return [{k: v for k, v in row.items() if k != "updates_per_second"} for row in log]

    assert last_log() == last_log()
    assert last_log(**options) != last_log()


def test_a_linear_reconstruction_is_linear():
    x, y = torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(0)) * 5
    bends = {}
    for crm in ("linear", "mlp"):
        agent = make_agent("C2IQL", crm=crm)
        agent.prepare([toy_dataset()], progress=False)
        model = agent.networks().reconstruction
        bends[crm] = (model(x) + model(y) - 2 * model((x + y) / 2)).abs().max().item()
    assert bends["linear"] < 1e-3 < 1e-2 < bends["mlp"]


def test_shifted_rewards_start_at_zero():
    data = toy_dataset()
    shifted = dataclasses.replace(data, rewards=data.rewards - data.rewards.min())
    logs = [
        train(make_agent("IQL", shift_rewards=shift), part, updates=3, log_every=1, progress=False)
        for shift, part in ((True, data), (False, shifted))
    ]
    assert [row["critic_loss"] for row in logs[0]] == pytest.approx([row["critic_loss"] for row in logs[1]])


@pytest.mark.parametrize("shift", [False, True])
def test_a_price_is_in_mean_returns_of_the_rewards_that_are_trained_on(shift):
    data, agent = toy_dataset(), make_agent("C2IQL", shift_rewards=shift)
    train(agent, data, updates=1, progress=False)
    rewards = (data.rewards - shift * data.rewards.min()).reshape(-1, T).tolist()
    to_go = [sum(r * 0.8**k for k, r in enumerate(row[t:])) for row in rewards for t in range(T)]
    assert agent.variables["reward_scale"].tolist() == pytest.approx([abs(sum(to_go) / len(to_go))], rel=1e-5)


@pytest.mark.parametrize(
    ("name", "gammas"), [("CIQL", [0.8]), ("C2IQL w/o CR", [0.8]), ("C2IQL", TASK.gammas)]
)
def test_cost_heads_start_at_the_datas_rate_for_ever(name, gammas):
    data, agent = toy_dataset(), make_agent(name, hidden_layers=0)
    agent.prepare([data], progress=False)
    for place, network in (
        (agent.parameters, "cost_value"),
        (agent.parameters, "cost_critics"),
        (agent.target_parameters, "cost_critics"),
    ):
        biases = {key: value[0] * ("bias" in key) for key, value in place[network].items()}
        inputs = torch.ones(1, TASK.obs_dim + agent.extra_inputs), torch.ones(1, TASK.act_dim)
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

    def batch(self, limit):
        """All of them, as the one run of an agent with this limit sees them, (1, rows, ...)."""

        def tensor(x):
            return torch.tensor(np.asarray(x, np.float32))[None]

        return dict(
            observations=tensor(np.eye(STATES)[self.state]),
            actions=tensor(np.eye(PAIRS)[self.pair]),
            rewards=tensor(self.reward),
            costs=tensor(self.cost),
            next_observations=tensor(np.eye(STATES)[self.next]),
            terminals=tensor(self.terminal),
            timeouts=tensor(np.zeros(len(self.pair))),
            timesteps=tensor(np.zeros(len(self.pair))),
            limit=tensor(np.full(len(self.pair), limit)),
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


def tables(agent):
    """The agent's networks at every state and every (s, a), as arrays."""
    s, pairs, net = torch.eye(STATES), torch.eye(PAIRS), agent.networks(0)
    at = s.repeat_interleave(ACTIONS, 0)
    with torch.no_grad():
        return SimpleNamespace(
            v=net.value(s).numpy(),
            v_cost=net.cost_value(s).numpy(),
            q=net.critics(at, pairs).numpy(),
            q_cost=net.cost_critics(at, pairs).numpy(),
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

    agent, batch = None, data.batch(limit)
    for rate in (2e-2, 2e-3):
        changes = {"gamma": GAMMA, "kappa_1": KAPPA, "hidden_layers": 0, "normalise_observations": False}
        changes |= {"value_lr": rate, "critic_lr": rate, "target_tau": 0.1, "crm": "linear"}
        last, agent = agent, make_agent("C2IQL w/o CC", task=TABULAR, limit=limit, **changes)
        model = agent.parameters["reconstruction"]  # in units of a horizon
        model["net.weight"].copy_(torch.tensor(WEIGHTS) / TABULAR.horizon)
        model["net.bias"].zero_()
        if last:
            agent.load_state({k: v for k, v in last.state().items() if not k.startswith("adam.")})
        for _ in range(700):
            agent.update(batch)
    found = tables(agent)
    close = {"rtol": 0.01, "atol": 0.02}
    np.testing.assert_allclose(found.v, solution.v, **close)
    np.testing.assert_allclose(found.v_cost, solution.v_cost, **close)
    for k in range(2):
        np.testing.assert_allclose(found.q[k], solution.q, **close)
        np.testing.assert_allclose(found.q_cost[k], solution.q_cost, **close)
