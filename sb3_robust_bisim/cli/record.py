"""Record an agent: a video of the task and, if it acts from pixels, a contact sheet of its observations."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_robust_bisim.frame_buffer import frames_per_observation
from sb3_robust_bisim.runs.atomic import atomic_path

COLUMNS, ROWS = 8, 4
MAX_FRAMES = 1000  # for tasks whose episodes do not end


def record_or_explain(model: BaseAlgorithm, make_venv: Callable[[], VecEnv], folder: Path) -> str:
    """
    :param model: see :func:`record`
    :param make_venv: makes the environment of :func:`record`
    :param folder: see :func:`record`
    :return: the paths of the files, or the reason why there are none: a missing package, or no OpenGL
    """
    try:
        import imageio.v2  # noqa: F401
    except ImportError as error:
        return f"not recorded, {error.name} is missing: pip install sb3_robust_bisim[dmc]"
    try:
        venv = make_venv()
    except RuntimeError as error:
        return f"not recorded, {error}"
    with closing(venv):
        return " ".join(map(str, record(model, venv, folder)))


def record(model: BaseAlgorithm, venv: VecEnv, folder: Path) -> list[Path]:
    """
    Record one episode of the deterministic policy.

    :param model: agent for vectors, or for stacks of RGB or grey frames
    :param venv: one environment with ``render_mode="rgb_array"`` and the wrappers that the agent was trained with
    :param folder: receives ``agent.mp4`` and, for frames, ``what_the_agent_sees.png``
    :return: the paths of the files
    :raises ImportError: if a package of the extra ``dmc`` is missing
    """
    import imageio.v2 as imageio

    from_pixels = is_image_space(venv.observation_space)
    shown: list[np.ndarray | None] = []
    seen: list[np.ndarray] = []
    n_stack = frames_per_observation(venv)
    done = False
    obs = venv.reset()
    while not done and len(shown) < MAX_FRAMES:
        shown.append(venv.render())
        if from_pixels:
            seen.append(_newest_frame(np.asarray(obs)[0], n_stack))
        action, _ = model.predict(obs, deterministic=True)  # type: ignore[arg-type]
        obs, _, dones, _ = venv.step(action)
        done = bool(dones[0])
    fps = venv.get_attr("metadata")[0].get("render_fps", 25)  # the speed of the task
    with atomic_path(folder / "agent.mp4") as temporary:
        imageio.mimwrite(temporary, shown, format="FFMPEG", fps=fps, macro_block_size=2)  # type: ignore[arg-type]
    if not from_pixels:
        return [folder / "agent.mp4"]
    with atomic_path(folder / "what_the_agent_sees.png") as temporary:
        Image.fromarray(contact_sheet(seen)).save(temporary)
    return [folder / "agent.mp4", folder / "what_the_agent_sees.png"]


def contact_sheet(frames: list[np.ndarray]) -> np.ndarray:
    """Arrange up to 32 evenly spaced frames of one episode, (H, W, 3) each, in 8 columns."""
    picked = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, COLUMNS * ROWS).astype(int))]
    blank = np.full_like(frames[0], 255)
    picked += [blank] * (-len(picked) % COLUMNS)
    rows = [np.concatenate(picked[i : i + COLUMNS], axis=1) for i in range(0, len(picked), COLUMNS)]
    return np.concatenate(rows)


def _newest_frame(stack: np.ndarray, n_stack: int) -> np.ndarray:
    """The newest frame of a stack, RGB or grey, channels first or last, as (H, W, 3)."""
    if stack.shape[0] < stack.shape[-1]:
        stack = stack.transpose(1, 2, 0)
    return stack[..., -3:] if stack.shape[-1] == 3 * n_stack else stack[..., -1:].repeat(3, axis=-1)
