"""The study's errors against closed forms; the committed table against its settings and a live run."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
import torch

from tutorial_lib.data.dataset import Dataset
from tutorial_lib.studies import reconstruction as study
from tutorial_lib.tasks import get_task

TASK = get_task("BallRun")
RATE = np.array([0.01 / 0.05, 0.01 / 0.04, 0.01 / 0.03])


@pytest.fixture
def dataset():
    """Two episodes: one that costs nothing, and one whose first 30 steps are unsafe."""
    costs = np.zeros(200, np.float32)
    costs[100:130] = 1
    timeouts = np.arange(200) % 100 == 99
    zeros = np.zeros((200, 7), np.float32)
    return Dataset(zeros, zeros, zeros[:, :2], zeros[:, 0], costs, ~timeouts & False, timeouts)


def test_a_configuration_has_the_size_and_the_noise_asked_for():
    config = study.crm_config("3 x 128", 0.2, 0.01, steps=7)
    found = (config.crm, config.crm_layers, config.crm_width, config.crm_steps)
    assert found == ("mlp", 3, 128, 7) and (config.crm_noise, config.crm_noise_rate) == (0.2, 0.01)
    assert study.crm_config("linear", 0.0).crm == "linear"


def test_the_error_of_a_model_that_answers_nothing_is_the_cost(dataset):
    found = study.errors(lambda x: torch.zeros(len(x)), TASK, dataset, study.crm_config("linear", 0.0))
    assert found["episodes"] == pytest.approx(np.sqrt(30**2 / 2))
    # Totals of random sequences are uniform on 0 to 100: the mean square is 100 * 201 / 6.
    assert found["random"] == pytest.approx(np.sqrt(3350), rel=0.02)


@pytest.mark.parametrize(("noise", "rate"), [(0.1, 0.0), (0.0, 0.01), (0.3, 0.01)])
def test_noise_adds_its_variance_times_the_squared_weights(noise, rate, dataset):
    weights = torch.tensor([30.0, -60.0, 31.0])
    clean, noisy = (
        study.errors(lambda x: x @ weights, TASK, dataset, study.crm_config("linear", *levels))["random"]
        for levels in ((0.0, 0.0), (noise, rate))
    )
    expected = (weights.numpy() ** 2 * (noise**2 + (rate / 0.01 * RATE) ** 2)).sum()
    assert noisy**2 - clean**2 == pytest.approx(expected, rel=0.1)


def test_a_run_writes_what_it_returns(tmp_path):
    chosen = [("BallRun", "1 x 16", 0.1, 0.0, [(0.0, 0.0), (0.1, 0.0)])]
    table = study.run(tmp_path / "table.csv", chosen, steps=3)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "table.csv"), table)
    assert list(table["test_noise"]) == [0.0, 0.1] and set(table["steps"]) == {3}
    assert set(table["parameters"]) == {3 * 16 + 16 + 16 + 1}


def test_the_committed_table_has_a_row_for_every_setting():
    table = pd.read_csv(study.PATH)
    expected = [
        (task, size, noise, rate, *test)
        for task, size, noise, rate, tests in study.settings()
        for test in tests
    ]
    columns = ["task", "size", "noise", "noise_rate", "test_noise", "test_noise_rate"]
    assert list(table[columns].itertuples(index=False, name=None)) == expected
    assert set(table.loc[table["size"] != "linear", "steps"]) == {study.STEPS}
    assert table["parameters"].max() > 1_000_000


def test_the_committed_table_repeats(tmp_path):
    first = next(study.settings())
    live = study.run(tmp_path / "table.csv", [first])
    committed = pd.read_csv(study.PATH).head(len(live))
    errors = ["rmse_random", "rmse_episodes"]
    np.testing.assert_allclose(live[errors], committed[errors], rtol=0.02)


def test_settings_are_small_models_first_and_all_different():
    rows = [dataclasses.astuple(study.crm_config(size, a, b)) for _, size, a, b, _ in study.settings()]
    assert len(set(rows)) == len(rows)
    sizes = [size for _, size, *_ in study.settings()]
    assert sizes == sorted(sizes, key=list(study.SIZES).index)
