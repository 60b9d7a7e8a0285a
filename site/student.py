"""`python site/student.py FROM TO` writes the notebooks of folder FROM for students to folder TO.

They have no outputs, no answers and no solutions. In the place of a solution stands a cell that says which
part of its exercise is still to be written, and then goes on with the course's own (see exercises.py). So the
notebook runs to its end whatever is still to be written. An exercise stays as it is.
"""

import ast
import json
import re
import shutil
import sys
from pathlib import Path

import nbformat
from exercises import bindings, to_write
from marks import END_SOLUTION, is_answer, is_solution, remove_marks
from nbformat.v4 import new_code_cell

HERE = Path(__file__).parent
EXERCISE = re.compile(r"^## Exercise .*(?:\n+\*Grade: (?P<grade>\w+))?", re.MULTILINE)
GO_ON = "from exercises import go_on\n\ngo_on({notebook!r}, {number})"


def without_solutions(notebook: nbformat.NotebookNode, name: str) -> list[tuple[str, str]]:
    """Makes a notebook the students' in place, and returns the code of its exercises and their solutions.

    `name` is the notebook's in exercises.json. The exercise of a solution is the last code cell since the
    exercise's heading that leaves something to write. An open-ended exercise may have none; its solution only
    goes. Raises ValueError for another solution without an exercise, and for one without an end.
    """
    since, kept, pairs, grade = [], [], [], "check"
    for cell in notebook.cells:
        if is_answer(cell):
            continue
        if cell.cell_type == "markdown" and (found := EXERCISE.search(cell.source)):
            since, grade = [], found["grade"] or "check"
        if is_solution(cell):
            if grade == "research" and not since:
                continue
            exercise = _exercise(since, cell).source
            pairs.append((exercise, _answer(exercise, cell.source)))
            source = GO_ON.format(notebook=name, number=len(pairs))
            cell = new_code_cell(source, id=cell.id, metadata={"jupyter": {"source_hidden": True}})
            since = []
        elif cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
            since.append(cell)
        kept.append(cell)
    notebook.cells = kept
    remove_marks(notebook)
    return pairs


def _exercise(cells: list[nbformat.NotebookNode], solution: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Returns the exercise of a solution, which is one of the code cells before it. Raises ValueError."""
    if not solution.source.rstrip().endswith(END_SOLUTION):
        raise ValueError(f"no {END_SOLUTION!r} ends this cell:\n{solution.source}")
    for cell in reversed(cells):
        if to_write(cell.source, solution.source):
            return cell
    raise ValueError(f"no exercise precedes this solution:\n{solution.source}")


def _answer(exercise: str, solution: str) -> str:
    """Returns the code of a solution that defines what the exercise asks for. Raises ValueError.

    The rest of the solution only checks or shows something.
    """
    body, last = ast.parse(solution).body, 0
    for name in to_write(exercise, solution):
        places = [n for n, node in enumerate(body) if name in bindings(ast.unparse(node))]
        if not places:
            raise ValueError(f"the exercise asks for {name}, which its solution does not define:\n{solution}")
        last = max(last, places[-1])
    return "\n".join(ast.unparse(node) for node in body[: last + 1] if not isinstance(node, ast.Expr))


def main(source: Path, target: Path) -> None:
    """Writes the students' notebooks of all notebooks in `source`, and what they need, to `target`."""
    target.mkdir(parents=True, exist_ok=True)
    exercises = {}
    for path in sorted(source.glob("[0-9]*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        exercises[path.stem] = without_solutions(notebook, path.stem)
        nbformat.write(notebook, target / path.name)
    (target / "exercises.json").write_text(json.dumps(exercises, indent=1), encoding="utf-8")
    shutil.copyfile(HERE / "exercises.py", target / "exercises.py")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
