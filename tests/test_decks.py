"""The lectures: their form, their figures and numbers, and that a browser shows them whole and offline."""

import re
from pathlib import Path

import lectures
import nbformat
import pytest
import slides
from nbformat.v4 import new_code_cell, new_notebook, new_output
from sample_notebook import picture

ROOT = Path(__file__).parents[1]
DECKS = sorted((ROOT / "site" / "decks").glob("*.md"))
STORED = lectures.Stored(ROOT / "notebooks")
IDS = [path.stem for path in DECKS]
VERBS = set(
    """is are was were be do does has have can may must needs need keeps keep follows follow earns pays takes
    tell form promises multiplies makes make pass learns averages approaches decides picks judges depends
    misses determine gets bring magnify trains train removes matters err moves give asks agree separate shows
    gives turns corrects works forgets ranks stand predict measures saves breaks break lead leaves copies
    """.split()
)  # words of titles that are verbs there, and hardly ever nouns


def slides_of(path):
    """Each slide's number with the slide, for messages."""
    return list(enumerate(lectures.read(path).slides, 1))


def sentences(text):
    """The sentences of a text without its formulas."""
    plain = re.sub(r"\$\$.*?\$\$|\$[^$]*\$", "x", text, flags=re.DOTALL)
    plain = re.sub(r"\b(eqs?|fig)\. ", r"\1 ", lectures.QUOTED.sub("1", plain), flags=re.IGNORECASE)
    return [part for part in re.split(r"(?<=[.?!])\s+", plain.replace("\nx\n", "\n").strip()) if part != "x"]


def test_there_are_six_lectures_for_all_notebooks():
    assert IDS == [f"lecture-{number}" for number in range(1, 7)]
    named = {number for path in DECKS for number in lectures.read(path).notebooks}
    assert {f"{n:02}" for n in (*range(10), 11, 13, 14)} <= named


@pytest.mark.parametrize("path", DECKS, ids=IDS)
def test_a_lecture_has_twelve_to_fifteen_slides_whose_titles_are_statements(path):
    assert 12 <= len(slides_of(path)) <= 15
    for number, slide in slides_of(path):
        words = set(re.findall(r"[a-z]+", slide.title.lower()))
        assert slide.title.endswith(".") and words & VERBS, f"slide {number}: {slide.title}"
        assert len(sentences(slide.title)) == 1 and len(slide.title) < 100


@pytest.mark.parametrize("path", DECKS, ids=IDS)
def test_a_slide_has_few_words(path):
    for number, slide in slides_of(path):
        said = sentences(lectures.FORMULA.sub("", slide.body))
        assert 1 <= len(said) <= 3, (number, said)
        assert all(len(sentence.split()) <= 28 for sentence in said), (number, said)


@pytest.mark.parametrize("path", DECKS, ids=IDS)
def test_notes_say_what_to_say_what_to_draw_and_what_students_get_wrong(path):
    for number, slide in slides_of(path):
        parts = re.split(r"^\*\*(Say|Draw|Wrong)\.\*\* ", slide.notes, flags=re.MULTILINE)
        assert parts[1::2] == ["Say", "Draw", "Wrong"], number
        assert all(len(part.split()) >= 5 for part in parts[2::2]), number


@pytest.mark.parametrize("path", DECKS, ids=IDS)
def test_a_figure_is_an_image_of_an_executed_notebook_of_this_lecture(path):
    lecture = lectures.read(path)
    for slide in lecture.slides:
        if slide.figure:
            assert slide.figure[0] in lecture.notebooks
            assert STORED.image(*slide.figure).alt
    used = [slide.figure for slide in lecture.slides if slide.figure]
    assert len(set(used)) == len(used) >= 8


@pytest.mark.parametrize("path", DECKS, ids=IDS)
def test_no_measured_number_is_typed_in_and_no_code_is_shown(path):
    """A decimal or a percentage in a slide's sentences is a quotation. Settings are formulas."""
    for number, slide in slides_of(path):
        plain = re.sub(r"\$[^$]*\$", "", lectures.QUOTED.sub("", lectures.FORMULA.sub("", slide.body)))
        assert not re.findall(r"\d\.\d+|\d%", plain), (number, plain)
        assert not re.search(r"\bimport\b|```|configure\(", slide.body)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lectures")
    slides.copy_scripts(folder / "scripts")
    titles = lectures.write(slides.DECKS, ROOT / "notebooks", folder, slides.HERE / "deck.html")
    (folder / "index.html").write_text(slides.index({}, titles))
    return folder


@pytest.mark.parametrize("path", DECKS, ids=IDS)
def test_a_page_asks_for_files_beside_it_only_and_quotes_every_number(built, path):
    text = (built / f"{path.stem}.html").read_text()
    wanted = re.findall(r'<(?:script|link|img)\b[^>]*?(?:src|href)="([^"]+)"', text)
    assert len(wanted) >= 6
    assert all(address.startswith("data:") or (built / address).is_file() for address in wanted)
    assert not re.search(r'\{\d\d "', text) and text.count("<section>") == len(slides_of(path))
    assert text.count('<aside class="notes">') == len(slides_of(path))


def test_the_index_leads_to_all_lectures(built):
    found = re.findall(r'<a class="deck" href="([^"]+)">([^<]+)', (built / "index.html").read_text())
    assert [name for name, _ in found] == [f"{name}.html" for name in IDS]
    assert all(title.startswith(f"Lecture {n}: ") for n, (_, title) in enumerate(found, 1))


SHOWN = """() => [...document.querySelectorAll(".slides > section")].map(page => {
    const { left, top } = page.getBoundingClientRect(), scale = Reveal.getScale();
    const parts = [...page.querySelectorAll(":scope > :not(.notes), .words > *, .shown img, svg")];
    const boxes = parts.map(part => part.getBoundingClientRect());
    return {
        height: Math.max(...boxes.map(box => box.bottom - top)) / scale,
        width: Math.max(...boxes.map(box => box.right - left)) / scale,
        formulas: page.querySelectorAll("mjx-container").length,
        wrong: page.querySelectorAll("mjx-merror, [data-mml-node=merror]").length,
        words: [...page.querySelectorAll(":scope > :not(.notes)")].map(part => part.innerText).join(" "),
        image: page.querySelector("img")?.getBoundingClientRect().height ?? null,
    };
})"""


@pytest.mark.parametrize("path", DECKS, ids=IDS)
def test_every_slide_fits_its_screen_and_sets_its_formulas_without_a_network(built, path, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    asked, wrong = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: wrong.append(error))
    page.goto((built / f"{path.stem}.html").as_uri())
    page.wait_for_selector("body[data-pages]")
    page.add_style_tag(content=".slides section { display: block !important; }")
    shown = page.evaluate(SHOWN)
    page.close()
    assert not wrong and all(url.startswith(("file:", "data:")) for url in asked)
    assert len(shown) == len(slides_of(path))
    for (number, slide), seen in zip(slides_of(path), shown, strict=True):
        assert seen["height"] <= 720 and seen["width"] <= 1280, number
        assert "$" not in seen["words"] and not seen["wrong"], (number, seen["words"])
        assert seen["image"] is None or seen["image"] > 200, number
        assert (seen["image"] is None) == (slide.figure is None)
        assert slide.figure or seen["formulas"] > 0


def test_a_key_shows_the_notes(built, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    page.goto((built / f"{IDS[0]}.html").as_uri())
    page.wait_for_selector("body[data-pages]")
    notes = page.locator(".speaker-notes")
    assert not notes.is_visible()
    page.keyboard.press("n")
    assert notes.is_visible() and "number line" in notes.inner_text()
    picture, beside = page.locator(".present img").bounding_box(), notes.bounding_box()
    assert picture["x"] >= 0 and picture["x"] + picture["width"] <= beside["x"]
    page.close()


@pytest.fixture
def small(tmp_path):
    """One notebook with two images and two printed lines."""
    printed = new_output(
        "stream", name="stdout", text="share: found 0.25, expected 1,000\nshare of b: found 3\n"
    )
    cells = [
        new_code_cell("figures.one()", outputs=[picture("red", "A square, 60 wide.")], execution_count=1),
        new_code_cell("figures.two()", outputs=[picture("blue", None)], execution_count=2),
        new_code_cell("figures.three()\nfigures.one(2)", outputs=[printed], execution_count=3),
    ]
    nbformat.write(new_notebook(cells=cells), tmp_path / "42_small.ipynb")
    return lectures.Stored(tmp_path)


def test_a_figure_is_found_by_its_code(small):
    image = small.image("42", "figures.one(")
    assert (image.alt, image.width, image.height) == ("A square, 60 wide.", 60, 60)


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [
        ("42", "figures.four(", "0 images"),
        ("42", "figures.", "2 images"),
        ("42", "figures.two(", "no alternative text"),
        ("41", "figures.one(", "no notebook 41"),
    ],
)
def test_a_figure_that_is_not_found_is_named(small, number, code, words):
    with pytest.raises(lectures.LectureError, match=words):
        small.image(number, code)


def test_a_number_is_quoted_from_what_a_notebook_printed(small):
    text = (
        '{42 "share: found #"} {42 "share: * expected #" ,.0f} {42 "share: found #" .0%} {42 "square, # w"}'
    )
    assert small.filled(text) == "0.25 1,000 25% 60"


@pytest.mark.parametrize("pattern", ["share of c: found #", "found #", "share", "# and #"])
def test_a_number_that_is_not_clear_is_refused(small, pattern):
    with pytest.raises(lectures.LectureError):
        small.value("42", pattern)


def test_a_quotation_with_a_slip_is_refused(small):
    with pytest.raises(lectures.LectureError, match="is no quotation"):
        small.filled('{42 "share: found #" }')


HEAD = "# Lecture 1: One\n\nNotebooks: 42.\n\n---\n\n"


@pytest.mark.parametrize(
    "text",
    [
        "# Lecture 1: One\n",
        HEAD + "No title.\n\n$$x$$\n\n???\n\nSay it.\n",
        HEAD + "## It is.\n\nfigure: 42 figures.one(\n\nWords.\n",
        HEAD + "## It is.\n\nWords.\n\n???\n\nSay it.\n",
        HEAD + "## It is.\n\n$$x$$\n\nfigure: 42 figures.one(\n\n???\n\nSay it.\n",
    ],
)
def test_a_text_that_is_no_lecture_is_refused(tmp_path, text):
    path = tmp_path / "lecture-1.md"
    path.write_text(text)
    with pytest.raises(lectures.LectureError):
        lectures.read(path)


def test_a_missing_figure_stops_the_build_and_names_the_slide(tmp_path, small):
    (tmp_path / "lecture-1.md").write_text(
        HEAD + "## It is.\n\nfigure: 42 figures.nine(\n\nWords.\n\n???\n\nSay.\n"
    )
    with pytest.raises(lectures.LectureError, match=r"Lecture 1: One, slide 1: 0 images.*figures.nine"):
        lectures.write(tmp_path, tmp_path, tmp_path, slides.HERE / "deck.html")
