"""A small notebook with one of each kind of cell that the site, slides and students' version change."""

import base64
import io
from pathlib import Path

import ipywidgets
from moving import WIDGET
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from PIL import Image

from tutorial_lib.course.pictures import store_pictures
from tutorial_lib.style import described, one_figure, subplots

FIRST = """# 99 · Sample

> **Does it fold?**

After this notebook you will be able to fold.

**Before this:** nothing. **Paper:** none. **Time:** 1 minute to read, 1 second to run."""
ANSWER = """<details>
<summary>Answer</summary>

It is **three quarters**, because $V_c$ is a mean:

$$V_c = \\frac{3}{4}$$

- The common wrong guess is one half.

</details>"""


def picture(colour: str, text: str | None) -> NotebookNode:
    """An output with a square of one colour, and its alternative text where there is one."""
    file = io.BytesIO()
    Image.new("RGB", (60, 60), colour).save(file, "PNG")
    data = {"image/png": base64.b64encode(file.getvalue()).decode(), "text/plain": "<Picture>"}
    return new_output("display_data", data, metadata={"image/png": {"alt": text}} if text else {})


def sample() -> NotebookNode:
    """The notebook, with outputs as if it had been executed."""
    solution = "# SOLUTION\na = 3 / 4\nshow(a)\n# END SOLUTION"
    slider = new_output("display_data", {WIDGET: {}, "text/plain": "(Run the notebook for sliders: limit.)"})
    printed = new_output("stream", name="stdout", text="OK  a is right\n")
    shown = [picture("red", 'A "red" square.'), picture("blue", "A blue square."), picture("green", None)]
    cells = [
        new_markdown_cell(FIRST, metadata={"slideshow": {"slide_type": "slide"}}),
        new_markdown_cell("**Predict.** How large is $V_c$?"),
        new_code_cell("show_all()", outputs=shown, execution_count=1),
        new_markdown_cell(ANSWER, metadata={"tags": ["answer"]}),
        new_code_cell("a = ...", execution_count=2),
        new_code_cell(
            solution,
            outputs=[printed, picture("black", "A black square.")],
            execution_count=3,
            metadata={"tags": ["hide-cell"]},
        ),
        new_code_cell("slider()", outputs=[slider], execution_count=4),
    ]
    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return new_notebook(cells=cells, metadata=kernel)


@one_figure
def draw(limit, start):
    """A bar for each of two numbers."""
    figure, ax = subplots(figsize=(12, 5))
    ax.bar(["limit", "start"], [limit, start])
    return described(figure, f"Two bars: limit {limit}, start {start:g}.")


def store_sample_pictures(folder: Path) -> None:
    """The pictures of the notebook's only control, which has two sliders of three and of five values."""
    limits = ipywidgets.IntSlider(5, 0, 10, 5, description="limit")
    starts = ipywidgets.FloatSlider(0.25, min=0, max=1, step=0.25, description="start")
    store_pictures(draw, {"limit": limits, "start": starts}, folder)
