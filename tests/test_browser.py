"""Every slider of every notebook in a real browser: in JupyterLab a key moves it, and the picture changes."""

import json
import os
import secrets
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import nbformat
import pytest
from controls import WIDGET, cut

ROOT = Path(__file__).parents[1]
TOKEN = secrets.token_hex()
LAB_FOLDERS = (
    "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "JUPYTERLAB_SETTINGS_DIR",
    "JUPYTERLAB_WORKSPACES_DIR", "IPYTHONDIR",
)  # fmt: skip
KERNEL = "window.jupyterapp?.shell?.currentWidget?.sessionContext?.session?.kernel?.status"
CELLS = """() => window.jupyterapp.shell.currentWidget.content.model.sharedModel.cells
    .filter(cell => cell.cell_type == "code")
    .map(cell => [cell.execution_count, cell.outputs.map(output => output.output_type)])"""
END_KERNEL = "window.jupyterapp.shell.currentWidget.sessionContext.shutdown()"
ERRORS = "[data-mime-type='application/vnd.jupyter.error'], [data-mime-type='application/vnd.jupyter.stderr']"
NOTEBOOKS = [path for path in sorted(ROOT.glob("notebooks/[0-9]*.ipynb")) if WIDGET in path.read_text()]


@pytest.fixture(scope="module")
def lab(browser, tmp_path_factory):
    """The address of a JupyterLab of our own, which leaves no trace in its user's folders."""
    folder = tmp_path_factory.mktemp("lab")
    environment = os.environ | {name: str(folder / name.lower()) for name in LAB_FOLDERS}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    settings = {
        "jupyter_config_dir/labconfig/page_config.json":
            {"disabledExtensions": {"@jupyterlab/apputils-extension:announcements": True}},
        "jupyterlab_settings_dir/@jupyterlab/notebook-extension/tracker.jupyterlab-settings":
            {"windowingMode": "none"},  # or cells out of sight do not exist
    }  # fmt: skip
    for name, content in settings.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
    (folder / "work").mkdir()
    for path in NOTEBOOKS:
        nbformat.write(cut(nbformat.read(path, as_version=4)), folder / "work" / path.name)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [
        sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root",
        "--ip=127.0.0.1", f"--port={port}", f"--IdentityProvider.token={TOKEN}",
        f"--ServerApp.root_dir={folder / 'work'}", "--expose-app-in-browser",
    ]  # fmt: skip
    address = f"http://127.0.0.1:{port}"
    log = folder / "log"
    with log.open("w") as file:
        server = subprocess.Popen(command, env=environment, stdout=file, stderr=file)
    try:
        _wait_until_it_answers(f"{address}/api/status?token={TOKEN}", server, log)
        yield address
    finally:
        server.terminate()  # JupyterLab ends its kernels
        server.wait(30)


def _wait_until_it_answers(url, server, log):
    for _ in range(240):
        assert server.poll() is None, log.read_text()
        try:
            urllib.request.build_opener(urllib.request.ProxyHandler({})).open(url, timeout=5).close()
            return
        except OSError:
            time.sleep(0.5)
    raise TimeoutError(log.read_text())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_key_moves_every_slider_and_the_picture_changes(lab, browser, path):
    """There and back again: the picture that comes back is the first, to the byte."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(90_000)
    page.goto(f"{lab}/doc/tree/{path.name}?token={TOKEN}")
    page.wait_for_function(f"{KERNEL} == 'idle'")
    page.evaluate("window.jupyterapp.commands.execute('notebook:run-all-cells')")
    page.wait_for_function(f"({CELLS})().every(([count]) => count) && {KERNEL} == 'idle'")
    cells = page.evaluate(CELLS)
    assert [count for count, _ in cells] == list(range(1, len(cells) + 1))
    assert not [kinds for _, kinds in cells if "error" in kinds]

    controls = page.locator(".widget-interact")
    assert controls.count() == len(cells) - 1 >= 1
    for control in controls.all():
        sliders = control.locator(".widget-inline-hbox")
        assert 1 <= sliders.count() == control.locator(".noUi-handle").count(), "a control that is no slider"
        for slider in sliders.all():
            _move_and_back(page, slider, control.locator("img"))
    assert not page.locator(ERRORS).all_inner_texts()
    page.evaluate(END_KERNEL)
    page.close()


def _move_and_back(page, slider, picture):
    handle, number = slider.locator(".noUi-handle"), slider.locator(".widget-readout")
    picture.wait_for()
    before, value = picture.get_attribute("src"), number.inner_text()
    assert len(before) > 5_000
    keys = ["ArrowRight", "ArrowLeft"]
    if handle.get_attribute("aria-valuenow") == handle.get_attribute("aria-valuemax"):
        keys.reverse()
    handle.focus()
    page.keyboard.press(keys[0])
    _wait_until(page, picture, lambda src: src != before, f"moved from {value}, the picture stays as it was")
    assert number.inner_text() != value
    page.keyboard.press(keys[1])
    _wait_until(page, picture, lambda src: src == before, f"back at {value}, the picture is another")
    assert number.inner_text() == value


def _wait_until(page, picture, is_right, complaint):
    for _ in range(900):
        if picture.count() and is_right(picture.get_attribute("src")):
            return
        page.wait_for_timeout(100)
    raise AssertionError(complaint)


TOY = {
    "import math\nimport os\nmath.floor(0.5)": "import math",
    "n = 3\nstep = 1\nfactor = 2\n\n\n@staticmethod\ndef twice(x):\n    return factor * x * math.pi":
        "factor = 2\n@staticmethod\ndef twice(x):\n    return factor * x * math.pi",
    "unused = twice(3)": "",
    "squares = [n * n for n in (1, 2)]": "squares = [n * n for n in (1, 2)]",
    "step = [5]\nstep += [1]\nstep[0] = 4": "step = [5]\nstep += [1]\nstep[0] = 4",
    "show(lambda: twice(step), squares)": "show(lambda: twice(step), squares)",
    "step = 0": "",
}  # fmt: skip


def test_a_cut_keeps_what_a_control_needs_and_no_more():
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in TOY])
    notebook.cells[5].outputs = [nbformat.v4.new_output("display_data", {WIDGET: {}})]
    *before, control, _ = TOY.values()
    assert [cell.source for cell in cut(notebook).cells] == ["\n".join(filter(None, before)), control]
