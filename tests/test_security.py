"""What SECURITY.md promises: no pickle is loaded, nothing talks to the network unasked, servers are local.

Other promises are proved elsewhere. The last test here sees to it that every test that the page names exists.
"""

import ast
import functools
import io
import json
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import make_agent, make_dataset

from benchmarks.reliability.samples import make_dataset as make_recording
from tutorial_lib.checkpoints import TrainingError, load_agent, save_checkpoint
from tutorial_lib.data.dataset import DatasetError
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.studies.results import read_results
from tutorial_lib.training import train

ROOT = Path(__file__).parents[1]
LOCAL = {"127.0.0.1", "::1", "localhost"}

# --- No pickle, no code from a file ---

FORBIDDEN = {
    "torch.load", "joblib.load", "pd.read_pickle", "pandas.read_pickle", "yaml.load", "yaml.unsafe_load",
    "eval", "exec", "compile", "__import__", "os.system", "os.popen",
}  # fmt: skip
MODULES = {"pickle", "cloudpickle", "dill", "marshal", "shelve"}


def violations(text):
    """What in a module runs code from a file or from a string: one word for each."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += MODULES & {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found += MODULES & {(node.module or "").split(".")[0]}
        elif isinstance(node, ast.Call):
            name, options = ast.unparse(node.func), {o.arg: ast.unparse(o.value) for o in node.keywords}
            if (
                name in FORBIDDEN
                or name in ("np.load", "numpy.load")
                and options.get("allow_pickle") != "False"
            ):
                found.append(name)
            if options.get("shell", "False") != "False":
                found.append("shell")
    return found


def sources():
    """The text of every module, and of every notebook's cells that are plain Python, by name."""
    for folder in ("tutorial_lib", "benchmarks"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield str(path.relative_to(ROOT)), path.read_text()
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for number, cell in enumerate(json.loads(path.read_text())["cells"]):
            text = "".join(cell["source"])
            if cell["cell_type"] == "code" and not re.search("^[%!]", text, re.M):
                yield f"{path.name}, cell {number}", text


def test_no_module_and_no_notebook_loads_a_pickle_or_runs_text():
    found = {name: violations(text) for name, text in sources()}
    assert len(found) > 150 and not {name: words for name, words in found.items() if words}


@pytest.mark.parametrize(
    "text",
    [
        "import pickle", "from pickle import loads", "import dill as d", "torch.load(x)", "np.load(x)",
        "eval(x)", "np.load(x, allow_pickle=True)", "run(x, shell=True)", "os.system(x)", "pd.read_pickle(x)",
    ],
)  # fmt: skip
def test_a_module_that_would_is_noticed(text):
    assert len(violations(text)) == 1 and not violations("np.load(x, allow_pickle=False)")


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def pickled(trap):
    """The bytes of three kinds of files that have a trap in them."""
    by_torch, by_numpy = io.BytesIO(), io.BytesIO()
    torch.save({"weight": trap}, by_torch)
    np.savez(by_numpy, allow_pickle=True, rewards=np.array([trap]))
    return {"pickle": pickle.dumps(trap), "torch": by_torch.getvalue(), "numpy": by_numpy.getvalue()}


def resume_in(path):
    train(make_agent(), make_dataset(), run_dir=path.parent, progress=False)


@pytest.mark.parametrize("kind", ["pickle", "torch", "numpy"])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("agent.safetensors", load_agent),
        ("checkpoint.safetensors", resume_in),
        ("metrics.csv", resume_in),
        ("data.hdf5", lambda path: read_dataset(path, "BallRun")),
        ("results.csv", read_results),
    ],
)
def test_a_pickle_in_the_place_of_a_file_is_refused_and_not_loaded(name, read, kind, tmp_path):
    trap, path = tmp_path / "sprung", tmp_path / "run" / name
    path.parent.mkdir()
    if name == "metrics.csv":
        agent = make_agent()
        agent.data_checksum = make_dataset().checksum
        save_checkpoint(agent, [torch.Generator()], [], path.parent)
    path.write_bytes(pickled(Trap(trap))[kind])
    with pytest.raises((TrainingError, DatasetError, ValueError)) as error:
        read(path)
    assert "\n" not in str(error.value) and not trap.exists()


def test_the_trap_springs(tmp_path):
    pickle.loads(pickled(Trap(tmp_path / "sprung"))["pickle"])
    assert (tmp_path / "sprung").is_dir()


# --- The network ---

HOOK = """
import os, sys

def heard(event, args):
    of_socket = event in ("socket.connect", "socket.bind", "socket.sendto")
    if of_socket or event in ("socket.getaddrinfo", "socket.gethostbyname"):
        address = args[1] if of_socket else args[0]
        sends = event != "socket.connect" or args[0].type != 2  # connecting by UDP sends nothing
        with open(os.environ["HEARD"], "a") as file:
            file.write(f"{event}|{address if isinstance(address, (str, bytes)) else address[0]}|{sends}\\n")

sys.addaudithook(heard)
"""
"""The start of every Python process of the test: whatever it wants of a socket is written down."""
TYPED = """
import sys
from tutorial_lib.__main__ import main
from tutorial_lib.studies import grids

grid = grids.Grid(("BallRun",), ("BC-All",), seeds=1, limits=lambda task: (25.0,))
grids.STUDIES["small"] = grids.Study("Does it talk?", (grid,))
for words in sys.argv[1].split(";"):
    sys.argv = ["c2iql", *words.split()]
    try:
        main()
    except SystemExit as end:
        assert not end.code, words
"""
SIZES = "--hidden-width 8 --hidden-layers 1 --batch-size 8"
COMMANDS = [
    "tasks",
    "data check data.hdf5 --task BallRun",
    f"train IQL BallRun --data data.hdf5 --out run --updates 2 {SIZES}",
    "evaluate run/agent.safetensors --limits 40 --episodes 11 --workers 2",
    "certify run/agent.safetensors --limits 40 --episodes 2 --workers 1",
    "capstone run/agent.safetensors --workers 1 --out capstone.json",
    "study small --data data.hdf5 --workers 1 --runs runs "
    "--option updates=2 batch_size=8 hidden_width=8 hidden_layers=1",
]
"""Commands that nobody asked to use the network. Two of them have processes that talk with each other."""


@functools.cache
def _addresses(folder, script, *words):
    (folder / "sitecustomize.py").write_text(HOOK)
    heard = folder / "heard"
    heard.touch()
    named = {
        "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}",
        "HEARD": str(heard),
        "JOBLIB_TEMP_FOLDER": str(folder),
    }
    command = [sys.executable, "-c", script, *words]
    done = subprocess.run(command, cwd=folder, env=os.environ | named, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    lines = [line.split("|") for line in heard.read_text().splitlines()]
    return [(event, address) for event, address, sends in lines if sends == "True"]


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    """(event, address) of all that the commands' processes asked of a socket."""
    folder = tmp_path_factory.mktemp("typed")
    write_dataset(folder / "data.hdf5", make_recording(), "BallRun")
    return _addresses(folder, TYPED, ";".join(COMMANDS))


def is_local(address):
    return address in LOCAL or address == "None" or "/" in address or "\0" in address or not address


def test_no_command_talks_to_the_network_unless_asked(heard):
    away = [(event, address) for event, address in heard if event != "socket.bind" and not is_local(address)]
    assert away == []


def test_servers_listen_on_this_machine_alone(heard):
    bound = {address for event, address in heard if event == "socket.bind"}
    assert "127.0.0.1" in bound  # the study's own scheduler and worker
    assert all(address and is_local(address) for address in bound)


def test_an_address_elsewhere_would_be_heard(tmp_path):
    script = "import socket; s = socket.socket(); s.settimeout(0.01); s.bind(('0.0.0.0', 0))\n"
    script += "try: s.connect(('192.0.2.1', 9))\nexcept OSError: pass"
    assert _addresses(tmp_path, script) == [("socket.bind", "0.0.0.0"), ("socket.connect", "192.0.2.1")]


def test_jupyterlab_listens_on_this_machine_and_keeps_its_token():
    recipe = re.search(r"^lab:.*?\n\n", (ROOT / "Makefile").read_text(), re.M | re.S).group()
    assert "--ip=127.0.0.1" in recipe and not re.search("token|password|allow_origin", recipe)
    published = re.findall(r"--publish (\S+)", (ROOT / "Dockerfile").read_text())
    assert published and all(place.startswith("127.0.0.1:") for place in published)


# --- The page ---


def test_every_test_that_the_page_names_exists():
    page = (ROOT / "SECURITY.md").read_text()
    named = re.findall(r"`(test_\w+\.py)::(test_\w+)`", page)
    assert len(named) >= 15
    for file, name in named:
        functions = [
            n.name for n in ast.parse((ROOT / "tests" / file).read_text()).body if hasattr(n, "name")
        ]
        assert name in functions, f"{file}::{name}"
    rows = [
        line
        for line in page.splitlines()
        if line.startswith("| ") and not line.startswith(("| promise", "| ---"))
    ]
    assert rows and all("::test_" in row for row in rows)
