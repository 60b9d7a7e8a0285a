"""The course's style: colours, type sizes, and figures that a notebook stores small.

Everywhere cost is vermilion, reward blue and a limit a dashed line (Okabe and Ito's colours, which
colour-blind readers tell apart).
"""

import base64
import functools
import io
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
from IPython.display import display
from matplotlib.figure import Figure
from PIL import Image

REWARD, COST, LIMIT, NEUTRAL = "#0072B2", "#D55E00", "#222222", "#8A8A8A"
DASHED = {"color": LIMIT, "linestyle": (0, (4, 2)), "linewidth": 2}
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


class Picture(Figure):
    """A figure that a notebook stores in 256 colours: half of the bytes or less, and no difference to see."""

    def small_png(self) -> bytes:
        """The picture in 256 colours."""
        file, small = io.BytesIO(), io.BytesIO()
        self.savefig(file, format="png", bbox_inches="tight")
        image = Image.open(file).convert("RGB").quantize(256, dither=Image.Dither.NONE)
        image.save(small, "PNG", optimize=True)
        return small.getvalue()

    def _ipython_display_(self):  # comes before matplotlib's own way, which _repr_png_ would not
        png = base64.b64encode(self.small_png()).decode()
        display({"image/png": png, "text/plain": repr(self)}, raw=True)


def subplots(*args: Any, **options: Any) -> tuple[Picture, Any]:
    """matplotlib's `subplots`, whose figure is a `Picture`: the figure and its axes."""
    figure, axes = plt.subplots(*args, FigureClass=Picture, **options)  # type: ignore[call-overload]
    return figure, axes


def one_figure(draw):
    """In the course's style, whatever the caller's; ticks are made when drawn, so drawing belongs inside."""

    @functools.wraps(draw)
    def in_style(*args, **options):
        with matplotlib.rc_context(STYLE):
            figure = draw(*args, **options)
            figure.draw_without_rendering()
        plt.close(figure)
        return figure

    return in_style


def task_panels(tasks, height: float, **options):
    """One panel per task name, four in a row; empty places stay empty."""
    columns = min(4, len(tasks))
    lines = -(-len(tasks) // columns)
    figure, axes = subplots(lines, columns, figsize=(12, height * lines), squeeze=False, **options)
    for ax, name in zip(axes.flat, tasks, strict=False):
        ax.set_title(name)
    for ax in axes.flat[len(tasks) :]:
        ax.set_visible(False)
    return figure, axes


def legend_below(figure, *axes):
    entries = {
        label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    columns = len(entries) if len(entries) <= 5 else -(-len(entries) // 2)
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns)
