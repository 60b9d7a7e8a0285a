"""The course's site: the executed notebooks, and a page on the library made from its docstrings."""

import pkgutil
from pathlib import Path

from markdown_it import MarkdownIt

import tutorial_lib

project = "Safe offline reinforcement learning with C2IQL"
html_title = project
copyright = "2026, the C2IQL tutorial authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx-mathjax-offline"]
exclude_patterns = ["data", "tutorial_lib"]

nb_execution_mode = "off"  # the Makefile has executed them
nb_output_stderr = "remove"
nb_ipywidgets_js = {}  # widgets need a running kernel, and their scripts the network
myst_enable_extensions = ["dollarmath", "amsmath"]
autodoc_member_order = "bysource"

html_theme = "furo"
html_static_path = html_css_files = ["style.css"]
html_copy_source = False


def setup(app):
    app.connect("builder-inited", write_reference_page)
    app.connect("autodoc-process-docstring", read_docstring_as_markdown)


def write_reference_page(app):
    """One section per module, in the order of the alphabet: a new module needs no line here."""
    modules = pkgutil.walk_packages(tutorial_lib.__path__, "tutorial_lib.")
    sections = [
        f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n```\n"
        for name in sorted(module.name for module in modules if not module.name.endswith("__main__"))
    ]
    Path(app.srcdir, "reference.md").write_text("\n".join(["# Reference", *sections]))


def read_docstring_as_markdown(app, what, name, obj, options, lines):
    """The docstrings are plain prose with `code` in it, which is Markdown and no reStructuredText."""
    html = MarkdownIt().render("\n".join(lines))
    lines[:] = [".. raw:: html", "", *("   " + line for line in html.splitlines()), ""]
