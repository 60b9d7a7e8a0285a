"""The student's version: no solution is left, its exercise says so, and what needs it finds its name."""

import ast
import builtins
from pathlib import Path

import nbformat
import pytest
import student
from marks import is_solution
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from tutorial_lib.course import checks

NOTEBOOKS = sorted(Path(__file__).parents[1].glob("notebooks/[0-9]*.ipynb"))
EXERCISE = '''def keeps_limit(costs, limit):
    """Does it?"""
    ...


checks.check_keeps_limit(keeps_limit)'''
SOLUTION = """# SOLUTION
# NBVAL_CHECK_OUTPUT
def keeps_limit(costs, limit):
    return sum(costs) / len(costs) <= limit


checks.check_keeps_limit(keeps_limit)
# END SOLUTION"""


def notebook_of(*sources):
    said = [new_output("stream", name="stdout", text="said\n")]
    cells = [new_code_cell(source, outputs=said, execution_count=1) for source in sources]
    return new_notebook(cells=[new_markdown_cell("# 1 · Title"), *cells])


def test_the_solution_goes_and_its_exercise_raises(capsys):
    notebook = notebook_of("x = 1", EXERCISE, SOLUTION, "keeps_limit([1], 2)")
    student.without_solutions(notebook)
    _, before, exercise, after = notebook.cells
    assert "return" not in exercise.source and '"""Does it?"""' in exercise.source
    assert not exercise.outputs and exercise.execution_count is None
    assert before.outputs and after.outputs

    names = {"checks": checks}
    exec(exercise.source, names)  # runs as it is
    said = capsys.readouterr().out
    assert said.startswith("NOT YET") and "write keeps_limit in place of this line" in said
    with pytest.raises(NotImplementedError, match="exercise: write keeps_limit"):
        exec(after.source, names)


def test_a_value_to_find_and_a_checker_in_a_cell_of_its_own():
    notebook = notebook_of("limit = ...", "check(limit)", "# SOLUTION\nlimit = 3\n# END SOLUTION")
    student.without_solutions(notebook)
    _, exercise, checker = notebook.cells
    assert exercise.source == 'raise NotImplementedError("exercise: write limit in place of this line")'
    assert not checker.outputs and checker.source == "check(limit)"


def test_a_faulty_function_to_repair_stays_as_it_is():
    faulty = "def keeps_limit(costs, limit):\n    return max(costs) <= limit"
    notebook = notebook_of("x = 1", faulty, SOLUTION)
    student.without_solutions(notebook)
    _, before, exercise = notebook.cells
    assert exercise.source == faulty and not exercise.outputs and before.outputs


def test_an_ellipsis_that_is_no_placeholder_stays():
    source = "first = x[..., 0]\nprint(...)\ndef f():\n    ..."
    notebook = notebook_of(source, "# SOLUTION\npass\n# END SOLUTION")
    student.without_solutions(notebook)
    assert notebook.cells[1].source.splitlines()[:3] == source.splitlines()[:3]
    assert notebook.cells[1].source.splitlines()[3].startswith("    raise")


@pytest.mark.parametrize(
    ("sources", "words"),
    [(["x = 1", SOLUTION], "precedes"), ([SOLUTION], "precedes"), ([EXERCISE, SOLUTION[:-5]], "ends"),
     ([EXERCISE, SOLUTION, SOLUTION], "precedes")],
)  # fmt: skip
def test_a_solution_without_exercise_or_end_is_an_error(sources, words):
    with pytest.raises(ValueError, match=words):
        student.without_solutions(notebook_of(*sources))


def names_in(tree, kind):
    return {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and isinstance(n.ctx, kind)}


def defined(source):
    """The names that a cell leaves behind, by assignment, `def`, `class` or import."""
    found = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
        else:
            found |= names_in(node, ast.Store)
    return found


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def test_no_solution_is_left(notebook):
    solutions = [cell.source for cell in notebook.cells if is_solution(cell)]
    assert len(solutions) >= 2
    student.without_solutions(notebook)
    nbformat.validate(notebook)
    text = "\n".join(cell.source for cell in notebook.cells)
    assert "SOLUTION" not in text
    assert "raise NotImplementedError" in text


def test_later_cells_find_their_names_without_the_solutions(notebook):
    """What a later cell reads and a solution defines, the exercise's own cell defines or raises for too."""
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    known, of_solutions = set(dir(builtins)), set()
    for source in code:
        if source.startswith("# SOLUTION"):
            of_solutions |= defined(source)
        else:
            known |= defined(source)
            assert names_in(ast.parse(source), ast.Load) & of_solutions <= known, source
