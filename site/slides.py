"""`python site/slides.py FROM TO` makes slides from the executed notebooks in folder FROM, in folder TO.

There are two kinds. The lectures are written in `decks/`, and take figures and numbers from the notebooks
(see lectures.py). For live use, nbconvert makes one HTML page of each notebook, and in the browser,
`lecture/pages.js` divides it into pages that fit the screen. reveal.js and MathJax are copied from installed
packages to the slides, so that no network is needed.
"""

import html
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import lectures
import nbformat
from marks import remove_marks
from moving import replace_widgets
from nbconvert import SlidesExporter
from nbconvert.preprocessors import CoalesceStreamsPreprocessor

HERE = Path(__file__).parent / "lecture"
DECKS = Path(__file__).parent / "decks"
SCRIPTS = {  # by package: the path of a file in the package's folder, and its path among the slides
    "sphinx_revealjs": {
        "_static/revealjs/dist/reveal.js": "dist/reveal.js",
        "_static/revealjs/dist/reveal.css": "dist/reveal.css",
        "_static/revealjs/plugin/notes/notes.js": "dist/notes.js",
        "_static/revealjs/LICENSE": "dist/LICENSE",
    },
    "sphinx-mathjax-offline": {"static/mathjax/tex-svg-full.js": "mathjax.js"},
}


def exporter() -> SlidesExporter:
    """nbconvert's exporter of slides, with the course's template and theme."""
    made = SlidesExporter(template_name="lecture", extra_template_basedirs=[str(HERE.parent)])
    made.exclude_input_prompt = made.exclude_output_prompt = made.exclude_anchor_links = True
    made.register_preprocessor(CoalesceStreamsPreprocessor, enabled=True)
    made.reveal_url_prefix, made.reveal_theme = "scripts", "course"
    return made


def convert(path: Path) -> str:
    """The slides of one notebook, as HTML. Pictures of controls are in a folder beside the notebook's."""
    notebook = nbformat.read(path, as_version=4)
    remove_marks(notebook)
    replace_widgets(notebook, path.parent.parent / "pictures" / path.stem, f"pictures/{path.stem}")
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = cell.source.replace(".ipynb)", ".html)")
    page, _ = exporter().from_notebook_node(notebook, {"metadata": {"name": title_of(notebook)}})
    return page


def title_of(notebook: nbformat.NotebookNode) -> str:
    """The title of a notebook: the first line of its first cell."""
    return notebook.cells[0].source.splitlines()[0].removeprefix("# ")


def index(titles: dict[str, str], talks: dict[str, str]) -> str:
    """The HTML page with links to all slides. Both arguments have the title of each file by its name."""
    entry = '<li><a{kind} href="{name}">{title}</a></li>'
    live = [entry.format(kind="", name=name, title=html.escape(title)) for name, title in titles.items()]
    decks = [
        entry.format(kind=' class="deck"', name=name, title=html.escape(title))
        for name, title in talks.items()
    ]
    text = (HERE / "contents.html").read_text(encoding="utf-8")
    return text.replace("ENTRIES", "\n".join(live)).replace("LECTURES", "\n".join(decks))


def copy_scripts(target: Path) -> None:
    """Copy all scripts and style sheets of the slides into the folder `target`."""
    (target / "dist" / "theme").mkdir(parents=True, exist_ok=True)
    for package, files in SCRIPTS.items():
        folder = Path(find_spec(package).origin).parent
        for source, name in files.items():
            shutil.copyfile(folder / source, target / name)
    for name in ("pages.js", "deck.js"):
        shutil.copyfile(HERE / name, target / name)
    shutil.copyfile(HERE.parent / "moving.js", target / "moving.js")
    shutil.copyfile(HERE / "course.css", target / "dist" / "theme" / "course.css")


def main(source: Path, target: Path, decks: Path | None = None) -> None:
    """Write the slides of all notebooks in `source`, their scripts, and a page of contents to `target`.

    `decks` is the folder with the texts of lectures. They need all notebooks that they take figures from.
    """
    copy_scripts(target / "scripts")
    if (source.parent / "pictures").is_dir():
        shutil.copytree(source.parent / "pictures", target / "pictures", dirs_exist_ok=True)
    titles = {}
    for path in sorted(source.glob("[0-9]*.ipynb")):
        name = path.with_suffix(".html").name
        (target / name).write_text(convert(path), encoding="utf-8")
        titles[name] = title_of(nbformat.read(path, as_version=4))
    talks = lectures.write(decks, source, target, HERE / "deck.html") if decks else {}
    (target / "index.html").write_text(index(titles, talks), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), DECKS)
