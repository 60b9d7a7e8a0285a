"""This module checks the answers to the exercises of notebooks 6 and 7, on the reconstruction of costs."""

import functools
from collections.abc import Callable, Iterable

import numpy as np
import torch

from tutorial_lib.costs.discounting import settled_share
from tutorial_lib.course.checks.checker import try_answer
from tutorial_lib.course.undiscounting import flat_weights, steady_heads
from tutorial_lib.networks import mlp
from tutorial_lib.tasks import TASKS


def _plain(answer: Callable) -> Callable:
    """Returns `answer` with results that a message can show.

    A tensor becomes an array. A result whose parts have different shapes, and a matrix, become words.
    """

    @functools.wraps(answer)
    def plain(*arguments):
        got = answer(*arguments)
        if isinstance(got, torch.Tensor):
            got = got.detach().cpu().numpy()
        try:
            shape = np.shape(got)
        except ValueError:
            return f"{type(got).__name__} of {len(got)} parts with different shapes"
        return f"an array of shape {shape}" if len(shape) > 1 else got

    return plain


def check_one_sum_bounds(answer: Callable) -> None:
    """Checks an exercise of notebook 6.

    `answer(head, gamma, horizon)` returns the least and the largest sum of costs in [0, 1] with the
    discounted sum `head`.
    """
    hints = {
        (1.0, 0.5, 4): "from the end, three steps cost 3 and count 0.875, and step 0 takes the rest",
        (0.0, 0.9, 5): "no cost at all",
        (0.7, 0.5, 3): "a step may cost a part of 1: the assumption is that c_t lies in [0, 1]",
        (1.9, 0.5, 5): "the least sum comes first: fill the steps from the start, where a cost counts most",
        (18.984, 0.99, 300): "CarCircle's first head of a steady 60: fill from the start, then from the end",
    }
    cases = []
    for (head, gamma, horizon), hint in hints.items():
        powers = gamma ** np.arange(horizon)
        both = []
        for weights in (powers, powers[::-1]):
            before = np.cumsum(weights) - weights
            both.append(np.clip((head - before) / weights, 0, 1).sum())
        cases.append(((head, gamma, horizon), tuple(both), hint))
    try_answer(_plain(answer), cases)


def check_flat_weights(answer: Callable) -> None:
    """Checks an exercise of notebook 6.

    `answer(gammas, horizon)` returns the weights w that minimise the sum over steps t of
    (sum over heads i of w_i gamma_i^t - 1)^2.
    """
    hints = {
        ((0.5,), 1): "a weight of 1, in an array of shape (1,). np.linalg.lstsq returns w first, and more",
        ((0.9, 0.5), 2): "two heads for two steps: exact, w_1 + w_2 = 1 and 0.9 w_1 + 0.5 w_2 = 1",
        ((0.9,), 10): "one head: (sum of gamma^t) / (sum of gamma^2t)",
    }
    hints |= {
        (TASKS[name].gammas, TASKS[name].horizon): f"{name}: minimise the sum over all steps"
        for name in ("CarCircle", "BallRun")
    }
    cases = []
    for (gammas, horizon), hint in hints.items():
        # These are the normal equations. Their sums over steps are geometric series.
        products = np.multiply.outer(gammas, gammas)
        gram = (1 - products**horizon) / (1 - products)
        sums = (1 - np.array(gammas) ** horizon) / (1 - np.array(gammas))
        cases.append(((np.array(gammas), horizon), np.linalg.solve(gram, sums), hint))
    try_answer(_plain(answer), cases)


def check_error_in_cost(answer: Callable) -> None:
    """Checks an exercise of notebook 6.

    `answer(weights, error)` returns three errors of the reconstructed cost, where every head has an error of
    size `error`: for independent errors, for errors with the worst signs, and for a common error.
    """
    small, large = np.array([3.0, -4.0]), np.array([8.3, -21.1, 13.9])
    three_ways = (np.sqrt(707.31) / 10, 4.33, 0.11)  # because 8.3^2 + 21.1^2 + 13.9^2 = 707.31
    cases = [
        ((small, 1.0), (5.0, 7.0, 1.0), "independent 5, worst 7, common 1: add squares, sizes, values"),
        ((np.array([2.0]), 0.5), (1.0, 1.0, 1.0), "with one head, all three are the same"),
        ((large, 0.1), three_ways, "variances of independent errors add up"),
        ((-large, 0.1), three_ways, "a size has no sign"),
    ]
    try_answer(_plain(answer), cases)


def _situations():
    """Returns {letter: (heads (m,), why the weighted sum is or is not right)}: CarCircle, true cost 60."""
    task = TASKS["CarCircle"]
    gammas, steps = np.array(task.gammas), np.arange(task.horizon)
    right = steady_heads(task, 60)
    powers = np.power.outer(gammas, steps)
    share = settled_share(gammas, 80_000, tau=0.005)
    return {
        "A": (1.05 * right, "a factor that all heads share is the factor of the sum"),
        "B": (right + 0.5, "an equal error is multiplied by the sum of the weights, which is near 1"),
        "C": (right * (1, 1.05, 1), "the error of one head is multiplied by its own weight, -21"),
        "D": (
            powers @ (steps >= task.horizon - 60),
            "the curve is near 1 at every step, early or late",
        ),
        "E": (
            steady_heads(task, 60, "bootstrap"),
            "steps beyond the time limit count, and many",
        ),
        "F": (share * right, "each head is nearly right, but they lag by different shares"),
        "G": (powers @ (3.0 * (steps < 20)), "the weighted sum does not need costs in [0, 1]: the bounds do"),
        "H": ((0 * right + 2 * right) / 2, "the weighted sum of a mean is the mean of the weighted sums"),
    }


def check_linear_failures(letters: Iterable[str]) -> None:
    """Checks an exercise of notebook 6: in which situations a linear reconstruction fails.

    `letters` are those of A to H in which the weighted sum of CarCircle's heads is off by more than 6 of 60
    unsafe steps: a text such as "AB", a list or a set.
    """
    weights = flat_weights(TASKS["CarCircle"].gammas, TASKS["CarCircle"].horizon)
    situations = _situations()
    if letters is None or letters is ...:
        print("NOT YET  no letters: write those of the situations that fail in place of the `...`")
        return
    try:
        said = {str(letter).upper() for letter in letters} - set(" ,")
    except TypeError:  # a single number or truth value
        said = {str(letters)}
    if said - set(situations):
        print(f"NOT YET  {min(said - set(situations))} is none of the letters {', '.join(situations)}")
        return
    for letter, (heads, why) in situations.items():
        fails = abs(weights @ heads - 60) > 6
        if fails != (letter in said):
            print(f"NOT YET  {letter} {'fails' if fails else 'does not fail'}: {why}")
            return
    print(f"OK  all {len(situations)} situations are judged right")


_SHORT = (0.5, 0.9)
"""The discount factors of the sequences of four steps on which `check_algorithm_1` trains."""


class _Net(torch.nn.Module):
    """A small network from two heads (B, 2) to costs (B,)."""

    def __init__(self):
        super().__init__()
        self.net = mlp(len(_SHORT), 32, 1, 1)

    def forward(self, heads):
        return self.net(heads).squeeze(-1)


def _short_sums(costs):
    """Returns heads (n, 2) and sums (n,) of costs (n, 4), as tensors."""
    powers = np.power.outer(np.array(_SHORT), np.arange(4))
    return torch.tensor(costs @ powers.T).float(), torch.tensor(costs.sum(1)).float()


def _trained(answer, recorded, drawn, noise, steps=500):
    """Returns a network that `answer` trained, whether it is as it was, and how often it drew sequences."""
    rng, calls = np.random.default_rng(0), []
    recorded, drawn = (np.array(costs, np.float32) for costs in (recorded, drawn))

    def draw(n):
        calls.append(n)
        return drawn[rng.integers(len(drawn), size=int(n))]

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        net = _Net()
        before = [parameter.detach().clone() for parameter in net.parameters()]
        answer(net, np.array(_SHORT), recorded, draw, steps, noise)
    same = all(torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True))
    return net, same, len(calls)


def _problem(answer: Callable) -> str:
    """Returns what is wrong with an Algorithm 1, or an empty text."""
    every = [[(number >> t) & 1 for t in range(4)] for number in range(16)]
    # The two sources differ so much that a network which was trained on one alone is wrong about the other.
    sources = {"recordings (lines 3, 6 and 7)": [[1] * 4], "random sequences (lines 8 to 14)": [[-1] * 4]}
    recorded, drawn = sources.values()
    net, same, calls = _trained(answer, recorded, drawn, noise=0.0)
    if same:
        return "leaves the network as it was: write its loop in place of the `...`"
    if not calls:
        return "never draws random sequences: lines 8 to 14 are missing"
    for name, costs in sources.items():
        x, y = _short_sums(np.array(costs, float))
        with torch.no_grad():
            found = net(x).item()
        if abs(found - y.item()) > 1:
            return (
                f"has not learnt the {name}: is there a loss for them, are (B,) and (B,) subtracted, and "
                "does each iteration call zero_grad, backward and step?"
            )
    heads, costs = _short_sums(np.array(every, float))
    answers = {}
    for noise in (0.0, 5.0):
        net, *_ = _trained(answer, every, every, noise)
        with torch.no_grad():
            answers[noise] = net(heads)
    off = (answers[0.0] - costs).square().mean().sqrt().item()
    if off > 0.7:
        return f"without noise it is off by {off:.2f} on sequences that it has seen: is the loss (R - C)^2?"
    if answers[5.0].std() > 0.6 * answers[0.0].std():
        return "trusts its inputs as much with a noise of 5 as without: add the noise to the inputs"
    return ""


def check_algorithm_1(answer: Callable) -> None:
    """Checks an exercise of notebook 7: whether `answer` is Algorithm 1.

    `answer(net, gammas, recorded, draw, steps, noise)` trains `net` in place. `recorded` (n, T) are the costs
    of episodes, and `draw(n)` returns random sequences (n, T). It is trained four times on short sequences.
    """
    try:
        problem = _problem(answer)
    except Exception as error:  # the reader's code can raise any error
        problem = f"raised {type(error).__name__}: {error}"
    if problem:
        print(f"NOT YET  {answer.__name__} {problem}")
    else:
        print(f"OK  {answer.__name__} trains on recordings and random sequences, with noise on its inputs")


def check_steady_head(answer: Callable) -> None:
    """Checks an exercise of notebook 7.

    `answer(rate, gamma, horizon, step, treatment)` is the head that an exact critic gives to the
    reconstruction at a step, for a constant cost per step, where treatment is 'bootstrap', 'rate' or 'mask'.
    """
    cases = []
    for arguments, hint in {
        (1.0, 0.5, 2, 0, "bootstrap"): "1 + 1/2 + 1/4 + ... = 2",
        (1.0, 0.5, 2, 0, "rate"): "the first two steps alone: 1 + 1/2",
        (1.0, 0.5, 2, 1, "rate"): "'rate' is T steps from every state: the step does not matter",
        (1.0, 0.5, 2, 1, "mask"): "one step is left at step 1",
        (0.2, 0.99, 300, 150, "bootstrap"): "an endless sum, whatever the step: rate / (1 - gamma)",
        (0.2, 0.99, 300, 150, "mask"): "150 steps are left at step 150 of 300",
    }.items():
        rate, gamma, horizon, step, treatment = arguments
        seen = {"bootstrap": 10_000, "rate": horizon, "mask": horizon - step}[treatment]
        cases.append((arguments, rate * (gamma ** np.arange(seen)).sum(), hint))
    try_answer(_plain(answer), cases)
