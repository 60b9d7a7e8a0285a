"""Sliders in a real browser: JupyterLab runs a whole notebook, a key moves a slider, the picture changes."""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOKEN = "course"
LAB_FOLDERS = (
    "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "JUPYTERLAB_SETTINGS_DIR",
    "JUPYTERLAB_WORKSPACES_DIR", "IPYTHONDIR",
)  # fmt: skip
KERNEL = "window.jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel?.status"
CELLS = """() => window.jupyterapp.shell.currentWidget.content.model.sharedModel.cells
    .filter(cell => cell.cell_type == "code")
    .map(cell => [cell.execution_count, cell.outputs.map(output => output.output_type)])"""
NOTEBOOK = "00_start_here.ipynb"


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
    shutil.copy(ROOT / "notebooks" / NOTEBOOK, folder / "work")
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
            urllib.request.urlopen(url, timeout=5).close()
            return
        except OSError:
            time.sleep(0.5)
    raise TimeoutError(log.read_text())


def test_a_key_moves_the_slider_and_the_picture_changes(lab, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(90_000)
    page.goto(f"{lab}/doc/tree/{NOTEBOOK}?token={TOKEN}")
    page.wait_for_function(f"{KERNEL} == 'idle'")
    page.evaluate("window.jupyterapp.commands.execute('notebook:run-all-cells')")
    page.wait_for_function(f"({CELLS})().every(([count]) => count) && {KERNEL} == 'idle'")
    cells = page.evaluate(CELLS)
    assert [count for count, _ in cells] == list(range(1, len(cells) + 1))
    assert not [kinds for _, kinds in cells if "error" in kinds]

    control = page.locator(".widget-interact").first
    picture, number = control.locator("img"), control.locator(".widget-readout").first
    picture.wait_for()
    before, limit = picture.get_attribute("src"), number.inner_text()
    assert len(before) > 10_000
    control.locator(".noUi-handle").first.focus()
    page.keyboard.press("ArrowRight")
    _wait_for_another(page, picture, before)
    assert number.inner_text() != limit
    page.close()


def _wait_for_another(page, picture, before):
    for _ in range(180):
        if picture.count() and picture.get_attribute("src") != before:
            return
        page.wait_for_timeout(500)
    raise AssertionError("the slider was moved, and the picture stayed as it was")
