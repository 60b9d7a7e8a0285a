"""Critics, bandits and any f of notebooks 3 and 4, against closed forms, brute force and linear solves."""

import matplotlib
import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from tutorial_lib.course import checks, figures, maximisation_bias, tabular
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import get_task, make_env


@pytest.fixture(autouse=True)
def without_a_screen():
    matplotlib.use("Agg")


# --- The bandit and the critics ---


def test_the_bandit_falls_off_at_its_cliff_and_logs_stay_away_from_it():
    assert maximisation_bias.bandit_value([-1.0, 0.2, 0.29, 0.31, 1.0]).tolist() == [0, 1.2, 1.29, -1, -1]
    actions, rewards = maximisation_bias.bandit_logs(np.random.default_rng(0), 20_000)
    assert -0.6 <= actions.min() and actions.max() <= 0.2
    assert (rewards - actions).mean() == pytest.approx(1, abs=0.01)
    assert (rewards - actions).std() == pytest.approx(0.2, abs=0.01)


def steady(flag, rows=60):
    """Episodes of one step, a reward of 1, one observation; each ends by `flag`, or one long episode."""
    seen = np.ones((rows, 3), np.float32)
    actions = np.random.default_rng(0).uniform(-1, 1, (rows, 2)).astype(np.float32)
    every, last = np.ones(rows, bool), np.arange(rows) == rows - 1
    fell = every if flag == "terminals" else np.zeros(rows, bool)
    ends = every if flag == "timeouts" else last & ~fell
    return Dataset(seen, seen, actions, np.ones(rows, np.float32), np.zeros(rows, np.float32), fell, ends)


@pytest.mark.parametrize(
    "flag, value", [("terminals", 1), ("timeouts", 1), ("neither", 1 / (1 - 0.8 * 59 / 60))]
)
def test_a_critic_finds_the_value_of_a_steady_reward(flag, value):
    course = maximisation_bias.train_critic(
        steady(flag), lambda c, s, g: c.v(s), kappa=0.5, gamma=0.8, updates=400
    )
    assert course.updates.tolist() == list(range(0, 401, 20)) and len(course.q) == 21
    assert course.q[-1] == pytest.approx(value, rel=0.05)


def test_next_value_is_what_the_critic_looks_ahead_with():
    course = maximisation_bias.train_critic(
        steady("neither"), lambda c, s, g: torch.full((len(s),), 10.0), gamma=0.5, updates=300
    )
    assert course.q[-1] == pytest.approx(1 + 0.5 * 10 * 59 / 60, rel=0.05)


def test_the_same_seed_repeats_and_another_does_not():
    runs = [
        maximisation_bias.train_critic(steady("neither"), lambda c, s, g: c.v(s), updates=40, seed=s).q
        for s in (0, 0, 1)
    ]
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])


def test_q_is_the_smaller_twin_at_any_depth_of_the_batch():
    critic = maximisation_bias.Critic(steady("neither"), scale=10.0, width=8)
    s, a = torch.randn(4, 5, 3), torch.rand(4, 5, 2)
    both = critic.twins(s, a)
    assert both.shape == (2, 4, 5) and critic.q(s, a).shape == (4, 5)
    assert torch.equal(critic.q(s, a), torch.minimum(both[0], both[1]))
    assert torch.allclose(both[:, 1, 2], critic.twins(s[1, 2][None], a[1, 2][None])[:, 0], atol=1e-5)
    assert torch.equal(critic.target_q(s, a), critic.q(s, a))


def test_weights_of_eq_8_are_those_of_each_step_alone():
    data = steady("neither")
    critic = maximisation_bias.Critic(data, scale=10.0, width=8)
    with torch.no_grad():
        critic.target_critics.layers[-1].bias += 5  # so that Q differs from V
    for alpha in (0.0, 0.01, 3.0):
        found = critic.awr_weights(data, alpha)
        assert found.shape == (60,) and not found.requires_grad
        for row in (0, 17, 59):
            s, a = (torch.tensor(x[row : row + 1]) for x in (data.observations, data.actions))
            with torch.no_grad():
                u = float(critic.target_q(s, a) - critic.v(s))
            assert found[row].item() == pytest.approx(min(np.exp(alpha * u), 100), rel=1e-4)


def likes(*action):
    """A Q that is 7 less the distance from one action."""
    return lambda observations, actions: 7 - (actions - torch.tensor(action)).norm(dim=1)


def test_greedy_takes_the_action_of_the_grid_that_q_likes():
    act = maximisation_bias.greedy(likes(0.45, -2.0), 2, points=5)
    assert act(torch.zeros(3)).tolist() == [0.5, -1.0]


def test_a_policy_is_fitted_to_the_actions_that_have_weight():
    data = steady("neither")
    data.actions[:30], data.actions[30:] = (0.5, -0.5), (-0.7, 0.1)
    for weights, expected in ((np.repeat([1, 0], 30), (0.5, -0.5)), (np.repeat([1, 3], 30), (-0.4, -0.05))):
        act = maximisation_bias.fit_policy(data, torch.tensor(weights, dtype=torch.float32), updates=400)
        assert act(torch.ones(3)).tolist() == pytest.approx(expected, abs=0.05)


def test_promised_is_q_of_the_first_action_and_earned_is_discounted():
    task, ahead = get_task("BallRun"), torch.tensor([1.0, 0.0])
    promised, earned = maximisation_bias.promised_and_earned(likes(1.0, 0.5), lambda s: ahead, task, [0, 1])
    assert promised == pytest.approx(6.5)
    env, sums = make_env(task), []
    for seed in (0, 1):
        env.reset(seed=seed)
        sums.append(sum(0.9**t * env.step(ahead.numpy())[1] for t in range(task.horizon)))
    env.close()
    found = maximisation_bias.promised_and_earned(likes(1.0, 0.0), lambda s: ahead, task, [0, 1], gamma=0.9)
    assert found == pytest.approx((7, np.mean(sums))) and found[1] < earned


# --- General f ---

PHI = {
    "expectile": (lambda u: np.where(u < 0, 0.2, 0.8) * u**2 / 2, lambda u: tabular.expectile_slope(u, 0.8)),
    "quantile": (lambda u: np.where(u < 0, 0.2, 0.8) * np.abs(u), lambda u: tabular.quantile_slope(u, 0.8)),
    "linex": (lambda u: np.exp(2 * u) - 2 * u, lambda u: tabular.linex_slope(u, 2.0)),
}


@pytest.mark.parametrize("name", PHI)
def test_slopes_are_the_derivatives(name):
    f, slope = PHI[name]
    u = np.array([-2.0, -0.3, 0.4, 1.7])
    assert slope(u) == pytest.approx((f(u + 1e-6) - f(u - 1e-6)) / 2e-6, rel=1e-6)


@pytest.mark.parametrize("name", PHI)
def test_general_value_minimises_the_mean_of_f(name):
    f, slope = PHI[name]
    rng = np.random.default_rng(4)
    q, mu = rng.normal(size=(5, 4)), rng.dirichlet(np.ones(4), 5)
    for state, v in enumerate(tabular.general_value(mu, q, slope)):

        def mean(x, state=state):
            return mu[state] @ f(q[state] - x)

        best = minimize_scalar(mean, bounds=(-4, 4), method="bounded", options={"xatol": 1e-9})
        assert mean(v) <= best.fun + 1e-12


@pytest.mark.parametrize("name", PHI)
def test_an_implicit_policy_has_the_value_that_it_was_made_from(name):
    _, slope = PHI[name]
    cmdp = tabular.random_cmdp(np.random.default_rng(5), states=7, actions=3)
    mu = np.random.default_rng(6).dirichlet(np.ones(3), 7)
    q, v = tabular.general_fixed_point(cmdp, mu, slope)
    policy = tabular.implicit_policy(mu, q, v, lambda u: tabular.general_weight(slope, u))
    assert tabular.state_values(cmdp, policy) == pytest.approx(v, abs=1e-8)


def test_the_expectile_is_one_case():
    cmdp = tabular.random_cmdp(np.random.default_rng(7))
    mu = np.random.default_rng(8).dirichlet(np.ones(3), 6)
    _, v = tabular.general_fixed_point(cmdp, mu, lambda u: tabular.expectile_slope(u, 0.9))
    assert v == pytest.approx(tabular.iql_fixed_point(cmdp, mu, 0.9)[1], abs=1e-8)


def test_weights_have_their_limit_at_zero():
    u = np.array([0.0])
    assert tabular.general_weight(lambda u: tabular.linex_slope(u, 3.0), u) == pytest.approx(9)
    assert tabular.general_weight(lambda u: tabular.expectile_slope(u, 0.7), u) == pytest.approx(0.7)
    assert tabular.general_weight(lambda u: tabular.quantile_slope(u, 0.7), u) > 1e11


def test_what_grows_for_ever_is_told():
    cmdp = tabular.random_cmdp(np.random.default_rng(9))
    mu = np.full((6, 3), 1 / 3)
    with pytest.raises(ArithmeticError, match="no fixed point after 3 steps"):
        tabular.general_fixed_point(cmdp, mu, lambda u: u, steps=3)


def test_the_in_sample_optimum_is_the_best_of_all_policies_on_recorded_actions():
    cmdp = tabular.random_cmdp(np.random.default_rng(10), states=4, actions=3)
    mu = np.array([[0.5, 0.5, 0]] * 4)
    _, v = tabular.in_sample_optimum(cmdp, mu)
    plays = [np.eye(3)[[i >> s & 1 for s in range(4)]] for i in range(16)]
    assert v == pytest.approx(np.max([tabular.state_values(cmdp, play) for play in plays], axis=0), abs=1e-9)


# --- Figures, slider, exercises ---


def test_two_maxima_stars_the_largest_estimate():
    left, right = figures.two_maxima(seed=1).axes
    (estimates,) = [line for line in left.lines if line.get_label() == "estimate"]
    (star,) = [line for line in left.lines if line.get_marker() == "*"]
    assert star.get_ydata()[0] == estimates.get_ydata().max()
    assert len([line for line in right.lines if line.get_marker() == "*"]) == 6


def test_promises_over_data_draw_medians_and_middle_halves():
    values = np.array([[[1.0, 0], [2, 1]], [[3, 4], [4, 5]], [[5, 2], [9, 3]]])  # (repeats, sizes, 2)
    ax, _ = figures.promises_over_data([40, 400], {"one": values, "two": values}).axes
    assert [line.get_ydata().tolist() for line in ax.lines] == [[3, 4], [2, 3]]
    assert [line.get_label() for line in ax.lines] == ["promised", "worth"]
    assert ax.collections[0].get_datalim(ax.transData).intervaly == pytest.approx([2, 6.5])


def test_courses_draw_each_run_and_both_levels():
    run = np.arange(3), np.array([1.0, 10, 100])
    figure = figures.courses(
        {"a": ({"maximum": run, "kappa = 0.7": run}, 5.0, 50.0), "b": ({"maximum": run}, 6, 60)}
    )
    for ax, runs, levels in zip(figure.axes, (2, 1), ((5, 50), (6, 60)), strict=True):
        assert [line.get_ydata().tolist() for line in ax.lines[:runs]] == [[1, 10, 100]] * runs
        assert tuple(line.get_ydata()[0] for line in ax.lines[runs:]) == levels
    assert "a: maximum 100, kappa = 0.7 100, achieved 5, ceiling 50" in figure.alt_text()


def test_promises_kept_draw_a_pair_of_bars_for_each_robot():
    figure = figures.promises_kept({"one": (2000.0, 20.0), "two": (90.0, -3.0)})
    (ax,) = figure.axes
    assert [bar.get_width() for bar in ax.patches] == [2000, 90, 20, 1]
    assert [text.get_text() for text in ax.texts] == ["2000", "90", "20", "-3"]
    assert [text.get_text() for text in ax.get_yticklabels()] == ["one", "two"]
    assert ax.get_yticks()[0] > ax.get_yticks()[1]
    assert "two: 90 promised, -3 earned" in figure.alt_text()


def test_expectile_of_sorts_the_actions_by_v():
    left, right = figures.expectile_of([0.1, 0.2, 0.3, 0.4], [0.0, 0, 0, 10], 0.9).axes
    worse, better, level, mean, best = left.lines
    assert (worse.get_xdata().tolist(), better.get_xdata().tolist()) == ([0.1, 0.2, 0.3], [0.4])
    assert [line.get_ydata()[0] for line in (level, mean, best)] == pytest.approx([7.5, 2.5, 10])
    assert (np.diff(right.lines[0].get_ydata()) > 0).all()


def test_implicit_policies_have_a_column_each_and_the_ratio_below():
    x = np.linspace(-1, 1, 5)
    figure = figures.implicit_policies(x, x + 2, -(x**2), {"one": (-0.5, x + 2), "two": (-0.2, 3 - x)})
    assert [ax.get_title() for ax in figure.axes[:2]] == ["one", "two"]
    assert figure.axes[1].lines[0].get_ydata() == pytest.approx((3 - x) / 4)
    below = figure.axes[3].lines[0]
    order = (-(x**2)).argsort()
    assert below.get_xdata() == pytest.approx((-(x**2) + 0.2)[order])
    assert below.get_ydata() == pytest.approx(((3 - x) / (x + 2))[order])
    assert figure.axes[3].get_yscale() == "log"


def test_hidden_policies_draw_levels_and_the_limit():
    levels = {"low": 1, "mid": 3, "top": 4}
    left, right = figures.hidden_policies([0.5, 0.9, 0.99], [1, 2, 3], [0.5, 0.6, 0.7], levels, 0.55).axes
    assert left.lines[0].get_xdata() == pytest.approx([0.5, 0.1, 0.01])
    assert [line.get_ydata()[0] for line in left.lines[1:]] == [1, 3, 4]
    assert [line.get_label() for line in left.lines[1:]] == ["low", "mid", "top"]
    assert right.lines[0].get_ydata() == pytest.approx([0.5, 0.6, 0.7])
    assert right.lines[1].get_ydata()[0] == 0.55


def by_search(values, kappa):
    def loss(v):
        return (np.where(values < v, 1 - kappa, kappa) * (values - v) ** 2).sum()

    return minimize_scalar(loss, bounds=(-20, 20), method="bounded", options={"xatol": 1e-10}).x


def on_a_grid(values, kappa):
    """As in the notebook's own picture: a search among 1001 values."""
    grid = np.linspace(values.min(), values.max(), 1001)
    u = values - grid[:, None]
    return grid[(np.where(u < 0, 1 - kappa, kappa) * u**2).sum(1).argmin()]


def one_round(values, kappa):
    weight = np.where(values < values.mean(), 1 - kappa, kappa)
    return (weight * values).sum() / weight.sum()


def table_iql(s, a, r, s_next, kappa, gamma, from_targets=False, by_mu=True, discount=True, holes=False):
    """IQL on records by loops and `by_search`, with a place for each mistake."""
    v = np.zeros(max(s.max(), s_next.max()) + 1)
    q = np.zeros((len(v), a.max() + 1))
    for _ in range(40):
        target = r + (gamma if discount else 1.0) * v[s_next]
        for i, j in np.ndindex(q.shape):
            if ((s == i) & (a == j)).any():
                q[i, j] = target[(s == i) & (a == j)].mean()
        for i in range(len(v)):
            here = s == i
            values = target[here] if from_targets else q[i, a[here]] if by_mu else q[i, np.unique(a[here])]
            v[i] = by_search(q[i] if holes else values, kappa)
    return q, v


def losses_by_hand(r, mask, q, target_q, v, v_next, log_pi, kappa, gamma, alpha, change=""):
    u = target_q - v
    eq_6 = (abs(kappa - (u < 0).float()) * u * u).mean()
    target, weight = r + gamma * (1 if change == "no mask" else mask) * v_next, (alpha * u).exp()
    target = target if change == "target" else target.detach()
    eq_7 = sum(((target - one) ** 2).mean() for one in q) / (1 if change == "sum" else 2)
    log_likelihood = ((weight if change == "weight" else weight.detach()) * log_pi).mean()
    eq_6 = eq_6.detach() if change == "no gradient" else eq_6
    return eq_6, eq_7, log_likelihood if change == "sign" else -log_likelihood


def changed(change):
    return lambda *arguments: losses_by_hand(*arguments, change=change)


def exit_weight(u, kappa):
    """By a difference quotient, where the checker has numbers."""
    f = [abs(kappa - (u < 0)) * (np.sqrt(1 + (u + h) ** 2) - 1) for h in (-1e-6, 1e-6)]
    return np.where(u == 0, abs(kappa - (u < 0)), (f[1] - f[0]) / 2e-6 / np.where(u == 0, 1, u))


def double(first, second):
    return [b[max(range(len(a)), key=a.__getitem__)] for a, b in zip(first, second, strict=True)]


def promise(actions, rewards, candidates, degree=2, best=None, worth=maximisation_bias.bandit_value):
    fit = np.poly1d(np.polyfit(actions, rewards, degree))
    chosen = max(candidates, key=best or fit)
    return float(fit(chosen)), worth(chosen)


@pytest.mark.parametrize(
    "checker, answer, said",
    [
        (checks.check_double_estimate, double, "OK  double is right"),
        (checks.check_double_estimate, lambda f, s: torch.tensor(double(f, s)), "OK  "),
        (checks.check_double_estimate, lambda f, s: f.max(1), "the second values it"),
        (checks.check_double_estimate, lambda f, s: s.max(1), "the second values it"),
        (checks.check_double_estimate, lambda f, s: np.minimum(f, s).max(1), "the second values it"),
        (checks.check_double_estimate, lambda f, s: s[:, f.argmax(1)[0]], "makes its own choice"),
        (checks.check_double_estimate, lambda f, s: s[:, f.argmax(1)], "the second values it"),
        (checks.check_promise_and_truth, promise, "OK  promise is right"),
        (checks.check_promise_and_truth, lambda a, r, c: promise(a, r, c)[::-1], "promises 2 at a = 1"),
        (checks.check_promise_and_truth, lambda a, r, c: promise(a, r, c, 1), "degree 2"),
        (checks.check_promise_and_truth, lambda a, r, c: promise(a, r, c, 3), "degree 2"),
        (
            checks.check_promise_and_truth,
            lambda a, r, c: promise(a, r, c, best=maximisation_bias.bandit_value),
            "promises 2 at a = 1",
        ),
        (checks.check_promise_and_truth, lambda a, r, c: promise(a, r, c, worth=lambda b: 1 + b), "worth -1"),
        (checks.check_expectile, by_search, "OK  by_search is right"),
        (checks.check_expectile, on_a_grid, "OK  on_a_grid is right"),
        (checks.check_expectile, lambda v, k: torch.tensor(by_search(v, k)), "OK  "),
        (checks.check_expectile, one_round, "one round is not enough"),
        (checks.check_expectile, lambda v, k: v.mean(), "V = (0.1 * 0"),
        (checks.check_expectile, lambda v, k: np.quantile(v, k), "the mean"),
        (checks.check_expectile, lambda v, k: (np.where(v < v.mean(), 1 - k, k) * v).sum(), "the mean"),
        (checks.check_expectile, lambda v, k: by_search(v, max(k, 0.5)), "leans to the worst"),
        (checks.check_expectile, lambda v, k: [[1], [2, 3]], "raised ValueError"),
        (checks.check_tabular_iql, table_iql, "OK  table_iql is right in 6 cases"),
        (checks.check_tabular_iql, lambda *x: table_iql(*x[:4], 0.5, x[5]), "the expectile of Q"),
        (checks.check_tabular_iql, lambda *x: table_iql(*x[:4], 0.9999, x[5]), "the mean of Q"),
        (checks.check_tabular_iql, lambda *x: table_iql(*x, by_mu=False), "as often as it was recorded"),
        (checks.check_tabular_iql, lambda *x: table_iql(*x[:5], 0.0), "Q = r + gamma V"),
        (checks.check_tabular_iql, lambda *x: table_iql(*x, from_targets=True), "the mean over the records"),
        (checks.check_tabular_iql, lambda *x: table_iql(*x, holes=True), "as often as it was recorded"),
        (checks.check_tabular_iql, lambda *x: table_iql(*x)[1], "raised ValueError"),
        (checks.check_iql_losses, losses_by_hand, "OK  iql_losses is right in 6 cases"),
        (checks.check_iql_losses, lambda *x: list(losses_by_hand(*x)), "OK  "),
        (checks.check_iql_losses, changed("sign"), "minus the mean"),
        (checks.check_iql_losses, changed("no mask"), "gamma mask v_next"),
        (checks.check_iql_losses, changed("sum"), "over both rows of q"),
        (checks.check_iql_losses, changed("target"), "`detach` the target"),
        (checks.check_iql_losses, changed("weight"), "`detach` the weight"),
        (checks.check_iql_losses, changed("no gradient"), "eq. 6 trains v"),
        (checks.check_iql_losses, lambda *x: losses_by_hand(*x)[:2], "raised IndexError"),
        (checks.check_exit_weight, exit_weight, "OK  exit_weight is right"),
        (checks.check_exit_weight, lambda u, k: exit_weight(u, k) * np.abs(u), "w = |f'|/|u|"),
        (checks.check_exit_weight, lambda u, k: exit_weight(u, 0.5), "the factor kappa"),
        (checks.check_exit_weight, lambda u, k: exit_weight(u, k) * np.sign(u), "w > 0"),
        (checks.check_exit_weight, lambda u, k: exit_weight(u, k) * (u != 0), "f''(0)"),
        *[
            (checker, lambda *x: None, "returns nothing")
            for checker in (
                checks.check_double_estimate,
                checks.check_promise_and_truth,
                checks.check_expectile,
                checks.check_tabular_iql,
                checks.check_iql_losses,
                checks.check_exit_weight,
            )
        ],
    ],
)
def test_exercises_tell_the_right_answer_from_each_mistake(checker, answer, said, capsys):
    checker(answer)
    assert said in capsys.readouterr().out


@pytest.mark.parametrize(
    "slope, mu, q, said",
    [
        (lambda u: u - 1, [0.5, 0.5], [0.0, 0.2], "OK  V = -0.9 lies outside of [0, 0.2]"),
        (lambda u: u + 3, torch.tensor([0.25, 0.75]), (1.0, 2.0), "OK  V = 4.75 lies outside of [1, 2]"),
        (np.exp, [1.0], [0.0], "OK  E f'(Q - V) is never 0"),
        (lambda u: u - 1, [0.5, 0.5], [0.0, 4.0], "NOT YET  V = 1 lies among the Q"),
        (lambda u: 2 * u, [0.5, 0.5], [0.0, 0.2], "NOT YET  f'(0) = 0"),
        (lambda u: 1 - u, [0.5, 0.5], [0.0, 0.2], "NOT YET  this f' falls"),
        (lambda u: u - 1, [0.5, 0.6], [0.0, 0.2], "NOT YET  mu and Q"),
        (lambda u: u - 1, [1.0], [0.0, 0.2], "NOT YET  mu and Q"),
        (lambda u: u - 1, ..., ..., "NOT YET  something is missing"),
        (lambda u: u - 1, ["half"], [0.0], "NOT YET  ValueError"),
        (lambda u: None, [0.5, 0.5], [0.0, 0.2], "NOT YET  something is missing"),
        (7, [0.5, 0.5], [0.0, 0.2], "NOT YET  TypeError"),
    ],
)
def test_the_exit_task_wants_a_value_that_no_policy_has(slope, mu, q, said, capsys):
    checks.check_no_policy(slope, mu, q)
    assert capsys.readouterr().out.startswith(said)
