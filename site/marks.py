"""The comments in a notebook's code that are for programs: nbval's, and those around a solution."""

import re
from typing import Any

CHECKED, SOLUTION, END_SOLUTION = "# NBVAL_CHECK_OUTPUT", "# SOLUTION", "# END SOLUTION"
LINES = re.compile(rf"^(?:{CHECKED}|{SOLUTION}|{END_SOLUTION})\n?", re.MULTILINE)


def is_solution(cell: dict) -> bool:
    """Is this cell of a notebook the solution of an exercise?"""
    return cell["cell_type"] == "code" and "".join(cell["source"]).startswith(SOLUTION + "\n")


def is_answer(cell: dict) -> bool:
    """Is this cell of a notebook the folded answer to a question or to an exercise without code?"""
    return cell["cell_type"] == "markdown" and "answer" in cell["metadata"].get("tags", [])


def remove_marks(notebook: Any) -> None:
    """Remove these comments from the code cells of a notebook (nbformat's object or plain JSON), in place."""
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            cell["source"] = LINES.sub("", "".join(cell["source"])).rstrip("\n")
