"""
The tasks of the DeepMind Control Suite, based on Shimmy's ``dm_control/...`` environments: ids, and the tasks from state.

The packages of the extra ``dmc`` are imported when an environment is made, so the ids can be registered without them.
"""

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces.utils import flatten, flatten_space

from sb3_robust_bisim.envs.noise import NoisyTask
from sb3_robust_bisim.envs.opengl import import_suite
from sb3_robust_bisim.values import is_whole

if TYPE_CHECKING:
    from sb3_robust_bisim.envs.camera import Camera
    from sb3_robust_bisim.envs.scene import Distraction

# dm_control.suite.ALL_TASKS without importing it
SUITE = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse", "two_poles", "three_poles"),
    "cheetah": ("run",),
    "dog": ("stand", "walk", "trot", "run", "fetch"),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "fish": ("upright", "swim"),
    "hopper": ("stand", "hop"),
    "humanoid": ("stand", "walk", "run", "run_pure_state"),
    "humanoid_CMU": ("stand", "walk", "run"),
    "lqr": ("lqr_2_1", "lqr_6_2"),
    "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
    "pendulum": ("swingup",),
    "point_mass": ("easy", "hard"),
    "quadruped": ("walk", "run", "escape", "fetch"),
    "reacher": ("easy", "hard"),
    "stacker": ("stack_2", "stack_4"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("stand", "walk", "run"),
}
EPISODE_STEPS = 1000  # control steps; the same limit as in dm_control, except for lqr, which has no limit

# Camera 0 is not good for these: it shows the quadruped from far above, and not the way from the ball to the dog's head
_DEFAULT_CAMERA = {"quadruped": "y", "dog-fetch": "y-axis"}
MAX_SIZE = 4096
# dm_control's bound of an actuator without limits
_UNBOUNDED = 1e9


def register_suite() -> None:
    """Register ``robust_bisim/<domain>-<task>-v0`` and ``robust_bisim/<domain>-<task>-pixels-v0`` for the whole suite."""
    for domain, tasks in SUITE.items():
        for task in tasks:
            name, arguments = f"robust_bisim/{domain}-{task}", {"domain": domain, "task": task}
            gym.register(f"{name}-v0", "sb3_robust_bisim.envs.dmc:state_task", kwargs=dict(arguments))
            gym.register(f"{name}-pixels-v0", "sb3_robust_bisim.envs.pixels:PixelTask", kwargs=dict(arguments))


class SuiteTask(gym.Env[np.ndarray, np.ndarray]):
    """
    Common parts of the tasks from state and from pixels: float32 actions in [-1, 1], each applied for several control steps.

    :param domain: domain of the suite, such as "cheetah"
    :param task: task of the domain, such as "run"
    :param action_repeat: control steps per action, whose rewards are summed; an integer >= 1
    :param camera_id: number or name of a camera of the model; None means :func:`default_camera`
    :param render_mode: None or "rgb_array"
    :param render_size: height and width of ``render()`` in pixels, in [1, 4096]
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    action_space: gym.spaces.Box
    distraction: "Distraction | None" = None

    def __init__(
        self,
        domain: str,
        task: str,
        action_repeat: int,
        camera_id: int | str | None,
        render_mode: str | None,
        render_size: int,
    ) -> None:
        self._env: gym.Env[Any, np.ndarray] = gym.make(
            f"dm_control/{domain}-{task}-v0",
            max_episode_steps=EPISODE_STEPS,
            disable_env_checker=True,
            # lqr draws the springs of its model from this. Without it, a seed could not reproduce an episode
            task_kwargs={"random": 0},
        )
        shimmy_env: Any = self._env.unwrapped
        # Otherwise, all unseeded environments would have the same start states
        shimmy_env.np_random = np.random.RandomState()
        self.physics = shimmy_env.physics
        self.action_repeat = action_repeat
        self.camera_id = default_camera(domain, task) if camera_id is None else camera_id
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(round(1 / (shimmy_env.dt * action_repeat)), 1)}
        self._render_size = render_size
        self._views: list[Camera] = []  # from ``_make_views``; ``render`` uses the last one
        space = self._env.action_space
        assert isinstance(space, gym.spaces.Box)
        bounded = space.high < _UNBOUNDED
        self._center = np.where(bounded, (space.high + space.low) / 2, 0.0)
        self._half_range = np.where(bounded, (space.high - space.low) / 2, 1.0)
        self.action_space = gym.spaces.Box(-1.0, 1.0, shape=space.shape, dtype=np.float32)
        self._episode_over = True

    @abstractmethod
    def _make_views(self) -> "list[Camera]":
        """The cameras that the task needs."""

    def __reduce__(self) -> tuple[Any, ...]:
        # OpenGL contexts belong to a process, and the OpenGL backend must be chosen before dm_control is imported
        return _bare, (type(self), bool(self._views)), {**self.__dict__, "_views": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._views = self._make_views()

    @abstractmethod
    def _observe(self, state: dict[str, Any], info: dict[str, Any]) -> np.ndarray:
        """
        :param state: observation of dm_control
        :param info: info of the step; entries may be added
        :return: the agent's observation
        """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Begin an episode.

        :param seed: seed of the start state and of the distraction; None continues both random sequences
        :param options: not used
        :return: observation and info
        """
        super().reset(seed=seed)
        state, info = self._env.reset(seed=seed)
        self._episode_over = False
        if self.distraction is not None:
            if seed is not None:
                self.distraction.seed(seed)
            self.distraction.reset()
        return self._observe(state, info), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Apply an action for ``action_repeat`` control steps, or fewer at the end of an episode.

        :param action: array of shape (n_a,) in [-1, 1]
        :return: observation, sum of the rewards, terminated, truncated and info
        :raises ResetNeeded: if the episode is over; dm_control would start the next one silently
        :raises ValueError: if the action is not a finite array of shape (n_a,)
        """
        if self._episode_over:
            raise ResetNeeded("The episode is over: call reset() before the next step()")
        if np.shape(action) != self._center.shape or not np.all(np.isfinite(action)):
            raise ValueError(
                f"action must hold finite numbers in an array of shape {self._center.shape}, got {action!r}; "
                "a NaN or an infinity usually comes from a policy whose training diverged"
            )
        control = self._center + self._half_range * action
        total_reward = 0.0
        for _ in range(self.action_repeat):
            state, reward, terminated, truncated, info = self._env.step(control)
            total_reward += float(reward)
            self._episode_over = terminated or truncated
            if self._episode_over:
                break
        if self.distraction is not None:
            self.distraction.step()
        return self._observe(state, info), total_reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """
        Draw the scene, including the distraction.

        :return: frame of shape (render_size, render_size, 3), or None without a render mode
        """
        return None if self.render_mode is None else self._views[-1].frame(self._render_size, self.distraction)

    def close(self) -> None:
        """Free the OpenGL contexts and the physics."""
        for view in self._views:
            view.close()
        self._env.close()


def _bare(task_class: type[SuiteTask], rendering: bool) -> SuiteTask:
    """Create a task without attributes, for ``__setstate__``."""
    import_suite(rendering)
    return task_class.__new__(task_class)


class StateTask(SuiteTask):
    """
    A task of the suite that observes its state, flattened to one float32 vector.

    Its ids also accept the arguments of :class:`~sb3_robust_bisim.envs.NoiseObservation`.

    :param domain: domain of the suite, such as "cheetah"
    :param task: task of the domain, such as "run"
    :param action_repeat: control steps per action, whose rewards are summed; an integer >= 1
    :param camera_id: camera of ``render()``, by number or name; None means :func:`default_camera`
    :param render_mode: None or "rgb_array"
    :param render_size: height and width of ``render()`` in pixels, in [1, 4096]
    :raises ValueError: for an argument outside its range
    :raises ImportError: if a package of the extra ``dmc`` is missing
    :raises RuntimeError: if a render mode is given and the machine has no OpenGL that works without a display
    """

    def __init__(
        self,
        domain: str,
        task: str,
        action_repeat: int = 1,
        camera_id: int | str | None = None,
        render_mode: str | None = None,
        render_size: int = 256,
    ) -> None:
        check_task(domain, task, action_repeat, render_mode, render_size)
        import_suite(rendering=render_mode is not None)
        super().__init__(domain, task, action_repeat, camera_id, render_mode, render_size)
        # A Dict that also contains single numbers of shape ()
        self._state_space = self._env.observation_space
        self._views = self._make_views()
        box = flatten_space(self._state_space)
        assert isinstance(box, gym.spaces.Box)
        low, high = box.low.astype(np.float32), box.high.astype(np.float32)
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)

    def _make_views(self) -> "list[Camera]":
        if self.render_mode is None:
            return []
        from sb3_robust_bisim.envs.camera import Camera

        return [Camera(self.physics, self.camera_id, self._render_size)]

    def _observe(self, state: dict[str, Any], info: dict[str, Any]) -> np.ndarray:
        return np.asarray(flatten(self._state_space, state), dtype=np.float32)


# Also accepts the arguments of NoiseObservation
state_task = NoisyTask(StateTask)


def default_camera(domain: str, task: str) -> int | str:
    """
    :param domain: domain of the suite
    :param task: task of the domain
    :return: a camera that shows the task well: 0, except for the quadruped ("y") and dog-fetch ("y-axis")
    """
    return _DEFAULT_CAMERA.get(f"{domain}-{task}", _DEFAULT_CAMERA.get(domain, 0))


def check_task(domain: str, task: str, action_repeat: int, render_mode: str | None, render_size: int) -> None:
    """
    Check the arguments of all tasks, before anything is created.

    :param domain: domain of the suite
    :param task: task of the domain
    :param action_repeat: an integer >= 1
    :param render_mode: None or "rgb_array"
    :param render_size: in pixels
    :raises ValueError: for an argument outside its range
    """
    if task not in SUITE.get(domain, ()):
        raise ValueError(f"domain and task must name a task of the DeepMind Control Suite, got {domain!r} and {task!r}")
    check_integer("action_repeat", action_repeat, EPISODE_STEPS)
    check_integer("render_size", render_size, MAX_SIZE)
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")


def check_integer(name: str, value: int, highest: int) -> None:
    """
    :param name: name of the argument
    :param value: value of the argument
    :param highest: largest value allowed
    :raises ValueError: unless the value is an integer in [1, highest]
    """
    if not is_whole(value, 1, highest):
        raise ValueError(f"{name} must be an integer in [1, {highest}], got {value!r}")
