"""Tables in the pages: they say what the files say."""

import numpy as np
import pandas as pd
import pytest

from tutorial_lib import report
from tutorial_lib.datasets import load_dataset
from tutorial_lib.tasks import get_task


def test_the_pages_are_up_to_date():
    for path, text in report.pages().items():
        assert path.read_text() == text, f"{path} is out of date: run `c2iql report`"


def test_every_shipped_dataset_stays_within_dsrls_bounds_and_size():
    for name in report.shipped_tasks():
        task, data = get_task(name), load_dataset(name)
        assert data.episode_costs.max() <= task.cost_range
        assert data.episode_returns.max() <= task.max_return * (1 + 1e-6)
        assert (report.SHIPPED_DATA / f"{name}.hdf5").stat().st_size <= 20e6


def test_every_shipped_dataset_reaches_nine_tenths_of_dsrls_frontier():
    for name, points in report.DSRL_FRONTIER.items():
        data = load_dataset(name)
        for cost, dsrl in points.items():
            best = max(r for r, c in zip(data.episode_returns, data.episode_costs, strict=True) if c <= cost)
            assert best >= 0.9 * dsrl, (name, cost)


def test_results_table_by_hand(tmp_path):
    same = {"task": "CarRun", "algorithm": "C2IQL", "profile": "small"}
    rows = [
        same | {"seed": seed, "threshold": limit, "return": r, "cost": c}
        for limit, r, c in ((10, 204.2873, 5), (20, 574.6533, 20), (40, 574.6533, 0))
        for seed in (0, 1)
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "results.csv", index=False)
    table = report.results_table(tmp_path / "results.csv")
    line = table.splitlines()[2]
    assert "0.00 [0.00, 0.00] / 0.50 [0.50, 0.50]" in line and "1.00 [1.00, 1.00] / 1.00 [1.00, 1.00]" in line
    assert f"{np.mean([0, 1, 1]):.2f} / {np.mean([0.5, 1, 0]):.2f}" in line and "0.95 / 0.08" in line


def test_between_marks_replaces_only_what_is_between():
    page = "a\n<!-- t:begin -->\nold\n<!-- t:end -->\nb"
    assert report.between_marks(page, "t", "new") == "a\n<!-- t:begin -->\nnew\n<!-- t:end -->\nb"
    with pytest.raises(ValueError, match="no marks"):
        report.between_marks(page, "other", "new")
