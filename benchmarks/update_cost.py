"""
What does a gradient step cost, beside other SACs and beside the matrix products that it cannot do without?

Arms: `full` is BisimSAC with everything on (metric, norm, dynamics, reward, bonus, inverse) and `off` the same with everything
off. `sb3_encoder` is SB3's SAC with the same encoder class, widths and batch. `sb3` is SB3's SAC as a user runs it: no encoder
in front of flat observations, NatureCNN in front of images. `sbx` is the SAC of sbx (JAX) as a user runs it, for flat
observations. `floor` is the full method's matrix products and convolutions alone.

BisimSAC and the floor are timed with the actor every 2nd update (`paper`) and every update (`sac`), in fp32 and, where the CPU
has the instructions, in bf16. All arms are interleaved in one process, one thread; peak memory is that of a process per arm.
sbx needs the extra `bench`; without it the arm is left out. `families_over_full` compares other metrics with that of the full
method, `keep_freed_memory` an update from pixels with and without this setting. The last line printed is one JSON object.
"""

import argparse
import itertools
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
import torch as th
from _aggregate import FULL as FULL_METHOD
from _figures import FIGURES, Method
from _machine import machine
from _random_pixels import RandomPixels
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack
from torch.nn import functional as F
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC, FrameStackReplayBuffer, IntrinsicRewardVecEnv
from sb3_robust_bisim.checks import has_bf16
from sb3_robust_bisim.cli.zoo_config import DEFAULT_CONFIG, variant_settings
from sb3_robust_bisim.encoders import MlpEncoder, PixelEncoder
from sb3_robust_bisim.runs.allocator import keep_freed_memory

BATCH = {"mlp": 512, "cnn": 128}
SCHEDULE = {"paper": dict(policy_delay=2, target_update_interval=2), "sac": dict(policy_delay=1)}
FULL = dict(intrinsic_reward_scale=2.0, inverse_dynamics_coef=1.0)
# bf16 without its instructions is emulated, and many times slower
PRECISIONS = (False, True) if has_bf16(th.device("cpu")) else (False,)
CPU = dict(device="cpu", seed=0)  # as the floor
OFF = dict(bisim_coef=0.0, norm_constraint=False)
CARTPOLE = "robust_bisim/SparseCartPole-v0"
PIXELS = "robust_bisim/cheetah-run-pixels-v0"
PARTS = ("mlp", "cnn", "families_over_full", "bonus", "learn", "keep_freed_memory")


def build(kind: str, arm: str, schedule: str, bf16: bool) -> BaseAlgorithm:
    """A model with a filled buffer whose next call is `train`."""
    env = gym.make(CARTPOLE, noise_multiplier=1) if kind == "mlp" else RandomPixels()
    encoder = MlpEncoder if kind == "mlp" else PixelEncoder
    common = dict(**CPU, buffer_size=1000, learning_starts=10**9, learning_rate=1e-3)
    policy = "MlpPolicy" if kind == "mlp" else "CnnPolicy"
    policy_kwargs = dict(
        net_arch=[256, 256], features_extractor_class=encoder, features_extractor_kwargs=dict(features_dim=50)
    )
    model: BaseAlgorithm
    if arm == "sb3_encoder":
        model = SAC(policy, env, policy_kwargs=policy_kwargs, **common)
    elif arm == "sb3":
        model = SAC(policy, env, policy_kwargs=dict(net_arch=[256, 256]), **common)
    elif arm == "sbx":
        from sbx import SAC as SbxSAC

        model = SbxSAC(
            policy, env, policy_kwargs=dict(net_arch=[256, 256]), batch_size=BATCH[kind], **{**common, "device": "auto"}
        )
    else:
        extras = {**(FULL if arm == "full" else OFF), **SCHEDULE[schedule]}
        model = BisimSAC(policy, env, policy_kwargs=policy_kwargs, bf16=bf16, **extras, **common)
    return model.learn(2 * BATCH[kind])


def floor(kind: str, schedule: str, bf16: bool) -> Callable[[], None]:
    """The full method's matrix products and convolutions, forward and backward, and nothing else."""
    batch, passes = BATCH[kind], []

    def linear(n_in: int, n_out: int, forward: float, weight: float, inputs: float, dtype: th.dtype = th.float32) -> None:
        x, w, y = th.randn(batch, n_in).to(dtype), th.randn(n_in, n_out).to(dtype), th.randn(batch, n_out).to(dtype)
        for count, left, right in ((forward, x, w), (weight, x.T, y), (inputs, y, w.T)):
            passes.append((count, left.mm, right))

    every = 1 / SCHEDULE[schedule]["policy_delay"]
    encoder_dtype = th.bfloat16 if bf16 else th.float32
    if kind == "mlp":
        # three forward passes (s, s', s' by the target), two backward
        linear(8, 50, 3, 2, 0, encoder_dtype)
        linear(50, 50, 6, 4, 4, encoder_dtype)
    else:
        x = th.rand(batch, 9, 84, 84).to(encoder_dtype)
        w1, w2 = (th.randn(*shape).to(encoder_dtype) for shape in ((32, 9, 3, 3), (32, 32, 3, 3)))
        h = F.conv2d(x, w1, stride=2)
        y = F.conv2d(h, w2)
        passes.append((3, lambda w: F.conv2d(x, w, stride=2), w1))
        passes.append((3, lambda w: F.conv2d(h, w), w2))
        geometry = ([0, 0], [1, 1], False, [0, 0], 1)
        backward = th.ops.aten.convolution_backward
        passes.append((2, lambda w: backward(h, x, w, [32], [2, 2], *geometry, [False, True, True]), w1))
        passes.append((2, lambda w: backward(y, h, w, [32], [1, 1], *geometry, [True, True, True]), w2))
        linear(int(np.prod(y.shape[1:])), 50, 3, 2, 2, encoder_dtype)
    # two critics: the TD error forward and backward, the target forward, the actor loss forward and back to the action
    for n_in, n_out in ((51, 256), (256, 256), (256, 1)):
        linear(n_in, n_out, 2 * (2 + every), 2, 2 * (1 + every))
    # actor: on s' forward; its loss forward and backward, though not into z
    for n_in, n_out in ((50, 256), (256, 256), (256, 2)):
        linear(n_in, n_out, 1 + every, every, every if n_in > 50 else 0)
    for n_in, n_out in ((51, 512), (512, 50), (50, 512), (512, 1), (100, 256), (256, 128), (128, 1)):  # the three models
        linear(n_in, n_out, 1, 1, 1)
    debts = [0.0] * len(passes)

    def run() -> None:
        for i, (count, product, operand) in enumerate(passes):
            debts[i] += count
            while debts[i] >= 1:
                debts[i] -= 1
                product(operand)

    return run


def peak_memory(kind: str, arm: str, schedule: str, bf16: bool) -> float:
    """MiB that two updates need at most, the process with its imports and the buffer included."""
    model = build(kind, arm, schedule, bf16)
    model.train(2, BATCH[kind])
    # not getrusage: its peak is the parent's where that one's was higher
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def update_time(arm: str, keep: bool) -> float:
    """Milliseconds of an update from pixels in this process, whose allocator keeps freed memory if asked to."""
    if keep:
        keep_freed_memory()
    model = build("cnn", arm, "paper", bf16=False)
    times = []
    for _ in range(12):
        started = time.perf_counter()
        model.train(1, BATCH["cnn"])
        times.append(1000 * (time.perf_counter() - started))
    return float(np.median(times[2:]))


def kept_memory_cost(rounds: int) -> dict[str, dict[str, float]]:
    """What `keep_freed_memory` saves (nothing without glibc), from processes that take turns: medians over the rounds."""
    times: dict[str, tuple[list[float], list[float]]] = {arm: ([], []) for arm in ("full", "off", "sb3_encoder")}
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for _ in tqdm(range(rounds), desc="allocator", file=sys.stderr):
            for arm, keep in itertools.product(times, (False, True)):
                times[arm][keep].append(pool.apply(update_time, (arm, keep)))
    result = {}
    for arm, (default, kept) in times.items():
        values = {"default_ms": default, "kept_ms": kept, "kept_over_default": np.divide(kept, default)}
        result[arm] = {name: round(float(np.median(value)), 3) for name, value in values.items()}
    return result


Arm = tuple[str, str, bool]  # name, schedule, bf16


def others(kind: str) -> dict[str, Arm]:
    """The arms of other libraries: one schedule, fp32."""
    names = ["sb3_encoder", "sb3", *(["sbx"] if kind == "mlp" and find_spec("sbx") else [])]
    return {name: (name, "sac", False) for name in names}


def build_arms(kind: str, per_round: int) -> dict[Arm, Callable[[], None]]:
    """For each arm a function that does ``per_round`` updates."""

    def trainer(arm: Arm) -> Callable[[], None]:
        model = build(kind, *arm)
        return lambda: model.train(per_round, BATCH[kind])

    def repeated(run: Callable[[], None]) -> Callable[[], None]:
        def repeat() -> None:
            for _ in range(per_round):
                run()

        return repeat

    arms = {arm: trainer(arm) for arm in others(kind).values()}
    for schedule, bf16 in itertools.product(SCHEDULE, PRECISIONS):
        arms |= {(name, schedule, bf16): trainer((name, schedule, bf16)) for name in ("full", "off")}
        arms["floor", schedule, bf16] = repeated(floor(kind, schedule, bf16))
    return arms


def time_arms(kind: str, rounds: int, per_round: int) -> dict[Arm, list[float]]:
    """Milliseconds per update of each arm, one number per round; in a round all arms follow each other."""
    arms = build_arms(kind, per_round)
    times: dict[Arm, list[float]] = {arm: [] for arm in arms}
    for round_number in tqdm(range(rounds + 1), desc=f"{kind} updates", file=sys.stderr):
        for arm, run in arms.items():
            started = time.perf_counter()
            run()
            if round_number > 0:  # the first one warms up
                times[arm].append(1000 * (time.perf_counter() - started) / per_round)
    return times


def update_times(kind: str, rounds: int, per_round: int) -> dict[str, dict]:
    times = time_arms(kind, rounds, per_round)
    models = [arm for arm in times if arm[0] != "floor"]
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        memory = dict(zip(models, pool.starmap(peak_memory, [(kind, *arm) for arm in models], 1), strict=True))
    result: dict[str, dict] = {"others": {}, "fp32": {}, **({"bf16": {}} if True in PRECISIONS else {})}

    def entry_of(arm: Arm) -> dict[str, float | list[float]]:
        entry: dict[str, float | list[float]] = {"ms": round(float(np.median(times[arm])), 3)}
        entry["ms_quartiles"] = np.percentile(times[arm], [25, 75]).round(3).tolist()
        return {**entry, "peak_mib": round(memory[arm])} if arm in memory else entry

    for name, arm in others(kind).items():
        result["others"][name] = entry_of(arm)
    for schedule, bf16 in itertools.product(SCHEDULE, PRECISIONS):
        entries: dict[str, dict] = {name: entry_of((name, schedule, bf16)) for name in ("full", "off", "floor")}
        # the ratio of each round, so that a slow spell of the machine strikes both sides
        beside = {**others(kind), "floor": ("floor", schedule, bf16)}
        ratios = {name: np.divide(times["full", schedule, bf16], times[arm]) for name, arm in beside.items()}
        entries["full_over"] = {name: round(float(np.median(ratio)), 3) for name, ratio in ratios.items()}
        result["bf16" if bf16 else "fp32"][schedule] = entries
    return result


def bonus_cost(env_id: str, n_envs: int, steps: int) -> dict[str, float]:
    """
    Milliseconds of a step of `learn()` beyond its update, policy call and environment step, with the bonus and without it,
    interleaved. `ratio` is that of whole steps, the update included.
    """
    pixels = "pixels" in env_id
    env_kwargs = dict(distractor="none", shadows=False) if pixels else dict(noise_multiplier=2)
    venv = make_vec_env(env_id, n_envs, env_kwargs=env_kwargs, seed=0)
    bonus_env = IntrinsicRewardVecEnv(VecFrameStack(venv, 3) if pixels else venv)
    settings = dict(learning_starts=0, batch_size=BATCH["cnn" if pixels else "mlp"], gradient_steps=2 if pixels else 1)
    buffer: dict = dict(replay_buffer_class=FrameStackReplayBuffer) if pixels else {}
    policy = "CnnPolicy" if pixels else "MlpPolicy"
    model = BisimSAC(policy, bonus_env, **FULL, **CPU, **SCHEDULE["paper"], **settings, **buffer, buffer_size=1000)
    model.learn(n_envs)
    model.policy.set_training_mode(False)  # as collect_rollouts does, once before its steps
    times: dict[str, list[float]] = {"without_ms": [], "with_ms": [], "update_ms": []}
    for round_number in range(steps + 1):
        for name in times:
            bonus_env.bind(model._intrinsic_reward if name == "with_ms" else None)
            started = time.perf_counter()
            if name == "update_ms":
                model.train(settings["gradient_steps"], settings["batch_size"])
            else:
                actions, _ = model._sample_action(0, None, n_envs)
                model._last_obs, *_ = model.env.step(actions)  # type: ignore[union-attr]
            if round_number > 0:
                times[name].append(1000 * (time.perf_counter() - started))
        model.policy.set_training_mode(False)
    whole = np.add(times["with_ms"], times["update_ms"]) / np.add(times["without_ms"], times["update_ms"])
    medians = {name: round(float(np.median(values)), 3) for name, values in times.items()}
    return {"n_envs": n_envs, **medians, "ratio": round(float(np.median(whole)), 3)}


def learn_cost(steps: int) -> dict[str, float]:
    """Time of a step of `learn()` on noisy cartpole over the time of its update."""
    settings = dict(**CPU, buffer_size=50_000, batch_size=512, learning_starts=1000, learning_rate=1e-3)
    model = BisimSAC("MlpPolicy", gym.make(CARTPOLE, noise_multiplier=2), **FULL, **SCHEDULE["paper"], **settings)
    model.learn(1000)
    updates: list[float] = []
    train = model.train

    def timed_train(*args: int, **kwargs: int) -> None:
        started = time.perf_counter()
        train(*args, **kwargs)
        updates.append(time.perf_counter() - started)

    model.train = timed_train  # type: ignore[method-assign]
    started = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    seconds = time.perf_counter() - started
    return {"step_ms": 1000 * seconds / steps, "update_ms": 1000 * sum(updates) / steps, "ratio": seconds / sum(updates)}


def family_cost(rounds: int, per_round: int) -> dict[str, float]:
    """
    Update of each method of the figure `metric` and of each family of the configuration over that of the full method, from
    flat observations: medians over the rounds, in which all methods follow each other.
    """
    methods = {**FIGURES["metric"].methods, **{name: Method((name,)) for name in ("MICo", "SimSR", "RAP", "DeepMDP")}}
    models = {}
    for name, method in methods.items():
        settings = {**variant_settings(DEFAULT_CONFIG, CARTPOLE, *method.variants), **method.params}
        settings = {**FULL, **SCHEDULE["paper"], **settings, **CPU, "buffer_size": 1000, "learning_starts": 10**9}
        models[name] = BisimSAC("MlpPolicy", gym.make(CARTPOLE, noise_multiplier=2), **settings).learn(2 * BATCH["mlp"])
    times: dict[str, list[float]] = {name: [] for name in models}
    for round_number in tqdm(range(rounds + 1), desc="families", file=sys.stderr):
        for name, model in models.items():
            started = time.perf_counter()
            model.train(per_round, BATCH["mlp"])
            if round_number > 0:
                times[name].append(time.perf_counter() - started)
    return {name: round(float(np.median(np.divide(times[name], times[FULL_METHOD]))), 3) for name in times}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30, help="timed rounds over all arms, mlp (default: %(default)s)")
    parser.add_argument("--cnn-rounds", type=int, default=10, help="the same for cnn (default: %(default)s)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure (default: everything)")
    args = parser.parse_args()
    th.set_num_threads(1)
    allocator = {key: value for key, value in os.environ.items() if key.startswith("MALLOC_")}
    result: dict = {"benchmark": "update_cost", **machine(), "allocator": allocator, "batch": BATCH}
    measure: dict[str, Callable[[], object]] = {
        "mlp": lambda: update_times("mlp", args.rounds, per_round=4),
        "cnn": lambda: update_times("cnn", args.cnn_rounds, per_round=2),
        "families_over_full": lambda: family_cost(args.rounds, per_round=4),
        "bonus": lambda: {CARTPOLE: bonus_cost(CARTPOLE, 1, 200), PIXELS: bonus_cost(PIXELS, 16, 10)},
        "learn": lambda: learn_cost(500),
        "keep_freed_memory": lambda: kept_memory_cost(max(args.cnn_rounds // 2, 1)),
    }
    print(json.dumps({**result, **{part: measure[part]() for part in args.parts}}))


if __name__ == "__main__":
    main()
