"""`python site/student.py FROM TO`: the notebooks of one folder without their solutions, in another.

The cell of a solution goes. Its exercise keeps its cell, where each `...` that a student is to replace
becomes a raise that says so: whatever needs an unsolved exercise stops with its name, and its checker tells
it too.
"""

import ast
import sys
from pathlib import Path

import nbformat
from marks import END_SOLUTION, is_solution, remove_marks


def without_solutions(notebook) -> None:
    """Take the solutions out of a notebook, and the outputs of their exercises, in place.

    An exercise's cells go from the last one with a `...` to the solution. Raises ValueError for a solution
    without an end, and for one without an exercise.
    """
    exercise, kept = [], []
    for cell in notebook.cells:
        if is_solution(cell):
            _close(exercise, cell)
            exercise = []
            continue
        kept.append(cell)
        if cell.cell_type == "code":
            exercise = [cell] if _open_lines(cell.source) else exercise + [cell]
    notebook.cells = kept
    remove_marks(notebook)


def _close(exercise, solution) -> None:
    if not solution.source.rstrip().endswith(END_SOLUTION):
        raise ValueError(f"no {END_SOLUTION!r} ends this cell:\n{solution.source}")
    if not exercise or not _open_lines(exercise[0].source):
        raise ValueError(f"no cell with a `...` to replace precedes this solution:\n{solution.source}")
    exercise[0].source = _raise_where_left_open(exercise[0].source)
    for cell in exercise:
        cell.outputs, cell.execution_count = [], None


def _open_lines(source: str) -> dict[int, tuple[int, str]]:
    """Where `...` stands as a statement or as a value, and what for: {line: (indentation, name)}."""
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


def _is_ellipsis(value) -> bool:
    return isinstance(value, ast.Constant) and value.value is ...


def _raise_where_left_open(source: str) -> str:
    lines = source.splitlines()
    for number, (indentation, name) in _open_lines(source).items():
        words = f'raise NotImplementedError("exercise: write {name} in place of this line")'
        lines[number - 1] = " " * indentation + words
    return "\n".join(lines)


def main(source: Path, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        without_solutions(notebook)
        nbformat.write(notebook, target / path.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
