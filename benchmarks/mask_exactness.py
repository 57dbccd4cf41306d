"""
Does the background take the place of exactly what is no object? Compared, task by task, with a segmentation rendering.

Background is the sky and every geom of the type plane. The usual key on colour (a pixel is background where blue is above
green and red) is judged beside ours, on the frame as dm_control draws it. "eaten" counts pixels of objects that the background
replaced, "left" those of background that it did not. The last line printed is one JSON object.
"""

import argparse
import json
import statistics
import sys
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from render_speed import describe_run

from sb3_robust_bisim.envs.distractors import ColorDistractor
from sb3_robust_bisim.envs.dmc import SUITE
from sb3_robust_bisim.envs.pixels import PixelTask

TASKS = [f"{domain}-{task}" for domain, tasks in SUITE.items() for task in tasks]
# In pixels per frame; what little is left standing are parts of objects below the ground, which is not drawn
TARGETS = {"eaten_at_most": 0.0, "differing_at_most": 0.1, "tasks_that_differ_so_little_at_least": 15}


def make(task: str, size: int, **kwargs: Any) -> PixelTask:
    env = gym.make(f"robust_bisim/{task}-pixels-v0", size=size, render_mode="rgb_array", render_size=size, **kwargs).unwrapped
    assert isinstance(env, PixelTask)
    return env


def replaced(env: PixelTask, size: int) -> np.ndarray:
    """
    :param env: environment with the distractor "color"
    :param size: height and width of the frames in pixels
    :return: mask of shape (size, size) of the pixels that change with the background
    """
    assert isinstance(env.distraction.background, ColorDistractor)
    frames = []
    for shade in (0, 255):
        env.distraction.background.paint(np.full(3, shade, dtype=np.uint8))
        frames.append(np.asarray(env.render()))
    return np.any(frames[0] != frames[1], axis=-1)


def background(env: PixelTask, size: int) -> np.ndarray:
    """
    :param env: environment whose frames are drawn without multisampling, which would mix the numbers of objects
    :param size: height and width of the frames in pixels
    :return: mask of shape (size, size): sky and planes, by MuJoCo's segmentation
    """
    segmentation = env.physics.render(size, size, camera_id=env.camera_id, segmentation=True)
    ids, types = segmentation[..., 0], segmentation[..., 1]
    planes = env.physics.model.geom_type[ids] == int(mujoco.mjtGeom.mjGEOM_PLANE)
    return (ids == -1) | ((types == int(mujoco.mjtObj.mjOBJ_GEOM)) & planes)


def errors(mask: np.ndarray, truth: np.ndarray) -> dict[str, int]:
    """
    :param mask: pixels taken for background, of shape (size, size)
    :param truth: pixels that are background, of shape (size, size)
    :return: numbers of pixels: of objects taken for background, of background left standing, and of both
    """
    return {"differing": int((mask != truth).sum()), "eaten": int((mask & ~truth).sum()), "left": int((~mask & truth).sum())}


def measure(task: str, args: argparse.Namespace) -> dict[str, Any]:
    """
    :param task: <domain>-<task>
    :param args: of the command line
    :return: mean numbers of pixels per frame for the one-pass key and for the key on colour
    """
    keyed, stock = make(task, args.size, distractor="color"), make(task, args.size)
    frame = stock.reset(seed=args.seed)[0]
    keyed.reset(seed=args.seed)
    keyed.action_space.seed(args.seed)
    found: dict[str, list[dict[str, int]]] = {"one_pass": [], "color_rule": []}
    objects = []
    for _ in range(args.frames):
        truth = background(keyed, args.size)
        red, green, blue = np.moveaxis(frame, -1, 0)
        found["one_pass"].append(errors(replaced(keyed, args.size), truth))
        found["color_rule"].append(errors((blue > green) & (blue > red), truth))
        objects.append(int((~truth).sum()))
        action = keyed.action_space.sample()
        keyed.step(action)
        frame = stock.step(action)[0]
    keyed.close()
    stock.close()
    result: dict[str, Any] = {"task": task, "object_pixels": round(statistics.mean(objects), 1)}
    for key, counts in found.items():
        result[key] = {name: round(statistics.mean(count[name] for count in counts), 2) for name in counts[0]}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=TASKS, metavar="TASK", help="tasks of the suite, as <domain>-<task>")
    parser.add_argument("--frames", type=int, default=20, help="frames per task, four control steps of random actions apart")
    parser.add_argument("--size", type=int, default=84, help="height and width of the frames in pixels")
    parser.add_argument("--seed", type=int, default=0, help="seed of environments and actions")
    args = parser.parse_args()
    if min(args.frames, args.size) < 1:
        parser.error("--frames and --size must be at least 1")
    if unknown := set(args.tasks) - set(TASKS):
        parser.error(f"--tasks must be tasks of the suite, such as cheetah-run, got {sorted(unknown)}")
    results = []
    for task in args.tasks:
        results.append(measure(task, args))
        print(results[-1], file=sys.stderr, flush=True)
    summary: dict[str, Any] = {}
    for key in ("one_pass", "color_rule"):
        means = {name: round(statistics.mean(result[key][name] for result in results), 3) for name in results[0][key]}
        summary[key] = means | {"worst_differing": max(result[key]["differing"] for result in results)}
    close = sum(result["one_pass"]["differing"] <= TARGETS["differing_at_most"] for result in results)
    nothing_eaten = all(result["one_pass"]["eaten"] <= TARGETS["eaten_at_most"] for result in results)
    report = {
        "targets": TARGETS,
        "targets_met": nothing_eaten and close >= TARGETS["tasks_that_differ_so_little_at_least"],
        "tasks": len(results),
        "tasks_that_differ_so_little": close,
        "mean_pixels_per_frame": summary,
        "results": results,
    }
    print(json.dumps(describe_run("mask_exactness", args, args.tasks[0]) | report))


if __name__ == "__main__":
    main()
