"""Thresholds and the budget rule, eq. 23, against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch

from tutorial_lib.costs.conditioning import (
    check_threshold,
    encode,
    nearest_threshold,
    rescaled_budget,
    threshold_set,
)
from tutorial_lib.tasks import TASKS

CAR_RUN = TASKS["CarRun"]  # thresholds 10, 20, 40; cost range 40: infinity's code stands at 60


def test_threshold_set_is_appendix_b2s():
    assert threshold_set(CAR_RUN).tolist() == [10, 20, 40, math.inf]
    assert threshold_set(TASKS["AntCircle"]).tolist() == [40, 100, 160, math.inf]
    assert threshold_set(CAR_RUN, with_zero=True).tolist() == [0, 10, 20, 40, math.inf]


def test_encode_counts_in_cost_ranges():
    codes = encode([0, 10, 40, math.inf], CAR_RUN)
    assert codes.dtype == torch.float32 and codes.tolist() == [0, 0.25, 1, 1.5]
    assert encode(20, CAR_RUN).shape == () and encode(20, CAR_RUN) == 0.5


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_every_threshold_has_a_code_of_its_own_and_infinity_the_largest(task):
    codes = encode(threshold_set(task), task).numpy()
    assert (np.diff(codes) > 0.1).all() and codes[-1] > 1 >= codes[-2]


@pytest.mark.parametrize("threshold", [0, 0.5, 30, math.inf])
def test_a_threshold_is_any_number_from_zero_on(threshold):
    result = check_threshold(threshold)
    assert result == threshold and isinstance(result, float)


@pytest.mark.parametrize("threshold", [-1, -1e-9, -math.inf, math.nan])
def test_a_threshold_that_is_negative_or_no_number_is_an_error_that_shows_it(threshold):
    with pytest.raises(ValueError, match=f"threshold must be zero or more, not {threshold}"):
        check_threshold(threshold)


# --- Eq. 23: (L - spent) T / (T - t) ---


@pytest.mark.parametrize(
    ("limit", "spent", "t", "horizon", "expected"),
    [
        (30, 0, 0, 200, 30),  # at the start: the limit itself
        (30, 15, 100, 200, 30),  # on schedule, half spent at half time: still the limit
        (30, 0, 100, 200, 60),  # nothing spent at half time: twice the rate
        (30, 5, 199, 200, 5000),  # the last step has all that is left, as if it were paid at every step
        (30, 30, 120, 200, 0),  # just spent
        (30, 40, 150, 200, -40),  # overspent
        (30, 31, 199, 200, -200),
        (0, 0, 10, 200, 0),
        (math.inf, 50, 10, 200, math.inf),
    ],
)
def test_rescaled_budget_by_hand(limit, spent, t, horizon, expected):
    assert rescaled_budget(limit, spent, t, horizon) == expected


def test_rescaled_budget_of_several_episodes():
    budget = rescaled_budget(np.array([10, 20, 40]), np.array([5.0, 20.0, 0.0]), 50, 100)
    np.testing.assert_array_equal(budget, [10, 0, 80])


@pytest.mark.parametrize("t", [-1, 200, 201])
def test_a_step_outside_the_episode_is_an_error(t):
    with pytest.raises(ValueError, match=f"step {t} .* 200 steps"):
        rescaled_budget(30, 0, t, 200)


# --- The nearest threshold ---

BUDGETS = [-1e9, -3, 0, 9, 14.9, 15.1, 29, 31, 49, 51, 1e9, math.inf]


def test_nearest_threshold_is_finite_unless_asked():
    assert nearest_threshold(BUDGETS, CAR_RUN).tolist() == [10] * 5 + [20] * 2 + [40] * 5


def test_nearest_threshold_with_infinity_at_its_code():
    # Halfway between 40 and infinity's 60 lies 50.
    nearest = nearest_threshold(BUDGETS, CAR_RUN, with_infinite=True)
    assert nearest.tolist() == [10] * 5 + [20] * 2 + [40] * 2 + [math.inf] * 3


def test_nearest_threshold_with_zero_below_half_of_the_smallest():
    nearest = nearest_threshold([-1e9, 0, 4.9, 5.1, 14.9, 15.1, 1e9], CAR_RUN, with_zero=True)
    assert nearest.tolist() == [0] * 3 + [10] * 2 + [20, 40]


def test_nearest_threshold_keeps_the_shape():
    assert nearest_threshold(12, CAR_RUN).shape == () and nearest_threshold(12, CAR_RUN) == 10
    assert nearest_threshold(np.full((2, 3), 35.0), CAR_RUN).tolist() == [[40] * 3] * 2


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_limit_of_the_set_stays_itself_while_it_is_spent_on_schedule(task):
    for limit in task.thresholds:
        for t in range(task.horizon):
            budget = rescaled_budget(limit, limit * t / task.horizon, t, task.horizon)
            assert nearest_threshold(budget, task) == limit
