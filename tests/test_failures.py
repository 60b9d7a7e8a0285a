"""Notebook 16: its patients against oracles, and the checkers of its exercises on right and wrong answers."""

import dataclasses

import numpy as np
import pytest
import torch

from tutorial_lib.course import checks, figures, laps, patients, table_agents, tabular
from tutorial_lib.course.checks.failures import EVIDENCE, worst_excess

TABLES = (1, 2, 5, 6)


def simulated(policy, episodes=4000):
    """The mean cost of an episode, by playing."""
    played = tabular.simulate(
        table_agents.WORLD, policy, table_agents.HORIZON, episodes, np.random.default_rng(1)
    )
    return played.costs.sum(1).mean()


# --- The recordings and the healthy agents ---


def test_recordings_have_the_costs_of_their_states_and_end_at_time_limits_only():
    rows = table_agents.recordings()
    cells = np.array([list(row) for row in ("     ", "  h  ", "ShhhG")]).ravel()
    assert np.array_equal(rows.costs, cells[rows.states] == "h")
    assert np.array_equal(rows.states[:, 1:], rows.next_states[:, :-1])
    assert not rows.terminals.any() and rows.timeouts[:, -1].all() and not rows.timeouts[:, :-1].any()


@pytest.mark.parametrize("number", TABLES)
def test_a_repaired_agent_pays_what_it_predicts_and_keeps_its_limits(number):
    patient = patients.admit(number, patients.PATIENTS[number])
    assert (patient.predicted <= patient.limits + 1e-6).all()
    np.testing.assert_allclose(patient.predicted, patient.paid, rtol=0.05)
    paid = [simulated(policy) for policy in patient.policies]
    np.testing.assert_allclose(patient.paid, paid, rtol=0.05)
    np.testing.assert_allclose(patient.by_step.sum(1), patient.paid)


@pytest.mark.parametrize("price", [0.0, 0.1, 0.5])
def test_the_policy_for_a_price_is_the_fixed_point_of_soft_values(price):
    """Against plain value iteration: V = b log E_mu exp(Q / b), and the policy is mu exp((Q - V) / b)."""
    agent, b = table_agents.TableAgent(table_agents.recordings()), table_agents.SHARPNESS
    v = np.zeros(len(agent.mu))
    for _ in range(3000):
        q = agent.reward - price * agent.cost + table_agents.GAMMA * agent.follows @ v
        top = q.max(1)
        v = top + b * np.log((agent.mu * np.exp((q - top[:, None]) / b)).sum(1))
    expected = agent.mu * np.exp((q - v[:, None]) / b)
    policy, worth = agent.priced(price)
    np.testing.assert_allclose(policy, expected, atol=1e-7)
    np.testing.assert_allclose(worth, q, atol=1e-6)


def test_the_frontier_is_above_every_table_patient():
    """No patient earns more than the oracle at its cost, up to what it neglects (a finite episode)."""
    costs, returns = figures.frontier()
    for number in TABLES:
        for repair in (None, patients.PATIENTS[number]):
            patient = patients.admit(number, repair)
            assert (patient.returns <= np.interp(patient.paid, costs, returns) + 0.1).all(), number


def test_the_predictor_is_compared_with_the_true_remaining_cost():
    """Patient 3's truth at step 0, against episodes that are played."""
    policy = 0.75 * laps.policies((20,))[20.0] + 0.25 / 4
    patient = patients.admit(3, "broadcast")
    early = patient.limits <= 15
    rate = simulated(policy) / table_agents.HORIZON
    np.testing.assert_allclose(patient.paid[early], rate * (100 - patient.limits[early]), rtol=0.1)
    assert np.corrcoef(patient.predicted, patient.paid)[0, 1] > 0.98


def test_the_budget_patient_is_told_what_is_left_once_it_is_repaired():
    sick, well = patients.admit(4), patients.admit(4, "budget")
    np.testing.assert_allclose(sick.told, np.repeat(sick.limits[:, None], 100, 1))
    spent = np.cumsum(well.by_step, 1) - well.by_step
    assert (well.told >= well.limits[:, None] - spent - 1e-6).all()  # never less than zero is told
    np.testing.assert_allclose(well.told[:, 10], (well.limits[:, None] - spent)[:, 10], rtol=0.02)


# --- Faults and repairs ---


@pytest.mark.parametrize("number", patients.PATIENTS)
def test_a_wrong_repair_changes_nothing_and_the_right_one_heals(number):
    sick, fault = patients.admit(number), patients.PATIENTS[number]
    networks = (fault, "late")  # which train for seconds: one wrong repair is enough
    for name in patients.FAULTS if number in TABLES else networks:
        treated = patients.admit(number, name)
        same = np.array_equal(treated.paid, sick.paid) and np.array_equal(
            treated.predicted, sick.predicted, equal_nan=True
        )
        assert same == (name != fault), name
        assert (worst_excess(treated) < worst_excess(sick)) == (name == fault), name


def test_the_evidence_convicts_the_guilty_alone():
    for number, fault in patients.PATIENTS.items():
        patient = patients.admit(number)
        for name, evidence in EVIDENCE.items():
            found = evidence.measure(patient)
            assert (not np.isnan(found) and evidence.fits(found)) == (name == fault), (number, name)
        if number in TABLES:  # and the repaired patient is acquitted
            well = patients.admit(number, fault)
            assert not EVIDENCE[fault].fits(EVIDENCE[fault].measure(well)), number


def test_unknown_patients_and_repairs_are_one_line():
    with pytest.raises(ValueError, match="the patients are 1, 2, 3, 4, 5, 6"):
        patients.admit(7)
    with pytest.raises(ValueError, match="the faults are terminal, discounted"):
        patients.admit(1, "magic")
    assert set(patients.PATIENTS.values()) < set(patients.FAULTS) == set(EVIDENCE)


# --- The checkers ---


@pytest.mark.parametrize("written", ["sign", "Sign", " sign ", np.str_("sign")])
def test_a_proved_diagnosis_passes(written, capsys):
    checks.check_case(patients.admit(2), written, patients.admit(2, "sign"))
    assert capsys.readouterr().out.startswith("OK  patient 2 has the fault 'sign'. ")


@pytest.mark.parametrize(
    ("number", "diagnosis", "hint"),
    [
        (1, ..., "in place of the `...`"),
        (1, None, "in place of the `...`"),
        (1, "gradient", "is no fault of the list"),
        (1, 3, "is no fault of the list"),
        (1, "terminal", "here it is 1.00"),
        (1, "late", "within states would be above 0; here it is 0.00"),
        (1, "budget", "is told nothing while it plays"),
        (2, "discounted", "would be 1; here it is 2.0"),
        (2, "target", "has no target network"),
        (3, "discounted", "compares no predicted cost"),
        (3, "terminal", "no next value"),
        (4, "discounted", "compares no predicted cost"),
        (4, "sign", "has no Q_r"),
        (4, "broadcast", "no better than a constant"),
        (5, "discounted", "predicted / (exact discounted sum) would be 1; here it is 1.3"),
        (5, "broadcast", "here it is 0.5"),
        (6, "discounted", "here it is 2.5"),
        (6, "normalised", "The least; here it is 0.00"),
    ],
)
def test_a_wrong_diagnosis_is_told_what_speaks_against_it(number, diagnosis, hint, capsys):
    checks.check_case(patients.admit(number), diagnosis, ...)
    said = capsys.readouterr().out
    assert said.startswith(f"NOT YET  patient {number}: ") and hint in said and said.count("\n") == 1
    assert patients.PATIENTS[number] not in said or diagnosis in ("gradient", 3)  # nothing is given away


@pytest.mark.parametrize(
    ("treated", "hint"),
    [
        (..., "is not proved"),
        (None, "is not proved"),
        ("discounted", "the experiment is a patient"),
        (lambda: patients.admit(5, "discounted"), "you treated patient 5"),
        (lambda: patients.admit(1), "nothing was repaired"),
        (lambda: patients.admit(1, "terminal"), "you repaired 'terminal'"),
    ],
)
def test_a_right_diagnosis_needs_a_proof(treated, hint, capsys):
    checks.check_case(patients.admit(1), "discounted", treated() if callable(treated) else treated)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  patient 1: ") and hint in said


def ratio(targets, fitted):
    targets, fitted = np.ravel(targets), np.ravel(fitted)
    return ((targets - fitted) ** 2).mean() / targets.var()


@pytest.mark.parametrize(
    "answer",
    [
        ratio,
        lambda t, f: torch.tensor([ratio(t, f)]),
        lambda t, f: np.array([[ratio(t, f)]]),
        lambda t, f: 1 - (1 - np.sum((t.ravel() - f.ravel()) ** 2) / np.sum((t - t.mean()) ** 2)),
    ],
)
def test_right_measurements_pass(answer, capsys):
    checks.check_against_constant(answer)
    assert capsys.readouterr().out.startswith("OK  ")


@pytest.mark.parametrize(
    ("answer", "hint"),
    [
        (lambda t, f: ((t - f) ** 2).mean() / ((t - t.mean()) ** 2).mean(), "broadcasts"),
        (lambda t, f: ((t.ravel() - f.ravel()) ** 2).mean(), "mean squared errors"),
        (lambda t, f: ((t.ravel() - f.ravel()) ** 2).mean() / t.var(ddof=1), "best constant"),
        (lambda t, f: 1 - ratio(t, f), "the mean itself is the best constant"),
        (lambda t, f: ((t.ravel() - f.ravel()) ** 2).mean() / (t**2).mean(), "best constant"),
        (lambda t, f: np.sqrt(ratio(t, f)), "mean squared errors"),
        (lambda t, f: ratio(t, f) if f.ndim == t.ndim else ratio(t, f[: len(f) // 2]), "raised"),
        (lambda t, f: None, "returns nothing"),
        (lambda t, f: ..., "in place"),
    ],
)
def test_wrong_measurements_get_their_hint(answer, hint, capsys):
    checks.check_against_constant(answer)
    said = capsys.readouterr().out
    assert said.startswith("NOT YET  ") and (hint in said or hint == "in place")


def test_the_factor_of_time_limits(capsys):
    checks.check_time_limit_factor(lambda g, n: (1 - g) / (1 - g + g / n))
    assert capsys.readouterr().out.startswith("OK  ")
    for wrong in (
        lambda g, n: (1 - g) / (1 - g * (1 + 1 / n)) if n > 1 else 1.0,
        lambda g, n: 1 - 1 / n,
        lambda g, n: 1 - g**n,
        lambda g, n: (1 - g * (1 - 1 / n)) / (1 - g),
        lambda g, n: None,
    ):
        checks.check_time_limit_factor(wrong)
        assert capsys.readouterr().out.startswith("NOT YET  ")


# --- The figures ---


def test_the_figures_draw_what_a_patient_pays():
    patient = patients.admit(1)
    picture = figures.symptoms(patient)
    assert "10 under 5" in picture.description
    paid = next(line for line in picture.axes[0].lines if line.get_label() == "paid")
    np.testing.assert_array_equal(paid.get_ydata(), patient.paid)
    picture = figures.treatments(patient, {"repaired": patients.admit(1, "discounted")})
    assert "before: 10, 20" in picture.description and "repaired: 5, 10" in picture.description
    without = dataclasses.replace(patient, predicted=np.full(5, np.nan))
    assert "predicted" not in [line.get_label() for line in figures.symptoms(without).axes[0].lines]
    assert len(figures.symptoms(patients.admit(3)).axes) == 1
