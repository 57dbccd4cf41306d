"""Distraction in the scene itself: random camera poses and colours, as in the Distracting Control Suite."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from sb3_robust_bisim.envs.distractors import Distractor
from sb3_robust_bisim.envs.random_sequence import RandomSequence

# The scale s; every range is a multiple of it
SCALES = {"easy": 0.1, "medium": 0.2, "hard": 0.3}

# MuJoCo objects that are drawn with a material or with their own colour
_COLORED = ("geom", "site", "tendon", "skin")
# For an object with a material, this value means that it has no colour of its own
_NO_COLOR = (0.5, 0.5, 0.5, 1.0)
# Lower bound of the brightest channel of a colour, because black objects would be replaced by the background
_DARKEST = 0.1


class CameraPose(RandomSequence):
    """
    A camera at a random position on a sphere around its target.

    Horizontal, vertical and roll angle are uniform in +-(pi/2) s, the distance in [1 - 0.5 s, 1 + 1.5 s] times the normal one.
    The camera stays in the upper quadrant of the sphere: in front of the robot, and not below its target. The reacher is seen
    from above and has no such limit: its camera tilts in all directions.

    The velocity of a moving camera is a random walk, and is reversed at the bounds. In radii of the sphere per step, each of
    its three components changes by N(0, (0.025 s)^2), and its norm is at most 0.1 s (the suite: 0.1 s and 0.4 s in metres,
    times a quarter of the radius). The speed of the roll, in radians per step, changes by N(0, (pi/300 s)^2) and is at most
    pi/50 s.

    :param scale: s, a value of :data:`SCALES`
    :param dynamic: move within an episode
    :param elevation: elevation angle of the normal position in radians, in [-pi/2, pi/2]; None: no limit to a quadrant
    :param radius: distance between the normal position and the target in metres, > 0
    """

    stream = (0x43414D45,)  # the letters "CAME"

    def __init__(self, scale: float, dynamic: bool, elevation: float | None, radius: float) -> None:
        super().__init__()
        self._dynamic = dynamic
        self._around_vertical = elevation is not None
        self._radius = radius
        angle = scale * math.pi / 2
        # Horizontal angle, vertical angle (upwards), relative distance, roll
        self.low = np.array([-angle, -angle, 1 - 0.5 * scale, -angle])
        self.high = np.array([angle, angle, 1 + 1.5 * scale, angle])
        if elevation is not None:
            self.low[1], self.high[1] = np.clip((-elevation, math.pi / 2 - elevation), -angle, angle)
        self._noise = scale * np.array([0.025, 0.025, 0.025, math.pi / 300])
        self._max_speed, self._max_roll_speed = 0.1 * scale, math.pi / 50 * scale
        self.pose = np.array([0.0, 0.0, 1.0, 0.0])
        self._velocity = np.zeros(4)

    def reset(self) -> None:
        self.pose = self._rng.uniform(self.low, self.high)
        self._velocity = np.zeros(4)

    def step(self) -> None:
        if not self._dynamic:
            return
        velocity = self._velocity + self._noise * self._rng.standard_normal(4)
        velocity[:3] *= min(1.0, self._max_speed / math.hypot(*velocity[:3]))
        velocity[3] *= min(1.0, self._max_roll_speed / abs(velocity[3]))
        pose = self.pose + velocity
        self.pose = np.minimum(np.maximum(pose, self.low), self.high)
        self._velocity = np.where(self.pose == pose, velocity, -velocity)

    def move(self, position: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Apply the current pose to a camera.

        :param position: position of the camera in metres, shape (3,)
        :param axes: its right, upward and backward axis as columns, shape (3, 3)
        :return: both after the move
        """
        horizontal, vertical, distance, roll = self.pose.tolist()
        tilt = _rotation(0, -vertical) @ _rotation(2, roll)
        turned = _rotation(2, horizontal) @ axes @ tilt if self._around_vertical else axes @ _rotation(1, horizontal) @ tilt
        return position + self._radius * (distance * turned[:, 2] - axes[:, 2]), turned


def _rotation(axis: int, angle: float) -> np.ndarray:
    """
    :param axis: 0, 1 or 2
    :param angle: in radians
    :return: rotation matrix of shape (3, 3)
    """
    matrix, cosine, sine = np.eye(3), math.cos(angle), math.sin(angle)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix[first, first] = matrix[second, second] = cosine
    matrix[first, second], matrix[second, first] = -sine, sine
    return matrix


class SceneColors(RandomSequence):
    """
    Random colours that replace those of the model: of every material, and of every geom, site, tendon and skin that has its
    own colour. Textures stay, tinted by the colour of their material.

    Red, green and blue are each uniform within +-s of their normal value, and in [0, 1]. No colour becomes black: the
    brightest channel of a colour is at least 0.1, unless the normal colour is darker. Dynamic colours change by a Gaussian
    step of standard deviation 0.03 s per channel at every agent step, within the same bounds.

    :param model: ``mujoco.MjModel`` in its normal colours
    :param scale: s, a value of :data:`SCALES`
    :param dynamic: change within an episode
    """

    stream = (0x434F4C4F,)  # the letters "COLO"

    def __init__(self, model: Any, scale: float, dynamic: bool) -> None:
        super().__init__()
        self._dynamic = dynamic
        self._step_size = 0.03 * scale
        # Names of the model's arrays and rows in them. The colours below have the same order
        self.rows = {"mat_rgba": np.arange(model.nmat)}
        for kind in _COLORED:
            rgba, material = getattr(model, f"{kind}_rgba"), getattr(model, f"{kind}_matid")
            self.rows[f"{kind}_rgba"] = np.flatnonzero((material < 0) | (rgba != _NO_COLOR).any(axis=1))
        usual = np.concatenate([getattr(model, name)[rows, :3] for name, rows in self.rows.items()]).astype(float)
        self.low, self.high = np.clip(usual - scale, 0, 1), np.clip(usual + scale, 0, 1)
        every, brightest = np.arange(len(usual)), usual.argmax(axis=1)
        self.low[every, brightest] = np.maximum(self.low[every, brightest], np.minimum(usual.max(axis=1), _DARKEST))
        self.colors = usual

    def reset(self) -> None:
        self.colors = self._rng.uniform(self.low, self.high)

    def step(self) -> None:
        if self._dynamic:
            steps = self._step_size * self._rng.standard_normal(self.colors.shape)
            self.colors = np.clip(self.colors + steps, self.low, self.high)

    @contextmanager
    def on(self, model: Any) -> Iterator[None]:
        """
        Apply the current colours to the model during a ``with`` block.

        :param model: the ``mujoco.MjModel``
        """
        painted = [(getattr(model, name), rows) for name, rows in self.rows.items() if len(rows)]
        usual = [rgba[rows, :3] for rgba, rows in painted]
        start = 0
        for rgba, rows in painted:
            rgba[rows, :3] = self.colors[start : start + len(rows)]
            start += len(rows)
        try:
            yield
        finally:
            for (rgba, rows), colors in zip(painted, usual, strict=True):
                rgba[rows, :3] = colors


@dataclass
class Distraction:
    """
    All distractions of a pixel task.

    :param background: replaces sky, ground and walls
    :param camera: moves the camera
    :param colors: changes the colours of the robot and the objects
    """

    background: Distractor | None = None
    camera: CameraPose | None = None
    colors: SceneColors | None = None

    @property
    def parts(self) -> list[RandomSequence]:
        """The parts that are not None."""
        return [part for part in (self.background, self.camera, self.colors) if part is not None]

    def seed(self, seed: int) -> None:
        """
        Restart all random generators. Each part has its own stream, so the parts do not affect each other.

        :param seed: integer >= 0
        """
        for part in self.parts:
            part.seed(seed)

    def reset(self) -> None:
        """Start an episode."""
        for part in self.parts:
            part.reset()

    def step(self) -> None:
        """Advance by one agent step."""
        for part in self.parts:
            part.step()

    def another(self) -> Self:
        """
        Create an independent distraction of the same kind. This one is not affected.

        :return: a distraction at the start of an episode
        """
        background, camera, colors = self.background, self.camera, self.colors
        return type(self)(
            None if background is None else background.another(),
            None if camera is None else camera.another(),
            None if colors is None else colors.another(),
        )


def check_scene(camera_distraction: str | None, color_distraction: str | None, dynamic: bool) -> None:
    """
    Check the arguments of a task.

    :param camera_distraction: None or a key of :data:`SCALES`
    :param color_distraction: None or a key of :data:`SCALES`
    :param dynamic: True needs one of the two above
    :raises ValueError: for an argument outside its range, or ``dynamic`` without something that moves
    """
    for name, value in (("camera_distraction", camera_distraction), ("color_distraction", color_distraction)):
        if value not in (None, *SCALES):
            raise ValueError(f"{name} must be None (the default) or one of {tuple(SCALES)}, got {value!r}")
    if not isinstance(dynamic, bool):
        raise ValueError(f"dynamic must be True or False, got {dynamic!r}")
    if dynamic and camera_distraction is None and color_distraction is None:
        raise ValueError("dynamic=True moves camera and colours: add camera_distraction or color_distraction, or omit it")
