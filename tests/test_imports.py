"""The law of imports: which part may build on which, and how long a module and a function may be."""

import ast
import graphlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "tutorial_lib").rglob("*.py"))
}
TREES = {name: ast.parse(path.read_text()) for name, path in FILES.items()}
FOUNDATION = "config losses networks costs tasks data files style matmul".split()
LOOPS = "training checkpoints playing scores".split()
LAYERS = [FOUNDATION, ["agents"], LOOPS, ["options", "studies"], ["course"], ["commands"], ["__main__"]]
"""A module imports from its own layer and from those before it."""
SHARED = "agent seeds lift player critic evaluation implicit lagrangian sequences".split()
"""The files of `agents` that are no algorithm's."""
ALGORITHMS = [
    name for name in FILES if name.startswith("tutorial_lib.agents.") and name.split(".")[2] not in SHARED
]


def imports_of(name):
    """What a module imports at its top or in a function, by full names, but not for types alone."""
    checking = [
        n for n in ast.walk(TREES[name]) if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.unparse(n.test)
    ]
    for_types = {inner for statement in checking for inner in ast.walk(statement)}
    for node in ast.walk(TREES[name]):
        if isinstance(node, ast.Import) and node not in for_types:
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node not in for_types:
            assert not node.level, f"{name} has a relative import"
            full = [f"{node.module}.{alias.name}" for alias in node.names]  # a module, or a name in one
            yield from (other if other in FILES else node.module for other in full)


IMPORTS = {name: set(imports_of(name)) for name in FILES}


def layer(name):
    """The number of a module's layer."""
    (found,) = (number for number, parts in enumerate(LAYERS) if name.split(".")[1] in parts)
    return found


@pytest.mark.parametrize("name", [name for name in FILES if name != "tutorial_lib"])
def test_imports_go_down(name):
    own = [other for other in IMPORTS[name] if other.startswith("tutorial_lib.")]
    assert not [other for other in own if layer(other) > layer(name)]
    assert "course" not in {other.split(".")[1] for other in own} or name.startswith("tutorial_lib.course")
    assert not [other for other in IMPORTS[name] if other.split(".")[0] in ("benchmarks", "tests")]


def test_an_algorithm_imports_of_other_algorithms_only_what_it_derives_from():
    assert {name.split(".")[2] for name in ALGORITHMS} >= {"iql", "ciql", "c2iql", "cpq", "bc"}
    for name in ALGORITHMS:
        classes = [node for node in ast.walk(TREES[name]) if isinstance(node, ast.ClassDef)]
        bases = {ast.unparse(base) for node in classes for base in node.bases}
        for node in ast.walk(TREES[name]):
            if isinstance(node, ast.ImportFrom) and node.module in ALGORITHMS:
                assert {alias.name for alias in node.names} <= bases, f"{name} imports {node.module}"


def test_no_imports_are_circular():
    """To import a.b.c runs the file of package a.b first, unless it is running already."""
    graph = {}
    for name, others in IMPORTS.items():
        parents = {other.rpartition(".")[0] for other in others & FILES.keys()}
        graph[name] = others | {parent for parent in parents if not name.startswith(parent)}
    graphlib.TopologicalSorter(graph).prepare()  # a CycleError names the circle


@pytest.mark.parametrize("name", FILES)
def test_modules_and_functions_are_short(name):
    assert len(FILES[name].read_text().splitlines()) < 300
    functions = [n for n in ast.walk(TREES[name]) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    lengths = [(function.end_lineno - function.lineno + 1, function.name) for function in functions]
    assert [pair for pair in lengths if pair[0] > 45] == []
