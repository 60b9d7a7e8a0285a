"""A notebook cut down to its interactive controls and to what they need.

To run all notebooks whole once more, in a browser, would take minutes; nbval runs them whole already.
"""

import ast
import symtable

from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_notebook

WIDGET = "application/vnd.jupyter.widget-view+json"


def cut(notebook: NotebookNode) -> NotebookNode:
    """The cells that show a widget, word for word, after one cell with the statements they depend on.

    A call that changes its argument is not seen to do so: what a control needs of it would be missing.
    """
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    controls = [cell for cell in cells if any(WIDGET in output.get("data", {}) for output in cell.outputs)]
    first = min(map(cells.index, controls), default=0)
    statements = [statement for cell in cells[:first] for statement in _statements(cell.source)]
    needed, kept = set().union(*(_reads(cell.source) for cell in controls)), []
    for statement in reversed(statements):
        binds, changes = _binds(statement), _changes(statement)
        if needed & (binds | changes):
            needed = needed - binds | changes | _reads(statement)
            kept.append(statement)
    sources = ["\n".join(reversed(kept)), *(cell.source for cell in controls)]
    return new_notebook(cells=[new_code_cell(source) for source in sources], metadata=notebook.metadata)


def _statements(source):
    """Each statement at the top level of a cell, a function with its decorators."""
    lines = source.splitlines()
    for node in ast.parse(source).body:
        first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", []))])
        yield "\n".join(lines[first - 1 : node.end_lineno])


def _scopes(table):
    yield table
    for child in table.get_children():
        yield from _scopes(child)


def _binds(source):
    names = symtable.symtable(source, "cell", "exec").get_symbols()
    bound = {name.get_name() for name in names if name.is_assigned() or name.is_imported()}
    return bound - _of_comprehensions(source)


def _of_comprehensions(source):
    """Variables of comprehensions alone, which Python 3.12 and newer count among the code's around them."""
    nodes = list(ast.walk(ast.parse(source)))
    targets = [node.target for node in nodes if isinstance(node, ast.comprehension)]
    inside = [node for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]
    stored = [node for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    return {node.id for node in inside} - {node.id for node in stored if node not in inside}


def _changes(source):
    """Names whose value is changed, not replaced: `a += 1`, `a[i] = 1`, `a.b = 1`."""
    nodes = list(ast.walk(ast.parse(source)))
    targets = [node.target for node in nodes if isinstance(node, ast.AugAssign)]
    parts = [node for node in nodes if isinstance(node, (ast.Subscript, ast.Attribute))]
    targets += [part.value for part in parts if isinstance(part.ctx, ast.Store)]
    return {node.id for node in targets if isinstance(node, ast.Name)}


def _reads(source):
    """Names of the notebook that the code looks up, in its functions too."""
    top = symtable.symtable(source, "cell", "exec")
    names = [(scope is top, name) for scope in _scopes(top) for name in scope.get_symbols()]
    read = [(at_top, name) for at_top, name in names if name.is_referenced()]
    names = {name.get_name() for at_top, name in read if at_top or name.is_global()}
    return names - _of_comprehensions(source)
