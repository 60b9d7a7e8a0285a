"""Options: profiles, and values that mean nothing."""

import dataclasses

import pytest

from tutorial_lib.agents import ALGORITHMS, C2IQL, BCAll
from tutorial_lib.config import PROFILES


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("time_limits", "masked", "is 'masked', and must be one of rate, bootstrap, mask"),
        ("crm", "Linear", "is 'Linear', and must be one of mlp, linear"),
        ("crm_width", 0, "is 0, and must be 1 or more where crm is not 'linear'"),
        ("batch_size", 1, "is 1, and must be 2 or more"),
        ("updates", 2.5, "is 2.5, and must be of type int"),
        ("updates", True, "is True, and must be of type int"),
        ("hidden_width", None, "is None, and must be of type int"),
        ("gamma", "0.9", "is '0.9', and must be of type float"),
        ("gamma", float("nan"), "is nan, and must be between 0 and 1"),
        ("recorded_step", 1, "is 1, and must be of type bool"),
        ("cost_kappa", 1.0, "is 1.0, and must be between 0 and 1"),
        ("unsafe_price", -1, "is -1, and must be 0 or more"),
        ("target_tau", 0.0, "is 0.0, and must be above 0 and at most 1"),
    ],
)
def test_an_option_that_means_nothing_is_refused(option, value, words):
    with pytest.raises(ValueError, match=f"^{option} {words}"):
        C2IQL.configure(**{option: value})


@pytest.mark.parametrize(
    ("option", "value"), [("cost_kappa", None), ("unsafe_price", None), ("target_tau", 1), ("crm_layers", 0)]
)
def test_a_value_at_its_bound_is_taken(option, value):
    assert getattr(C2IQL.configure(**{option: value}), option) == value


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("kind", ALGORITHMS.values(), ids=ALGORITHMS)
def test_changes_come_last_and_leave_all_else(kind, profile):
    config = kind.configure(profile)
    assert type(config) is kind.Config and config.profile == profile
    changed = kind.configure(profile, updates=7, policy_lr=0.5)
    assert (changed.updates, changed.policy_lr) == (7, 0.5)
    assert dataclasses.replace(changed, updates=config.updates, policy_lr=config.policy_lr) == config
    if profile == "paper":
        assert config == kind.Config()


def test_the_printed_profile_is_what_the_paper_prints_at_the_sizes_of_small():
    printed, small, paper = (C2IQL.configure(profile) for profile in ("printed", "small", "paper"))
    sizes = {
        "updates",
        "batch_size",
        "hidden_width",
        "policy_lr",
        "target_tau",
        "crm_width",
        "crm_layers",
        "crm_steps",
    }
    for name in sizes:
        assert getattr(printed, name) == getattr(small, name)
    assert (printed.kappa_1, printed.kappa_2, printed.gamma, printed.critic_lr) == (
        0.7,
        0.9,
        0.99,
        1e-3,
    )  # Table 4
    silent = {
        "time_limits": "bootstrap",
        "reward_time_limits": "bootstrap",
        "cost_critics": 1,
        "first_guess": "zero",
    }
    silent |= {"thresholds_per": "batch", "infinite_at_test": "never", "normalise_observations": False}
    differs = {
        field.name
        for field in dataclasses.fields(printed)
        if getattr(printed, field.name) != getattr(paper, field.name)
    }
    assert differs == sizes | silent.keys() | {"profile"}
    assert {name: getattr(printed, name) for name in silent} == silent
    assert (printed.unsafe_price, printed.crm_noise, printed.zero_threshold) == (None, 0.1, False)


def test_what_an_algorithm_does_not_read_is_refused():
    with pytest.raises(ValueError, match="option kappa_1.*: the options are profile, updates, batch_size"):
        BCAll.configure(kappa_1=0.5)
    with pytest.raises(ValueError, match="option.* kappa, width"):
        C2IQL.configure().changed(kappa=0.5, width=3, gamma=0.9)


def test_an_unknown_profile_is_refused_and_the_known_ones_are_listed():
    with pytest.raises(ValueError, match="unknown profile 'huge': the profiles are paper, small, printed"):
        C2IQL.configure("huge")


def test_options_that_fit_together_are_changed_together():
    config = C2IQL.configure(crm="linear", crm_width=0)
    assert (config.crm, config.crm_width) == ("linear", 0)
    with pytest.raises(ValueError, match="crm_width is 0"):
        config.changed(crm="mlp")
