"""Makes lectures to speak from, for a browser, of the plain texts in site/decks and the executed notebooks.

A text begins with `# Title` and a line `Notebooks: 00, 01.`. Slides follow, each after a line `---`.
A slide is

- `## A statement, which is the slide's title.`
- either a line `figure: 05 figures.falling_cost(`, or a displayed formula between two `$$`;
- at most three short sentences;
- a line `???`, and after it the notes for the speaker.

`figure: NN CODE` takes the image below the only cell of notebook NN whose code contains CODE. A number that a
notebook has measured is quoted: `{05 "limit 50: * steps can be rejected, # can be accepted"}` stands for the
number at the `#` in the notebook's printed outputs and alternative texts. `*` is any text within the line. A
format may follow, `{05 "..." .0f}`. So a slide shows nothing that no notebook has shown.
"""

import base64
import html
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import nbformat
from nbconvert.filters import markdown2html

FIGURE = re.compile(r"^figure: (\d\d) (.+)$", re.MULTILINE)
FORMULA = re.compile(r"^\$\$.+?\$\$$", re.MULTILINE | re.DOTALL)
QUOTED = re.compile(r'\{(\d\d) "([^"]+)"(?: (,?\.\d[f%]))?\}')
NUMBER = r"(-?\d+(?:,\d{3})*(?:\.\d+)?)"


class LectureError(ValueError):
    """A text that is no lecture, or one that asks for what no notebook shows."""


@dataclass(frozen=True)
class Slide:
    """One slide, as it is written: `figure` is (notebook's number, code), or None beside a formula."""

    title: str
    figure: tuple[str, str] | None
    body: str
    notes: str


@dataclass(frozen=True)
class Lecture:
    """A whole text."""

    title: str
    notebooks: tuple[str, ...]
    slides: tuple[Slide, ...]


@dataclass(frozen=True)
class Image:
    """A PNG file in base64, what it shows in words, and its size in pixels."""

    data: str
    alt: str
    width: int
    height: int


def read(path: Path) -> Lecture:
    """Returns the lecture that a text holds. Raises LectureError, with the number of the slide."""
    head, *parts = re.split(r"^---\n", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = re.fullmatch(r"# (.+)\n+Notebooks: ([\d, ]+)\.\n+", head)
    if not found or not parts:
        raise LectureError(f"{path.name}: a title, 'Notebooks: 00, 01.' and slides after '---' are expected")
    slides = [_slide(part, f"{path.name}, slide {number}") for number, part in enumerate(parts, 1)]
    return Lecture(found[1], tuple(found[2].split(", ")), tuple(slides))


def _slide(text: str, place: str) -> Slide:
    """Returns the slide of one part of a text. Raises LectureError."""
    shown, mark, notes = text.partition("\n???\n")
    title = re.match(r"\s*## (.+)\n", shown)
    if not title or not mark or not notes.strip():
        raise LectureError(f"{place}: '## A title.' and notes after '???' are expected")
    body = shown[title.end() :]
    figures = FIGURE.findall(body)
    if len(figures) + len(FORMULA.findall(body)) != 1:
        raise LectureError(f"{place}: exactly one 'figure: NN CODE' or one $$formula$$ is expected")
    return Slide(title[1], figures[0] if figures else None, FIGURE.sub("", body).strip(), notes.strip())


class Stored:
    """What the executed notebooks in a folder show: images, and printed numbers."""

    def __init__(self, folder: Path):
        """`folder` has the notebooks, whose names begin with two digits."""
        self.folder = folder

    @cached_property
    def notebooks(self) -> dict[str, nbformat.NotebookNode]:
        """The notebooks, by their numbers."""
        paths = sorted(self.folder.glob("[0-9][0-9]_*.ipynb"))
        return {path.name[:2]: nbformat.read(path, as_version=4) for path in paths}

    def _cells(self, number: str) -> list[nbformat.NotebookNode]:
        """The code cells of a notebook. Raises LectureError if there is no such notebook."""
        if number not in self.notebooks:
            raise LectureError(f"there is no notebook {number} in {self.folder}")
        return [cell for cell in self.notebooks[number].cells if cell.cell_type == "code"]

    def image(self, number: str, code: str) -> Image:
        """Returns the image of the only cell of a notebook that contains `code`. Raises LectureError."""
        found = []
        for cell in self._cells(number):
            if code in cell.source:
                found += [part for part in cell.outputs if "image/png" in part.get("data", {})]
        if len(found) != 1:
            raise LectureError(f"{len(found)} images, and not one, belong to {code!r} in notebook {number}")
        data = found[0].data["image/png"].replace("\n", "")
        width, height = struct.unpack(">II", base64.b64decode(data)[16:24])  # where a PNG has its size
        alt = found[0].metadata.get("image/png", {}).get("alt", "")
        if not alt:
            raise LectureError(f"the image of {code!r} in notebook {number} has no alternative text")
        return Image(data, alt, width, height)

    def lines(self, number: str) -> Iterator[str]:
        """Yields the lines that a notebook printed, and the alternative texts of its images."""
        for cell in self._cells(number):
            for output in cell.outputs:
                yield from output.get("text", "").splitlines()
                shown = output.get("data", {})
                yield from shown.get("text/markdown", shown.get("text/plain", "")).splitlines()
                yield output.get("metadata", {}).get("image/png", {}).get("alt", "")

    def value(self, number: str, pattern: str) -> str:
        """Returns the number at the `#` of a pattern, as printed. Raises LectureError unless it is clear."""
        if pattern.count("#") != 1:
            raise LectureError(f"one # is expected in {pattern!r}")
        expression = re.escape(pattern).replace(r"\#", NUMBER).replace(r"\*", ".*?")
        expression = re.sub(r"(?:\\ )+", r"\\s+", expression)
        found = {match[1] for line in self.lines(number) for match in re.finditer(expression, line)}
        if len(found) != 1:
            raise LectureError(
                f"notebook {number} says {sorted(found)} for {pattern!r}: one number is needed"
            )
        return found.pop()

    def filled(self, text: str) -> str:
        """Returns a text in which quotations are replaced by the numbers of the notebooks."""

        def replace(match: re.Match) -> str:
            value = self.value(match[1], match[2])
            return format(float(value.replace(",", "")), match[3]) if match[3] else value

        done = QUOTED.sub(replace, text)
        if left := re.search(r'\{\d\d "[^}]*\}', done):
            raise LectureError(f'{left[0]} is no quotation: {{05 "text with one #" .0f}} is expected')
        return done


def page(lecture: Lecture, stored: Stored, template: str) -> str:
    """Returns the HTML page of a lecture. Raises LectureError, with the number of the slide."""
    sections = []
    for number, slide in enumerate(lecture.slides, 1):
        try:
            sections.append(_section(lecture, slide, stored))
        except LectureError as error:
            raise LectureError(f"{lecture.title}, slide {number}: {error}") from error
    return template.replace("TITLE", html.escape(lecture.title)).replace("SLIDES", "\n".join(sections))


def _section(lecture: Lecture, slide: Slide, stored: Stored) -> str:
    """Returns the HTML of one slide. A picture that is not much wider than tall stands beside the words."""
    shape, figure = "formula", ""
    if slide.figure:
        image = stored.image(*slide.figure)
        ratio = image.width / image.height
        shape = "tall" if ratio < 1 else "side" if ratio < 1.75 else "wide"
        figure = f'<img src="data:image/png;base64,{image.data}" alt="{html.escape(image.alt)}">'
    title = re.sub(r"</?p>", "", _html(slide.title, stored)).strip()
    return (
        f'<section>\n<p class="running">{html.escape(lecture.title)}</p>\n<h2>{title}</h2>\n'
        f'<div class="shown {shape}">{figure}\n<div class="words">{_html(slide.body, stored)}</div></div>\n'
        f'<aside class="notes">{_html(slide.notes, stored)}</aside>\n</section>'
    )


def _html(text: str, stored: Stored) -> str:
    """Returns Markdown as HTML, with the notebooks' numbers in the place of quotations."""
    return markdown2html(stored.filled(text))


def write(decks: Path, notebooks: Path, target: Path, template: Path) -> dict[str, str]:
    """Writes a page for each text in `decks` to the folder `target`. Returns the titles by the pages' names.

    `notebooks` has the executed notebooks. Raises LectureError where a text asks for what they do not show.
    """
    stored, titles = Stored(notebooks), {}
    for path in sorted(decks.glob("lecture-*.md")):
        lecture = read(path)
        made = page(lecture, stored, template.read_text(encoding="utf-8"))
        (target / path.with_suffix(".html").name).write_text(made, encoding="utf-8")
        titles[path.with_suffix(".html").name] = lecture.title
    return titles
