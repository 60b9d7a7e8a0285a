"""The tables and the figure of speed, and the two pages that show them: README.md and data/README.md."""

from pathlib import Path

from benchmarks import tables
from benchmarks.figure import speed
from tutorial_lib.data.sources import SHIPPED_DATA
from tutorial_lib.files import written_whole
from tutorial_lib.studies.report import ROOT, between_marks, drawn, markdown


def speed_front() -> str:
    """The aims for the speed of training, and what was measured: the table of README.md."""
    updates = tables.load("updates")
    return tables.NOT_RUN if updates is None else markdown(tables.marks(updates))


def speed_text() -> str:
    """Everything that `python -m benchmarks --full` measured, and on which machine, for data/README.md."""
    updates, simulation, machine = (tables.load(name) for name in ("updates", "simulation", "machine"))
    if updates is None or machine is None:
        return tables.NOT_RUN
    made = (tables.yardsticks, tables.by_algorithm, tables.by_precision, tables.by_part, tables.growth)
    parts = [tables.circumstances(machine), "![speed](results/bench/speed.png)"]
    parts += [markdown(table(updates)) for table in made]
    played = "*Rollouts: not measured.*" if simulation is None else markdown(tables.rollouts(simulation))
    return "\n\n".join([*parts, played])


def write_speed() -> Path | None:
    """Draw the figure of speed. Returns its path, or None where nothing was measured."""
    updates = tables.load("updates")
    return None if updates is None else drawn(speed(updates), tables.FOLDER / "speed.png")


def pages() -> dict[Path, str]:
    """The text that both pages should have now, by path."""
    made = {ROOT / "README.md": speed_front, SHIPPED_DATA / "README.md": speed_text}
    return {path: between_marks(path.read_text(), "speed", table()) for path, table in made.items()}


def write() -> list[Path]:
    """Bring the pages and the figure up to date. Returns the files that were written."""
    for path, text in pages().items():
        with written_whole(path) as temporary:
            temporary.write_text(text)
    figure = write_speed()
    return [*pages(), *([figure] if figure else [])]
