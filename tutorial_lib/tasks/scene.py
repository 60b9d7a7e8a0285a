"""The scene of a task: where it takes place, seen from above, and how figures show it.

Figures of episodes and recordings ask a task's scene and never its name. matplotlib is slow to import, so
this module does not import it: methods draw with the axis that they are given.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True)
class Scene:
    """A place with two parallel walls. A step is unsafe when it ends outside them.

    Positions are (x, y) in metres, as arrays of shape (..., 2). The origin lies midway between the walls.
    """

    name: str
    """The word that the names of its tasks end with."""
    wall: float
    """The distance of each wall from the origin, in metres."""
    wall_axis: Literal["x", "y"]
    """The coordinate that the walls limit: a step is unsafe where its absolute value is above `wall`."""
    reach: float
    """How far a figure's axes extend from the origin at least, in metres."""
    circle_radius: float | None = None
    """The radius of the circle on which the reward is highest, in metres. None: there is no circle."""
    has_speed_limit: bool = False
    """Whether a step is also unsafe when the robot is too fast. The limit is the robot's."""
    is_wide: bool = False
    """Whether robots travel far along x. Figures then have wide panels, one below the other, of which the
    x axis fits the episode. The panels of other scenes are squares beside each other, with equal axes."""
    is_seen_from_afar: bool = False
    """Whether the robot is only a few pixels wide in the simulator's picture. Figures then mark it."""
    metres_per_unit: float = 10.0
    """Observations begin with the robot's x and y in this unit."""

    def positions(self, observations: np.ndarray) -> np.ndarray:
        """The robot's positions (..., 2) in metres, from its observations (..., obs_dim)."""
        return self.metres_per_unit * observations[..., :2]

    def is_outside(self, positions: np.ndarray) -> np.ndarray:
        """Whether each position (..., 2) lies outside the walls, (...) bool."""
        return np.abs(np.asarray(positions)[..., "xy".index(self.wall_axis)]) > self.wall

    def reasons(self, positions: np.ndarray) -> dict[str, np.ndarray]:
        """The reasons for which a step can be unsafe, and for each a mask (...) of the positions (..., 2).

        An unsafe step is unsafe for the reason whose mask holds the position where it ended. Outside the
        walls the reason is 'outside', whatever the speed.
        """
        outside = self.is_outside(positions)
        return {"outside": outside} | ({"too fast": ~outside} if self.has_speed_limit else {})

    def layout(self, count: int, wide_panel: tuple[float, float] = (12, 2.5)):
        """Where `count` panels stand: (rows, columns), and the figure's (width, height) in inches.

        `wide_panel` is the size of one panel of a wide scene.
        """
        if self.is_wide:
            return (count, 1), (wide_panel[0], wide_panel[1] * count)
        return (1, count), (4 * count, 4.9)

    def draw(self, ax, positions: np.ndarray) -> None:
        """Draw the cost zone and the circle on a matplotlib axis whose limits hold the positions (N, 2), too.

        The limits only grow, because panels can share their axes.
        """
        from tutorial_lib.style import COST, REWARD  # imports matplotlib

        far = np.abs(positions[:, 1] if self.is_wide else positions).max(initial=0)
        half = max(self.reach, 1.1 * far, ax.get_ylim()[1])
        ticks = (-self.wall, 0, self.wall)
        ax.set(ylim=(-half, half), yticks=ticks, xlabel="x (m)", ylabel="y (m)")
        if not self.is_wide:
            ax.set(xlim=(-half, half), xticks=ticks, aspect="equal")
        span = ax.axvspan if self.wall_axis == "x" else ax.axhspan
        for side in (-1, 1):
            span(side * self.wall, side * 1000, color=COST, alpha=0.15, linewidth=0)
        if self.circle_radius is not None:
            angle = np.linspace(0, 2 * np.pi, 200)
            circle = self.circle_radius * np.cos(angle), self.circle_radius * np.sin(angle)
            ax.plot(*circle, color=REWARD, linewidth=1.5, alpha=0.6, label="where the reward is highest")

    def draw_walls(self, ax) -> None:
        """Draw the walls as lines over a picture of positions, such as a histogram.

        The axis of a wide scene grows where it is too small to show both walls.
        """
        from tutorial_lib.style import COST  # imports matplotlib

        line = ax.axvline if self.wall_axis == "x" else ax.axhline
        for side in (-1, 1):
            line(side * self.wall, color=COST, linewidth=2, label="edge of the cost zone")
        if self.is_wide:
            low, high = ax.get_ylim()
            ax.set_ylim(min(low, -1.15 * self.wall), max(high, 1.15 * self.wall))
        else:
            ax.set_aspect("equal")


RUN = Scene("Run", wall=2.0, wall_axis="y", reach=3.0, has_speed_limit=True, is_wide=True)
"""Robots run along x. A step costs 1 outside the walls or above the robot's speed limit."""

CIRCLE = Scene("Circle", wall=6.0, wall_axis="x", reach=9.0, circle_radius=7.0, is_seen_from_afar=True)
"""Robots drive around a circle that lies partly outside the walls, where a step costs 1."""
