"""The installed packages are the locked ones, and every task runs on them."""

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from tutorial_lib.tasks import TASKS, make_env

ROOT = Path(__file__).parents[1]
needs_venv = pytest.mark.skipif(
    Path(sys.prefix).resolve() != ROOT.resolve() / ".venv",
    reason="only .venv promises what environment.lock says",
)


def _locked():
    """The requirements in environment.lock that apply to this machine, by name."""
    lines = (ROOT / "environment.lock").read_text().splitlines()
    requirements = [Requirement(line) for line in lines if not line.startswith("#")]
    return {r.name: r for r in requirements if r.marker is None or r.marker.evaluate()}


def test_every_direct_dependency_is_locked():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    direct = sum(project["optional-dependencies"].values(), project["dependencies"])
    assert {Requirement(line).name for line in direct} <= _locked().keys(), "run `make lock`"


def test_the_lock_pins_and_names_no_address():
    assert all(re.fullmatch(r"==[\d.]+\w*", str(r.specifier)) for r in _locked().values())
    assert "://" not in (ROOT / "environment.lock").read_text()


@needs_venv
def test_installed_versions_are_the_locked_ones():
    # `public` leaves out the build, as in 2.13.0+cpu.
    installed = {name: Version(metadata.version(name)).public for name in _locked()}
    assert installed == {name: str(r.specifier).removeprefix("==") for name, r in _locked().items()}


@needs_venv
def test_pip_check_has_the_one_known_complaint():
    """bullet-safety-gym's metadata asks for an older gymnasium than the one it runs on below."""
    check = subprocess.run([sys.executable, "-m", "pip", "check"], capture_output=True, text=True)
    assert check.stdout.splitlines() == [
        "bullet-safety-gym 1.4.0 has requirement gymnasium~=0.28.1, but you have gymnasium 1.4.0."
    ]


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_every_task_runs(task):
    env = make_env(task)
    try:
        env.action_space.seed(0)
        observation, info = env.reset(seed=0)
        for _ in range(5):
            assert observation.shape == (task.obs_dim,) and np.isfinite(observation).all()
            assert info["cost"] in (0.0, 1.0)
            action = env.action_space.sample()
            assert action.shape == (task.act_dim,)
            observation, reward, terminated, truncated, info = env.step(action)
            assert np.isfinite(reward) and not (terminated or truncated)
    finally:
        env.close()
