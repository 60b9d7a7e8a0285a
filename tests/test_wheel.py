"""The wheel, built of a copy of the sources and installed into an empty folder, works there."""

import configparser
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE")
PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel's file. Nothing is downloaded: setuptools, which builds it, is in the lock."""
    source = tmp_path_factory.mktemp("source")
    shutil.copytree(ROOT / "tutorial_lib", source / "tutorial_lib", ignore=shutil.ignore_patterns("*.pyc"))
    for name in SOURCES:
        shutil.copy(ROOT / name, source)
    out = tmp_path_factory.mktemp("wheel")
    build = "wheel --no-deps --no-build-isolation --no-index --wheel-dir"
    subprocess.run([*PIP, *build.split(), out, source], check=True)
    (path,) = out.iterdir()
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A folder with the installed wheel and nothing else."""
    folder = tmp_path_factory.mktemp("site")
    subprocess.run([*PIP, *"install --no-deps --no-index --target".split(), folder, wheel], check=True)
    return folder


def run(installed, home, *words):
    """Runs Python in an empty folder on the installed package, not on this clone's."""
    named = {"PYTHONPATH": str(installed), "HOME": str(home), "USERPROFILE": str(home)}
    environment = {key: value for key, value in os.environ.items() if key != "C2IQL_DATA"} | named
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True)


def test_the_wheel_has_the_library_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        entry_points = next(name for name in archive.namelist() if name.endswith("/entry_points.txt"))
        scripts = configparser.ConfigParser()
        scripts.read_string(archive.read(entry_points).decode())
        assert any(name.endswith("/LICENSE") for name in archive.namelist())
    library = (path for path in (ROOT / "tutorial_lib").rglob("*") if path.suffix == ".py")
    expected = {path.relative_to(ROOT).as_posix() for path in library}
    assert names == expected | {"tutorial_lib/py.typed"}
    assert dict(scripts["console_scripts"]) == {"c2iql": "tutorial_lib.__main__:main"}


def test_the_installed_package_lists_tasks(installed, tmp_path):
    tasks = run(installed, tmp_path, "-m", "tutorial_lib", "tasks")
    assert tasks.returncode == 0 and tasks.stdout.count("bullet") == 8, tasks.stderr


USE = """
import sys
from tutorial_lib.__main__ import main
from tutorial_lib.data import places

print(places.why_missing(places.data_folder()))
sys.argv = ["c2iql", "train", *sys.argv[1:]]
main()
"""


def test_the_installed_package_looks_for_data_in_the_home_and_trains(installed, tmp_path):
    options = ["--data", f"{ROOT}/data/BallRun.hdf5", *"--updates 2 --crm-steps 2 --out run".split()]
    used = run(installed, tmp_path, "-c", USE, "BallRun", *options)
    assert used.returncode == 0, used.stderr
    message, *_ = used.stdout.splitlines()
    assert message.startswith(f"{tmp_path / '.c2iql'}: this package was installed without its data")
    assert (tmp_path / "run" / "agent.safetensors").is_file() and os.listdir(tmp_path) == ["run"]
