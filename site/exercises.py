"""`go_on(notebook, number)` lets a notebook run on where its reader has not solved an exercise yet.

site/student.py copies this file into the folder of the students' notebooks. It writes `exercises.json` beside
it, which has the code of every exercise and of its solution.
"""

import ast
import json
from pathlib import Path

from IPython import get_ipython


def go_on(notebook: str, number: int) -> None:
    """Says what is still to be written in an exercise, and puts the course's own in its place.

    What the reader has written stays, right or wrong. `number` counts the exercises with code, from 1.
    """
    names = get_ipython().user_ns
    everything = json.loads(Path(__file__).with_name("exercises.json").read_text(encoding="utf-8"))
    exercise, solution = everything[notebook][number - 1]
    missing = unsolved(exercise, solution, names["In"])
    if not missing:
        return
    verb, place = ("write", " in place of the `...`") if is_open(exercise) else ("repair", "")
    print(f"exercise: {verb} {' and '.join(missing)}{place}. Until then, the course's own is used below.")
    solved = dict(names)
    exec(solution, solved)
    names.update({name: solved[name] for name in missing})


def unsolved(exercise: str, solution: str, history: list[str]) -> list[str]:
    """Returns the names that a reader has still to write. `history` is the code that was run, oldest first.

    A name is written when the code which bound it last has no `...` left and differs from the exercise's.
    """
    asked, written = to_write(exercise, solution), {}
    for source in history:
        try:
            written |= bindings(source)
        except SyntaxError:  # such a cell has not run
            continue
    left = asked.items()
    return [
        name for name, code in left if name not in written or is_open(written[name]) or written[name] == code
    ]


def to_write(exercise: str, solution: str) -> dict[str, str]:
    """Returns the names that an exercise asks for, with the code that it gives for each.

    These are the names with a `...`, and where there is none, the functions and classes of both.
    """
    given = bindings(exercise)
    placeholders = {name: code for name, code in given.items() if is_open(code)}
    both = {name: code for name, code in given.items() if name in bindings(solution)}
    faulty = {name: code for name, code in both.items() if code.startswith(("def ", "class ", "@"))}
    return placeholders or faulty


def bindings(source: str) -> dict[str, str]:
    """Returns the names that a cell binds at its top level, each with its last statement that binds it."""
    found = {}
    for statement in ast.parse(source).body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            names = [statement.name]
        elif isinstance(statement, ast.Import | ast.ImportFrom):
            names = [(alias.asname or alias.name).split(".")[0] for alias in statement.names]
        else:
            inside = [node for node in ast.walk(statement) if isinstance(node, ast.Name)]
            names = [node.id for node in inside if isinstance(node.ctx, ast.Store)]
        found |= dict.fromkeys(names, ast.unparse(statement))
    return found


def is_open(source: str) -> bool:
    """Returns whether a `...` stands in place of a statement, or in an assigned or returned value."""
    statements = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt)]
    return any(_is_placeholder(getattr(statement, "value", None)) for statement in statements)


def _is_placeholder(value: ast.expr | None) -> bool:
    """Returns whether an expression is `...`, or a tuple, list or dictionary that has one."""
    if isinstance(value, ast.Tuple | ast.List):
        return any(map(_is_placeholder, value.elts))
    if isinstance(value, ast.Dict):
        return any(map(_is_placeholder, value.values))
    return isinstance(value, ast.Constant) and value.value is ...
