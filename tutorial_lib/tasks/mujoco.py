"""The tasks of the family "mujoco" as gymnasium environments: four Point tasks and three Velocity tasks.

Source: safety-gymnasium 1.0.0 (Ji et al. 2023). It was written for gymnasium 0.28.1, MuJoCo 2.3.3 and Python
3.10, and is played here with the releases of `mujoco.lock`. `_prepare` puts right what fails with them.

Departures. None changes an episode, but for the release of MuJoCo.

1. The sky is a plain gradient. The package decodes six pictures of stars at every reset, which takes 0.6 s.
2. A reset without a seed draws the next seed from the environment's own generator, as in every task.
3. The quaternion in the Ant's first observation has length one, as in MuJoCo 2.3.3. MuJoCo 4 leaves it as it
   was drawn.
4. Where the package finds no place for a new goal it ends the episode. Here that is a time limit, not a fall.

Measured on HalfCheetah: with MuJoCo 2.3.3 and with 4.0.0 the same seed and actions give observations that
differ by 1e-15 after a step, and by 4e-10 after 50. Contacts amplify rounding errors, so single episodes
repeat only with one release of MuJoCo.
"""

import contextlib
import copy
import ctypes.util
import functools
import importlib
import importlib.util
import os
import sys
import types
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from tutorial_lib.tasks.record import Task


class MujocoTask(gymnasium.Env):
    """One task of SafetyGymnasium.

    Observations are float32 (obs_dim,), actions float32 (act_dim,) in [-1, 1]. `step` returns the reward and
    puts the cost, 0.0 or 1.0, into `info["cost"]`. `terminated` means that the robot fell; `truncated` that
    the horizon was reached: the two are never merged. `reset(seed)` repeats an episode bit for bit, with its
    layout of hazards, goals and buttons.

    Raises ValueError for an unknown `render_mode`, and RuntimeError where pictures cannot be drawn.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, task: Task, render_mode: str | None = None, image_size=(320, 240)):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', not {render_mode!r}")
        if render_mode:
            choose_backend()
        self.task = task
        self.render_mode = render_mode
        self._is_velocity = task.name.endswith("Velocity")
        with _silence():
            self._sim = _make_simulator(task, render_mode, *image_size)
        limit = np.full(task.obs_dim, 1e6, np.float32)
        self.observation_space = gymnasium.spaces.Box(-limit, limit, dtype=np.float32)
        one = np.ones(task.act_dim, np.float32)
        self.action_space = gymnasium.spaces.Box(-one, one, dtype=np.float32)
        self._steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        observation, _ = self._sim.reset(seed=int(self.np_random.integers(2**32)))
        if self._is_velocity:
            import mujoco

            mujoco.mj_normalizeQuat(self._sim.model, self._sim.data.qpos)
            observation = self._sim._get_obs()
            if self.render_mode:  # the simulator marks the speed only where it has a viewer
                self._sim.mujoco_renderer._get_viewer(self.render_mode)._markers.clear()
        self._steps = 0
        return observation.astype(np.float32), {"cost": 0.0}

    def step(self, action):
        action = np.asarray(action, np.float32)
        if action.shape != (self.task.act_dim,):
            raise ValueError(
                f"{self.task.name} takes actions of shape ({self.task.act_dim},), not {action.shape}"
            )
        observation, reward, cost, ended, _, _ = self._sim.step(action)
        self._steps += 1
        terminated = bool(ended) and self.task.terminates
        truncated = not terminated and (bool(ended) or self._steps >= self.task.horizon)
        return observation.astype(np.float32), float(reward), terminated, truncated, {"cost": float(cost)}

    def render(self):
        """The scene as (height, width, 3) uint8, drawn off-screen; None without `render_mode`.

        The camera follows the robot of a Velocity task, and shows a Point task from above. A red sphere marks
        a robot whose last step was unsafe. A Velocity task shows it once per step.
        """
        if self.render_mode is None:
            return None
        return np.ascontiguousarray(self._sim.render())

    def close(self):
        if self._is_velocity:
            self._sim.close()
        else:
            for viewer in self._sim.task._viewers.values():
                viewer.close()
            self._sim.task._viewers.clear()
            self._sim.task.viewer = None


def _make_simulator(task: Task, render_mode: str | None, width: int, height: int):
    """The package's environment of a task. Its `step` returns six values: the cost is the third."""
    _prepare()
    options = {"render_mode": render_mode, "width": width, "height": height}
    if not task.name.endswith("Velocity"):
        return _seeded_builder()(task.env_id, {"agent_name": task.robot}, camera_name="fixedfar", **options)
    snake = "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in task.robot)
    module = importlib.import_module(f"safety_gymnasium.tasks.safe_velocity.safety{snake}_velocity_v1")
    return getattr(module, f"Safety{task.robot}VelocityEnv")(**options)


@contextlib.contextmanager
def _silence():
    """Hide what the package's own files cause whenever an environment is made.

    The infinite bounds of its spaces overflow in float32. MuJoCo warns of an old word in the HalfCheetah's
    model, and would write that into a file in the working directory.
    """
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    finally:
        mujoco.set_mju_user_warning(before)


@functools.cache
def _seeded_builder() -> type:
    """The class of the Point tasks. The package draws its first seed from NumPy's global generator."""
    from safety_gymnasium.builder import Builder

    class SeededBuilder(Builder):
        def set_seed(self, seed=None):
            super().set_seed(seed or 0)

    return SeededBuilder


# --- What safety-gymnasium needs on newer releases ---


class _HashableArray(np.ndarray):
    """Dataclasses refuse a default that has no hash, because it could be changed for all instances."""

    __hash__ = object.__hash__  # type: ignore[assignment]


@functools.cache
def _prepare() -> None:
    """Make the package's modules importable, once per process, without changing the package's files."""
    package = _bare_package("safety_gymnasium")
    # Its window needs a display and a class that gymnasium has changed. Pictures are drawn off-screen only.
    viewer = types.ModuleType("safety_gymnasium.utils.keyboard_viewer")
    vars(viewer)["KeyboardViewer"] = object
    sys.modules[viewer.__name__] = viewer

    colours = importlib.import_module("safety_gymnasium.assets.color").COLOR
    for name, colour in colours.items():
        colours[name] = np.asarray(colour, float).view(_HashableArray)

    # The world reads its textures from a file at every reset. It gets a copy of what was read once.
    world: Any = importlib.import_module("safety_gymnasium.world")
    file = Path(package.__path__[0]) / "configs" / "assets.yaml"
    assets = world.yaml.safe_load(file.read_text(encoding="utf-8"))
    assets["textures"]["skybox"] = {
        "@type": "skybox", "@builtin": "gradient", "@width": "64", "@height": "64",
        "@rgb1": "0.9 0.95 1", "@rgb2": "0.6 0.75 0.9",
    }  # fmt: skip
    world.yaml = types.SimpleNamespace(load=lambda file, Loader: copy.deepcopy(assets), FullLoader=None)

    # gymnasium 1 wants the size of the pictures, which the package has put into the model.
    underlying: Any = importlib.import_module("safety_gymnasium.bases.underlying")
    make = underlying.OffScreenViewer

    def make_viewer(model, data):
        return make(model, data, model.vis.global_.offwidth, model.vis.global_.offheight)

    underlying.OffScreenViewer = make_viewer


def _bare_package(name: str) -> types.ModuleType:
    """A package whose modules can be imported, but whose `__init__` has not run.

    The `__init__` of safety-gymnasium registers environments with functions that gymnasium 1 does not have,
    and imports gymnasium-robotics for tasks with many robots.
    """
    spec = importlib.util.find_spec(name)
    if spec is None or spec.submodule_search_locations is None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    package = types.ModuleType(name)
    package.__path__ = list(spec.submodule_search_locations)
    package.__file__, package.__spec__ = spec.origin, spec
    sys.modules[name] = package
    return package


# --- Pictures without a display ---


@functools.cache
def choose_backend() -> str:
    """Decide, once per process, what draws pictures: the value of the environment variable MUJOCO_GL.

    Where it is not set, Linux draws with EGL, or with OSMesa where there is no EGL: neither needs a display.
    Other systems draw with GLFW. Raises RuntimeError where the choice does not work here.
    """
    if "MUJOCO_GL" not in os.environ:
        names = {"egl": "EGL", "osmesa": "OSMesa"} if sys.platform == "linux" else {}
        os.environ["MUJOCO_GL"] = next(filter(lambda n: ctypes.util.find_library(names[n]), names), "glfw")
    name = os.environ["MUJOCO_GL"]
    try:
        importlib.import_module(f"mujoco.{name}").GLContext(16, 16).free()
    except Exception as error:  # PyOpenGL raises many kinds where a library or a driver is missing
        raise RuntimeError(
            f"MuJoCo cannot draw pictures with MUJOCO_GL={name} ({error}): install EGL (Debian: apt install "
            "libegl1 libegl-mesa0 libgl1-mesa-dri), or OSMesa (libosmesa6) and set MUJOCO_GL=osmesa"
        ) from error
    return name
