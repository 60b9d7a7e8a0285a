"""What nbval cannot see: that it compares anything at all, and that a notebook is complete and clean.

nbval passes over a cell without an execution count even where it is marked, and a cell tagged
raises-exception that raises nothing: both are ruled out here.
"""

import dataclasses
import re
from pathlib import Path
from pkgutil import resolve_name

import nbformat
import pandas as pd
import pytest
from marks import is_answer, remove_marks

from tutorial_lib.agents import ALGORITHMS
from tutorial_lib.studies import report, results

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("notebooks/[0-9]*.ipynb"))


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def _code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def _outputs(notebook):
    return [output for cell in _code(notebook) for output in cell.outputs]


def test_is_valid_and_runs_on_the_kernel_that_everyone_has(notebook):
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"


def test_was_executed_once_from_top_to_bottom(notebook):
    code = _code(notebook)
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "run `make notebooks`"


def test_has_a_checked_cell(notebook):
    """And every checked cell has an output to check."""
    checked = [cell for cell in _code(notebook) if "# NBVAL_CHECK_OUTPUT" in cell.source]
    assert checked and all(cell.outputs for cell in checked)


def test_stores_no_error_and_no_stderr(notebook):
    assert not [output for output in _outputs(notebook) if output.output_type == "error"]
    assert not [output for output in _outputs(notebook) if output.get("name") == "stderr"]
    assert not [cell for cell in _code(notebook) if "raises-exception" in cell.metadata.get("tags", [])]


def test_stores_no_trace_of_the_machine(notebook):
    assert set(notebook.metadata) == {"kernelspec"}, "run `make notebooks`"
    assert not [cell for cell in notebook.cells if "execution" in cell.metadata]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_is_small(path):
    assert path.stat().st_size < 500_000


GRADE = re.compile(r"^\*Grade: (check|derive|research)\. Objectives?: ([\d, and]+)\.\*$", re.MULTILINE)
ANSWER = re.compile(r"<details>\n<summary>Answer</summary>\n\n.+\n\n</details>", re.DOTALL)


@pytest.fixture
def lesson(notebook):
    """A notebook of the second edition; skips one of the first, which has no answers."""
    if not any(is_answer(cell) for cell in notebook.cells):
        pytest.skip("first edition: no cell is tagged 'answer'")
    return notebook


def _prose(notebook):
    return "\n\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")


def test_every_objective_is_met_by_an_exercise(lesson):
    objectives = re.findall(r"^(\d+)\. ", lesson.cells[0].source, re.MULTILINE)
    met = [number for _, named in GRADE.findall(_prose(lesson)) for number in re.findall(r"\d+", named)]
    assert objectives == [str(n + 1) for n in range(len(objectives))] and len(objectives) >= 2
    assert set(met) == set(objectives)


def test_every_exercise_has_a_grade_and_one_is_open_ended(lesson):
    headings = re.findall(r"^## Exercise (\d+): .+\n(?:\n)?(.*)$", _prose(lesson), re.MULTILINE)
    assert [int(number) for number, _ in headings] == list(range(1, len(headings) + 1))
    grades = [GRADE.fullmatch(line) for _, line in headings]
    assert all(grades), "under an exercise's heading: *Grade: check. Objective: 2.*"
    assert "research" in [grade[1] for grade in grades]


def test_every_prediction_is_answered_before_the_next(lesson):
    """`open_since` is the cell with a question that no answer has followed yet."""
    open_since = None
    for number, cell in enumerate(lesson.cells):
        if is_answer(cell):
            open_since = None
        elif cell.cell_type == "markdown":
            for _ in re.findall(r"^\*\*Predict\.\*\*", cell.source, re.MULTILINE):
                assert open_since is None, f"cell {open_since} asks and is not answered before cell {number}"
                open_since = number
    assert open_since is None, f"cell {open_since} asks and is not answered"


def test_answers_can_be_folded(lesson):
    for cell in lesson.cells:
        if is_answer(cell):
            assert ANSWER.fullmatch(cell.source.rstrip()), cell.source[:80]
        else:
            assert "<details" not in cell.source


def test_a_measured_value_or_a_claim_is_checked(lesson):
    checked = [cell for cell in _code(lesson) if "# NBVAL_CHECK_OUTPUT" in cell.source]
    printed = "".join(output.get("text", "") for cell in checked for output in cell.outputs)
    claims = any("checks.check_that(" in cell.source for cell in checked)
    assert claims or re.search(r"^OK  .*: found ", printed, re.MULTILINE)


def test_leads_on_to_further_reading(lesson):
    reading = re.split(r"^#+ Further reading.*$", _prose(lesson), flags=re.MULTILINE)
    assert len(reading) == 2, "one heading '## Further reading'"
    assert len(set(re.findall(r"\]\((https?://[^)]+)\)", reading[1]))) >= 2


def test_code_can_be_read_at_a_glance(lesson):
    remove_marks(lesson)
    long = {cell.source.count("\n") + 1: cell.source for cell in _code(lesson)}
    assert max(long) <= 25, long[max(long)]


def test_every_figure_says_what_it_shows(lesson):
    figures = [output for output in _outputs(lesson) if "image/png" in output.get("data", {})]
    texts = [output.metadata.get("image/png", {}).get("alt", "") for output in figures]
    assert texts and all(len(text.split()) >= 3 for text in texts), "use style.described(figure, ...)"


def test_shows_the_map_of_the_method_and_the_time_it_takes(lesson):
    assert any("figures.method_map(" in cell.source for cell in _code(lesson))
    assert re.search(r"\*\*Time:\*\*[^.]*minutes?", lesson.cells[0].source)


def _read(start):
    (path,) = (path for path in NOTEBOOKS if path.name.startswith(start))
    return nbformat.read(path, as_version=4)


def test_links_to_files_lead_somewhere(notebook):
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    for address in re.findall(r"\]\(([^)#:]+)[^):]*\)", text):
        assert (NOTEBOOKS[0].parent / address).is_file(), address


def test_the_symbols_are_names_of_the_library():
    """Every name in the second column of notebook 0's table of symbols exists where the table says."""
    table = _read("00").cells[-1].source
    names = re.findall(
        r"`([a-z_]+(?:\.\w+)+)`", "".join(line for line in table.splitlines() if line[:1] == "|")
    )
    assert len(names) > 20
    for name in names:
        owner, last = resolve_name(f"tutorial_lib.{name}".rpartition(".")[0]), name.rpartition(".")[2]
        fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
        assert hasattr(owner, last) or last in [field.name for field in fields], name


def test_the_results_show_a_new_algorithm(monkeypatch):
    """Notebook 14 as it is shows an algorithm that is added to the registry, run or not."""
    rows = results.load_results("table1")
    both = pd.concat([rows, rows[rows["algorithm"] == "BC-All"].assign(algorithm="Run")])
    monkeypatch.setattr(results, "load_results", lambda name: both)
    monkeypatch.setattr(report, "load_results", lambda name: both)
    monkeypatch.setitem(ALGORITHMS, "Later", type("Later", (ALGORITHMS["BC-All"],), {"name": "Later"}))
    names, tables, pictures = {}, [], []
    for cell in _code(_read("14")):
        if "import" in cell.source:
            exec(cell.source, names)
        elif cell.source.startswith(("Markdown(report.baselines_table", "Markdown(report.markdown(kept(")):
            tables.append(eval(cell.source, names).data)
        elif cell.source.startswith("figures.per_limit("):
            pictures.append(eval(cell.source, names))
    (baselines, kept), (picture,) = tables, pictures
    (legend,) = picture.legends
    assert "| Run |" in baselines and "| Run |" in kept
    assert "Later" in next(line for line in baselines.splitlines() if "| - |" in line)
    assert "Run" in [text.get_text() for text in legend.get_texts()]


def test_the_code_of_the_results_names_no_algorithm_but_c2iql():
    code = "\n".join(cell.source for cell in _code(_read("14")))
    assert set(re.findall("|".join(f'"{re.escape(name)}"' for name in ALGORITHMS), code)) == {'"C2IQL"'}
