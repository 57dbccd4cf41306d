"""Cameras that stay: frames of a dm_control physics, as dm_control draws them or keyed for a background."""

from typing import Any

import mujoco
import numpy as np
from dm_control.mujoco import wrapper

from sb3_robust_bisim.envs.distractors import Distractor
from sb3_robust_bisim.envs.opengl import rendering_contexts

# What is drawn beyond the objects themselves. Off for the key; the fog would tint the objects.
_EFFECTS = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_HAZE,
    mujoco.mjtRndFlag.mjRND_FOG,
)
# The last of the groups by which MuJoCo shows and hides geoms is hidden unless asked for.
_HIDDEN_GROUP = mujoco.mjNGROUP - 1


def camera_index(physics: Any, camera_id: int | str) -> int:
    """
    :param physics: a dm_control physics
    :param camera_id: number or name of a camera of the model
    :return: its number
    :raises ValueError: when the model has no such camera
    """
    names = [physics.model.id2name(index, "camera") for index in range(physics.model.ncam)]
    if isinstance(camera_id, str) and camera_id in names:
        return names.index(camera_id)
    if isinstance(camera_id, int) and not isinstance(camera_id, bool) and 0 <= camera_id < len(names):
        return camera_id
    raise ValueError(f"camera_id must be a number in [0, {len(names) - 1}] or one of {names}, got {camera_id!r}")


class Camera:
    """
    A view that keeps its scene and its buffers between frames; ``physics.render`` builds both anew for each.

    The frames equal those of ``physics.render``, pixel by pixel, unless ``effects`` is off: no shadows, no reflections and no
    multisampling are then drawn, which a processor without a GPU spends nearly all its time on.

    :param physics: a dm_control physics
    :param camera_id: number or name of a camera of the model
    :param max_size: largest height and width that will be asked for, in pixels
    :param effects: draw shadows, reflections and smooth edges
    :param own_context: hold an OpenGL context of its own, needed beside a camera with other ``effects``, as it fixes them;
        otherwise it is the one that the physics makes when it is first asked for
    :raises ValueError: when the model has no such camera
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
        # MuJoCo reads these when it makes a context: the size of its frame buffer and how much memory the effects get
        physics.model.vis.global_.offwidth = physics.model.vis.global_.offheight = max_size
        if not effects:
            physics.model.vis.quality.offsamples = physics.model.vis.quality.shadowsize = 0
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        contexts = rendering_contexts(physics)
        self._gl = contexts.gl
        self._own_context = wrapper.MjrContext(physics.model, self._gl) if own_context else None
        self._context = self._own_context or contexts.mujoco

    def frame(self, size: int) -> np.ndarray:
        """
        Draw the present state.

        :param size: height and width in pixels, at most ``max_size``
        :return: new contiguous uint8 array of shape (size, size, 3)
        """
        return np.ascontiguousarray(self._draw(size)[::-1])

    def close(self) -> None:
        """Free the context of its own; the camera must not be used afterwards."""
        if self._own_context is not None:
            self._own_context.free()

    def _update_scene(self) -> None:
        model, data = self._physics.model.ptr, self._physics.data.ptr
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._option, self._perturb, self._camera, everything, self._scene)

    def _draw(self, size: int) -> np.ndarray:
        """
        :param size: height and width in pixels
        :return: uint8 array of shape (size, size, 3), bottom row first, that the next call overwrites
        """
        self._update_scene()
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
    A view in which a distractor takes the place of the sky and of all planes: the ground and the walls.

    Neither is drawn, nor anything that would mix an object's colour with theirs, so that the pixels that no object covers stay
    black, and those alone. A key on colour, by contrast, eats blue objects and leaves a fringe around the others. A height
    field (the terrain of ``quadruped-escape``) is an object: it hides what lies behind it.

    :param physics: a dm_control physics
    :param camera_id: number or name of a camera of the model
    :param max_size: largest height and width that will be asked for, in pixels
    :param distractor: its present picture is scaled to the size of the frame, without smoothing
    :param own_context: see :class:`Camera`
    :raises ValueError: when the model has no such camera
    """

    def __init__(
        self, physics: Any, camera_id: int | str, max_size: int, distractor: Distractor, *, own_context: bool = False
    ) -> None:
        super().__init__(physics, camera_id, max_size, effects=False, own_context=own_context)
        self._distractor = distractor
        for effect in _EFFECTS:
            self._scene.flags[effect] = 0
        self._planes = np.flatnonzero(physics.model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE))
        self._plane_groups = physics.model.geom_group[self._planes].copy()

    def frame(self, size: int) -> np.ndarray:
        """
        Draw the present state in front of the present picture of the distractor.

        :param size: height and width in pixels, at most ``max_size``
        :return: new contiguous uint8 array of shape (size, size, 3)
        """
        objects = self._draw(size)
        covered = (objects[..., 0] | objects[..., 1] | objects[..., 2]) != 0
        frame = self._background(size)
        frame[::-1][covered] = objects[covered]
        return frame

    def _background(self, size: int) -> np.ndarray:
        """
        :param size: height and width in pixels
        :return: new contiguous uint8 array of shape (size, size, 3)
        """
        picture = self._distractor.frame
        if len(picture) == size:
            return picture.copy(order="C")
        nearest = np.arange(size) * len(picture) // size
        return picture[nearest[:, None], nearest]

    def _update_scene(self) -> None:
        groups = self._physics.model.geom_group
        groups[self._planes] = _HIDDEN_GROUP
        super()._update_scene()
        groups[self._planes] = self._plane_groups
