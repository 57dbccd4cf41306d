"""Record an agent that acts from pixels: a video of the task, and a contact sheet of the agent's observations."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from PIL import Image
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_robust_bisim.frame_buffer import frames_per_observation
from sb3_robust_bisim.runs.atomic import atomic_path

COLUMNS, ROWS = 8, 4
MAX_FRAMES = 1000  # for tasks whose episodes do not end


def record(model: BaseAlgorithm, venv: VecEnv, folder: Path) -> tuple[Path, Path]:
    """
    Record one episode of the deterministic policy.

    :param model: agent for stacks of RGB or grey frames
    :param venv: one environment with ``render_mode="rgb_array"`` and the wrappers that the agent was trained with
    :param folder: receives ``agent.mp4`` and ``what_the_agent_sees.png``
    :return: the paths of the two files
    """
    shown: list[np.ndarray | None] = []
    seen: list[np.ndarray] = []
    n_stack = frames_per_observation(venv)
    done = False
    obs = venv.reset()
    while not done and len(shown) < MAX_FRAMES:
        shown.append(venv.render())
        seen.append(_newest_frame(np.asarray(obs)[0], n_stack))
        action, _ = model.predict(obs, deterministic=True)  # type: ignore[arg-type]
        obs, _, dones, _ = venv.step(action)
        done = bool(dones[0])
    fps = venv.get_attr("metadata")[0].get("render_fps", 25)  # the speed of the task
    with atomic_path(folder / "agent.mp4") as temporary:
        imageio.mimwrite(temporary, shown, format="FFMPEG", fps=fps, macro_block_size=2)  # type: ignore[arg-type]
    with atomic_path(folder / "what_the_agent_sees.png") as temporary:
        Image.fromarray(contact_sheet(seen)).save(temporary)
    return folder / "agent.mp4", folder / "what_the_agent_sees.png"


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
