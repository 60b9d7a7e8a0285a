"""Thresholds and the budget rule, eq. 23, against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch

from tutorial_lib.costs.conditioning import (
    ConditioningConfig,
    after_step,
    check_limit,
    draw_thresholds,
    encode,
    nearest_threshold,
    rescaled_budget,
    threshold_set,
    told_limit,
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


@pytest.mark.parametrize("limit", [0, 0.5, 30, math.inf])
def test_a_limit_is_any_number_from_zero_on(limit):
    result = check_limit(limit)
    assert result == limit and isinstance(result, float)


@pytest.mark.parametrize("limit", [-1, -1e-9, -math.inf, math.nan])
def test_a_limit_that_is_negative_or_no_number_is_an_error_that_shows_it(limit):
    with pytest.raises(ValueError, match=f"limit on the cost must be zero or more, not {limit}"):
        check_limit(limit)


@pytest.mark.parametrize("zero", [False, True])
def test_thresholds_are_drawn_from_the_whole_set_in_equal_shares(zero):
    config = ConditioningConfig(batch_size=5_000, zero_threshold=zero)
    draws = draw_thresholds(CAR_RUN, config, torch.Generator().manual_seed(0))
    expected = [0.0] * zero + [10, 20, 40, math.inf]
    assert draws.dtype == torch.float32 and sorted(set(draws.tolist())) == expected
    shares = [(draws == threshold).float().mean().item() for threshold in expected]
    assert shares == pytest.approx([1 / len(expected)] * len(expected), abs=0.03)


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


# --- What is told: CarRun's horizon is 200, and a step costs 1 at most ---


def told(limit, spent, t, remaining=False, **options):
    config = ConditioningConfig.make("paper").changed(**options)
    return told_limit(CAR_RUN, config, np.array([limit]), np.array([spent]), t, remaining).tolist()


@pytest.mark.parametrize(
    ("limit", "spent", "t", "expected"),
    [
        (20, 0, 0, 20),  # at the start: the limit itself
        (20, 10, 100, 20),  # on schedule
        (20, 0, 100, 40),  # twice the rate is left
        (20, 20, 100, 10),  # spent: the smallest
        (20, 30, 190, 10),  # overspent
        (20, 9, 199, math.inf),  # 11 are left for one step, which costs 1 at most
        (20, 10, 190, math.inf),  # 10 are left for ten steps
        (20, 10, 189, 40),  # 10 are left for eleven steps: 10 * 200 / 11 is about 182
        (math.inf, 50, 0, math.inf),
        (200, 0, 0, math.inf),  # a limit that no episode can exceed
        (199, 0, 0, 40),
    ],
)
def test_told_limits_by_hand_where_infinity_is_told_once_all_is_covered(limit, spent, t, expected):
    assert told(limit, spent, t) == [expected]


@pytest.mark.parametrize(
    ("rule", "expected"),
    [("covered", [10, 40, math.inf]), ("nearest", [10, math.inf, math.inf])] + [("never", [10, 40, 40])],
)
def test_when_infinity_is_told(rule, expected):
    """Rescaled, the budgets are 10, 60 (infinity's code) and 2000 (the last step's)."""
    given = [told(limit, 0, t, infinite_at_test=rule) for limit, t in ((10, 0), (30, 100), (10, 199))]
    assert given == [[threshold] for threshold in expected]


def test_a_spent_budget_is_told_as_zero_where_the_set_holds_one():
    assert told(20, 20, 100) == [10] and told(20, 20, 100, zero_threshold=True) == [0]
    assert told(20, 25, 100, zero_threshold=True) == [0] and told(20, 18, 100, zero_threshold=True) == [0]
    assert told(20, 17, 100, zero_threshold=True) == [10]  # 3 are left for half of the steps: 6


def test_a_remaining_budget_is_not_rescaled():
    assert told(20, 0, 100, remaining=True) == [20] and told(20, 0, 100) == [40]
    assert told(20, 12, 199, remaining=True) == [math.inf]
    assert told(20, 12, 199, remaining=True, infinite_at_test="never") == [10]


def test_where_all_thresholds_were_trained_on_the_budget_itself_is_told():
    assert told(20, 5, 100, thresholds="range") == [30]
    assert told(20, 5, 100, thresholds="range", remaining=True) == [15]
    assert told(20, 25, 100, thresholds="range") == [0]
    assert told(150, 0, 10, thresholds="range", remaining=True) == [40]  # CarRun's cost range
    assert told(20, 10, 190, thresholds="range") == [math.inf]  # covered


def test_a_margin_is_kept_in_reserve_until_nothing_can_break_the_limit():
    assert told(20, 3, 100, thresholds="range", remaining=True, margin=0.25) == [12]
    assert told(20, 16, 100, thresholds="range", remaining=True, margin=0.25) == [0]
    assert told(20, 5, 100, thresholds="range", margin=0.25) == [20]  # 10 for half of the steps
    assert told(20, 10, 190, thresholds="range", margin=0.25) == [math.inf]  # the limit itself covers all
    assert told(math.inf, 5, 100, thresholds="range", margin=0.25) == [math.inf]


def test_a_threshold_shrinks_by_what_is_paid_and_never_below_zero():
    left = after_step(torch.tensor([3.0, 1.0, 0.0, math.inf]), torch.tensor([1.0, 1.0, 1.0, 1.0]))
    assert left.tolist() == [2, 0, 0, math.inf]


def test_every_episode_is_told_its_own():
    limits, spent = np.array([10.0, 20, 40, math.inf]), np.array([9.0, 0, 20, 3])
    config = ConditioningConfig.make("paper")
    assert told_limit(CAR_RUN, config, limits, spent, 100).tolist() == [10, 40, 40, math.inf]
