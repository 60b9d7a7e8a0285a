"""`python site/student.py FROM TO`: the notebooks of one folder without their solutions, in another.

The cell of a solution goes. Its exercise keeps its cell, where each `...` that a student is to replace
becomes a raise that says so: whatever needs an unsolved exercise stops with its name, and its checker tells
it too. An exercise without a `...` is a faulty function to repair, and stays as it is.
"""

import ast
import sys
from pathlib import Path

import nbformat
from marks import END_SOLUTION, is_solution, remove_marks


def without_solutions(notebook) -> None:
    """Take the solutions out of a notebook, and the outputs of their exercises, in place.

    An exercise is the last cell with a `...`, or with a function that the solution defines anew, and what
    stands between it and the solution. Raises ValueError for a solution without an end or an exercise.
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


def _open_exercise(cells, solution) -> None:
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
    return {node.name for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)}


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
    for path in sorted(source.glob("[0-9]*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        without_solutions(notebook)
        nbformat.write(notebook, target / path.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
