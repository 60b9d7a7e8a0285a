"""The checkers and figures of notebook 11: right forms pass, and every likely mistake is told apart."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from tutorial_lib.agents import C2IQL
from tutorial_lib.course import checks, figures
from tutorial_lib.course.checks import c2iql
from tutorial_lib.scores import certificate
from tutorial_lib.tasks import get_task

TABLE = {
    12: ("V_r(s)", {"Q_r target", "Q_c target"}),
    14: ("V_c(s)", {"V_r(s)", "Q_r target", "Q_c target"}),
    16: ("Q_r", {"V_r(s')"}),
    18: ("Q_c", {"V_c(s')"}),
    20: ("policy", {"V_r(s)", "Q_r target", "Q_c target"}),
}
OTHER_WORDS = {
    12: ("Vr(s)", ["qr_target", "Qc target", "V_r(s)"]),
    14: ("v_c(s)", ("Q_c target", "Q_r target", "V_r( s )")),
    16: ("Q_r", "V_r(s')"),
    18: ["Q_c", ["V_c(s’)", "Q_c"]],
    20: ("Policy", {"V_r(s)", "Q_r target", "Q_c target", "policy"}),
}


@pytest.mark.parametrize("table", [TABLE, OTHER_WORDS], ids=["as asked", "other words"])
def test_every_form_of_the_table_of_readings_passes(table, capsys):
    checks.check_readings(table)
    assert capsys.readouterr().out == "OK  all 5 losses: what each trains and what each asks\n"


@pytest.mark.parametrize(
    "line, entry, hint",
    [
        (12, (..., {...}), "in place of the `...`"),
        (12, ("V_r(s)", {"Q_r", "Q_c target"}), "asks the target network of Q_r"),
        (12, ("V_r(s)", {"Q_r target"}), "the penalty is in Q_r|c"),
        (12, ("V_r(s)", {"Q_c target"}), "u contains Q_r"),
        (12, ("Q_r", {"Q_r target", "Q_c target"}), "trains another network than Q_r"),
        (12, ("V_r(s)", {"Q_r target", "Q_c target", "V_c(s)"}), "does not ask V_c(s)"),
        (12, ("value", {"Q_r target"}), "'value' is no name of the list"),
        (14, ("V_c(s)", {"Q_c target"}), "its weight M depends on u"),
        (16, ("Q_r", {"V_r(s)"}), "one step ahead"),
        (16, ("Q_r target", {"V_r(s')"}), "trained by no loss"),
        (16, ("Q_r", set()), "it also asks V_r(s')"),
        (18, ("Q_c", {"V_c(s')", "policy"}), "no value asks the policy"),
        (20, ("policy", {"Q_r target", "Q_c target"}), "its weight M depends on u"),
    ],
)
def test_a_wrong_reading_gets_its_hint(line, entry, hint, capsys):
    checks.check_readings(TABLE | {line: entry})
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  line {line}: ") and hint in said and said.count("\n") == 1


def test_a_missing_line_is_asked_for(capsys):
    checks.check_readings({12: TABLE[12]})
    assert "line 14" in capsys.readouterr().out


def test_the_table_of_readings_is_what_gradients_say():
    """The oracle: gradients with respect to each network's parameters, and networks that are replaced.

    It does not use the checker's table, nor the notebook's way to shake outputs.
    """
    task = get_task("BallCircle")
    agent = C2IQL(task, C2IQL.configure("printed", hidden_width=8, crm_width=8, batch_size=64))
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator)

    batch = SimpleNamespace(
        observations=draw(64, task.obs_dim), next_observations=draw(64, task.obs_dim),
        actions=draw(64, task.act_dim).clamp(-0.9, 0.9), rewards=draw(64), costs=draw(64).sign().clamp(min=0),
        terminals=torch.zeros(64), timeouts=torch.zeros(64), timesteps=torch.zeros(64),
        limit=torch.full((64,), 30.0),
    )  # fmt: skip
    agent.episode_cost = lambda net, heads, over: (
        30 + heads.sum(-1) - heads.sum(-1).mean()
    )  # half exceed the limit
    net = agent.networks()
    now = agent.network_input(net, batch.observations, batch.limit)
    before, _ = agent.losses(net, batch)
    names = dict(zip(before, c2iql.READINGS, strict=True))
    places = {
        "V_r(s)": ("value", True), "V_r(s')": ("value", False), "V_c(s)": ("cost_value", True),
        "V_c(s')": ("cost_value", False), "Q_r": ("critics", None), "Q_r target": ("target_critics", None),
        "Q_c": ("cost_critics", None), "Q_c target": ("target_cost_critics", None),
        "policy": ("policy", None),
    }  # fmt: skip
    found = {line: ([], set()) for line in names.values()}
    for place, (name, at_s) in places.items():
        real = getattr(net, name)

        def other(x, *a, real=real, at_s=at_s):
            if at_s is not None and bool((x == now).all()) != at_s:
                return real(x, *a)
            says, on = real(x, *a), torch.ones(1, requires_grad=True)
            if isinstance(says, tuple):
                return tuple(0.5 * on * y for y in says)
            return on * says * (1 + draw(*says.shape))

        after, _ = agent.losses(SimpleNamespace(**{**vars(net), name: other}), batch)
        for loss, line in names.items():
            if after[loss].requires_grad:
                found[line][0].append(place)
            elif not torch.equal(after[loss], before[loss]):
                found[line][1].add(place)
    assert found == {line: ([trained], still) for line, (trained, still) in c2iql.READINGS.items()}


def by_steps(v, q, q_target, reward, gamma, rate, tau, in_turn):
    new_v = v + rate * (q_target - v)
    new_q = q + 2 * rate * (reward + gamma * (new_v if in_turn else v) - q)
    return new_v, new_q, (1 - tau) * q_target + tau * new_q


def by_autograd(v, q, q_target, reward, gamma, rate, tau, in_turn):
    v, q = torch.tensor([v, q], dtype=torch.float64).requires_grad_().unbind()
    new_v = v - rate * torch.autograd.grad(0.5 * (q_target - v) ** 2, v)[0]
    seen = (new_v if in_turn else v).detach()
    new_q = q - rate * torch.autograd.grad((reward + gamma * seen - q) ** 2, q)[0]
    return torch.stack([new_v, new_q, q_target + tau * (new_q - q_target)]).detach().numpy()


@pytest.mark.parametrize("answer", [by_steps, by_autograd])
def test_every_form_of_the_update_passes(answer, capsys):
    checks.check_after_update(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is right in 6 cases\n"


def test_the_update_by_hand_of_the_page_is_the_checkers():
    numbers = 2.0, 4.0, 3.0, 1.0, 0.5, 0.1, 0.5
    assert c2iql._update_by_slopes(*numbers, False) == pytest.approx([2.1, 3.6, 3.3])
    assert c2iql._update_by_slopes(*numbers, True) == pytest.approx([2.1, 3.61, 3.305])


@pytest.mark.parametrize(
    "answer, hint",
    [
        (lambda *x: None, "returns nothing"),
        (lambda *x: 1 / 0, "raised ZeroDivisionError"),
        (lambda *x: by_steps(*x[:-1], True), "both are taken at the old numbers"),
        (lambda *x: by_steps(*x[:-1], False), "Q sees the V that has already moved"),
        (lambda v, q, t, *x: by_steps(v, q, q, *x), "with steps of zero"),
        (lambda v, q, t, r, g, rate, tau, i: (*by_steps(v, q, t, r, g, rate, tau, i)[:2], t + tau * (q - t)),
         "moves towards the new Q"),
        (lambda v, q, t, r, g, rate, *x: by_steps(v, q, t, r, g, rate / 2, *x), "with the slope of"),
    ],
)  # fmt: skip
def test_a_wrong_update_gets_its_hint(answer, hint, capsys):
    checks.check_after_update(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def with_unique(seed, paid, predicted):
    return [paid[seed == own].mean() / predicted[seed == own].mean() for own in np.unique(seed)]


def with_pandas(seed, paid, predicted):
    sums = pd.DataFrame({"paid": paid, "predicted": predicted}).groupby(seed).sum()
    return sums["paid"] / sums["predicted"]


def with_sums(seed, paid, predicted):
    return np.array([paid[seed == s].sum() / predicted[seed == s].sum() for s in sorted(set(seed.tolist()))])


@pytest.mark.parametrize("answer", [with_unique, with_pandas, with_sums])
def test_every_form_of_the_ratio_passes(answer, capsys):
    checks.check_paid_per_predicted(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is right in 5 cases\n"


@pytest.mark.parametrize(
    "answer, hint",
    [
        (
            lambda s, a, b: [b[s == i].mean() / a[s == i].mean() for i in np.unique(s)],
            "above 1 is an optimist",
        ),
        (lambda s, a, b: [a.mean() / b.mean()], "must not cancel"),
        (lambda s, a, b: [(a[s == i] / b[s == i]).mean() for i in np.unique(s)], "the mean first"),
        (lambda s, a, b: with_unique(s, a, b)[::-1], "one number for each seed"),
        (lambda s, a, b: [a[s == i].mean() - b[s == i].mean() for i in np.unique(s)], "as predicted is 1"),
    ],
)
def test_a_wrong_ratio_gets_its_hint(answer, hint, capsys):
    checks.check_paid_per_predicted(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def by_beta(exceeded, episodes):
    return stats.beta.ppf(0.975, exceeded + 1, episodes - exceeded) if exceeded < episodes else 1


def by_library(exceeded, episodes):
    return stats.binomtest(exceeded, episodes).proportion_ci().high


def by_grid(exceeded, episodes):
    p = np.linspace(0, 1, 10_001)
    return p[stats.binom.cdf(exceeded, episodes, p) >= 0.025].max()


@pytest.mark.parametrize("answer", [by_beta, by_library, by_grid])
def test_every_form_of_the_largest_chance_passes(answer, capsys):
    checks.check_largest_chance(answer)
    assert capsys.readouterr().out == f"OK  {answer.__name__} is right in 5 cases\n"


@pytest.mark.parametrize(
    "answer, hint",
    [
        (lambda k, n: k / n, "None seen is not none possible"),
        (lambda k, n: 1 - 0.05 ** (1 / n), "this bound is for 5%"),
        (lambda k, n: 3 / n, "rule of three"),
        (lambda k, n: 1 - 0.025 ** (1 / n), "largest_chance(2, 10)"),
        (lambda k, n: by_beta(k, n) if k != 25 else 0.5 + 1.96 * 0.5 / 50**0.5, "normal approximation"),
        (lambda k, n: stats.binomtest(k, n).proportion_ci().low if k else by_beta(k, n), "the smallest such"),
        (lambda k, n: None, "returns nothing"),
        (lambda k, n: 1 / 0, "raised ZeroDivisionError"),
    ],
)
def test_a_wrong_chance_gets_its_hint(answer, hint, capsys):
    answer.__name__ = "largest_chance"
    checks.check_largest_chance(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and hint in said and said.count("\n") == 1


def test_readings_have_a_cell_per_loss_and_network_and_say_all():
    table = {
        "line 12": {"V": "learns", "Q": "", "Q target": "asked"},
        "line 16": {"V": "asked", "Q": "learns", "Q target": ""},
    }
    figure = figures.readings({"one": table, "two": table})
    assert [len(ax.patches) for ax in figure.axes] == [6, 6]
    fills = [patch.get_facecolor() for patch in figure.axes[0].patches]
    assert fills[0] == fills[4] and fills[2] == fills[3] and fills[1] == fills[5] == (1, 1, 1, 1)
    assert "two, line 16: trains Q, asks V" in figure.alt_text()


def raw_results():
    rng = np.random.default_rng(0)
    rows = [
        {"task": "BallCircle", "algorithm": "C2IQL", "seed": seed, "threshold": limit, "episode": e,
         "cost": float(rng.integers(0, 60)), "predicted_cost": 30.0}
        for seed in (0, 4) for limit in (10.0, 30.0, np.inf) for e in range(4)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_certificates_draw_each_runs_interval_beside_its_prediction_and_the_limit():
    results = raw_results()
    table = certificate(results[np.isfinite(results["threshold"])])
    figure = figures.certificates(table)
    assert len(figure.axes) == 2
    for ax, limit in zip(figure.axes, (10, 30), strict=True):
        part = table[table["threshold"] == limit]
        (bars,) = ax.containers
        assert bars[0].get_ydata() == pytest.approx(part["cost"].to_numpy())
        ends = np.array([segment[:, 1] for segment in bars[2][0].get_segments()])
        assert ends == pytest.approx(part[["cost_low", "cost_high"]].to_numpy())
        lines = {line.get_label(): line for line in ax.lines}
        assert set(lines["limit"].get_ydata()) == {limit}
        assert lines["predicted at the first step"].get_ydata() == pytest.approx([30, 30])
    assert "seed 4 paid" in figure.alt_text()


def test_named_limits_draw_a_line_per_run_and_what_no_limit_costs():
    results = raw_results()
    figure = figures.named_limits(results, known=(10, 30))
    (ax,) = figure.axes
    lines = {line.get_label(): line for line in ax.lines}
    for seed in (0, 4):
        own = results[results["seed"] == seed]
        expected = [own.loc[own["threshold"] == limit, "cost"].mean() for limit in (10, 30)]
        assert lines[f"seed {seed}"].get_xydata() == pytest.approx(
            np.array([[10, expected[0]], [30, expected[1]]])
        )
    free = results.loc[np.isinf(results["threshold"]), "cost"].mean()
    assert lines["paid without a limit, mean"].get_ydata() == pytest.approx([free, free])
    assert sum(line.get_label() == "limit of Table 1" for line in ax.lines) == 2
    assert "Without a limit they pay" in figure.alt_text()
