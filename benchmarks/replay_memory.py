"""
Memory and sampling time of FrameStackReplayBuffer against SB3's ReplayBuffer on 9x84x84 observations (3 RGB frames).

Memory: growth of the resident set while a buffer is made and filled past its end, each buffer in a process of its own.
Time: both buffers in one process, full, used in turn. The last line printed is one JSON object.
"""

import argparse
import json
import multiprocessing
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
import psutil
import torch as th
from _machine import machine
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_robust_bisim.frame_buffer import FrameStackReplayBuffer

BUFFERS: dict[str, type[ReplayBuffer]] = {"sb3": ReplayBuffer, "frame_stack": FrameStackReplayBuffer}
TARGETS = {"bytes_per_transition_at_most": 21_600, "sampling_speed_at_least": 0.8}
IMAGE_SPACE = spaces.Box(0, 255, (9, 84, 84), dtype=np.uint8)
ACTION_SPACE = spaces.Box(-1, 1, (6,), dtype=np.float32)


class Transitions:
    """Transitions with random frames, in the memory layout that VecTransposeImage leaves; zeros fill a stack after a reset."""

    def __init__(self, n_envs: int, episode_length: int, seed: int) -> None:
        self.n_envs, self.episode_length = n_envs, episode_length
        self.rng = np.random.default_rng(seed)
        self.age = np.arange(n_envs) * episode_length // n_envs  # the environments end their episodes at different times
        self.stacks = np.zeros((n_envs, 84, 84, 9), dtype=np.uint8)

    def _push(self, stacks: np.ndarray) -> np.ndarray:
        frames = self.rng.integers(256, size=(self.n_envs, 84, 84, 3), dtype=np.uint8)
        return np.concatenate([stacks[..., 3:], frames], axis=-1)

    def step(self) -> tuple[Any, ...]:
        obs, next_obs = self.stacks, self._push(self.stacks)
        self.age += 1
        done = self.age >= self.episode_length
        self.age[done] = 0
        self.stacks = np.where(done[:, None, None, None], self._push(np.zeros_like(obs)), next_obs)
        action, reward = self.rng.uniform(-1, 1, (self.n_envs, 6)), self.rng.random(self.n_envs)
        infos = [{"TimeLimit.truncated": bool(d)} for d in done]
        return obs.transpose(0, 3, 1, 2), next_obs.transpose(0, 3, 1, 2), action, reward, done, infos


def make(name: str, n_envs: int, n_transitions: int) -> ReplayBuffer:
    return BUFFERS[name](n_transitions, IMAGE_SPACE, ACTION_SPACE, device="cpu", n_envs=n_envs)


def measure_memory(name: str, n_envs: int, args: argparse.Namespace) -> float:
    """
    :return: Resident bytes per transition of a full buffer a quarter of which has been overwritten
    """
    source = Transitions(n_envs, args.episode_length, args.seed)
    for _ in range(50):  # until the source itself takes no more memory
        source.step()
    process = psutil.Process()
    before = process.memory_info().rss
    buffer = make(name, n_envs, args.transitions)
    for _ in range(buffer.buffer_size * 5 // 4):
        buffer.add(*source.step())
    return (process.memory_info().rss - before) / (buffer.buffer_size * n_envs)


def seconds(call: Callable[..., Any], *args: Any) -> float:
    start = time.perf_counter()
    call(*args)
    return time.perf_counter() - start


def measure_time(n_envs: int, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """
    :return: Median milliseconds per sampled batch and median microseconds per added transition, for each buffer
    """
    source = Transitions(n_envs, args.episode_length, args.seed)
    buffers = {name: make(name, n_envs, args.transitions) for name in BUFFERS}
    add: dict[str, list[float]] = {name: [] for name in BUFFERS}
    sample: dict[str, list[float]] = {name: [] for name in BUFFERS}
    n_rows = args.transitions // n_envs
    for _ in range(n_rows * 5 // 4):
        transition = source.step()
        for name, buffer in buffers.items():
            add[name].append(seconds(buffer.add, *transition))
    np.random.seed(args.seed)  # noqa: NPY002 (the generator that SB3 samples with)
    for repeat in range(args.repeats):
        for name in sorted(buffers, reverse=bool(repeat % 2)):
            sample[name].append(seconds(buffers[name].sample, args.batch_size))
    return {
        name: {
            "sample_ms": 1e3 * statistics.median(sample[name]),
            "add_us": 1e6 * statistics.median(add[name][n_rows:]) / n_envs,
        }
        for name in buffers
    }


def in_new_process(function: Callable[..., Any], *args: Any) -> Any:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *args).result()


def measure(n_envs: int, args: argparse.Namespace) -> dict[str, Any]:
    """
    :return: What was measured with this number of environments, with ratios and whether the targets are met
    """
    memory = {name: in_new_process(measure_memory, name, n_envs, args) for name in BUFFERS}
    times = in_new_process(measure_time, n_envs, args)
    result: dict[str, Any] = {"n_envs": n_envs}
    for name in BUFFERS:
        result[name] = {"bytes_per_transition": round(memory[name])} | {k: round(v, 3) for k, v in times[name].items()}
    result["memory_saved"] = round(memory["sb3"] / memory["frame_stack"], 2)
    result["sampling_speed"] = round(times["sb3"]["sample_ms"] / times["frame_stack"]["sample_ms"], 2)
    result["add_speed"] = round(times["sb3"]["add_us"] / times["frame_stack"]["add_us"], 2)
    result["targets_met"] = (
        memory["frame_stack"] <= TARGETS["bytes_per_transition_at_most"]
        and result["sampling_speed"] >= TARGETS["sampling_speed_at_least"]
    )
    return result


def describe_run(args: argparse.Namespace) -> dict[str, Any]:
    settings = {"settings": vars(args), "seeds": [args.seed], "torch_threads": th.get_num_threads(), "targets": TARGETS}
    return {"benchmark": "replay_memory"} | settings | machine()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--transitions", type=int, default=20_000, help="size of the buffers; SB3's takes 127 kB each")
    parser.add_argument("--n-envs", type=int, nargs="+", default=[1, 16], help="numbers of environments")
    parser.add_argument("--episode-length", type=int, default=250, help="steps of the agent per episode")
    parser.add_argument("--batch-size", type=int, default=256, help="transitions per sampled batch")
    parser.add_argument("--repeats", type=int, default=200, help="batches sampled from each buffer")
    parser.add_argument("--seed", type=int, default=0, help="seed of frames and of sampling")
    args = parser.parse_args()
    if min(args.transitions // max(args.n_envs), args.episode_length, args.batch_size, args.repeats, *args.n_envs) < 1:
        parser.error("all numbers must be at least 1, and --transitions at least the largest of --n-envs")
    results = []
    for n_envs in args.n_envs:
        results.append(measure(n_envs, args))
        print(results[-1], flush=True)
    print(json.dumps(describe_run(args) | {"results": results}))


if __name__ == "__main__":
    main()
