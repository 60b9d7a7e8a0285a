"""The tasks of the family "bullet" as gymnasium environments that are seeded and report the cost separately.

The simulator, `bullet-safety-gym`, ignores `reset(seed=...)`: it draws from NumPy's global generator, and
the motor commands and contacts of one episode act on the first instant of the next. This module corrects
both, so that a seed repeats an episode whatever ran before it.
"""

import contextlib
import sys
import warnings
from importlib.metadata import PackageNotFoundError, version

import gymnasium
import numpy as np

from tutorial_lib.tasks.record import Task


def pybullet_package() -> str:
    """The installed package that brings the module `pybullet`.

    It is pybullet-arm64 where pybullet has no ready-made files, for example on macOS on Arm.
    """
    try:
        version("pybullet-arm64")
    except PackageNotFoundError:
        return "pybullet"
    return "pybullet-arm64"


class BulletTask(gymnasium.Env):
    """One task of Bullet-Safety-Gym.

    Observations are float32 (obs_dim,), actions float32 (act_dim,) in [-1, 1]. `step` returns the
    reward and puts the cost, 0.0 or 1.0, into `info["cost"]`. `terminated` means that the robot fell
    or tipped over; `truncated` that the horizon was reached: the two are never merged.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}

    def __init__(self, task: Task, render_mode: str | None = None, image_size=(320, 240)):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', not {render_mode!r}")
        self.task = task
        self.render_mode = render_mode
        self.image_size = image_size
        with _global_numpy_seed(0):
            self._sim = _make_simulator(self.task.env_id)
            self._sim.reset()  # the simulator saves its state at its first reset, and restores it at others
        limit = np.full(self.task.obs_dim, 1000.0, np.float32)
        self.observation_space = gymnasium.spaces.Box(-limit, limit, dtype=np.float32)
        one = np.ones(self.task.act_dim, np.float32)
        self.action_space = gymnasium.spaces.Box(-one, one, dtype=np.float32)
        self._steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._forget_last_episode()
        with _global_numpy_seed(int(self.np_random.integers(2**32))):
            observation, _ = self._sim.reset()
        self._hide_red_sphere()
        self._steps = 0
        return observation.astype(np.float32), {"cost": 0.0}

    def step(self, action):
        action = np.asarray(action, np.float32)
        if action.shape != (self.task.act_dim,):
            raise ValueError(
                f"{self.task.name} takes actions of shape ({self.task.act_dim},), not {action.shape}"
            )
        observation, reward, terminated, _, info = self._sim.step(action)
        self._steps += 1
        truncated = self._steps >= self.task.horizon and not terminated
        return (
            observation.astype(np.float32),
            float(reward),
            terminated,
            truncated,
            {"cost": float(info["cost"])},
        )

    def render(self):
        """The scene as (height, width, 3) uint8, drawn off-screen; None without `render_mode`.

        A red sphere surrounds a robot whose last step was unsafe.
        """
        if self.render_mode is None:
            return None
        client = self._sim.bc
        width, height = self.image_size
        pixels = client.getCameraImage(width, height, *self._camera(), renderer=client.ER_TINY_RENDERER)[2]
        return np.asarray(pixels, np.uint8).reshape(height, width, 4)[..., :3]

    def close(self):
        self._sim.close()

    @property
    def position(self) -> np.ndarray:
        """The robot's (x, y) in metres: what the Run and Circle costs look at.

        Raises AttributeError where the task has no scene, so that the environment has no position.
        """
        if self.task.scene is None:
            raise AttributeError(f"{self.task.name} has no scene, and so no position")
        return self._sim.agent.get_position()[:2]

    @property
    def speed_limit(self) -> float:
        """In m/s: what the Run costs look at besides the position."""
        return self._sim.agent.velocity_constraint

    @property
    def pixel(self) -> tuple[float, float]:
        """Where `render` shows the robot's middle: (column, row), in pixels from the upper left corner."""
        view, projection = (np.reshape(matrix, (4, 4)).T for matrix in self._camera())  # stored by columns
        x, y, _, w = projection @ view @ [*self._sim.agent.get_position(), 1.0]
        width, height = self.image_size
        return float((x / w + 1) / 2 * width), float((1 - y / w) / 2 * height)

    def _camera(self):
        """The view and projection matrices of the simulator's camera."""
        client, camera = self._sim.bc, self._sim.world.camera
        width, height = self.image_size
        view = client.computeViewMatrixFromYawPitchRoll(
            camera.cam_base_pos, camera.cam_dist, camera.cam_yaw, camera.cam_pitch, 0, 2
        )
        return view, client.computeProjectionMatrixFOV(60, width / height, nearVal=0.1, farVal=100.0)

    def _hide_red_sphere(self):
        """The simulator puts a red sphere around a robot whose last step was unsafe, and only then.

        It leaves it from one episode to the next, and begins with one that is almost transparent, which
        off-screen is opaque: at a reset it is taken away.
        """
        self._sim.agent._violates_constraints = True  # so that a change is seen
        self._sim.agent.violates_constraints(False)

    def _forget_last_episode(self):
        """Drop the motor commands and contacts that the simulator keeps: its reset steps the physics once."""
        client, body = self._sim.bc, self._sim.agent.body_id
        self._sim.agent.set_position((0, 0, 100))  # out of reach of everything, so that no contact is kept
        client.performCollisionDetection()
        for joint in range(client.getNumJoints(body)):
            client.setJointMotorControl2(body, joint, client.VELOCITY_CONTROL, targetVelocity=0, force=0)


def _make_simulator(env_id: str):
    """The bare simulator, without gymnasium's wrappers.

    It silences its own start-up by file descriptor, which a notebook's stdout may not have.
    """
    real_streams = (contextlib.redirect_stdout(sys.__stdout__), contextlib.redirect_stderr(sys.__stderr__))
    with warnings.catch_warnings(), real_streams[0], real_streams[1]:
        warnings.simplefilter("ignore")
        import bullet_safety_gym  # noqa: F401  (registers the environments)

        return gymnasium.make(env_id, disable_env_checker=True).unwrapped


@contextlib.contextmanager
def _global_numpy_seed(seed: int):
    """The one place where global random state is touched, because the simulator draws from it."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)
