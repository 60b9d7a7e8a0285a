"""Pictures of a control: which values they show, and that each file shows its own values."""

import hashlib
import json

import ipywidgets
import matplotlib
import numpy as np
import pytest
from sample_notebook import draw

from tutorial_lib.course import pictures, widgets


@pytest.mark.parametrize(
    ("slider", "values"),
    [
        (ipywidgets.IntSlider(4, 0, 10, 3), [0, 3, 4, 6, 9]),
        (ipywidgets.FloatSlider(0.7, min=0.5, max=0.9, step=0.1), [0.5, 0.6, 0.7, 0.8, 0.9]),
        (ipywidgets.SelectionSlider(options=[0.9, 0.99, 0.999]), [0.9, 0.99, 0.999]),
    ],
    ids=lambda part: type(part).__name__,
)
def test_a_slider_can_take_these_values(slider, values):
    assert pictures.slider_values(slider) == pytest.approx(values)
    assert slider.value in pictures.slider_values(slider)


def test_a_widget_that_is_no_slider_is_an_error():
    with pytest.raises(TypeError, match="not a Checkbox"):
        pictures.slider_values(ipywidgets.Checkbox())


@pytest.mark.parametrize("start", [0, 1, 37, 80])
def test_values_are_spread_over_all_with_the_first_one(start):
    shown = pictures.spread(list(range(81)), start, 9)
    assert start in shown and shown == sorted(set(shown)) and len(shown) == 9
    assert max(np.diff(shown)) <= 20 and shown[0] <= 1 and shown[-1] == 80


def test_a_control_stores_a_picture_for_each_combination(tmp_path, monkeypatch):
    """No slider and no control has too many; a second control gets a folder of its own."""
    matplotlib.use("Agg")
    assert (pictures.MOST_VALUES, pictures.MOST_PICTURES) == (12, 60)
    monkeypatch.setattr(pictures, "MOST_VALUES", 4)
    monkeypatch.setattr(pictures, "MOST_PICTURES", 9)
    monkeypatch.setenv("C2IQL_PICTURES", str(tmp_path))
    for width in (100, 1):
        limits = ipywidgets.IntSlider(1, 0, width, 1, description="limit")
        starts = ipywidgets.FloatSlider(0.5, min=0, max=1, step=0.125, description="start")
        widgets.Controls(draw, limit=limits, start=starts)
    for number, counts in (("0", (3, 3)), ("1", (2, 4))):
        control = json.loads((tmp_path / number / "control.json").read_text())
        limit, start = control["sliders"]
        assert (limit["name"], start["name"]) == ("limit", "start")
        assert (len(limit["labels"]), len(start["labels"])) == counts
        assert limit["labels"][limit["start"]] == "1" and start["labels"][start["start"]] == "0.5"
        texts = [
            f"Two bars: limit {first}, start {second}."
            for first in limit["labels"]
            for second in start["labels"]
        ]
        assert control["texts"] == texts and len(control["pictures"]) == len(texts)
    last = (tmp_path / "1" / control["pictures"][-1]).read_bytes()
    assert last == draw(1, 1.0).small_png()
    assert control["pictures"][-1].startswith(hashlib.sha256(last).hexdigest()[:16])


def test_a_control_stores_nothing_unasked(tmp_path, monkeypatch):
    monkeypatch.delenv("C2IQL_PICTURES", raising=False)
    monkeypatch.chdir(tmp_path)
    widgets.Controls(draw, limit=ipywidgets.IntSlider(1, 0, 2), start=ipywidgets.IntSlider(1, 0, 2))
    assert not list(tmp_path.iterdir())
