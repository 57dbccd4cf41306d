"""Draw the pictures of docs/environments: frames of one episode of each family of tasks, and of several suite tasks."""

import argparse
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image, ImageOps

import sb3_robust_bisim.envs  # noqa: F401

HEIGHT, GAP, COLORS = 150, 6, 256
Policy = Callable[[np.ndarray], np.ndarray]
SUITE_TASKS = ("cartpole-swingup", "cheetah-run", "walker-walk", "finger-spin", "reacher-easy")


def frames(
    env_id: str, steps: tuple[int, ...], policy: Policy | None = None, seed: int = 1, **kwargs: Any
) -> list[np.ndarray]:
    """
    Frames of one episode.

    :param steps: increasing, the steps after which a frame is drawn
    :param policy: from observation to action; None: random actions
    :param seed: of the episode
    :param kwargs: arguments of the task
    """
    env = gym.make(f"robust_bisim/{env_id}", render_mode="rgb_array", **kwargs)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=seed)
    drawn = []
    for before, step in pairwise((0, *steps)):
        for _ in range(step - before):
            action = env.action_space.sample() if policy is None else policy(observation)
            observation = env.step(action)[0]
        drawn.append(np.asarray(env.render()))
    env.close()
    return drawn


def along(velocity: int, strength: float) -> Policy:
    """Push in the direction of the motion, which swings up."""
    return lambda observation: np.array([strength if observation[velocity] >= 0 else -strength], dtype=np.float32)


def suite(suffix: str, **kwargs: Any) -> list[np.ndarray]:
    """One frame of each of several tasks, and with video a clip of its own behind each."""
    return [frames(f"{task}{suffix}-v0", (10,), seed=seed, **kwargs)[0] for seed, task in enumerate(SUITE_TASKS)]


STRIPS: dict[str, Callable[[], list[np.ndarray]]] = {
    "sparse_cartpole": lambda: [
        frame[130:350, 170:430]  # the track is wide and empty
        for frame in frames("SparseCartPole-v0", (0, 4, 8, 12, 16), lambda _: np.full(1, 0.15, dtype=np.float32))
    ],
    "sparse_pendulum": lambda: frames("SparsePendulum-v0", (0, 15, 30, 45, 60), along(2, 2.0), seed=34),
    "mountain_car": lambda: frames("MountainCarContinuous-v0", (0, 30, 60, 85, 105), along(1, 1.0)),
    "dmc_state": lambda: suite(""),
    "dmc_pixels": lambda: suite("-pixels", distractor="video", render_size=HEIGHT),
}


def strip(images: list[np.ndarray]) -> Image.Image:
    """The images beside each other, equally high."""
    scaled = [ImageOps.contain(Image.fromarray(image), (10_000, HEIGHT), Image.Resampling.LANCZOS) for image in images]
    joined = Image.new("RGB", (sum(image.width for image in scaled) + GAP * (len(scaled) - 1), HEIGHT), "white")
    left = 0
    for image in scaled:
        joined.paste(image, (left, 0))
        left += image.width + GAP
    return joined.quantize(COLORS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=STRIPS, default=list(STRIPS), help="families to draw")
    parser.add_argument("--out", type=Path, default=Path("docs/environments"), help="folder for the PNG files")
    args = parser.parse_args()
    for name in args.only:
        path = args.out / f"{name}.png"
        picture = strip(STRIPS[name]())
        picture.save(path, optimize=True)
        print(f"{path}: {picture.width} x {picture.height} pixels, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
