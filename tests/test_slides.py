"""Slides: the notebooks' own text, nothing from the network, and every page fits its screen."""

import re
from html import unescape
from pathlib import Path

import nbformat
import pytest
import slides
from marks import LINES, remove_marks
from sample_notebook import sample, store_sample_pictures

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("notebooks/[0-9]*.ipynb"))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("slides")
    slides.main(NOTEBOOKS[0].parent, folder)
    return folder


def plain(text):
    return re.sub(r"\s", "", unescape(re.sub(r"<[^>]+>", "", text)))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_all_code_is_there_without_its_marks(made, path):
    page = (made / f"{path.stem}.html").read_text()
    text = plain(page.split("<main>")[1])
    assert not LINES.search(page)
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            assert plain(LINES.sub("", cell.source).replace("<", "&lt;")) in text


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_page_asks_for_files_beside_it_only(made, path):
    page = (made / f"{path.stem}.html").read_text()
    wanted = re.findall(r'<(?:script|link|img)\b[^>]*?(?:src|href)="([^"]+)"', page)
    assert len(wanted) >= 5
    for address in wanted:
        assert address.startswith("data:") or (made / address).is_file(), address


def test_the_index_leads_to_all(made):
    links = re.findall(r'<a href="([^"]+)">([^<]+)', (made / "index.html").read_text())
    assert [link for link, _ in links] == [f"{path.stem}.html" for path in NOTEBOOKS]
    assert links[0][1] == "Start here"


def test_links_between_notebooks_lead_to_slides(made):
    for path in NOTEBOOKS:
        page = (made / f"{path.stem}.html").read_text()
        assert ".ipynb" not in "".join(re.findall(r'href="([^"]+)"', page))


def test_marks_go_and_nothing_else():
    source = "# NBVAL_CHECK_OUTPUT\nx = 1  # SOLUTION of the equation\n# END SOLUTION"
    notebook = {"cells": [{"cell_type": kind, "source": source} for kind in ("code", "markdown")]}
    remove_marks(notebook)
    assert notebook["cells"][0]["source"] == "x = 1  # SOLUTION of the equation"
    assert notebook["cells"][1]["source"] == source


PAGES = """() => [...document.querySelectorAll(".slides > section > section")].map(page => ({
    height: page.scrollHeight, width: page.scrollWidth, code: page.querySelectorAll(".code").length,
}))"""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_page_fits_its_screen(made, path, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    asked, wrong = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: wrong.append(error))
    page.goto((made / f"{path.stem}.html").as_uri())
    page.wait_for_selector("body[data-pages]")
    page.add_style_tag(content=".slides section { display: block !important; }")
    pages = page.evaluate(PAGES)
    formulas = page.locator("mjx-container").count()
    page.close()
    assert not wrong and all(url.startswith(("file:", "data:")) for url in asked)
    assert 100 < max(shown["height"] for shown in pages) <= 720
    assert max(shown["width"] for shown in pages) <= 1280
    cells = nbformat.read(path, as_version=4).cells
    assert sum(shown["code"] for shown in pages) == sum(cell.cell_type == "code" for cell in cells)
    assert formulas > 0 and len(pages) >= 10


@pytest.fixture
def sample_page(tmp_path, browser):
    (tmp_path / "notebooks").mkdir()
    nbformat.write(sample(), tmp_path / "notebooks" / "99_sample.ipynb")
    store_sample_pictures(tmp_path / "pictures" / "99_sample" / "0")
    slides.main(tmp_path / "notebooks", tmp_path / "slides")
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    page.goto((tmp_path / "slides" / "99_sample.html").as_uri())
    page.wait_for_selector("body[data-pages]")
    yield page
    page.close()


def test_a_key_moves_a_slider_and_turns_no_page(sample_page):
    sample_page.evaluate("Reveal.slide(0, Reveal.getTotalSlides() - 1)")
    picture = sample_page.locator(".moving img")
    sample_page.evaluate("while (Reveal.availableFragments().next) Reveal.next()")
    slider = sample_page.locator(".moving input").first
    slider.wait_for(state="visible")
    sample_page.wait_for_function("location.hash")  # reveal.js writes it a little later
    sample_page.wait_for_timeout(500)  # it fades in
    before = picture.get_attribute("src"), sample_page.url
    slider.focus()
    sample_page.keyboard.press("ArrowRight")
    assert picture.get_attribute("alt") == "Two bars: limit 10, start 0.25."
    assert picture.get_attribute("src") != before[0] and sample_page.url == before[1]
    assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") > 500


def test_an_answer_and_a_solution_stand_on_pages_of_their_own(sample_page):
    page = sample_page
    pages = page.locator(".slides > section > section")
    texts = pages.evaluate_all("pages => pages.map(page => page.textContent)")
    images = page.locator(".slides img").evaluate_all("images => images.map(image => image.alt)")
    formulas = pages.evaluate_all("pages => pages.map(page => page.querySelectorAll('mjx-container').length)")
    (answer,) = [n for n, text in enumerate(texts) if "three quarters" in text]
    assert texts[answer].strip().startswith("99 · SampleAnswer") and formulas[answer] == 2
    assert not any(code in texts[answer] for code in ("show_all", "a = ..."))
    (solution,) = [n for n, text in enumerate(texts) if "a = 3 / 4" in text]
    assert "a = ..." in texts[solution - 1] and solution - 1 == answer + 1
    assert images[:2] == ['A "red" square.', "A blue square."] and images[3] == "A black square."
