"""The site: no warning, no link that leads nowhere, tables that code made are tables, and a way on."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import nbformat
import pandas as pd
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


@pytest.fixture
def first_page(site, browser):
    """The site's first page for a visitor who has asked for less motion: nothing moves by itself."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, reduced_motion="reduce")
    page = context.new_page()
    page.goto((site / "index.html").as_uri())
    yield page
    context.close()


@pytest.mark.parametrize("width", [1280, 390])
def test_a_visitor_names_a_limit_and_watches_the_robot_by_keyboard_alone(first_page, width):
    page = first_page
    page.set_viewport_size({"width": width, "height": 900})
    limit, step = page.locator(".moving input").all()
    picture, words, button = (page.locator(f".moving {part}") for part in ("img", ".words", "button"))
    shown = []
    for _ in range(3):
        step.focus()
        page.keyboard.press("End")
        assert picture.get_attribute("alt") == words.inner_text()
        assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") > 300
        shown.append([int(number) for number in re.findall(r"\d+", words.inner_text())])
        limit.focus()
        page.keyboard.press("ArrowRight")
    assert [named for named, _, _ in shown] == [10, 30, 70]
    assert all(paid <= named for named, _, paid in shown) and shown[0][2] < shown[2][2]
    button.focus()
    assert button.inner_text() == "Play"
    page.keyboard.press("Enter")
    assert button.inner_text() == "Pause"
    page.wait_for_function("document.querySelectorAll('.moving input')[1].valueAsNumber >= 3")
    page.keyboard.press("Enter")
    assert button.inner_text() == "Play"
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_first_page_moves_by_itself_where_motion_is_welcome(site, browser):
    context = browser.new_context(reduced_motion="no-preference")
    page = context.new_page()
    page.goto((site / "index.html").as_uri())
    page.wait_for_function("document.querySelectorAll('.moving input')[1].valueAsNumber >= 2")
    context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_button_can_be_read_in_light_and_in_dark(site, browser, scheme):
    context = browser.new_context(color_scheme=scheme, reduced_motion="reduce")
    page = context.new_page()
    page.goto((site / "index.html").as_uri())
    colours = page.locator(".moving button").evaluate(
        "button => [getComputedStyle(button).color, getComputedStyle(button).backgroundColor]"
    )
    context.close()
    light = [_luminance(*map(float, re.findall(r"[\d.]+", colour)[:3])) for colour in colours]
    assert (max(light) + 0.05) / (min(light) + 0.05) >= 4.5
    assert (light[0] > light[1]) == (scheme == "dark")


def _luminance(*channels: float) -> float:
    """The relative luminance of a colour (red, green, blue, 0 to 255), by WCAG 2.1."""
    linear = [
        c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in (x / 255 for x in channels)
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_the_first_page_shows_the_results_of_the_file(site):
    page = (site / "index.html").read_text()
    raw = pd.read_csv(ROOT / "data" / "results" / "table1.csv")
    ours = raw[raw["algorithm"] == "C2IQL"]
    rows = dict(re.findall(r"<tr[^>]*>\s*<td><p>(\w+)</p></td>\s*<td><p>([-\d./ ]+)</p></td>", page))
    assert list(rows) == list(ours["task"].unique())
    for task, part in ours.groupby("task"):
        cost = (part["cost"] / part["threshold"]).groupby([part["seed"], part["threshold"]]).mean().mean()
        assert float(rows[task].split(" / ")[1]) == pytest.approx(cost, abs=0.006)


def test_the_first_page_has_commands_licence_citation_source_and_what_is_known_of_other_code(site):
    page = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", (site / "index.html").read_text()))
    for words in ("make lab", "c2iql train BallCircle", "MIT licence", "Machine Learning Research 267"):
        assert words in page
    assert "no public code of the paper’s authors, and of no other public implementation" in page


@pytest.mark.parametrize(("name", "folded"), [("problems", 19), ("exam", 8), ("guide", 7)])
def test_what_is_folded_in_the_pages_for_lecturers_opens_with_its_formulas(site, browser, name, folded):
    page = browser.new_page(viewport={"width": 390, "height": 900})
    page.goto((site / f"{name}.html").as_uri())
    details = page.locator("article details")
    assert details.count() == folded
    assert not any(part.is_visible() for part in page.locator("article details > :not(summary)").all())
    page.evaluate("document.querySelectorAll('article details').forEach(part => { part.open = true; })")
    text = page.locator("article").inner_text()
    assert "$" not in text and "details" not in text and page.locator("mjx-merror").count() == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.close()
