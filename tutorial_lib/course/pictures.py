"""The pictures of a control for many values of its sliders, for pages that have no kernel."""

import hashlib
import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ipywidgets
import numpy as np

MOST_VALUES = 12
"""The most values of one slider that have pictures."""
MOST_PICTURES = 60
"""The most pictures of one control."""


def store_pictures(draw: Callable[..., Any], sliders: dict[str, ipywidgets.Widget], folder: Path) -> None:
    """Writes the figures (`Picture`) that `draw` returns to a new folder, as PNG files, and control.json.

    `sliders` maps an argument of `draw` to its slider. control.json has the name, the labels and the first
    position of each slider, and a picture and its alternative text for every combination of their positions.
    The last slider's position changes fastest. Raises FileExistsError if the folder exists.
    """
    folder.mkdir(parents=True)
    shown = dict(zip(sliders, _shown_values(list(sliders.values())), strict=True))
    pictures, texts = [], []
    for values in itertools.product(*shown.values()):
        figure = draw(**dict(zip(shown, values, strict=True)))
        png = figure.small_png()
        name = f"{hashlib.sha256(png).hexdigest()[:16]}.png"
        (folder / name).write_bytes(png)
        pictures.append(name)
        texts.append(figure.alt_text())
    described = [
        {
            "name": slider.description,
            "labels": [f"{value:g}" for value in shown[key]],
            "start": shown[key].index(slider.value),
        }
        for key, slider in sliders.items()
    ]
    control = {"sliders": described, "pictures": pictures, "texts": texts}
    (folder / "control.json").write_text(json.dumps(control), encoding="utf-8")


def _shown_values(sliders: list[ipywidgets.Widget]) -> list[list[Any]]:
    """Returns the values of each slider that have pictures. The widest slider loses values first."""
    everything = [slider_values(slider) for slider in sliders]
    counts = [min(MOST_VALUES, len(values)) for values in everything]
    while math.prod(counts) > MOST_PICTURES:
        counts[counts.index(max(counts))] -= 1
    return [
        spread(values, slider.value, count)
        for values, slider, count in zip(everything, sliders, counts, strict=True)
    ]


def slider_values(slider: ipywidgets.Widget) -> list[Any]:
    """Returns all values that a slider can take. Its own value is among them.

    Raises TypeError for a widget that is no slider for one number.
    """
    if isinstance(slider, ipywidgets.SelectionSlider):
        return list(slider.options)
    if not isinstance(slider, ipywidgets.IntSlider | ipywidgets.FloatSlider):
        raise TypeError(f"pictures of a control need sliders for numbers, not a {type(slider).__name__}")
    steps = math.floor((slider.max - slider.min) / slider.step + 1e-9)
    values = [type(slider.value)(round(slider.min + n * slider.step, 9)) for n in range(steps + 1)]
    values = [value for value in values if not math.isclose(value, slider.value, abs_tol=1e-9)]
    return sorted([*values, slider.value])


def spread(values: list[Any], start: Any, count: int) -> list[Any]:
    """Returns `count` of the sorted `values`, evenly spread over them, with `start` among them."""
    places = np.linspace(0, len(values) - 1, count).round().astype(int)
    first = values.index(start)
    places[np.abs(places - first).argmin()] = first
    return [values[place] for place in places]
