"""This module checks the answers to the exercises of notebook 16."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from tutorial_lib.course.checks.checker import try_answer
from tutorial_lib.course.patients import FAULTS, PATIENTS, Patient
from tutorial_lib.course.table_agents import GAMMA, START, WORLD
from tutorial_lib.course.tabular import state_values


def check_against_constant(answer: Callable) -> None:
    """Checks an exercise of notebook 16.

    `answer(targets, fitted)` returns the mean squared error divided by that of the best constant. Both are
    arrays of B numbers, with the shape (B,) or (B, 1).
    """
    rng = np.random.default_rng(0)
    targets = 5 + 3 * rng.normal(size=40)
    fitted = targets + rng.normal(size=40)
    best = np.mean((targets - targets.mean()) ** 2)
    expected = np.mean((targets - fitted) ** 2) / best
    hints = (
        ((np.array([0.0, 2.0]), np.array([1.0, 1.0])), 1.0, "the mean itself is the best constant: 1"),
        ((np.array([0.0, 2.0]), np.array([0.0, 2.0])), 0.0, "no error: 0"),
        ((np.array([0.0, 4.0]), np.array([1.0, 3.0])), 0.25, "mean squared errors, 1 and 4"),
        ((np.array([0.0, 2.0]), np.array([3.0, 3.0])), 5.0, "the best constant is the mean of the targets"),
        ((targets, fitted), expected, "compare with a loop"),
        (
            (targets, fitted[:, None]),
            expected,
            "the fit is (B, 1) here: your measurement broadcasts, as the loss that it should convict",
        ),
        ((targets[:, None], fitted), expected, "here the targets are (B, 1): bring both to one shape"),
    )
    try_answer(_as_number(answer), hints)


def check_time_limit_factor(answer: Callable) -> None:
    """Checks an exercise of notebook 16.

    `answer(gamma, horizon)` returns predicted / paid where time limits are treated as terminals.
    """
    hints = (
        ((0.98, 100), "the row is the last of its episode with the chance 1 / T: then nothing follows"),
        ((0.99, 100), "at gamma = 0.99 and T = 100 it is about one half"),
        ((0.9, 1000), "a long episode or a small gamma: hardly anything is lost"),
        ((0.5, 1), "every row is the last: what is left is the cost of one step, 1 - gamma of the sum"),
    )
    cases = [
        (case, (1 - case[0]) / (1 - case[0] * (1 - 1 / case[1])), hint) for case, hint in hints
    ]  # V = c + gamma (1 - 1/T) V, divided by V = c + gamma V
    try_answer(_as_number(answer), cases)


def _as_number(answer: Callable) -> Callable:
    """Returns `answer`, where an array or a tensor of one number is this number."""

    def number(*arguments):
        got = answer(*arguments)
        if isinstance(got, torch.Tensor):
            got = got.detach().numpy()
        return float(np.squeeze(got)) if np.size(got) == 1 and got is not None else got

    number.__name__ = getattr(answer, "__name__", "the answer")
    return number


class Evidence(NamedTuple):
    """What speaks for a fault, or against it."""

    measure: Callable[[Patient], float]
    """Returns the number that decides, or NaN where the patient has no such part."""
    fits: Callable[[float], bool]
    """Returns whether the number is what the fault makes of it."""
    words: str
    """The misconception, and what the measurement would show."""
    missing: str
    """Why a patient has no such number."""


def _discounted(patient: Patient) -> float:
    if patient.policies is None:
        return np.nan
    sums = [state_values(WORLD, policy, "costs", GAMMA)[START] for policy in patient.policies]
    return float(np.median(patient.predicted / sums))


def _after_time_limits(patient: Patient) -> float:
    if patient.next_values is None:
        return np.nan
    last = patient.rows.timeouts.ravel()
    return float(patient.next_values[last].mean() / patient.next_values[~last].mean())


def _negative(patient: Patient) -> float:
    return np.nan if patient.q_reward is None else float((patient.q_reward < 0).mean())


def _against_constant(patient: Patient) -> float:
    errors = ((patient.targets - patient.fitted) ** 2).mean()
    return float(errors / ((patient.targets - patient.targets.mean(0)) ** 2).mean())


def _told_at_the_end(patient: Patient) -> float:
    return np.nan if patient.told is None else float((patient.told[:, -1] / patient.told[:, 0]).mean())


def _within_states(patient: Patient) -> float:
    states, costs = patient.rows.states.ravel(), patient.rows.costs.ravel()
    visits = np.bincount(states)
    means = np.bincount(states, costs) / visits.clip(1)
    return float(((costs - means[states]) ** 2).mean() / costs.var())


EVIDENCE = {
    "terminal": Evidence(
        _after_time_limits, lambda x: x < 0.1,
        "A prediction that is too low has several causes. With this fault, the targets at the time limits "
        "would have nothing after the step: (next value there) / (elsewhere) would be 0",
        "its targets have no next value, so nothing can be missing there",
    ),
    "discounted": Evidence(
        _discounted, lambda x: abs(x - 1) < 0.1,
        "A prediction that is too low need not be a discounted one. With this fault, predicted / (exact "
        "discounted sum) would be 1",
        "it compares no predicted cost with a limit",
    ),
    "sign": Evidence(
        _negative, lambda x: x > 0.5,
        "Not every agent that breaks its limit is in the sign trap. With this fault, most Q_r would be "
        "negative. Their share",
        "it has no Q_r",
    ),
    "broadcast": Evidence(
        _against_constant, lambda x: x > 0.9,
        "A loss that stops falling can also be noise that nobody can predict. With this fault, the fit would "
        "be no better than a constant: loss / variance would be 1",
        "it fits nothing",
    ),
    "target": Evidence(
        lambda patient: np.nan, lambda x: x == 0,
        "A frozen target network keeps values near their first guess. The distance that it moved",
        "it has no target network (read what it is made of)",
    ),
    "budget": Evidence(
        _told_at_the_end, lambda x: abs(x - 1) < 0.1,
        "Not every agent that pays too much has forgotten to count. With this fault, the told limit would be "
        "the same in the last step and in the first: the ratio would be 1",
        "it has one policy for each limit, and is told nothing while it plays",
    ),
    "normalised": Evidence(
        lambda patient: float(patient.rows.costs.min()), lambda x: x < 0,
        "Costs of a wrong size are one possible cause of a wrong prediction. With this fault, some recorded "
        "costs would be negative. The least",
        "it reads no costs",
    ),
    "late": Evidence(
        _within_states, lambda x: x > 0.05,
        "Wrong costs of actions need not come from wrong rows. With this fault, one and the same state would "
        "have different costs: the share of the variance of the cost within states would be above 0",
        "it reads no costs",
    ),
}  # fmt: skip
"""The measurement that decides on each fault of `FAULTS`.

That of 'late' is possible because the cost of a step depends on its state alone on the laps."""


def worst_excess(patient: Patient) -> float:
    """Returns how far a patient is from health: the largest paid / limit.

    In patient 3, which has no limits, it is the error of its predictions: loss / variance.
    """
    return (
        _against_constant(patient)
        if patient.returns is None
        else float((patient.paid / patient.limits).max())
    )


def check_case(patient: Patient, diagnosis, treated) -> None:
    """Checks a diagnosis of notebook 16, and the experiment that proves it.

    `diagnosis` is a name in `FAULTS`. `treated` is the same patient, admitted again with one repair.
    """
    problem = _problem_of(patient, diagnosis) or _problem_of_proof(patient, str(diagnosis), treated)
    if problem:
        print(f"NOT YET  patient {patient.number}: {problem}")
        return
    before, after = worst_excess(patient), worst_excess(treated)
    what = "loss / variance" if patient.returns is None else "largest paid / limit"
    assert after < before, f"the repair of patient {patient.number} changed nothing: {before} and {after}"
    print(
        f"OK  patient {patient.number} has the fault {PATIENTS[patient.number]!r}. {what}: found "
        f"{before:.2f} before the repair and {after:.2f} after, expected less after than before"
    )


def _problem_of(patient: Patient, diagnosis) -> str:
    """Returns what speaks against a diagnosis, or no words."""
    if diagnosis is ... or diagnosis is None:
        return "write the name of a fault in place of the `...`"
    name = str(diagnosis).strip().lower()
    if name not in FAULTS:
        return f"{diagnosis!r} is no fault of the list: {', '.join(FAULTS)}"
    if name == PATIENTS[patient.number]:
        return ""
    evidence = EVIDENCE[name]
    found = evidence.measure(patient)
    if np.isnan(found):
        return f"{name!r} cannot be its fault: {evidence.missing}"
    return f"{name!r} does not fit. {evidence.words}; here it is {found:.2f}"


def _problem_of_proof(patient: Patient, diagnosis: str, treated) -> str:
    """Returns what an experiment lacks as a proof of the right diagnosis, or no words."""
    name = diagnosis.strip().lower()
    if treated is ... or treated is None:
        return f"{name!r} fits the measurements, but is not proved: admit the patient again with one repair"
    if not isinstance(treated, Patient):
        return "the experiment is a patient: patients.admit(number, repair=...)"
    if treated.number != patient.number:
        return f"you treated patient {treated.number}: compare a patient with itself"
    if treated.repaired is None:
        return "nothing was repaired: without a change there is no experiment"
    if treated.repaired != name:
        return f"the diagnosis is {name!r} and you repaired {treated.repaired!r}: test what you claim"
    return ""
