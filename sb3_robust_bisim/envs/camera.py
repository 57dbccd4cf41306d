"""Reusable cameras: frames of a dm_control physics, as dm_control draws them or with a replaced background."""

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import mujoco
import numpy as np
from dm_control.mujoco import wrapper

from sb3_robust_bisim.envs.opengl import rendering_contexts
from sb3_robust_bisim.envs.scene import CameraPose, Distraction

# Everything that is drawn besides the objects. Off if the background is replaced; fog would tint the objects.
_EFFECTS = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_HAZE,
    mujoco.mjtRndFlag.mjRND_FOG,
)
# MuJoCo shows and hides geoms by group. The last group is hidden by default.
_HIDDEN_GROUP = mujoco.mjNGROUP - 1


def camera_index(physics: Any, camera_id: int | str) -> int:
    """
    :param physics: a dm_control physics
    :param camera_id: number or name of a camera of the model
    :return: its number
    :raises ValueError: if the model has no such camera
    """
    names = [physics.model.id2name(index, "camera") for index in range(physics.model.ncam)]
    if isinstance(camera_id, str) and camera_id in names:
        return names.index(camera_id)
    if isinstance(camera_id, int) and not isinstance(camera_id, bool) and 0 <= camera_id < len(names):
        return camera_id
    raise ValueError(f"camera_id must be a number in [0, {len(names) - 1}] or one of {names}, got {camera_id!r}")


def make_camera_pose(physics: Any, camera_id: int | str, scale: float, dynamic: bool, upper_quadrant: bool) -> CameraPose:
    """
    Measure position and target of a camera in the reference pose of the model.

    The target is the centre of mass of the body that the camera tracks, or of the whole scene. A camera that looks ahead from
    a body turns around a point in front of it, at the distance of the model's extent.

    :param physics: a dm_control physics
    :param camera_id: number or name of a camera of the model
    :param scale: see :class:`~sb3_robust_bisim.envs.scene.CameraPose`
    :param dynamic: see :class:`~sb3_robust_bisim.envs.scene.CameraPose`
    :param upper_quadrant: stay in the upper quadrant; False for the reacher
    :return: the random pose of the camera
    :raises ValueError: if the model has no such camera
    """
    camera, model = camera_index(physics, camera_id), physics.model.ptr
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = max(int(model.cam_targetbodyid[camera]), 0) or int(model.cam_bodyid[camera])
    backward = data.cam_xmat[camera].reshape(3, 3)[:, 2]
    radius, extent = float((data.cam_xpos[camera] - data.subtree_com[body]) @ backward), float(model.stat.extent)
    elevation = math.asin(float(np.clip(backward[2], -1, 1))) if upper_quadrant else None
    return CameraPose(scale, dynamic, elevation, radius if radius > 0.1 * extent else extent)


class Camera:
    """
    A camera that keeps its scene and its buffers between frames. ``physics.render`` builds both for every frame.

    The frames equal those of ``physics.render``, pixel by pixel, unless ``effects`` is off. Shadows, reflections and
    multisampling are then not drawn; without a GPU they take nearly all the time.

    :param physics: a dm_control physics
    :param camera_id: number or name of a camera of the model
    :param max_size: largest height and width of a frame in pixels
    :param effects: draw shadows, reflections and smooth edges
    :param own_context: use a separate OpenGL context instead of the one of the physics. It is needed next to a camera with
        other ``effects``, because a context fixes them
    :raises ValueError: if the model has no such camera
    """

    def __init__(
        self, physics: Any, camera_id: int | str, max_size: int, *, effects: bool = True, own_context: bool = False
    ) -> None:
        self._physics = physics
        self._camera = wrapper.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = camera_index(physics, camera_id)
        self._scene = wrapper.MjvScene(model=physics.model)
        self._option = wrapper.MjvOption()
        self._perturb = wrapper.MjvPerturb()
        self._buffers: dict[int, np.ndarray] = {}
        # MuJoCo reads these when it creates a context: the size of the frame buffer, and the memory for the effects
        physics.model.vis.global_.offwidth = physics.model.vis.global_.offheight = max_size
        if not effects:
            physics.model.vis.quality.offsamples = physics.model.vis.quality.shadowsize = 0
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        contexts = rendering_contexts(physics)
        self._gl = contexts.gl
        self._own_context = wrapper.MjrContext(physics.model, self._gl) if own_context else None
        self._context = self._own_context or contexts.mujoco

    def frame(self, size: int, distraction: Distraction | None = None) -> np.ndarray:
        """
        Draw the current state.

        :param size: height and width in pixels, at most ``max_size``
        :param distraction: moves the camera and changes the colours; its background is not drawn
        :return: new contiguous uint8 array of shape (size, size, 3)
        """
        return np.ascontiguousarray(self._draw(size, distraction)[::-1])

    def close(self) -> None:
        """Free the separate context. The camera must not be used afterwards."""
        if self._own_context is not None:
            self._own_context.free()

    def _update_scene(self, distraction: Distraction | None) -> None:
        model, data = self._physics.model.ptr, self._physics.data.ptr
        everything = mujoco.mjtCatBit.mjCAT_ALL
        with ExitStack() as undo:
            if distraction is not None and distraction.camera is not None:
                undo.enter_context(_moved(data, self._camera.fixedcamid, distraction.camera))
            if distraction is not None and distraction.colors is not None:
                undo.enter_context(distraction.colors.on(model))
            mujoco.mjv_updateScene(model, data, self._option, self._perturb, self._camera, everything, self._scene)

    def _draw(self, size: int, distraction: Distraction | None) -> np.ndarray:
        """
        :param size: height and width in pixels
        :param distraction: see :meth:`frame`
        :return: uint8 array of shape (size, size, 3), bottom row first; the next call overwrites it
        """
        self._update_scene(distraction)
        if size not in self._buffers:
            self._buffers[size] = np.empty((size, size, 3), dtype=np.uint8)
        with self._gl.make_current() as gl:
            gl.call(self._draw_on_gl_thread, self._buffers[size], mujoco.MjrRect(0, 0, size, size))
        return self._buffers[size]

    def _draw_on_gl_thread(self, pixels: np.ndarray, rect: mujoco.MjrRect) -> None:
        context = self._context.ptr
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        mujoco.mjr_render(rect, self._scene, context)
        mujoco.mjr_readPixels(pixels, None, rect, context)


class KeyCamera(Camera):
    """
    A camera that replaces the sky and all planes (ground and walls) by a distractor.

    Sky and planes are not drawn, and neither is anything that mixes their colours with an object's. Exactly the pixels that no
    object covers are therefore black. Detecting the background by its colour instead would remove blue objects and leave a
    fringe around the others. A height field (the terrain of ``quadruped-escape``) is an object and hides what is behind it.

    :param physics: a dm_control physics
    :param camera_id: number or name of a camera of the model
    :param max_size: largest height and width of a frame in pixels
    :param own_context: see :class:`Camera`
    :raises ValueError: if the model has no such camera
    """

    def __init__(self, physics: Any, camera_id: int | str, max_size: int, *, own_context: bool = False) -> None:
        super().__init__(physics, camera_id, max_size, effects=False, own_context=own_context)
        for effect in _EFFECTS:
            self._scene.flags[effect] = 0
        self._planes = np.flatnonzero(physics.model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))
        self._plane_groups = physics.model.geom_group[self._planes].copy()

    def frame(self, size: int, distraction: Distraction | None = None) -> np.ndarray:
        """
        Draw the current state in front of the current background picture.

        :param size: height and width in pixels, at most ``max_size``
        :param distraction: must have a background; its picture is scaled to the size of the frame, without smoothing
        :return: new contiguous uint8 array of shape (size, size, 3)
        """
        assert distraction is not None
        assert distraction.background is not None
        objects = self._draw(size, distraction)
        covered = (objects[..., 0] | objects[..., 1] | objects[..., 2]) != 0
        frame = _scaled(distraction.background.frame, size)
        frame[::-1][covered] = objects[covered]
        return frame

    def _update_scene(self, distraction: Distraction | None) -> None:
        groups = self._physics.model.geom_group
        groups[self._planes] = _HIDDEN_GROUP
        super()._update_scene(distraction)
        groups[self._planes] = self._plane_groups


@contextmanager
def _moved(data: Any, camera: int, pose: CameraPose) -> Iterator[None]:
    """
    Move a camera from where it currently is (it may track a body), during a ``with`` block.

    :param data: ``mujoco.MjData``
    :param camera: number of the camera
    :param pose: the pose to apply
    """
    position, axes = data.cam_xpos[camera], data.cam_xmat[camera]
    usual = position.copy(), axes.copy()
    moved, turned = pose.move(position, axes.reshape(3, 3))
    position[:], axes[:] = moved, turned.ravel()
    try:
        yield
    finally:
        position[:], axes[:] = usual


def _scaled(picture: np.ndarray, size: int) -> np.ndarray:
    """
    :param picture: square uint8 array
    :param size: height and width in pixels
    :return: new contiguous uint8 array of shape (size, size, 3)
    """
    if len(picture) == size:
        return picture.copy(order="C")
    nearest = np.arange(size) * len(picture) // size
    return picture[nearest[:, None], nearest]
