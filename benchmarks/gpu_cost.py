"""
What does a gradient step from pixels cost on a GPU?

Methods with the settings of zoo_configs/: the paper's (84x84 pixels) and the variant `small` (64x64, random shift), batches of
128 and 512, fp32 and bf16. `SB3` is its SAC with the same encoder, replay buffer and batch. All arms are interleaved in one
process; the times are medians over the rounds, and the ratios are computed within each round. `cpu` is one thread of the same
machine, in a few rounds. `kernels_ms` is how long the GPU computes in an update: the rest is Python that starts its kernels.
The last line printed is one JSON object.
"""

import argparse
import itertools
import json
import os
import sys
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch as th
from _figures import SWINGUP_PIXELS
from _machine import machine
from _random_pixels import RandomPixels
from stable_baselines3 import SAC
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch.profiler import ProfilerActivity, profile
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC, FrameStackReplayBuffer
from sb3_robust_bisim.cli.zoo_config import DEFAULT_CONFIG, variant_settings
from sb3_robust_bisim.encoders import PixelEncoder

METHODS = {"SAC": ("SAC",), "self-prediction": ("self-prediction",), "full": ("normed-IR-ID", "balanced")}
SETTINGS = {"paper": (), "small": ("small",)}
NOT_OURS = {"env_kwargs", "n_timesteps", "buffer_size", "batch_size", "gradient_steps", "initial_gradient_steps"}
PER_ROUND = {"cuda": 10, "cpu": 1}


def build(method: str, scale: str, bf16: bool, device: str) -> OffPolicyAlgorithm:
    """A model with a filled buffer whose next call is `train`."""
    variants = (*METHODS.get(method, ("SAC",)), *SETTINGS[scale])
    settings: dict[str, Any] = variant_settings(DEFAULT_CONFIG, SWINGUP_PIXELS, *variants)
    size = settings.get("env_kwargs", {}).get("size", 84)
    settings = {key: value for key, value in settings.items() if key not in NOT_OURS}
    settings |= dict(device=device, seed=0, buffer_size=1000, learning_starts=10**9)
    if method == "SB3":
        names = ("device", "seed", "buffer_size", "learning_starts", "ent_coef", "tau")
        kept = {name: settings[name] for name in names if name in settings}
        encoder = settings.get("policy_kwargs", {}).get("features_extractor_kwargs", {})
        kwargs = dict(net_arch=[256, 256], features_extractor_class=PixelEncoder, features_extractor_kwargs=encoder)
        buffer = dict(replay_buffer_class=FrameStackReplayBuffer, replay_buffer_kwargs=dict(n_stack=1))
        return SAC("CnnPolicy", RandomPixels(size), policy_kwargs=kwargs, **buffer, **kept).learn(600)
    return BisimSAC("CnnPolicy", RandomPixels(size), bf16=bf16, **settings).learn(600)


def timed(model: OffPolicyAlgorithm, batch: int, updates: int) -> float:
    """Milliseconds of an update, transfer of the batch included."""
    started = time.perf_counter()
    model.train(updates, batch)
    if model.device.type == "cuda":
        th.cuda.synchronize()
    return 1000 * (time.perf_counter() - started) / updates


def kernels(model: OffPolicyAlgorithm, batch: int, updates: int = 5) -> dict[str, float]:
    """How long the GPU computes in an update, without copies from the host, and how many kernels are started."""
    with profile(activities=[ProfilerActivity.CUDA]) as measured:
        model.train(updates, batch)
        th.cuda.synchronize()
    events = [event for event in measured.key_averages() if "Memcpy" not in event.key and event.self_device_time_total > 0]
    ms, count = sum(event.self_device_time_total for event in events) / 1000, sum(event.count for event in events)
    return {"kernels_ms": round(ms / updates, 3), "kernels": round(count / updates)}


def deterministic_cost(model: OffPolicyAlgorithm, batch: int, rounds: int) -> float:
    """What SB3's choice of deterministic convolutions costs: the time of an update over that without it."""
    times: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(rounds + 1):
        for deterministic, measured in reversed(times.items()):  # ends as it began
            th.backends.cudnn.deterministic = deterministic
            measured.append(timed(model, batch, PER_ROUND["cuda"]))
    return round(float(np.median(np.divide(times[True][1:], times[False][1:]))), 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="beside which the CPU is timed (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=8, help="timed rounds over all arms (default: %(default)s)")
    parser.add_argument(
        "--cpu-rounds", type=int, default=2, help="in how many of them the CPU takes part (default: %(default)s)"
    )
    parser.add_argument("--scales", nargs="+", choices=SETTINGS, default=list(SETTINGS), help="settings (default: all)")
    args = parser.parse_args()
    th.set_num_threads(1)
    arms: dict[tuple[str, str, bool, str, int], OffPolicyAlgorithm] = {}
    for scale, method in itertools.product(args.scales, (*METHODS, "SB3")):
        for bf16 in (False, True) if method != "SB3" else (False,):
            model = build(method, scale, bf16, args.device)
            arms |= {(scale, method, bf16, args.device, batch): model for batch in (128, 512)}
        arms[scale, method, False, "cpu", 128] = build(method, scale, False, "cpu")
    times: dict[tuple, list[float]] = {arm: [] for arm in arms}
    for round_number in tqdm(range(args.rounds + 1), desc="updates", file=sys.stderr):
        for (*names, device, batch), model in arms.items():
            if device == "cpu" and round_number > args.cpu_rounds:
                continue
            took = timed(model, batch, PER_ROUND["cpu" if device == "cpu" else "cuda"])
            if round_number > 0:  # the first one warms up
                times[*names, device, batch].append(took)
    result: dict[str, dict] = {scale: {} for scale in args.scales}
    for (scale, method, bf16, device, batch), values in times.items():
        quartiles = np.percentile(values, [25, 50, 75]).round(2).tolist()
        entry: dict[str, Any] = {"ms": quartiles.pop(1), "ms_quartiles": quartiles}
        if device != "cpu":
            sb3 = times[scale, "SB3", False, device, batch]
            entry["over_SB3"] = round(float(np.median(np.divide(values, sb3))), 3)
            if device == "cuda" and batch == 128:
                entry |= kernels(arms[scale, method, bf16, device, batch], batch)
        result[scale][f"{method}{' bf16' if bf16 else ''}, batch {batch}, {device}"] = entry
        if method == "full" and device == "cuda" and not bf16:
            entry["deterministic_over_not"] = deterministic_cost(arms[scale, method, bf16, device, batch], batch, args.rounds)
    print(json.dumps({"benchmark": "gpu_cost", **machine(args.device), **result}))


if __name__ == "__main__":
    main()
