"""Weights, bounds and steady costs against loops, closed forms and greedy fillings."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from tutorial_lib.costs.reconstruction import CostReconstruction, ReconstructionConfig
from tutorial_lib.course import undiscounting
from tutorial_lib.tasks import TASKS, get_task

TASK = dataclasses.replace(TASKS["BallRun"], horizon=12, gammas=(0.7, 0.8, 0.9))


@pytest.mark.parametrize("name", TASKS)
def test_no_nearby_weights_are_flatter(name):
    task = get_task(name)

    def unevenness(weights):
        total = 0.0
        for t in range(task.horizon):
            total += (sum(w * g**t for w, g in zip(weights, task.gammas, strict=True)) - 1) ** 2
        return total

    weights = undiscounting.flat_weights(task.gammas, task.horizon)
    best = unevenness(weights)
    for i, step in itertools.product(range(len(weights)), (-0.05, 0.05)):
        assert unevenness(weights + step * (np.arange(len(weights)) == i)) > best


def test_one_head_has_a_closed_form_and_as_many_heads_as_steps_are_exact():
    powers = [0.9**t for t in range(10)]
    weight = sum(powers) / sum(p * p for p in powers)
    assert undiscounting.flat_weights([0.9], 10) == pytest.approx([weight])
    weights = undiscounting.flat_weights([0.3, 0.6, 0.9], 3)
    assert [sum(weights * np.array([0.3, 0.6, 0.9]) ** t) for t in range(3)] == pytest.approx([1, 1, 1])


def test_the_weight_curve_is_its_loop():
    curve = undiscounting.weight_curve([2.0, -1.0], [0.5, 0.9], 6)
    assert curve == pytest.approx([2 * 0.5**t - 0.9**t for t in range(6)])


def test_linear_weights_are_the_models_slopes():
    model = CostReconstruction(TASK, ReconstructionConfig(crm="linear"))
    model.mean.copy_(torch.tensor([1.0, 2.0, 3.0]))
    model.whiten.copy_(torch.tensor([[1.0, 2.0, 0.0], [0.0, 3.0, 1.0], [0.5, 0.0, 4.0]]))
    with torch.no_grad():
        slopes = [(model(2 * row) - model(0 * row)).item() / 2 for row in torch.eye(3)]
    assert undiscounting.linear_weights(model) == pytest.approx(slopes, rel=1e-4)
    with pytest.raises(ValueError, match="linear"):
        small = ReconstructionConfig(crm_width=4, crm_layers=1)
        undiscounting.linear_weights(CostReconstruction(TASK, small))


def test_steady_heads_are_sums_over_the_steps_that_each_treatment_sees():
    def loop(steps):
        return [sum(g**t * 6 / 12 for t in range(steps)) for g in TASK.gammas]

    assert undiscounting.steady_heads(TASK, 6, "rate") == pytest.approx(loop(12))
    assert undiscounting.steady_heads(TASK, 6, "rate", step=5) == pytest.approx(loop(12))
    assert undiscounting.steady_heads(TASK, 6, "bootstrap") == pytest.approx(loop(1000))
    for step in (0, 5, 11):
        assert undiscounting.steady_heads(TASK, 6, "mask", step) == pytest.approx(loop(12 - step))
    with pytest.raises(ValueError, match="'clip'.*bootstrap, rate, mask"):
        undiscounting.steady_heads(TASK, 6, "clip")


# --- What the heads leave open ---


@pytest.mark.parametrize("discounted", [0.0, 0.4, 2.5, 5.0])
def test_with_one_head_the_bounds_fill_the_steps_from_either_end(discounted):
    """Early steps count most: the least cost fills them first, the largest fills the last ones first."""

    def fill(steps):
        left, total = discounted, 0.0
        for t in steps:
            here = min(1.0, left / 0.9**t)
            left, total = left - here * 0.9**t, total + here
        return total

    found = undiscounting.cost_bounds([discounted], [0.9], 12)
    assert found == pytest.approx((fill(range(12)), fill(reversed(range(12)))), abs=1e-6)


def test_the_truth_lies_within_bounds_that_shrink_with_each_head_to_the_truth():
    rng = np.random.default_rng(0)
    gammas = np.array([0.5, 0.7, 0.8, 0.9])
    for _ in range(5):
        costs = rng.random(4)
        sums = np.array([sum(g**t * costs[t] for t in range(4)) for g in gammas])
        widths = []
        for m in range(1, 5):
            low, high = undiscounting.cost_bounds(sums[:m], gammas[:m], 4)
            assert low - 1e-5 <= costs.sum() <= high + 1e-5
            widths.append(high - low)
        assert all(np.diff(widths) < 1e-5) and widths[0] > 0.1 and widths[-1] < 1e-4


def test_heads_that_no_sequence_has_have_no_bounds():
    assert np.isnan(undiscounting.cost_bounds([-0.1], [0.9], 12)).all()
    assert np.isnan(undiscounting.cost_bounds([7.3], [0.9], 12)).all()  # 12 unsafe steps: 7.18
    assert np.isnan(
        undiscounting.cost_bounds([3.0, 2.0], [0.8, 0.9], 12)
    ).all()  # the longer memory sees more
    assert np.isfinite(undiscounting.cost_bounds([2.0, 3.0], [0.8, 0.9], 12)).all()


def test_what_one_head_can_be_is_where_the_bounds_of_the_cost_end():
    sums = undiscounting.steady_heads(TASK, 6)
    low, high = undiscounting.head_bounds(sums, 1, TASK.gammas, 12)
    assert low < sums[1] < high
    for value, possible in ((low - 1e-3, 0), (low + 1e-3, 1), (high - 1e-3, 1), (high + 1e-3, 0)):
        moved = np.array([sums[0], value, sums[2]])
        assert np.isfinite(undiscounting.cost_bounds(moved, TASK.gammas, 12)).all() == possible


def test_extremal_costs_have_the_heads_and_switch_between_0_and_1_at_most_m_times():
    """A curve 1 - sum_i w_i gamma_i^t has at most m zeros, and each switch is at one of them."""
    gammas = np.array([0.7, 0.8, 0.9])
    for m in (1, 2, 3):
        heads = [sum(g**t * 0.4 for t in range(12)) for g in gammas[:m]]
        for costs, last in zip(undiscounting.extremal_costs(heads, gammas[:m], 12), (0, 1), strict=True):
            assert [sum(costs * g ** np.arange(12)) for g in gammas[:m]] == pytest.approx(heads, abs=1e-6)
            assert costs.min() > -1e-9 and costs.max() < 1 + 1e-9
            between = (costs > 1e-6) & (costs < 1 - 1e-6)
            assert between.sum() <= m
            assert np.abs(np.diff(costs[~between].round())).sum() <= m
            assert costs[-1] == pytest.approx(last, abs=1e-6) or between[-1]


def test_no_sequence_no_extremal_costs():
    least, most = undiscounting.extremal_costs([7.3], [0.9], 12)
    assert least.shape == most.shape == (12,) and np.isnan([least, most]).all()
