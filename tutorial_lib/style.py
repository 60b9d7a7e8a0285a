"""This module defines the colours and font sizes of the course's figures, and figures with small files.

In every figure, cost is vermilion, reward is blue and a limit is a dashed line. The colours are from the
palette of Okabe and Ito, which colour-blind readers can distinguish.
"""

import base64
import contextlib
import functools
import io
from collections.abc import Iterator
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
from IPython.display import display
from matplotlib.figure import Figure
from PIL import Image

REWARD, COST, LIMIT, NEUTRAL = "#0072B2", "#D55E00", "#222222", "#8A8A8A"
DASHED: dict[str, Any] = {"color": LIMIT, "linestyle": (0, (4, 2)), "linewidth": 2}
STYLE: Any = {
    "font.size": 14,
    "axes.titlesize": 15,
    "axes.labelsize": 14,
    "legend.fontsize": 13,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 2.5,
    "figure.dpi": 80,
    "figure.constrained_layout.use": True,
}


@contextlib.contextmanager
def _course_style() -> Iterator[None]:
    """Uses matplotlib's defaults and `STYLE` in the block, instead of the caller's style.

    The backend stays as it is.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


class Picture(Figure):
    """This is a figure that a notebook stores as a PNG image of 256 colours.

    The image has at most half of the bytes of a full-colour image, and the difference is not visible.
    `described` sets what the figure shows, in words.
    """

    description = ""

    def alt_text(self) -> str:
        """Returns the text that stands in place of the image where it cannot be seen.

        A figure without a description gets one from the titles and labels of its panels.
        """
        panels = [_panel_text(ax) for ax in self.axes if ax.get_visible()]
        return self.description or "Figure. " + " ".join(filter(None, panels))

    def small_png(self) -> bytes:
        """Returns the figure as a PNG image of 256 colours."""
        file, small = io.BytesIO(), io.BytesIO()
        with _course_style():
            self.savefig(file, format="png", bbox_inches="tight")
        image = Image.open(file).convert("RGB").quantize(256, dither=Image.Dither.NONE)
        image.save(small, "PNG", optimize=True)
        return small.getvalue()

    # IPython prefers this method to matplotlib's own display. It would not prefer _repr_png_.
    def _ipython_display_(self):
        """Shows the image of 256 colours in a notebook, which stores the alternative text beside it."""
        data = {"image/png": base64.b64encode(self.small_png()).decode(), "text/plain": repr(self)}
        display(data, metadata={"image/png": {"alt": self.alt_text()}}, raw=True)


def _panel_text(ax) -> str:
    """Returns one sentence from the title, the axis labels and the legend's entries of a panel."""
    title = ax.get_title() or ax.get_title("left") or ax.get_title("right")
    axes = " over ".join(filter(None, (ax.get_ylabel(), ax.get_xlabel())))
    entries = ", ".join(dict.fromkeys(ax.get_legend_handles_labels()[1]))
    words = "; ".join(" ".join(text.split()) for text in (title, axes, entries) if text)
    return f"{words}." if words else ""


def described(figure: Picture, text: str) -> Picture:
    """Sets what a figure shows, in words, as its alternative text, and returns the figure.

    Raises ValueError for an empty text.
    """
    if not text.strip():
        raise ValueError("the description of a figure is empty: say what the figure shows")
    figure.description = " ".join(text.split())
    return figure


def subplots(*args: Any, **options: Any) -> tuple[Picture, Any]:
    """Returns the figure and the axes of matplotlib's `subplots`, where the figure is a `Picture`."""
    figure, axes = plt.subplots(*args, FigureClass=Picture, **options)  # type: ignore[call-overload]
    return figure, axes


def one_figure(draw):
    """Returns a version of `draw` that uses the course's style and closes its figure.

    matplotlib makes the ticks when it renders the figure. The figure is therefore rendered while the style is
    active.
    """

    @functools.wraps(draw)
    def in_style(*args, **options):
        with _course_style():
            figure = draw(*args, **options)
            figure.draw_without_rendering()
        plt.close(figure)
        return figure

    return in_style


def task_panels(tasks, height: float, **options):
    """Returns a figure and its axes, with one panel for each task name and at most four panels in a row."""
    columns = min(4, len(tasks))
    lines = -(-len(tasks) // columns)
    figure, axes = subplots(lines, columns, figsize=(12, height * lines), squeeze=False, **options)
    for ax, name in zip(axes.flat, tasks, strict=False):
        ax.set_title(name)
    for ax in axes.flat[len(tasks) :]:
        ax.set_visible(False)
    return figure, axes


def legend_below(figure, *axes):
    """Draws one legend below the panels. It has one entry for each different label of `axes`."""
    entries = {
        label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    rows = max(1, -(-len(entries) // 5))  # at most five entries stand in a row
    columns = -(-len(entries) // rows)
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns)
