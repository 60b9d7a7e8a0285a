"""Sphinx's configuration of the site: the executed notebooks, and pages made from docstrings."""

import hashlib
import importlib
import json
import pkgutil
import re
import shutil
import sys
from binascii import a2b_base64
from pathlib import Path

from docutils import nodes
from markdown_it import MarkdownIt
from sphinx.application import Sphinx
from sphinx.util import logging

import tutorial_lib

sys.path.insert(0, str(Path(__file__).parent))
import algorithms  # noqa: E402
import landing  # noqa: E402
from marks import remove_marks  # noqa: E402
from moving import replace_widgets  # noqa: E402

project = "Safe offline reinforcement learning with C2IQL"
html_title = project
copyright = "2026, the C2IQL tutorial authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx-mathjax-offline"]
exclude_patterns = ["tutorial_lib", "benchmarks", "data/second"]

nb_execution_mode = "off"  # the Makefile has executed the notebooks
nb_output_stderr = "remove"
nb_merge_streams = True
nb_render_markdown_format = "myst"  # the default, plain CommonMark, has no tables
nb_code_prompt_show = "Show a solution"  # only solutions are folded
nb_code_prompt_hide = "Hide it"
nb_ipywidgets_js = {}  # widgets need a running kernel, and their scripts need the network
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3  # pages have links to their own sections
autodoc_member_order = "bysource"
add_module_names = False  # the page's title has the module's name

DESCRIPTIONS: dict[str, str] = {}  # of the images in notebooks: by the SHA-256 hash of a PNG file, its text
LARGEST_SITE = 80_000_000  # bytes

html_theme = "furo"
html_css_files, html_js_files = ["style.css"], ["moving.js"]
html_static_path = html_css_files + html_js_files
html_copy_source = False


def setup(app: Sphinx) -> None:
    """Connect this file's functions to Sphinx's events."""
    app.connect("builder-inited", write_reference_pages)
    app.connect("source-read", finish_page)
    app.connect("doctree-read", describe_images)
    app.connect("build-finished", copy_pictures)
    app.connect("autodoc-process-docstring", read_docstring_as_markdown)


def write_reference_pages(app: Sphinx) -> None:
    """Write the pages of the algorithms, one page per module, and the list of the modules.

    The modules are found automatically. Their order is alphabetical.
    """
    modules = pkgutil.walk_packages(tutorial_lib.__path__, "tutorial_lib.")
    algorithms.write(Path(app.srcdir))
    names = sorted(module.name for module in modules if not module.name.endswith("__main__"))
    folder = Path(app.srcdir, "reference")
    folder.mkdir(exist_ok=True)
    for name in names:
        page = f"# {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n```\n"
        (folder / f"{name}.md").write_text(page)
    rows = [f"| [{name}](reference/{name}.md) | {first_paragraph(name)} |" for name in names]
    table = "\n".join(["| module | what it holds |", "|---|---|", *rows])
    entries = "\n".join(f"reference/{name}" for name in names)
    words = "From the docstrings, a page per module. (B,) and the like are shapes: one value per transition."
    toctree = f"```{{toctree}}\n:hidden:\n\n{entries}\n```\n"
    Path(app.srcdir, "reference.md").write_text(f"# Reference\n\n{words}\n\n{table}\n\n{toctree}")


def first_paragraph(module: str) -> str:
    """The first paragraph of a module's docstring, as the text of one cell of a table."""
    text = importlib.import_module(module).__doc__.split("\n\n")[0]
    return " ".join(text.split()).replace("|", r"\|")


def finish_page(app: Sphinx, docname: str, source: list[str]) -> None:
    """Change the text of a page, `source[0]`, before Sphinx reads it.

    Notebooks lose the comments for machines. Their sliders become pictures that move. What their images show
    is kept for `describe_images`. The first page gets its moving picture, its results and its contents.
    """
    if docname.startswith("notebooks/"):
        notebook = json.loads(source[0])
        remove_marks(notebook)
        name = docname.removeprefix("notebooks/")
        replace_widgets(notebook, Path(app.srcdir, "pictures", name), f"../pictures/{name}")
        for cell in notebook["cells"]:
            for output in cell.get("outputs", []):
                data = output.get("data", {})
                if "image/png" in data:
                    stem = hashlib.sha256(a2b_base64("".join(data["image/png"]))).hexdigest()
                    DESCRIPTIONS[stem] = output["metadata"].get("image/png", {}).get("alt", "A figure.")
        source[0] = json.dumps(notebook)
    if docname == "index":
        pictures = Path(app.srcdir, "pictures", "landing")
        source[0] = source[0].replace("TEASER", landing.teaser(pictures, "pictures/landing"))
        source[0] = source[0].replace("RESULTS", landing.results())
        source[0] = source[0].replace("CONTENTS", contents(Path(app.srcdir)))


def describe_images(app: Sphinx, doctree: nodes.document) -> None:
    """Give the images of a notebook the alternative texts that their outputs have in the notebook.

    myst-nb leaves these texts out, and names each image's file after the image's hash.
    """
    for image in doctree.findall(nodes.image):
        text = DESCRIPTIONS.get(Path(image["uri"]).stem)
        if text:
            image["alt"] = text


def copy_pictures(app: Sphinx, exception: Exception | None) -> None:
    """Copy the pictures of all controls to the site. Warns of a site that has grown too large."""
    pictures = Path(app.srcdir, "pictures")
    if exception or not pictures.is_dir():
        return
    shutil.copytree(pictures, Path(app.outdir, "pictures"), dirs_exist_ok=True)
    files = (path for path in Path(app.outdir).rglob("*") if not path.is_relative_to(app.doctreedir))
    size = sum(path.stat().st_size for path in files if path.is_file())
    if size > LARGEST_SITE:
        logging.getLogger(__name__).warning("the site has %d bytes, more than %d", size, LARGEST_SITE)


def contents(folder: Path) -> str:
    """A table of the notebooks in Markdown: title, question and time, read from the first cell of each."""
    rows = ["| notebook | question | time |", "|---|---|---|"]
    for path in sorted(folder.glob("notebooks/[0-9]*.ipynb")):
        text = "".join(json.loads(path.read_text())["cells"][0]["source"])
        title = re.search(r"^# (.+)", text)[1]
        question = " ".join(re.findall(r"^> (.+)", text, re.MULTILINE)).strip("*")
        time = " ".join(re.search(r"\*\*Time:\*\*(.+)", text, re.DOTALL)[1].split()).rstrip(".")
        rows.append(f"| [{title}](notebooks/{path.name}) | {question} | {time} |")
    return "\n".join(rows)


def read_docstring_as_markdown(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Replace the lines of a docstring by HTML: docstrings are Markdown, which Sphinx does not read."""
    html = MarkdownIt().render("\n".join(lines))
    lines[:] = [".. raw:: html", "", *("   " + line for line in html.splitlines()), ""]
