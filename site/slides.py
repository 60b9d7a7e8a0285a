"""`python site/slides.py FROM TO`: lecture slides of the notebooks in one folder, made in another.

nbconvert makes the page of each notebook; `lecture/pages.js` then cuts it, in the browser, into pages that
fit a screen. reveal.js and MathJax come from installed packages and lie beside the slides: no network is
needed.
"""

import html
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import nbformat
from marks import remove_marks
from nbconvert import SlidesExporter
from nbconvert.preprocessors import CoalesceStreamsPreprocessor

HERE = Path(__file__).parent / "lecture"
SCRIPTS = {  # from a package's folder to the slides' own
    "sphinx_revealjs": {
        "_static/revealjs/dist/reveal.js": "dist/reveal.js",
        "_static/revealjs/dist/reveal.css": "dist/reveal.css",
        "_static/revealjs/LICENSE": "dist/LICENSE",
    },
    "sphinx-mathjax-offline": {"static/mathjax/tex-svg-full.js": "mathjax.js"},
}


def exporter() -> SlidesExporter:
    made = SlidesExporter(template_name="lecture", extra_template_basedirs=[str(HERE.parent)])
    made.exclude_input_prompt = made.exclude_output_prompt = made.exclude_anchor_links = True
    made.register_preprocessor(CoalesceStreamsPreprocessor, enabled=True)
    made.reveal_url_prefix, made.reveal_theme = "scripts", "course"
    return made


def convert(path: Path) -> str:
    """The slides of one notebook, as HTML."""
    notebook = nbformat.read(path, as_version=4)
    remove_marks(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = cell.source.replace(".ipynb)", ".html)")
        for output in cell.get("outputs", []):  # no slider moves here: leave its words
            output.get("data", {}).pop("application/vnd.jupyter.widget-view+json", None)
    page, _ = exporter().from_notebook_node(notebook, {"metadata": {"name": title_of(notebook)}})
    return page


def title_of(notebook) -> str:
    return notebook.cells[0].source.splitlines()[0].removeprefix("# ")


def index(titles: dict[str, str]) -> str:
    """A page that leads to all slides; `titles` by file name."""
    entries = [f'<li><a href="{name}">{html.escape(title)}</a></li>' for name, title in titles.items()]
    return (HERE / "contents.html").read_text().replace("ENTRIES", "\n".join(entries))


def copy_scripts(target: Path) -> None:
    (target / "dist" / "theme").mkdir(parents=True, exist_ok=True)
    for package, files in SCRIPTS.items():
        folder = Path(find_spec(package).origin).parent
        for source, name in files.items():
            shutil.copyfile(folder / source, target / name)
    shutil.copyfile(HERE / "pages.js", target / "pages.js")
    shutil.copyfile(HERE / "course.css", target / "dist" / "theme" / "course.css")


def main(source: Path, target: Path) -> None:
    copy_scripts(target / "scripts")
    titles = {}
    for path in sorted(source.glob("[0-9]*.ipynb")):
        name = path.with_suffix(".html").name
        (target / name).write_text(convert(path), encoding="utf-8")
        titles[name] = title_of(nbformat.read(path, as_version=4))
    (target / "index.html").write_text(index(titles), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
