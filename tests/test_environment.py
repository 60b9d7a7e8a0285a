"""The installed packages are the locked ones, and every task runs on them."""

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from episodes import needs_simulator
from packaging.requirements import Requirement
from packaging.version import Version

from tutorial_lib.tasks import SIMULATORS, all_tasks, get_task, make_env

ROOT = Path(__file__).parents[1]
needs_venv = pytest.mark.skipif(
    Path(sys.prefix).resolve() != ROOT.resolve() / ".venv",
    reason="only .venv promises what environment.lock says",
)


SYSTEMS = {  # the variables of markers that differ between systems
    "Linux": {"sys_platform": "linux", "platform_machine": "x86_64", "os_name": "posix"},
    "Linux on Arm": {"sys_platform": "linux", "platform_machine": "aarch64", "os_name": "posix"},
    "macOS": {"sys_platform": "darwin", "platform_machine": "arm64", "os_name": "posix"},
    "Windows": {"sys_platform": "win32", "platform_machine": "AMD64", "os_name": "nt"},
}
PYTHONS = ("3.11", "3.12", "3.13")


def _applying(lines, environment=None):
    """Those requirements among lines that apply to this machine, or to another one, by name."""
    requirements = map(Requirement, lines)
    found = [r for r in requirements if r.marker is None or r.marker.evaluate(environment)]
    assert len({r.name for r in found}) == len(found), "one package has two lines"
    return {r.name: r for r in found}


def _locked(environment=None, lock="environment.lock"):
    """The requirements in a lock that apply to a machine, by name."""
    lines = (ROOT / lock).read_text().splitlines()
    return _applying([line for line in lines if not line.startswith("#")], environment)


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_every_direct_dependency_is_locked_on_every_system(system, python):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    mujoco = extras.pop("mujoco")
    direct = sum(extras.values(), project["dependencies"])
    there = SYSTEMS[system] | {"python_version": python, "python_full_version": f"{python}.0"}
    locked = _locked(there)
    assert _applying(direct, there).keys() <= locked.keys(), "run `make lock`"
    added = _locked(there, "mujoco.lock")
    assert _applying(mujoco, there).keys() <= added.keys() and not added.keys() & locked.keys()
    simulators = [name for name in locked if name.startswith("pybullet")]
    ready = system == "Linux" and python == "3.11"  # the only ready-made wheel of pybullet itself
    assert simulators == ["pybullet" if ready or system == "Linux on Arm" else "pybullet-arm64"]
    assert ("pywinpty" in locked) == ("colorama" in locked) == (system == "Windows")


@pytest.mark.parametrize("lock", ["environment.lock", "mujoco.lock"])
def test_a_lock_pins_and_names_no_address(lock):
    assert all(re.fullmatch(r"==[\d.]+\w*", str(r.specifier)) for r in _locked(lock=lock).values())
    assert "://" not in (ROOT / lock).read_text()


@needs_venv
@pytest.mark.parametrize(
    "lock",
    ["environment.lock", pytest.param("mujoco.lock", marks=needs_simulator(get_task("PointGoal1")))],
)
def test_installed_versions_are_the_locked_ones(lock):
    locked = _locked(lock=lock)
    # `public` leaves out the build, as in 2.13.0+cpu.
    installed = {name: Version(metadata.version(name)).public for name in locked}
    assert installed == {name: str(r.specifier).removeprefix("==") for name, r in locked.items()}


@needs_venv
def test_pip_check_has_only_the_known_complaints():
    """bullet-safety-gym's metadata asks for an older gymnasium than the one it runs on below.

    Where pybullet-arm64 takes the place of pybullet, it asks for that, too. Where the extra `mujoco` is
    installed, it asks for older releases, and for packages of which the course uses nothing.
    """
    known = {"bullet-safety-gym 1.4.0 has requirement gymnasium~=0.28.1, but you have gymnasium 1.4.0."}
    if "pybullet" not in _locked():
        known.add("bullet-safety-gym 1.4.0 requires pybullet, which is not installed.")
    if not SIMULATORS["mujoco"].missing():
        known |= {
            "mujoco 4.0.0 requires mujoco-studio, which is not installed.",
            "safety-gymnasium 1.0.0 requires gymnasium-robotics, which is not installed.",
            "safety-gymnasium 1.0.0 requires pygame, which is not installed.",
            "safety-gymnasium 1.0.0 has requirement gymnasium==0.28.1, but you have gymnasium 1.4.0.",
            "safety-gymnasium 1.0.0 has requirement mujoco==2.3.3, but you have mujoco 4.0.0.",
        }
    check = subprocess.run([sys.executable, "-m", "pip", "check"], capture_output=True, text=True)
    assert set(check.stdout.splitlines()) == known


@pytest.mark.parametrize(
    "task", [pytest.param(task, id=task.name, marks=needs_simulator(task)) for task in all_tasks().values()]
)
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
