"""The students' version: no solution is left, and it runs to its end where an exercise is not solved."""

import ast
import builtins
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import exercises
import nbformat
import pytest
import student
from marks import is_answer, is_solution
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from tutorial_lib.course import checks

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted(ROOT.glob("notebooks/[0-9]*.ipynb"))
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
GO_ON = student.GO_ON.format(notebook="name", number=1)


def notebook_of(*sources):
    said = [new_output("stream", name="stdout", text="said\n")]
    cells = [new_code_cell(source, outputs=said, execution_count=1) for source in sources]
    return new_notebook(cells=[new_markdown_cell("# 1 · Title"), *cells])


def students(*sources):
    """The students' version of the cells of a notebook, and the code of its exercises and solutions."""
    notebook = notebook_of(*sources)
    pairs = student.without_solutions(notebook, "name")
    assert not any(cell.outputs or cell.execution_count for cell in notebook.cells[1:])
    return [cell.source for cell in notebook.cells[1:]], pairs


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs cells in one namespace, as a kernel does, beside the exercises of a student's notebook."""

    def run_cells(pairs, *cells):
        names = {"checks": checks, "In": [""]}
        (tmp_path / "exercises.json").write_text(json.dumps({"name": pairs}))
        monkeypatch.setattr(exercises, "__file__", str(tmp_path / "exercises.py"))
        monkeypatch.setattr(exercises, "get_ipython", lambda: SimpleNamespace(user_ns=names))
        for cell in cells:
            names["In"].append(cell)
            exec(cell, names)
        return names

    return run_cells


def test_an_exercise_that_is_not_solved_says_so_and_stops_nothing_after_it(run, capsys):
    cells, pairs = students("x = 1", EXERCISE, SOLUTION, "found = keeps_limit([1], 2)")
    assert cells == ["x = 1", EXERCISE, GO_ON, "found = keeps_limit([1], 2)"]
    assert run(pairs, *cells)["found"] is True
    not_yet, go_on = capsys.readouterr().out.splitlines()
    assert not_yet.startswith("NOT YET")
    assert go_on.startswith("exercise: write keeps_limit in place of the `...`. Until then")


@pytest.mark.parametrize(
    ("written", "expected"), [("return sum(costs) / len(costs) <= limit", True), ("return 7", 7)]
)
def test_what_a_student_wrote_stays_right_or_wrong(written, expected, run, capsys):
    (exercise, go_on, after), pairs = students(EXERCISE, SOLUTION, "found = keeps_limit([1], 2)")
    found = run(pairs, exercise, exercise.replace("...", written), go_on, after)["found"]
    assert found == expected and "exercise:" not in capsys.readouterr().out


def test_an_exercise_half_done_is_not_done(run, capsys):
    (exercise, go_on), pairs = students("a = ...\nb = ...", "# SOLUTION\na, b = 3, 4\n# END SOLUTION")
    found = run(pairs, exercise, "a = 1", go_on)
    assert (found["a"], found["b"]) == (1, 4)
    assert capsys.readouterr().out.startswith("exercise: write b in place")


def test_a_solution_leaves_nothing_but_what_the_exercise_asks_for(run, capsys):
    solution = "# SOLUTION\nhelp = 2\nprint(help)\na = help + 1\nprint(a)\nx = 5\n# END SOLUTION"
    cells, pairs = students("x = 1\na = ...", solution)
    found = run(pairs, *cells)
    assert (found["a"], found["x"]) == (3, 1) and "help" not in found
    assert capsys.readouterr().out.count("\n") == 1
    assert "x = 5" not in pairs[0][1]


def test_the_checker_may_stand_in_a_cell_of_its_own():
    cells, pairs = students("limit = ...", "check(limit)", "# SOLUTION\nlimit = 3\n# END SOLUTION")
    assert cells[:2] == ["limit = ...", "check(limit)"] and pairs == [("limit = ...", "limit = 3")]


def test_a_faulty_function_to_repair_stays_until_it_is_repaired(run, capsys):
    faulty = "def keeps_limit(costs, limit):\n    return max(costs) <= limit"
    cells, pairs = students("x = 1", faulty, SOLUTION, "found = keeps_limit([0, 9], 5)")
    assert cells[1] == faulty
    assert run(pairs, *cells)["found"] is True
    assert capsys.readouterr().out.startswith("exercise: repair keeps_limit. Until then")
    cells[1] = faulty.replace("max", "min")
    assert run(pairs, *cells)["found"] is True
    assert "exercise" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("source", "is_open"),
    [("a = ...", True), ("a, b = ..., ...", True), ("def f():\n    'doc'\n    ...", True),
     ("class A:\n    def f(self):\n        ...", True), ("def f():\n    return ...", True),
     ("def f(x):\n    y = ...\n    return y", True), ("first = x[..., 0]", False), ("print(...)", False),
     ("a = [1, ...]", True), ("a: int = ...", True),
     ("a = {'x': ..., 'y': 1}", True), ("a = {'x': f(...)}", False)],
)  # fmt: skip
def test_which_ellipsis_is_a_placeholder(source, is_open):
    assert exercises.is_open(source) is is_open


def test_answers_go():
    notebook = notebook_of("x = 1")
    notebook.cells.append(new_markdown_cell("<details>", metadata={"tags": ["answer"]}))
    student.without_solutions(notebook, "name")
    assert [cell.source for cell in notebook.cells] == ["# 1 · Title", "x = 1"]


@pytest.mark.parametrize("grade", ["research", "check"])
def test_the_solution_of_an_open_ended_exercise_may_stand_alone(grade):
    notebook = notebook_of("x = 1", "# SOLUTION\nx = 2\n# END SOLUTION", "y = 3")
    heading = f"Before.\n\n## Exercise 3: try\n*Grade: {grade}. Objective: 2.*\n\nTry it."
    notebook.cells.insert(2, new_markdown_cell(heading))
    if grade == "check":
        with pytest.raises(ValueError, match="precedes"):
            student.without_solutions(notebook, "name")
        return
    assert student.without_solutions(notebook, "name") == []
    assert [cell.source for cell in notebook.cells[1:]] == ["x = 1", heading, "y = 3"]


@pytest.mark.parametrize(
    ("sources", "words"),
    [(["x = 1", SOLUTION], "precedes"), ([SOLUTION], "precedes"), ([EXERCISE, SOLUTION[:-5]], "ends"),
     ([EXERCISE, SOLUTION, SOLUTION], "precedes"),
     (["a = ...", "# SOLUTION\nb = 1\n# END SOLUTION"], "asks for a")],
)  # fmt: skip
def test_a_solution_without_exercise_or_end_is_an_error(sources, words):
    with pytest.raises(ValueError, match=words):
        students(*sources)


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def test_no_solution_and_no_answer_is_left(notebook):
    solutions = [cell.source for cell in notebook.cells if is_solution(cell)]
    pairs = student.without_solutions(notebook, "name")
    nbformat.validate(notebook)
    text = "\n".join(cell.source for cell in notebook.cells)
    assert "SOLUTION" not in text and text.count("\ngo_on(") == len(pairs) <= len(solutions)
    assert len(pairs) >= 1
    assert not [cell for cell in notebook.cells if is_answer(cell) or cell.get("outputs")]


def reads(source):
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)]
    return {node.id for node in nodes if isinstance(node.ctx, ast.Load)}


def test_later_cells_find_their_names_without_the_solutions(notebook):
    """What a later cell reads and a solution defines, another cell defines too, often the exercise."""
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    known, of_solutions = set(dir(builtins)), set()
    for source in code:
        if source.startswith("# SOLUTION"):
            of_solutions |= exercises.bindings(source).keys()
        else:
            known |= exercises.bindings(source).keys()
            assert reads(source) & of_solutions <= known, source


QUICK = [path for path in NOTEBOOKS if path.stem[:2] in ("00", "05")]  # these run in seconds


@pytest.mark.parametrize("path", QUICK, ids=lambda path: path.stem)
def test_a_notebook_with_no_exercise_done_runs_to_its_end(path, tmp_path):
    folder = tmp_path / "student"
    student.main(ROOT / "notebooks", folder)
    for name in ("data", "tutorial_lib", "benchmarks"):
        (tmp_path / name).symlink_to(ROOT / name)
    command = [
        sys.executable, "-m", "nbconvert", "--log-level=ERROR", "--KernelManager.transport_encryption=auto",
        "--ExecutePreprocessor.timeout=300", "--to", "notebook", "--execute", "--inplace", folder / path.name,
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    cells = nbformat.read(folder / path.name, as_version=4).cells
    said = "".join(output.get("text", "") for cell in cells for output in cell.get("outputs", []))
    pairs = json.loads((folder / "exercises.json").read_text())[path.stem]
    assert said.count("exercise: ") == len(pairs) >= 1 and "NOT YET" in said
