"""The site: no warning, no link that leads nowhere, tables that code made are tables, and a way on."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import nbformat
import pytest
from sample_notebook import sample, store_sample_pictures

from tutorial_lib.agents import ALGORITHMS, slug
from tutorial_lib.options import describe
from tutorial_lib.studies.results import load_results

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted(ROOT.glob("notebooks/[0-9]*.ipynb"))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Built as `make course` does, of the notebooks with their stored outputs, and of a sample after them."""
    pages, built = (tmp_path_factory.mktemp(name) for name in ("pages", "site"))
    shutil.copytree(ROOT / "notebooks", pages / "notebooks", ignore=shutil.ignore_patterns(".*"))
    nbformat.write(sample(), pages / "notebooks" / "99_sample.ipynb")
    store_sample_pictures(pages / "pictures" / "99_sample" / "0")
    for folder in ("tutorial_lib", "benchmarks"):
        (pages / folder).symlink_to(ROOT / folder)
    (pages / "data").mkdir()
    for path in (ROOT / "data").iterdir():
        if path.name != "README.md":
            (pages / "data" / path.name).symlink_to(path)
    for path in (ROOT / "data" / "README.md", *ROOT.glob("site/*.md")):
        shutil.copy(path, pages / path.relative_to(ROOT / "site" if path.parent.name == "site" else ROOT))
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", ROOT / "site", pages, built]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return built


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_page_shows_tables_equations_and_the_way_on(site, path):
    page = (site / "notebooks" / f"{path.stem}.html").read_text()
    cells = nbformat.read(path, as_version=4).cells
    outputs = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
    texts = [data["text/markdown"] for data in outputs if "text/markdown" in data]
    texts += [cell.source for cell in cells if cell.cell_type == "markdown"]
    tables = sum(len(re.findall(r"^\|[-| :]+\|$", text, re.MULTILINE)) for text in texts)
    assert page.count("<table") == tables + sum("<table" in data.get("text/html", "") for data in outputs)
    assert 'class="math' in page
    assert 'class="next-page"' in page and 'class="prev-page"' in page


def test_every_link_leads_somewhere(site):
    pages = {page: page.read_text() for page in site.rglob("*.html")}
    assert len(pages) > 50
    for page, text in pages.items():
        for address in re.findall(r'(?:href|src)="([^"#]+)[^"]*"', text):
            if not re.match(r"\w+:", address):
                assert (page.parent / unquote(address.split("?")[0])).exists(), (page.name, address)


def test_the_reference_has_a_line_on_every_module(site):
    page = (site / "reference.html").read_text()
    modules = [path for path in ROOT.glob("tutorial_lib/**/*.py") if path.name != "__main__.py"]
    assert page.split("<table")[1].count("<tr") == len(modules)  # a head, and the package itself is no row


def test_the_list_of_algorithms_has_a_line_on_each(site):
    page = (site / "algorithms.html").read_text()
    assert page.split("<table")[1].count("<tr") == 1 + len(ALGORITHMS)  # the first is the head
    for name in ALGORITHMS:
        assert f'href="algorithms/{slug(name)}.html">{name}</a>' in page


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_algorithm_has_a_page(site, name):
    """The page shows every option, every logged scalar, and the algorithm's row of Table 1."""
    kind, results = ALGORITHMS[name], load_results("table1")
    page = (site / "algorithms" / f"{slug(name)}.html").read_text()
    assert f"<h1>{name}<" in page
    options, scalars = section(page, "Options"), section(page, "What it logs")
    assert first_cells(options)[: len(describe(kind.Config)) - 1] == [
        option for option in describe(kind.Config) if option != "profile"
    ]
    assert first_cells(scalars) == list(kind.scalars)
    tasks = list(results.loc[results["algorithm"] == name, "task"].unique())
    assert first_cells(section(page, "Results")) == tasks
    assert kind.in_table1 or not tasks


def section(page: str, title: str) -> str:
    """The HTML from one heading of second order to the next."""
    return page.split(f"<h2>{title}<")[1].split("<h2>")[0]


def first_cells(html: str) -> list[str]:
    """The text of the first cell of each row of all tables, without their heads."""
    bodies = "".join(re.findall(r"<tbody>(.*?)</tbody>", html, re.DOTALL))
    cells = re.findall(r"<tr[^>]*>\s*<td>(.*?)</td>", bodies, re.DOTALL)
    return [re.sub(r"<[^>]+>", "", cell).strip() for cell in cells]


@pytest.fixture
def sample_page(site, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((site / "notebooks" / "99_sample.html").as_uri())
    page.wait_for_selector("mjx-container", state="attached")
    yield page
    page.close()


def test_an_answer_is_folded_until_it_is_clicked_with_its_formulas(sample_page):
    answer = sample_page.locator("details", has_text="three quarters")
    assert not answer.locator("strong").is_visible() and answer.locator("summary").is_visible()
    answer.locator("summary").click()
    assert answer.locator("strong").inner_text() == "three quarters"
    assert answer.locator("mjx-container").count() == 2
    assert answer.locator("mjx-container").last.is_visible() and answer.locator("li").is_visible()
    assert "$" not in answer.inner_text() and "details" not in sample_page.locator("article").inner_text()


def test_a_solution_is_folded_with_all_that_it_shows(sample_page):
    solution = sample_page.locator("details.hide")
    hidden = [solution.locator("img"), solution.get_by_text("OK a is right"), solution.locator("pre").first]
    assert not any(part.is_visible() for part in hidden)
    assert solution.locator("summary").inner_text().strip() == "Show a solution"
    solution.locator("summary").click()
    assert all(part.is_visible() for part in hidden)
    assert "SOLUTION" not in solution.inner_text()


def test_an_image_has_the_text_that_its_figure_stored(sample_page):
    texts = sample_page.locator("article img").evaluate_all("images => images.map(image => image.alt)")
    assert texts == [
        'A "red" square.',
        "A blue square.",
        "A figure.",
        "A black square.",
        "Two bars: limit 5, start 0.25.",
    ]


@pytest.mark.parametrize("width", [1280, 390])
def test_a_key_moves_a_slider_and_its_picture_without_a_kernel(sample_page, width):
    sample_page.set_viewport_size({"width": width, "height": 900})
    limit, start = sample_page.locator(".moving input").all()
    picture, number = sample_page.locator(".moving img"), sample_page.locator(".moving output")
    first = picture.get_attribute("src")
    for slider, key, text in (
        (limit, "ArrowRight", "limit 10, start 0.25"), (start, "End", "limit 10, start 1"),
        (limit, "Home", "limit 0, start 1"), (start, "ArrowLeft", "limit 0, start 0.75"),
    ):  # fmt: skip
        before = picture.get_attribute("src")
        slider.focus()
        sample_page.keyboard.press(key)
        assert picture.get_attribute("alt") == f"Two bars: {text}." and picture.get_attribute("src") != before
        assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") > 500
    assert number.all_inner_texts() == ["0", "0.75"] and start.get_attribute("aria-valuetext") == "0.75"
    limit.press("ArrowRight")
    start.press("ArrowLeft")
    start.press("ArrowLeft")
    assert picture.get_attribute("src") == first
    assert sample_page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_image_of_a_page_is_without_a_text(site, path):
    page = (site / "notebooks" / f"{path.stem}.html").read_text()
    texts = re.findall(r'<img\b[^>]*?\balt="([^"]*)"', page)
    assert len(texts) == page.count("<img") and all(texts)
    assert not [text for text in texts if text.endswith(".png")]
