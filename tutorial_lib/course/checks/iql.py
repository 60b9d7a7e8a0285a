"""This module checks the answers to the exercises of notebooks 3 and 4."""

import functools
from collections.abc import Callable

import numpy as np
import torch

from tutorial_lib.course import tabular
from tutorial_lib.course.checks.checker import try_answer
from tutorial_lib.course.maximisation_bias import bandit_value


def check_double_estimate(answer: Callable) -> None:
    """Checks an exercise of notebook 3.

    `answer(first, second)` takes two independent estimates of the same K actions in each of n repetitions,
    both (n, K). It returns (n,): the second estimate of the action that is best by the first.
    """
    first, second = np.array([[1.0, 3.0, 2.0], [5.0, 0.0, 1.0]]), np.array([[7.0, 4.0, 9.0], [2.0, 6.0, 3.0]])
    try_answer(
        _arrays(answer),
        [
            ((first[:1], second[:1]), np.array([4.0]), "the first chooses action 1, the second values it"),
            (
                (first, second),
                np.array([4.0, 2.0]),
                "each row makes its own choice: return one value per row",
            ),
            ((second, first), np.array([2.0, 0.0]), "choose by the first argument, look up in the second"),
            ((-first, -second), np.array([-7.0, -6.0]), "the estimates may be negative"),
        ],
    )


def check_promise_and_truth(answer: Callable) -> None:
    """Checks an exercise of notebook 3.

    `answer(actions, rewards, candidates)` fits a parabola to recorded actions (n,) and their rewards (n,). It
    returns what the parabola promises for its best candidate, and what this candidate is worth.
    """
    line = np.array([-0.5, -0.3, -0.1, 0.1])
    grid, edge = np.linspace(-1, 1, 201), np.array([-0.5, 0.0, 0.25])
    hill = np.linspace(-0.5, 0.2, 30)

    def case(actions, rewards, candidates, hint):
        curve = np.polyval(np.linalg.lstsq(np.vander(actions, 3), rewards)[0], candidates)
        best = curve.argmax()
        expected = [curve[best], float(bandit_value(candidates[best]))]
        return (actions, rewards, candidates), expected, hint

    try_answer(
        _arrays(answer),
        [
            case(line, 1 + line, edge, "it is best at 0.25, promises 1.25, and that is the truth"),
            case(line, 1 + line, grid, "it promises 2 at a = 1, which is beyond the cliff and worth -1"),
            case(hill, 1 - (hill + 0.2) ** 2, grid, "fit a parabola, degree 2, and take its best candidate"),
            case(line, line**2, edge, "the promise is the parabola's, and the truth is bandit_value's"),
            case(hill, np.sin(9 * hill), edge, "fit a parabola: a polynomial of degree 2"),
        ],
    )


def check_expectile(answer: Callable) -> None:
    """Checks an exercise of notebook 4.

    `answer(values, kappa)` returns the expectile of equally frequent values. An answer within 1% of the range
    of the values is right: a search on a grid is good enough.
    """

    def snap(found, values, kappa):
        exact = tabular.expectile(np.full((1, len(values)), 1 / len(values)), values[None], kappa)[0]
        near = np.ndim(found) == 0 and abs(float(found) - exact) <= 0.01 * np.ptp(values)
        return exact if near else found

    try_answer(
        _arrays(answer, snap),
        [
            ((np.array([1.0, 2.0, 6.0]), 0.5), 3.0, "at kappa = 0.5 all weigh the same: the mean"),
            ((np.array([4.0, 4.0]), 0.9), 4.0, "equal values have one expectile"),
            ((np.array([0.0, 1.0]), 0.9), 0.9, "V = (0.1 * 0 + 0.9 * 1) / (0.1 + 0.9)"),
            ((np.array([0.0, 0.0, 0.0, 10.0]), 0.9), 7.5, "V = 9 / (3 * 0.1 + 0.9): divide by the weights"),
            ((np.array([0.0, 4.0, 10.0]), 0.9), 9.4 / 1.1, "V moves, and so does who is better than V"),
            ((np.arange(10.0), 0.97), 17.33 / 2.18, "repeat until V stops moving: one round is not enough"),
            ((np.array([0.0, 4.0, 10.0]), 0.1), 1.4 / 1.1, "below 0.5 it leans to the worst"),
        ],
    )


def check_tabular_iql(answer: Callable) -> None:
    """Checks an exercise of notebook 4.

    `answer(s, a, r, s_next, kappa, gamma)` takes recorded transitions, each array (N,), and returns Q (S, A)
    and V (S,), the fixed point of eqs. 6 and 7. V must be right to 0.001. The Q of pairs that were never
    recorded may be anything.
    """

    def values(found, *_):
        q, v = found
        return np.asarray(v, float).round(3)

    def transitions(*rows):
        s, a, r, s_next = np.array(rows).T
        return s.astype(int), a.astype(int), r, s_next.astype(int)

    bandit = transitions((0, 0, 0.0, 0), (0, 1, 10.0, 0))
    often = transitions(*[(0, 0, 0.0, 0)] * 3, (0, 1, 10.0, 0))
    lottery = transitions((0, 0, 4.0, 0), (0, 0, 4.0, 0), (0, 1, 0.0, 0), (0, 1, 6.0, 0))
    chain = transitions((0, 0, 1.0, 1), (1, 0, 2.0, 1))
    holes = transitions((0, 0, -1.0, 1), (1, 1, -2.0, 1), (1, 2, -4.0, 1))
    # Lottery: Q is 4 and 3. With kappa 0.9: V = (0.9 * 4 + 0.1 * 3) / 1 = 3.9.
    # Holes: with kappa 0.9 and gamma 0.5, V1 = -2.2 + V1 / 2 = -4.4 and V0 = -1 - 2.2.
    try_answer(
        _arrays(answer, values),
        [
            ((*bandit, 0.5, 0.0), np.array([5.0]), "at kappa = 0.5, V is the mean of Q over the records"),
            ((*bandit, 0.9, 0.0), np.array([9.0]), "V is the expectile of Q: 0.1 * 0 + 0.9 * 10"),
            ((*often, 0.9, 0.0), np.array([7.5]), "an action counts as often as it was recorded: mu"),
            ((*chain, 0.7, 0.5), np.array([3.0, 4.0]), "Q = r + gamma V(s'), repeated until nothing moves"),
            (
                (*lottery, 0.9, 0.0),
                np.array([3.9]),
                "first take the mean over the records of a pair: Q",
            ),
            ((*holes, 0.9, 0.5), np.array([-3.2, -4.4]), "a pair that was never recorded has no weight"),
        ],
    )


def check_iql_losses(answer: Callable) -> None:
    """Checks an exercise of notebook 4.

    `answer(r, mask, q, target_q, v, v_next, log_pi, kappa, gamma, alpha)` returns the losses of eqs. 6, 7 and
    8. The argument q is (2, B), the other tensors are (B,). Besides the values, the gradients are checked: a
    loss may change only what it trains.
    """
    numbers = {
        "r": [1.0, 2.0, 0.5], "mask": [1.0, 1.0, 0.0], "q": [[1.5, 3.5, 1.0], [2.5, 3.0, -1.0]],
        "target_q": [1.0, 3.0, 2.0], "v": [2.0, 1.0, 1.5], "v_next": [1.0, 2.0, 7.0],
        "log_pi": [-1.0, -2.0, 0.5],
    }  # fmt: skip
    trained = ("q", "v", "v_next", "log_pi")

    def iql_losses(part, equation):
        given = {name: torch.tensor(value, requires_grad=name in trained) for name, value in numbers.items()}
        found = answer(*given.values(), 0.8, 0.5, 0.25)
        if found is None:
            return None
        loss = found[equation - 6]
        if part == "value":
            return loss.item() if isinstance(loss, torch.Tensor) else loss
        leaves = [given[name] for name in trained]
        slopes = torch.autograd.grad(loss, leaves, allow_unused=True) if loss.requires_grad else [None] * 4
        return np.array([float(slope is not None and bool(slope.any())) for slope in slopes])

    weight = np.exp(0.25 * np.array([-1.0, 2.0, 0.5]))
    eq_6 = (0.2 + 0.8 * 4 + 0.8 * 0.25) / 3
    eq_7 = np.mean([0.0, 0.25, 0.25, 1.0, 0.0, 2.25])
    which = "The list says which of (q, v, v_next, log_pi) the loss changes"
    try_answer(
        iql_losses,
        [
            (
                ("value", 6),
                eq_6,
                "the mean of |kappa - 1(u < 0)| u^2, u = target_q - v",
            ),
            (("value", 7), eq_7, "the mean of (r + gamma mask v_next - q)^2, over both rows of q"),
            (("value", 8), -(weight * [-1.0, -2.0, 0.5]).mean(), "minus the mean of exp(alpha u) log_pi"),
            (("gradient", 6), np.array([0.0, 1, 0, 0]), f"{which}: eq. 6 trains v alone"),
            (("gradient", 7), np.array([1.0, 0, 0, 0]), f"{which}: `detach` the target of eq. 7"),
            (("gradient", 8), np.array([0.0, 0, 0, 1]), f"{which}: `detach` the weight of eq. 8"),
        ],
    )


def check_exit_weight(answer: Callable) -> None:
    """Checks the exit task of notebook 4.

    `answer(u, kappa)` returns the implicit policy's weight of f(u) = |kappa - 1(u < 0)| (sqrt(1 + u^2) - 1)
    for an array u (n,), in which u may be 0.
    """
    try_answer(
        _arrays(answer),
        [
            (
                (np.array([0.75]), 0.5),
                np.array([0.4]),
                "f'(u) = u / 2 / sqrt(1 + u^2), w = |f'|/|u|",
            ),
            ((np.array([0.75]), 0.9), np.array([0.72]), "an action above V has the factor kappa"),
            (
                (np.array([-0.75]), 0.9),
                np.array([0.08]),
                "below V the factor is 1 - kappa, and w > 0",
            ),
            ((np.array([2.4, -2.4]), 0.7), np.array([0.7, 0.3]) / 2.6, "one weight for each element of u"),
            (
                (np.array([0.0]), 0.5),
                np.array([0.5]),
                "at u = 0 the limit is f''(0): cancel u first",
            ),
        ],
    )


def check_no_policy(slope: Callable, mu, q) -> None:
    """Checks the exit task of notebook 4.

    `slope` is f' of a convex f with f'(0) != 0, and `mu` and `q` are (n,). It prints OK if the V of eq. 9 is
    not the value of any policy: if it lies outside of the values q, or if there is none.
    """
    try:
        if mu is ... or q is ... or slope(0.0) is None:
            print("NOT YET  something is missing: write f', mu and Q in place of the `...`")
        else:
            print(_no_policy(slope, np.asarray(mu, float), np.asarray(q, float)))
    except Exception as error:  # the reader's code can raise any error
        print(f"NOT YET  {type(error).__name__}: {error}")


def _no_policy(slope: Callable, mu: np.ndarray, q: np.ndarray) -> str:
    """Returns the line that `check_no_policy` prints."""
    if mu.ndim != 1 or mu.shape != q.shape or (mu < 0).any() or abs(mu.sum() - 1) > 1e-6:
        return "NOT YET  mu and Q have one number per action each, and mu is not negative and sums to 1"
    grid = np.linspace(-20, 20, 401)
    values = np.array([float(slope(u)) for u in grid])
    if (np.diff(values) < -1e-9).any():
        return "NOT YET  this f' falls somewhere, so that f is not convex"
    if abs(float(slope(0.0))) < 1e-9:
        return "NOT YET  f'(0) = 0: then w >= 0, and V is the mean of Q under the policy mu w / E[w]"

    def mean(v):
        return sum(chance * float(slope(value - v)) for chance, value in zip(mu, q, strict=True))

    low, high = q.min() - 20, q.max() + 20
    if mean(low) * mean(high) > 0:
        return "OK  E f'(Q - V) is never 0: there is no V, and no policy behind it"
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if mean(middle) > 0 else (low, middle)
    if q.min() - 1e-6 <= high <= q.max() + 1e-6:
        return f"NOT YET  V = {high:.3g} lies among the Q: some policy has this value. Bring the Q together"
    return f"OK  V = {high:.3g} lies outside of [{q.min():.3g}, {q.max():.3g}]: no policy has this value"


def _arrays(answer: Callable, then: Callable | None = None) -> Callable:
    """Returns `answer` with its result as an array, or as `then(result, *arguments)`. None stays None."""

    @functools.wraps(answer)
    def converted(*arguments):
        found = answer(*arguments)
        if found is None:
            return None
        return then(found, *arguments) if then else np.asarray(found, float)

    return converted
