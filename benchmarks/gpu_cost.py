"""
What does a gradient step from pixels cost on a GPU?

Methods with the settings of zoo_configs/: the paper's (84x84 pixels) and the variant `small` (64x64, random shift), batches
of 128 and 512, fp32 and bf16; on GPUs, torch computes fp32 convolutions in TF32. `SB3` is its SAC with the same encoder and
replay buffer. It does not shift, and updates the actor at every step, not at every second one. All arms are interleaved in
one process; the times are medians over the rounds, and the ratios are computed within each round. `cpu` is one thread of the
same machine, in a few rounds.

`kernels_ms` is how long the GPU computes in an update. In the rest, Python samples the batch, copies it and starts kernels.
`kernels_ms_not_deterministic` is the same without SB3's choice of deterministic convolutions. The last line printed is one
JSON object.
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
from sb3_robust_bisim.cli.zoo_config import DEFAULT_CONFIG, ZOO_KEYS, entry_of, variant_settings
from sb3_robust_bisim.encoders import PixelEncoder

METHODS = {"SAC": ("SAC",), "self-prediction": ("self-prediction",), "full": ("normed-IR-ID", "balanced")}
SCALES = {"paper": (), "small": ("small",)}
FOR_SB3 = ("learning_rate", "ent_coef", "tau", "target_update_interval")
NOT_OF_AN_UPDATE = {*ZOO_KEYS, "replay_buffer_class", "batch_size", "train_freq", "initial_gradient_steps"}
UPDATES = 4  # in one call of train(), as in the variant `small`


def build(method: str, scale: str, bf16: bool, device: str) -> OffPolicyAlgorithm:
    """A model with a filled buffer whose next call is `train`."""
    variants = (*METHODS.get(method, METHODS["SAC"]), *SCALES[scale])
    settings: dict[str, Any] = entry_of(DEFAULT_CONFIG, SWINGUP_PIXELS)
    settings = {**settings, **variant_settings(DEFAULT_CONFIG, SWINGUP_PIXELS, *variants)}
    env = RandomPixels(settings["env_kwargs"].get("size", 84))
    common = dict(device=device, seed=0, buffer_size=1000, learning_starts=10**9)
    if method == "SB3":
        encoder = settings.get("policy_kwargs", {}).get("features_extractor_kwargs", {})
        policy_kwargs = dict(net_arch=[256, 256], features_extractor_class=PixelEncoder, features_extractor_kwargs=encoder)
        buffer: Any = dict(replay_buffer_class=FrameStackReplayBuffer, replay_buffer_kwargs=dict(n_stack=1))
        kept = {name: settings[name] for name in FOR_SB3 if name in settings}
        return SAC("CnnPolicy", env, policy_kwargs=policy_kwargs, **buffer, **kept, **common).learn(600)
    kept = {name: value for name, value in settings.items() if name not in NOT_OF_AN_UPDATE}
    return BisimSAC("CnnPolicy", env, **{**kept, **common, "bf16": bf16}).learn(600)


def timed(model: OffPolicyAlgorithm, batch: int, calls: int) -> float:
    """Milliseconds of an update, with sampling and copying of the batch."""
    started = time.perf_counter()
    for _ in range(calls):
        model.train(UPDATES, batch)
    if model.device.type == "cuda":
        th.cuda.synchronize(model.device)
    return 1000 * (time.perf_counter() - started) / (calls * UPDATES)


def kernels(model: OffPolicyAlgorithm, batch: int) -> dict[str, float]:
    """How long the GPU computes in an update, without copies from the host, and how many kernels are started."""
    with profile(activities=[ProfilerActivity.CUDA]) as measured:
        model.train(UPDATES, batch)
        th.cuda.synchronize(model.device)
    events = [event for event in measured.key_averages() if "HtoD" not in event.key and event.self_device_time_total > 0]
    ms, count = sum(event.self_device_time_total for event in events) / 1000, sum(event.count for event in events)
    return {"kernels_ms": round(ms / UPDATES, 3), "kernels": round(count / UPDATES)}


def all_kernels(model: OffPolicyAlgorithm, batch: int) -> dict[str, float]:
    """The same, and how long the GPU computes if cuDNN may take convolutions that are not deterministic."""
    result = kernels(model, batch)
    th.backends.cudnn.deterministic = False
    model.train(UPDATES, batch)  # cuDNN chooses
    result["kernels_ms_not_deterministic"] = kernels(model, batch)["kernels_ms"]
    th.backends.cudnn.deterministic = True  # as SB3 has set it
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="beside which the CPU is timed (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=8, help="timed rounds over all arms (default: %(default)s)")
    parser.add_argument("--cpu-rounds", type=int, default=3, help="in how many the CPU takes part (default: %(default)s)")
    parser.add_argument("--scales", nargs="+", choices=SCALES, default=list(SCALES), help="settings (default: all)")
    args = parser.parse_args()
    th.set_num_threads(1)
    is_gpu = th.device(args.device).type == "cuda"
    arms: dict[tuple[str, str, bool, str, int], OffPolicyAlgorithm] = {}
    for scale, method in itertools.product(args.scales, (*METHODS, "SB3")):
        for bf16 in (False, True) if method != "SB3" else (False,):
            model = build(method, scale, bf16, args.device)
            arms |= {(scale, method, bf16, args.device, batch): model for batch in (128, 512)}
        if is_gpu:
            arms[scale, method, False, "cpu", 128] = build(method, scale, False, "cpu")
    times: dict[tuple, list[float]] = {arm: [] for arm in arms}
    for round_number in tqdm(range(args.rounds + 1), desc="updates", file=sys.stderr):
        for arm, model in arms.items():
            on_gpu = model.device.type == "cuda"
            if on_gpu or round_number <= args.cpu_rounds:
                took = timed(model, arm[-1], calls=3 if on_gpu else 1)
                times[arm] += [took] if round_number > 0 else []  # the first one warms up
    result: dict[str, dict] = {scale: {} for scale in args.scales}
    for (scale, method, bf16, device, batch), values in times.items():
        quartiles = np.percentile(values, [25, 50, 75]).round(2).tolist()
        entry: dict[str, Any] = {"ms": quartiles.pop(1), "ms_quartiles": quartiles}
        if device == args.device:
            over = np.divide(values, times[scale, "SB3", False, device, batch])
            entry["over_SB3"] = round(float(np.median(over)), 3)
        if device == args.device and is_gpu:
            entry |= all_kernels(arms[scale, method, bf16, device, batch], batch)
        result[scale][f"{method}{' bf16' if bf16 else ''}, batch {batch}, {device}"] = entry
    print(json.dumps({"benchmark": "gpu_cost", **machine(args.device), **result}))


if __name__ == "__main__":
    main()
