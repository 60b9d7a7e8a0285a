"""What nbval cannot see: that it compares anything at all, and that a notebook stays short and clean.

nbval passes over a cell without an execution count even where it is marked, and a cell tagged
raises-exception that raises nothing: both are ruled out here.
"""

from pathlib import Path

import nbformat
import pytest

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


def test_is_short(notebook):
    lines = [len(cell.source.splitlines()) for cell in _code(notebook)]
    words = sum(len(cell.source.split()) for cell in notebook.cells if cell.cell_type == "markdown")
    assert len(lines) <= 25 and max(lines) <= 25 and sum(lines) <= 220
    assert words <= 1500


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_is_small(path):
    assert path.stat().st_size < 500_000
