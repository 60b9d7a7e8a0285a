"""This module checks the answers to the exercises of notebook 9."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch

from tutorial_lib.costs.conditioning import rescaled_budget
from tutorial_lib.course.checks.checker import given, name_of, text, try_answer
from tutorial_lib.course.tabular import budget_optimum, random_cmdp


def check_rescaled_budget(answer: Callable) -> None:
    """Checks an exercise of notebook 9: `answer(limit, spent, t, horizon)` returns the value of eq. 23."""
    hints = {
        (30.0, 0.0, 0, 200): "at the start: the limit itself",
        (30.0, 15.0, 100, 200): "half spent at half time: on schedule, the limit itself",
        (30.0, 0.0, 100, 200): "all of the budget for half of the steps counts double",
        (30.0, 40.0, 150, 200): "overspent: negative; what to make of that, the nearest threshold settles",
        (30.0, 5.0, 199, 200): "one step is left for all of the 25",
        (np.inf, 50.0, 10, 200): "no limit stays none",
    }
    try_answer(answer, [(case, float(rescaled_budget(*case)), hint) for case, hint in hints.items()])


def check_budget_backup(answer: Callable) -> None:
    """Checks an exercise of notebook 9.

    `answer(cmdp, then)` computes one backward step of the budget recursion. `then` and the result have the
    shape (b+1, S), where b is the budget and S is the number of states.
    """
    rng = np.random.default_rng(0)
    free = random_cmdp(rng, 3)
    free = replace(free, costs=np.zeros_like(free.costs))
    some, costly, tiring = random_cmdp(rng, 3), random_cmdp(rng, 4), random_cmdp(rng, 3)
    costly.costs[0] = 1  # a state in which every action costs something
    tiring = replace(tiring, rewards=tiring.rewards - 5)
    cases = []
    for cmdp, budget, hint in (
        (free, 0, "nothing costs anything: the largest r + sum P W, without a discount factor"),
        (some, 0, "without a budget only actions that cost nothing are to be had"),
        (some, 2, "after an action with cost c the value of the next state is then[b - c]"),
        (costly, 3, "where no action is affordable the episode is stopped, at the value 0"),
        (tiring, 2, "values can be negative: the maximum is over the affordable actions alone, without a 0"),
    ):
        values, _ = budget_optimum(cmdp, 6, budget)
        cases.append(((cmdp, values[3]), values[2], hint))
    try_answer(answer, cases)


def check_encoding(answer: Callable) -> None:
    """Checks an exercise of notebook 9: `answer(threshold, cost_range)` returns a number for the networks.

    Every number of order one for infinity is right if it is above the codes of all finite thresholds.
    """
    name = name_of(answer)
    for cost_range, thresholds in ((80.0, (0, 30, 50, 70, 80)), (200.0, (0, 40, 100, 160, 200))):
        codes = []
        for threshold in (*thresholds, np.inf):
            call = f"{name}({threshold:g}, {cost_range:g})"
            code = given(answer, (threshold, cost_range), call, float)
            if code is None:
                return
            codes.append(code)
            if not abs(codes[-1]) <= 5:
                print(
                    f"NOT YET  {call} = {codes[-1]:.4g}: a network's input should be finite and of order one"
                )
                return
        if not (np.diff(codes) > 0.05).all():
            print(
                f"NOT YET  the codes {text(codes)} must rise with the limit, and infinity must be the highest"
            )
            return
    print(f"OK  {name} gives every limit a code of its own, in order and of order one")


CORNERS = {
    "tie at the start": ((40, 0, 0), "30 and 50 are equally near to 40: the first of the set counts"),
    "last step": ((30, 25, 199), "5 left for 1 step of 200 is a budget of 1000: the largest finite one"),
    "overspent": ((30, 40, 100), "a budget of -20: its nearest element is the smallest, which is not 0"),
    "limit zero": ((0, 0, 0), "a budget of 0: the set as printed has no 0"),
    "no limit": ((np.inf, 60, 100), "the distance to infinity is infinite: the closest value is finite"),
}
"""The corners of eq. 23 on BallCircle, with limit, cost so far and step, and what must be noticed in each."""


def check_corners(answers: dict) -> None:
    """Checks an exercise of notebook 9: what the agent is told in each corner, by the set as printed.

    `answers` has a threshold for each name of `CORNERS`.
    """
    choices = (30.0, 50.0, 70.0)  # the finite thresholds of BallCircle
    for corner, ((limit, spent, t), hint) in CORNERS.items():
        found = answers.get(corner, ...) if isinstance(answers, dict) else ...
        if found is ...:
            print(f"NOT YET  {corner}: write a threshold in place of the `...`")
            return
        budget = min(max((limit - spent) * 200 / (200 - t), choices[0]), choices[-1])
        right = min(choices, key=lambda choice: abs(choice - budget))
        try:
            wrong = float(found) != right
        except (TypeError, ValueError):
            wrong = True
        if wrong:
            print(f"NOT YET  {corner}: {text(found)} is not what is told. {hint}")
            return
    print(f"OK  all {len(CORNERS)} corners")


LOSSES = "L_Vr (line 12)", "L_Vc (line 14)", "L_Qr (line 16)", "L_Qc (line 18)", "L_pi (line 20)"


def five_losses_batch(seed: int = 0, size: int = 64, heads: int = 3) -> SimpleNamespace:
    """Returns random outputs of C2IQL's networks on a batch of B transitions, as float64 tensors.

    Rewards, limits, Q_r, V_r and log pi are (B,). Q_c and V_c are (B, m). A name that ends with `_target` is
    the output of a target network, and one that ends with `_next` is the output at s'.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    x = SimpleNamespace(reward=draw(size, low=-1, high=2), cost=draw(size).round())
    x.limit = torch.tensor([30.0, 50.0, 70.0, torch.inf], dtype=torch.float64).repeat(size)[:size]
    x.episode_cost = draw(size, high=100)
    for name in ("q_reward", "q_reward_target", "v_reward", "v_reward_next"):
        setattr(x, name, draw(size, low=-5, high=10))
    for name in ("q_cost", "q_cost_target", "v_cost", "v_cost_next"):
        setattr(x, name, draw(size, heads, high=30))
    x.log_prob = draw(size, low=-3, high=1)
    return x


def _five_by_loop(x: SimpleNamespace, kappas, gamma: float, gammas, **change) -> list[float]:
    """Returns the five losses in a loop over the batch. A `change` makes one of the likely mistakes."""
    kappa_1, kappa_2 = kappas
    sums = np.zeros(5)
    for i in range(len(x.reward)):
        unsafe = float(x.episode_cost[i]) > float(x.limit[i])
        q = 0.0 if unsafe and not change.get("free") else float(x.q_reward_target[i])
        u = (q - float(x.v_reward[i])) * (-1 if change.get("reverse") else 1)
        of_values, of_policy = (1 - k if u < 0 else k for k in (kappa_1, kappa_2))
        v_r, v_c = (x.v_reward, x.v_cost) if change.get("here") else (x.v_reward_next, x.v_cost_next)
        heads = [g if not change.get("one_gamma") else gamma for g in gammas]
        weight = 1.0 if change.get("plain") else of_values
        sums += [
            of_values * u**2,
            weight
            * sum((float(x.q_cost_target[i, j]) - float(x.v_cost[i, j])) ** 2 for j in range(len(heads))),
            (float(x.reward[i]) + gamma * float(v_r[i]) - float(x.q_reward[i])) ** 2,
            sum(
                (float(x.cost[i]) + g * float(v_c[i, j]) - float(x.q_cost[i, j])) ** 2
                for j, g in enumerate(heads)
            ),
            (1 if change.get("sign") else -1) * of_policy * float(x.log_prob[i]),
        ]
    return list(sums / len(x.reward))


def check_five_losses(answer: Callable) -> None:
    """Checks an exercise of notebook 9: `answer(x, kappa_1, kappa_2, gamma, gammas)` returns five losses.

    `x` is a batch as in `five_losses_batch`. The losses are in the order of Algorithm 2, as a sequence or
    a dictionary. A loss of m heads may be their sum or their mean.
    """
    x, gammas = five_losses_batch(), (0.9, 0.95, 0.97)

    def read(got) -> list[np.ndarray]:
        return [np.asarray(part, float) for part in (got.values() if isinstance(got, dict) else got)]

    found = given(answer, (x, 0.7, 0.9, 0.99, torch.tensor(gammas, dtype=torch.float64)), read=read)
    if found is None:
        return
    if len(found) != 5 or any(part.ndim for part in found):
        shapes = ", ".join(str(part.shape) for part in found)
        print(f"NOT YET  five numbers are expected, one per loss, not arrays of the shapes [{shapes}]")
        return
    right = _five_by_loop(x, (0.7, 0.9), 0.99, gammas)
    for n, (name, part) in enumerate(zip(LOSSES, found, strict=True)):
        if not _is_one_of(part, right[n]):
            hint = _five_hint(x, gammas, n, part)
            print(f"NOT YET  {name} = {text(part)}, expected {text(right[n])}: {hint}")
            return
    print("OK  all five losses of Algorithm 2")


def _is_one_of(found, sum_of_heads: float, heads: int = 3) -> bool:
    return bool(np.isclose(found, [sum_of_heads, sum_of_heads / heads], rtol=1e-6).any())


def _five_hint(x: SimpleNamespace, gammas, n: int, found) -> str:
    """Returns what was mistaken in loss n, by comparing it with the likely mistakes."""
    mistakes: tuple[tuple[tuple[float, float], dict[str, bool], str], ...] = (
        ((0.7, 0.9), {"free": True}, "the penalty is missing: Q_(r|c) is 0 where the cost exceeds the limit"),
        ((0.7, 0.9), {"reverse": True}, "u is Q_(r|c) - V_r, and kappa stands where u is not negative"),
        ((0.9, 0.7), {}, "the other kappa: kappa_1 for both values, kappa_2 for the policy"),
        ((0.7, 0.9), {"plain": True}, "the weight M is missing: V_c is the cost of the implicit policy"),
        ((0.7, 0.9), {"here": True}, "the target has the value of the next state, as in Algorithm 2"),
        ((0.7, 0.9), {"one_gamma": True}, "each head has its own discount factor gamma_i"),
        ((0.7, 0.9), {"sign": True}, "the minus is missing: the loss falls where log pi rises"),
    )
    for kappas, change, hint in mistakes:
        if _is_one_of(found, _five_by_loop(x, kappas, 0.99, gammas, **change)[n]):
            return hint
    return "compare with its line of Algorithm 2, for one transition by hand; a loss is a mean over the batch"
