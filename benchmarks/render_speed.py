"""
Agent steps per second of pixel DeepMind Control: this package, with and without video, against stock Shimmy and Gymnasium.

All arms step the same task with the same action repeat in SB3's DummyVecEnv under VecFrameStack (3 frames), in one process,
in turn within every round, so that a busy machine slows all of them. The last line printed is one JSON object.
"""

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
from _machine import machine
from gymnasium.wrappers import AddRenderObservation, RepeatAction
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

import sb3_robust_bisim.envs  # noqa: F401
from sb3_robust_bisim.envs.opengl import import_suite
from sb3_robust_bisim.envs.pixels import PixelTask

TARGETS = {"video_over_stock_at_least": 20.0, "video_cost_at_most": 0.25}
PACKAGES = ("shimmy", "dm_control", "mujoco", "imageio_ffmpeg")


def make_stock(args: argparse.Namespace) -> gym.Env[Any, Any]:
    import_suite(rendering=True)
    render_kwargs = {"height": args.size, "width": args.size, "camera_id": 0}
    env: gym.Env[Any, Any] = gym.make(f"dm_control/{args.task}-v0", render_mode="rgb_array", render_kwargs=render_kwargs)
    return AddRenderObservation(RepeatAction(env, args.action_repeat), render_only=True)


def make_ours(args: argparse.Namespace, **kwargs: Any) -> gym.Env[Any, Any]:
    env_id = f"robust_bisim/{args.task}-pixels-v0"
    return gym.make(env_id, action_repeat=args.action_repeat, size=args.size, camera_id=0, **kwargs)


# "clean" shows what stock shows, pixel by pixel; "clean_fast" is what the cost of video is reckoned on: neither has shadows
ARMS: dict[str, Callable[[argparse.Namespace], gym.Env[Any, Any]]] = {
    "stock": make_stock,
    "clean": partial(make_ours, distractor="none"),
    "clean_fast": partial(make_ours, distractor="none", shadows=False),
    "color": partial(make_ours, distractor="color"),
    "video": partial(make_ours, distractor="video"),
}


def start(arm: str, n_envs: int, args: argparse.Namespace) -> VecEnv:
    vec_env = VecFrameStack(DummyVecEnv([partial(ARMS[arm], args)] * n_envs), n_stack=3)
    vec_env.seed(args.seed)
    vec_env.reset()
    return vec_env


def steps_per_second(vec_env: VecEnv, actions: np.ndarray, seconds: float) -> float:
    """
    :param vec_env: environments that have been reset
    :param actions: of shape (steps, environments, n_a), taken in turn
    :param seconds: how long to step at least
    :return: agent steps per second, those of all environments together
    """
    begin = time.perf_counter()
    steps = 0
    while (elapsed := time.perf_counter() - begin) < seconds:
        vec_env.step(actions[steps % len(actions)])
        steps += 1
    return steps * vec_env.num_envs / elapsed


def measure(n_envs: int, args: argparse.Namespace) -> dict[str, Any]:
    """
    :param n_envs: number of environments in the process
    :param args: of the command line
    :return: medians over the rounds, and the median over the rounds of each ratio
    """
    vec_envs = {arm: start(arm, n_envs, args) for arm in ARMS}
    shape = (50, n_envs, *vec_envs["video"].action_space.shape)  # type: ignore[misc]
    actions = np.random.default_rng(args.seed).uniform(-1, 1, shape).astype(np.float32)
    rates: dict[str, list[float]] = {arm: [] for arm in ARMS}
    for round_number in range(-1, args.rounds):  # round -1 warms up
        for arm in sorted(ARMS, reverse=bool(round_number % 2)):
            rate = steps_per_second(vec_envs[arm], actions, args.seconds)
            if round_number >= 0:
                rates[arm].append(rate)
        print(f"{n_envs} environments, round {round_number + 1} of {args.rounds}", file=sys.stderr, flush=True)
    for vec_env in vec_envs.values():
        vec_env.close()

    def ratio(arm: str, other: str) -> float:
        return statistics.median(rate / base for rate, base in zip(rates[arm], rates[other], strict=True))

    video_over_stock, video_cost = ratio("video", "stock"), ratio("clean_fast", "video") - 1
    return {
        "n_envs": n_envs,
        "steps_per_second": {arm: round(statistics.median(values), 1) for arm, values in rates.items()},
        "range": {arm: [round(min(values), 1), round(max(values), 1)] for arm, values in rates.items()},
        "video_over_stock": round(video_over_stock, 2),
        "clean_over_stock": round(ratio("clean", "stock"), 2),
        "clean_fast_over_stock": round(ratio("clean_fast", "stock"), 2),
        "video_cost_over_clean_fast": round(video_cost, 3),
        "video_cost_over_color": round(ratio("color", "video") - 1, 3),
        "targets_met": video_over_stock >= TARGETS["video_over_stock_at_least"]
        and video_cost <= TARGETS["video_cost_at_most"],
    }


def opengl_renderer(task: str) -> str:
    """
    :param task: any task of the suite
    :return: what draws, in the words of the OpenGL driver
    """
    from OpenGL import GL

    env = gym.make(f"robust_bisim/{task}-pixels-v0").unwrapped
    assert isinstance(env, PixelTask)
    with env.physics.contexts.gl.make_current() as gl:
        name = gl.call(GL.glGetString, GL.GL_RENDERER)
    env.close()
    return name.decode()


def describe_run(name: str, args: argparse.Namespace, task: str) -> dict[str, Any]:
    """
    :param name: of the benchmark
    :param args: of the command line, with a seed
    :param task: any task of the suite
    :return: settings, commit, machine and versions
    """
    measured_on = machine()
    measured_on["versions"] |= {package: version(package) for package in PACKAGES}
    opengl = {"mujoco_gl": os.environ.get("MUJOCO_GL"), "opengl_renderer": opengl_renderer(task)}
    return {"benchmark": name, "settings": vars(args), "seeds": [args.seed]} | measured_on | opengl


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--task", default="cheetah-run", help="task of the suite, as <domain>-<task>")
    parser.add_argument("--n-envs", type=int, nargs="+", default=[1, 16], help="numbers of environments in the process")
    parser.add_argument("--size", type=int, default=84, help="height and width of the frames in pixels")
    parser.add_argument("--action-repeat", type=int, default=4, help="control steps per agent step")
    parser.add_argument("--rounds", type=int, default=9, help="rounds in which every arm has its turn")
    parser.add_argument("--seconds", type=float, default=1.0, help="length of a turn")
    parser.add_argument("--seed", type=int, default=0, help="seed of environments, videos and actions")
    args = parser.parse_args()
    if min(args.rounds, args.size, args.action_repeat, *args.n_envs) < 1 or args.seconds <= 0:
        parser.error("all numbers must be at least 1, and --seconds above 0")
    if f"robust_bisim/{args.task}-pixels-v0" not in gym.registry:
        parser.error(f"--task must be one of the suite, such as cheetah-run, got {args.task!r}")
    results = [measure(n_envs, args) for n_envs in args.n_envs]
    print(json.dumps(describe_run("render_speed", args, args.task) | {"targets": TARGETS, "results": results}))


if __name__ == "__main__":
    main()
