"""Critics, bandits and general f of notebook 3, against closed forms, brute force and linear solves."""

import matplotlib
import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from tutorial_lib.course import checks, figures, maximisation_bias, tabular, widgets
from tutorial_lib.data.dataset import Dataset
from tutorial_lib.tasks import get_task


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


class Likes:
    """Stands in for a critic: Q is 7 less the distance from one action."""

    def __init__(self, *action):
        self.action = torch.tensor(action)

    def q(self, observations, actions):
        return 7 - (actions - self.action).norm(dim=1)


def test_play_greedy_plays_what_q_likes():
    task = get_task("BallRun")
    claim, ahead = maximisation_bias.play_greedy(Likes(1.0, 0.0), task, points=5)
    assert claim == pytest.approx(7)
    _, back = maximisation_bias.play_greedy(Likes(-1.0, 0.0), task, points=5)
    assert ahead > 100 > 0 > back


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


def test_courses_draw_each_run_and_both_levels():
    run = maximisation_bias.Course(np.arange(3), np.array([1.0, 10, 100]), None)
    figure = figures.courses(
        {"a": ({"maximum": run, "kappa = 0.7": run}, 5.0, 50.0), "b": ({"maximum": run}, 6, 60)}
    )
    for ax, runs, levels in zip(figure.axes, (2, 1), ((5, 50), (6, 60)), strict=True):
        assert [line.get_ydata().tolist() for line in ax.lines[:runs]] == [[1, 10, 100]] * runs
        assert tuple(line.get_ydata()[0] for line in ax.lines[runs:]) == levels


def test_moving_kappa_moves_the_expectile(capsys):
    control = widgets.expectile_slider(np.array([0.0, 0.0, 0.0, 10.0]), kappa=0.9)
    (kappa,) = control.kwargs_widgets
    assert control.result.axes[0].get_title() == "kappa = 0.9: V = 7.5"
    kappa.value = 0.5
    assert control.result.axes[0].get_title() == "kappa = 0.5: V = 2.5"


def test_implicit_policies_have_a_column_each():
    x = np.linspace(-1, 1, 5)
    figure = figures.implicit_policies(x, x + 2, -(x**2), {"one": (-0.5, x + 2), "two": (-0.2, 3 - x)})
    assert [ax.get_title() for ax in figure.axes[:2]] == ["one", "two"]
    assert figure.axes[3].lines[0].get_ydata() == pytest.approx((3 - x) / 4)


def test_towards_the_maximum_draws_its_levels():
    (ax,) = figures.towards_the_maximum([0.5, 0.9, 0.99], [1, 2, 3], {"low": 1, "mid": 3, "top": 4}).axes
    assert ax.lines[0].get_xdata() == pytest.approx([0.5, 0.1, 0.01])
    assert [line.get_ydata()[0] for line in ax.lines[1:]] == [1, 3, 4]
    assert [line.get_label() for line in ax.lines[1:]] == ["low", "mid", "top"]


def by_search(values, kappa):
    def loss(v):
        return (np.where(values < v, 1 - kappa, kappa) * (values - v) ** 2).sum()

    return minimize_scalar(loss, bounds=(-20, 20), method="bounded", options={"xatol": 1e-10}).x


def weight(u, a):
    return np.array([a * a if x == 0 else abs(a * np.exp(a * x) - a) / abs(x) for x in u])


@pytest.mark.parametrize(
    "checker, answer, said",
    [
        (checks.check_expectile, by_search, "OK  by_search is right"),
        (checks.check_expectile, lambda v, k: v.mean(), "V = (0.1 * 0"),
        (checks.check_expectile, lambda v, k: np.quantile(v, k), "the mean"),
        (checks.check_expectile, lambda v, k: (np.where(v < v.mean(), 1 - k, k) * v).sum(), "the mean"),
        (checks.check_expectile, lambda v, k: by_search(v, max(k, 0.5)), "leans to the worst"),
        (checks.check_linex_weight, weight, "OK  weight is right"),
        (checks.check_linex_weight, lambda u, a: np.exp(a * u), "f'(u) = a exp"),
        (checks.check_linex_weight, lambda u, a: np.abs(np.expm1(a * u) / u), "a twice"),
        (checks.check_linex_weight, lambda u, a: np.abs(a * np.expm1(a * u)), "over |u|"),
        (checks.check_linex_weight, lambda u, a: np.where(u == 0, 1.0, weight(u, a)), "a^2"),
        (checks.check_linex_weight, lambda u, a: np.where(u == 0, 0.0, weight(u, a)), "has a limit"),
        (checks.check_linex_weight, lambda u, a: a * np.expm1(a * u) / np.abs(u), "is positive"),
        (checks.check_linex_weight, lambda u, a: None, "returns nothing"),
    ],
)
def test_exercises_tell_the_right_answer_from_each_mistake(checker, answer, said, capsys):
    checker(answer)
    assert said in capsys.readouterr().out
