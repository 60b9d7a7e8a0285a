"""Replaces the sliders of an executed notebook, which need a kernel, by pictures that were made before.

A notebook that is executed with the environment variable C2IQL_PICTURES writes the pictures of its controls,
in their order, to the folders 0, 1, ... of the folder that the variable names. moving.js moves them.
"""

import html
import json
from pathlib import Path
from typing import Any

WIDGET = "application/vnd.jupyter.widget-view+json"


def replace_widgets(notebook: Any, pictures: Path, address: str) -> None:
    """Replaces the widgets of a notebook (nbformat's object or plain JSON) by pictures, in place.

    `address` is that of folder `pictures`, from the page. Where there are no pictures, the widget's text is
    left, which says that the notebook must be run.
    """
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    found = [
        output["data"] for cell in cells for output in cell["outputs"] if WIDGET in output.get("data", {})
    ]
    for number, data in enumerate(found):
        del data[WIDGET]
        path = pictures / str(number) / "control.json"
        if path.is_file():
            data["text/html"] = control_html(json.loads(path.read_text("utf-8")), f"{address}/{number}")


def control_html(control: dict, address: str, before: str = "", after: str = "") -> str:
    """The HTML of one control: a range input for each slider, and the first picture.

    `before` and `after` are more HTML, before and after the picture.
    """
    inputs, place = [], 0
    for slider in control["sliders"]:
        labels, start = slider["labels"], slider["start"]
        place = place * len(labels) + start
        inputs.append(
            f"<label>{html.escape(slider['name'])} "
            f'<input type="range" min="0" max="{len(labels) - 1}" step="1" value="{start}"'
            f' aria-valuetext="{labels[start]}" autocomplete="off">'
            f" <output>{labels[start]}</output></label>"
        )
    picture, text = control["pictures"][place], html.escape(control["texts"][place])
    data = json.dumps(control).replace("<", "\\u003c")
    return (
        f'<div class="moving" data-address="{address}">{"".join(inputs)}{before}'
        f'<img src="{address}/{picture}" alt="{text}">{after}'
        f'<script type="application/json">{data}</script></div>'
    )
