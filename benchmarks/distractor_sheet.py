"""Draw the contact sheet of docs/distractors.md: every distractor, every scale of camera and colours, and all together."""

import argparse
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot as plt
from PIL import Image, ImageOps

import sb3_robust_bisim.envs  # noqa: F401
from sb3_robust_bisim.envs.distractors import DISTRACTORS
from sb3_robust_bisim.envs.scene import SCALES

TILE = 84  # pixels, the default size of an observation
LABEL = 0.9  # width of the column of labels, in tiles
DOTS_PER_INCH = 100
HARD = {"camera_distraction": "hard", "color_distraction": "hard"}


def episodes(task: str, **kwargs: Any) -> Iterator[np.ndarray]:
    """The first frame of one episode after another, all in front of the same start state."""
    env = gym.make(f"robust_bisim/{task}-pixels-v0", size=TILE, **kwargs)
    yield env.reset(seed=1)[0]
    while True:
        yield env.unwrapped.look()  # type: ignore[attr-defined]


def steps(task: str, apart: int, **kwargs: Any) -> Iterator[np.ndarray]:
    """
    Frames of one episode.

    :param apart: steps of the agent from one frame to the next
    """
    env = gym.make(f"robust_bisim/{task}-pixels-v0", size=TILE, **kwargs)
    env.action_space.seed(0)
    yield env.reset(seed=1)[0]
    while True:
        for _ in range(apart):
            frame = env.step(env.action_space.sample())[0]
        yield frame


def rows(task: str, columns: int) -> Iterator[tuple[str, list[np.ndarray], list[str]]]:
    """Label, frames and their titles."""
    names = list(DISTRACTORS)
    backgrounds = [list(islice(steps(task, 15, distractor=name), 2)) for name in names]
    yield "distractor,\nstep 0", [first for first, _ in backgrounds], names
    yield "distractor,\nstep 15", [second for _, second in backgrounds], names
    for what in HARD:
        for scale in SCALES:
            yield f"{what.split('_')[0]}\n{scale}", list(islice(episodes(task, **{what: scale}), columns)), []
    yield "camera\nhard", list(islice(episodes("reacher-easy", camera_distraction="hard"), columns)), ["reacher"]
    times = [f"step {10 * index}" for index in range(columns)]
    yield "both hard,\ndynamic", list(islice(steps(task, 10, dynamic=True, **HARD), columns)), times
    yield "both hard", [next(episodes(task, distractor=name, **HARD)) for name in names], names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--task", default="walker-walk", help="task of the suite, as <domain>-<task>")
    parser.add_argument("--columns", type=int, default=len(DISTRACTORS), help="frames per row, where they are many")
    parser.add_argument("--out", type=Path, default=Path("docs/distractors.png"), help="PNG to write")
    args = parser.parse_args()
    if args.columns < 1:
        parser.error(f"--columns must be at least 1, got {args.columns}")
    if f"robust_bisim/{args.task}-pixels-v0" not in gym.registry:
        parser.error(f"--task must be one of the suite, such as walker-walk, got {args.task!r}")
    sheet = list(rows(args.task, args.columns))
    width = max(len(frames) for _, frames, _ in sheet)
    pitch = (TILE + 4, TILE + 16)  # with the gaps, the lower one for a title
    size = (round((width + LABEL) * pitch[0]), len(sheet) * pitch[1])
    figure = plt.figure(figsize=(size[0] / DOTS_PER_INCH, size[1] / DOTS_PER_INCH), dpi=DOTS_PER_INCH)
    for row, (label, frames, titles) in enumerate(sheet):
        bottom = size[1] - (row + 1) * pitch[1] + 2
        figure.text(0.01, (bottom + TILE / 2) / size[1], label, fontsize=7, va="center")
        for column, frame in enumerate(frames):
            left = round((column + LABEL) * pitch[0])
            figure.figimage(frame, left, bottom)
            if column < len(titles):
                figure.text(
                    (left + TILE / 2) / size[0], (bottom + TILE + 2) / size[1], titles[column], fontsize=6, ha="center"
                )
    figure.savefig(args.out)
    ImageOps.posterize(Image.open(args.out).convert("RGB"), 6).save(args.out, optimize=True)  # smaller, and looks the same
    print(f"{args.out}: {size[0]} x {size[1]} pixels, {args.out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
