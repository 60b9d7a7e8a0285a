"""`python site/student.py FROM TO` writes the notebooks of folder FROM without their solutions to folder TO.

The cells of solutions are removed. In the cell of an exercise, each `...` that a student must replace becomes
a `raise` which says so. Code that needs an unsolved exercise then stops with the exercise's name, and the
exercise's check reports it too. An exercise without a `...` is a faulty function to repair, and stays as it
is.
"""

import ast
import sys
from pathlib import Path
from typing import Any

import nbformat
from marks import END_SOLUTION, is_solution, remove_marks


def without_solutions(notebook: nbformat.NotebookNode) -> None:
    """Remove the solutions from a notebook, and the outputs of their exercises, in place.

    The exercise of a solution is the last code cell since the previous solution that has a `...`, or that
    defines a function which the solution defines again. The outputs of all code cells from there to the
    solution are removed. Raises ValueError for a solution without an end or an exercise.
    """
    since, kept = [], []
    for cell in notebook.cells:
        if is_solution(cell):
            _open_exercise(since, cell)
            since = []
            continue
        kept.append(cell)
        if cell.cell_type == "code":
            since.append(cell)
    notebook.cells = kept
    remove_marks(notebook)


def _open_exercise(cells: list[nbformat.NotebookNode], solution: nbformat.NotebookNode) -> None:
    """Prepare the exercise of a solution, which is one of the code cells before it. Raises ValueError."""
    if not solution.source.rstrip().endswith(END_SOLUTION):
        raise ValueError(f"no {END_SOLUTION!r} ends this cell:\n{solution.source}")
    solved = _functions(solution.source)
    found = [
        n for n, cell in enumerate(cells) if _open_lines(cell.source) or _functions(cell.source) & solved
    ]
    if not found:
        raise ValueError(f"no exercise precedes this solution:\n{solution.source}")
    exercise = cells[found[-1]]
    exercise.source = _raise_where_left_open(exercise.source)
    for cell in cells[found[-1] :]:
        cell.outputs, cell.execution_count = [], None


def _functions(source: str) -> set[str]:
    """The names of the functions that a cell defines."""
    return {node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)}


def _open_lines(source: str) -> dict[int, tuple[int, str]]:
    """The lines where `...` is a statement or an assigned value: {line: (indentation, its name)}."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            for statement in node.body:
                if _is_ellipsis(getattr(statement, "value", None)):
                    found[statement.lineno] = (statement.col_offset, node.name)
        elif isinstance(node, ast.Assign) and _is_ellipsis(node.value):
            name = ast.unparse(node.targets[0])
            found.setdefault(node.lineno, (node.col_offset, name))
    return found


def _is_ellipsis(value: Any) -> bool:
    return isinstance(value, ast.Constant) and value.value is ...


def _raise_where_left_open(source: str) -> str:
    """The source of an exercise, with a `raise` in place of each `...`."""
    lines = source.splitlines()
    for number, (indentation, name) in _open_lines(source).items():
        words = f'raise NotImplementedError("exercise: write {name} in place of this line")'
        lines[number - 1] = " " * indentation + words
    return "\n".join(lines)


def main(source: Path, target: Path) -> None:
    """Write all notebooks in `source` without their solutions to `target`."""
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.glob("[0-9]*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        without_solutions(notebook)
        nbformat.write(notebook, target / path.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
