"""The comments in a notebook's code that are for machines: nbval's, and those around a solution."""

import re

CHECKED, SOLUTION, END_SOLUTION = "# NBVAL_CHECK_OUTPUT", "# SOLUTION", "# END SOLUTION"
LINES = re.compile(rf"^(?:{CHECKED}|{SOLUTION}|{END_SOLUTION})\n?", re.MULTILINE)


def is_solution(cell) -> bool:
    return cell["cell_type"] == "code" and "".join(cell["source"]).startswith(SOLUTION + "\n")


def remove_marks(notebook) -> None:
    """Take them out of the code cells of a notebook, nbformat's or plain JSON, in place."""
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            cell["source"] = LINES.sub("", "".join(cell["source"])).rstrip("\n")
