"""Record an agent: a video of the task and, if it acts from pixels, a contact sheet of its observations."""

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_robust_bisim.frame_buffer import frames_per_observation, newest_frames
from sb3_robust_bisim.runs.atomic import atomic_path

COLUMNS, ROWS = 8, 4
MAX_FRAMES = 1000  # for tasks whose episodes do not end
GIF_FPS = 50  # browsers slow down faster ones


@dataclass
class Episode:
    """
    :param fps: speed of the task in frames per second
    :param shown: rendered frames, (H, W, 3) bytes each
    :param seen: the newest frame of each observation, likewise; none if the agent observes no frames
    :param total_reward: undiscounted return
    """

    fps: float
    shown: list[np.ndarray] = field(default_factory=list)
    seen: list[np.ndarray] = field(default_factory=list)
    total_reward: float = 0.0


def record_or_explain(model: BaseAlgorithm, make_venv: Callable[[], VecEnv], folder: Path) -> str:
    """
    :param model: see :func:`record`
    :param make_venv: makes the environment of :func:`record`
    :param folder: see :func:`record`
    :return: the files and the return, or the reason why there are none: a missing package, no OpenGL, a task that renders
        nothing, or a full disk
    """
    try:
        _imageio()
    except ImportError as error:
        return f"not recorded, {error}"
    try:
        with closing(make_venv()) as venv:
            paths, total_reward = record(model, venv, folder)
    except (RuntimeError, ValueError, TypeError, OSError, gym.error.Error) as error:
        return f"not recorded, {error}"
    return f"{' '.join(map(str, paths))}, one episode with return {total_reward:.1f}"


def record(model: BaseAlgorithm, venv: VecEnv, folder: Path) -> tuple[list[Path], float]:
    """
    Record one episode.

    :param model: see :func:`play`
    :param venv: see :func:`play`
    :param folder: receives ``agent.mp4`` and, for frames, ``what_the_agent_sees.png``
    :return: the paths of the files, and the undiscounted return of the episode
    :raises ImportError: if a package of the extra ``dmc`` is missing
    """
    episode = play(model, venv)
    write_video(folder / "agent.mp4", episode.shown, episode.fps)
    if not episode.seen:
        return [folder / "agent.mp4"], episode.total_reward
    with atomic_path(folder / "what_the_agent_sees.png") as temporary:
        Image.fromarray(contact_sheet(episode.seen)).save(temporary)
    return [folder / "agent.mp4", folder / "what_the_agent_sees.png"], episode.total_reward


def play(model: BaseAlgorithm, venv: VecEnv) -> Episode:
    """
    Play one episode of the deterministic policy, or its first 1000 steps.

    :param model: agent for vectors, or for stacks of RGB or grey frames
    :param venv: one environment with ``render_mode="rgb_array"`` and the wrappers that the agent was trained with
    :return: what was shown and seen
    :raises ValueError: if the task renders no frames
    """
    from_pixels = is_image_space(venv.observation_space)
    n_stack = frames_per_observation(venv)
    episode = Episode(venv.get_attr("metadata")[0].get("render_fps", 25))
    done = False
    obs = venv.reset()
    while not done and len(episode.shown) < MAX_FRAMES:
        frame = venv.render()
        if frame is None:
            raise ValueError('The task renders no frames: it needs render_mode="rgb_array" in its metadata.')
        episode.shown.append(frame)
        if from_pixels:
            episode.seen.append(_newest_frame(np.asarray(obs), n_stack))
        action, _ = model.predict(obs, deterministic=True)  # type: ignore[arg-type]
        obs, rewards, dones, _ = venv.step(action)
        episode.total_reward += float(rewards[0])
        done = bool(dones[0])
    return episode


def check_video(path: Path) -> None:
    """
    :param path: where :func:`write_video` is going to write
    :raises ValueError: for another suffix than .mp4 or .gif
    :raises ImportError: if a package of the extra ``dmc`` is missing, which GIF does not need
    """
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}, use .mp4 or .gif.")
    if path.suffix == ".mp4":
        _imageio()


def write_video(path: Path, frames: list[np.ndarray], fps: float) -> None:
    """
    :param path: file, see :func:`check_video`
    :param frames: (H, W, 3) bytes each
    :param fps: frames per second. A GIF shows at most 50 of them
    """
    with atomic_path(path) as temporary:
        if path.suffix == ".gif":
            every = math.ceil(fps / GIF_FPS)
            first, *others = [Image.fromarray(frame) for frame in frames[::every]]
            durations = gif_durations(len(others) + 1, fps / every)
            first.save(temporary, save_all=True, append_images=others, duration=durations, loop=0)
        else:
            _imageio().mimwrite(temporary, frames, format="FFMPEG", fps=fps, macro_block_size=2)


def gif_durations(n_frames: int, fps: float) -> list[int]:
    """
    Milliseconds for which a GIF shows each frame. GIF counts hundredths of seconds: the times are rounded and not the
    durations, so that the error does not add up.
    """
    return (10 * np.diff(np.round(100 / fps * np.arange(n_frames + 1)))).astype(int).tolist()


def _imageio() -> Any:
    try:
        import imageio.v2
        import imageio_ffmpeg  # noqa: F401
    except ImportError as error:
        raise ImportError(f"{error.name} is missing: pip install sb3_robust_bisim[dmc]") from error
    return imageio.v2


def contact_sheet(frames: list[np.ndarray]) -> np.ndarray:
    """Arrange up to 32 evenly spaced frames of one episode, (H, W, 3) each, in 8 columns."""
    picked = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, COLUMNS * ROWS).astype(int))]
    blank = np.full_like(frames[0], 255)
    picked += [blank] * (-len(picked) % COLUMNS)
    rows = [np.concatenate(picked[i : i + COLUMNS], axis=1) for i in range(0, len(picked), COLUMNS)]
    return np.concatenate(rows)


def _newest_frame(stacks: np.ndarray, n_stack: int) -> np.ndarray:
    """The newest frame of the first stack, channels first or last, as (H, W, 3)."""
    if stacks.shape[1] > stacks.shape[-1]:
        stacks = np.moveaxis(stacks, -1, 1)
    return newest_frames(stacks[:1], n_stack)[0].transpose(1, 2, 0)
