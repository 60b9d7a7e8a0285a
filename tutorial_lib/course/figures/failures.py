"""The figures of the failure hunt: the symptoms of a patient, and the experiment that proves a diagnosis."""

import functools

import numpy as np

from tutorial_lib.course import laps
from tutorial_lib.course.patients import Patient
from tutorial_lib.style import (
    COST,
    DASHED,
    LIMIT,
    NEUTRAL,
    REWARD,
    described,
    legend_below,
    one_figure,
    subplots,
)

_PARTS = 10
"""The number of parts of an episode over which the cost is averaged."""


@functools.cache
def frontier() -> tuple[np.ndarray, np.ndarray]:
    """Returns the costs and returns, both (n,), of the best policies for a cost rate: an oracle."""
    limits = (0, 0.5, 1, 1.5, 2, 3, 4, 5, 7.5, 10, 12.5, *range(15, 61, 5))
    played = [laps.follow_one(policy) for policy in laps.policies(limits).values()]
    return np.array([x.cost for x in played]), np.array([x.reward for x in played])


@one_figure
def symptoms(patient: Patient):
    """Draws what the owner of a patient sees, beside what is possible.

    Left: paid and predicted cost over the limit. Middle: return over paid cost, with that of the best
    policies. Right: the cost per step along an episode, with one line for each limit, which is paler where
    the limit is smaller. A patient without limits has one panel: predicted over paid cost.
    """
    if patient.returns is None or patient.by_step is None:
        return _predictions(patient)
    figure, (left, middle, right) = subplots(1, 3, figsize=(12, 4.6))
    end = 1.08 * max(patient.limits.max(), patient.paid.max())
    left.plot([0, end], [0, end], **DASHED, label="limit")
    left.plot(patient.limits, patient.paid, "o-", color=COST, markersize=8, label="paid")
    if np.isfinite(patient.predicted).any():
        left.plot(patient.limits, patient.predicted, "x", color=LIMIT, markersize=9, label="predicted")
    left.set(title="cost of an episode", xlabel="limit", ylabel="unsafe steps")
    left.set(xlim=(0, 1.1 * patient.limits.max()), ylim=(0, end))
    middle.plot(*frontier(), color=NEUTRAL, label="best policies")
    middle.plot(patient.paid, patient.returns, "o", color=REWARD, markersize=8, label="patient")
    middle.set(title="return of an episode", xlabel="paid cost", ylim=(0, None))
    steps = np.arange(0, patient.by_step.shape[1], _PARTS) + _PARTS / 2
    shades = np.linspace(0.3, 1, len(patient.limits))
    for limit, row, shade in zip(patient.limits, patient.by_step, shades, strict=True):
        words = f"limit {limit:g}" if limit in (patient.limits[0], patient.limits[-1]) else ""
        rates = row.reshape(-1, _PARTS).mean(1)
        right.plot(steps, rates, color=COST, alpha=shade, label=words)
    right.set(title="cost per step", xlabel="step of the episode", ylim=(0, None))
    legend_below(figure, left, middle, right)
    told = ", ".join(f"{x:.0f} under {y:g}" for x, y in zip(patient.paid, patient.limits, strict=True))
    return described(
        figure,
        f"Patient {patient.number}. Left: paid and predicted cost over the limit. It pays {told}. Middle: "
        "its return over its paid cost, with that of the best policies. Right: its cost per step.",
    )


def _predictions(patient: Patient):
    """Draws predicted over paid cost for each situation of a patient that chooses no action."""
    figure, ax = subplots(figsize=(8, 5))
    end = 1.05 * max(patient.paid.max(), patient.predicted.max())
    ax.plot([0, end], [0, end], **DASHED, label="right")
    ax.plot(patient.paid, patient.predicted, "o", color=COST, alpha=0.6, label="a situation")
    ax.set(xlabel="true remaining cost (unsafe steps)", ylabel="predicted", xlim=(0, end), ylim=(0, end))
    legend_below(figure, ax)
    return described(
        figure,
        f"Patient {patient.number}. Predicted over true remaining cost for {len(patient.paid)} situations. "
        f"Truths range from {patient.paid.min():.0f} to {patient.paid.max():.0f}, predictions from "
        f"{patient.predicted.min():.0f} to {patient.predicted.max():.0f}.",
    )


@one_figure
def treatments(before: Patient, after: dict[str, Patient]):
    """Draws paid over limit of a patient, and of the same patient after each repair, {words: patient}.

    Where a repair changes nothing, its marks lie on those of the patient.
    """
    figure, ax = subplots(figsize=(8, 4.8))
    end = 1.08 * max(before.limits.max(), before.paid.max())
    ax.plot([0, end], [0, end], **DASHED, label="limit")
    ax.plot(before.limits, before.paid, "o-", color=COST, markersize=12, label="before")
    looks = ((NEUTRAL, "s", 6), (REWARD, "^", 8), (LIMIT, "x", 8))
    for (words, patient), (colour, marker, size) in zip(after.items(), looks, strict=False):
        ax.plot(patient.limits, patient.paid, marker + "-", color=colour, markersize=size, label=words)
    ax.set(xlabel="limit", ylabel="paid cost (unsafe steps)")
    ax.set(xlim=(0, 1.1 * before.limits.max()), ylim=(0, end))
    legend_below(figure, ax)
    told = "; ".join(
        f"{words}: {', '.join(f'{x:.0f}' for x in patient.paid)}"
        for words, patient in ({"before": before} | after).items()
    )
    return described(figure, f"Paid cost over the limits of patient {before.number}. {told}.")
