"""
Which setting of torch's threads is good on a quiet and on a busy machine?

A step of `learn()` of the full method is timed with torch's default, with OMP_WAIT_POLICY=passive and with one thread. Each is
timed alone and beside as many copies of itself as there are cores. The last line printed is one JSON object.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

SETTINGS: dict[str, dict[str, str]] = {
    "default": {},
    "passive": {"OMP_WAIT_POLICY": "passive"},
    "one thread": {"OMP_NUM_THREADS": "1"},
}


def step_ms(kind: str, steps: int) -> float:
    """Milliseconds of a step of `learn()`, its update included."""
    # update_cost.py, which has the same models, sets the number of threads when it is imported
    import gymnasium as gym
    from stable_baselines3.common.envs import FakeImageEnv

    from sb3_robust_bisim import BisimSAC

    batch = 512 if kind == "mlp" else 128
    settings: dict = dict(intrinsic_reward_scale=2.0, inverse_dynamics_coef=1.0, policy_delay=2, target_update_interval=2)
    settings |= dict(device="cpu", seed=0, batch_size=batch, learning_starts=batch, buffer_size=1000)
    if kind == "mlp":
        model = BisimSAC("MlpPolicy", gym.make("robust_bisim/SparseCartPole-v0", noise_multiplier=2), **settings)
    else:
        images = FakeImageEnv(screen_height=84, screen_width=84, n_channels=9, discrete=False, channel_first=True)
        model = BisimSAC("CnnPolicy", images, **settings)
    model.learn(batch + 2)
    started = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    return 1000 * (time.perf_counter() - started) / steps


def timed(kind: str, setting: str, steps: int, copies: int) -> float:
    """The median over ``copies`` processes that run at once."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith(("OMP_", "MKL_"))}
    command = [sys.executable, str(Path(__file__).resolve()), "--one", kind, "--steps", str(steps)]
    processes = [
        subprocess.Popen(command, env={**inherited, **SETTINGS[setting]}, stdout=subprocess.PIPE, text=True)
        for _ in range(copies)
    ]
    found = sorted(float(process.communicate()[0].splitlines()[-1]) for process in processes)
    return found[len(found) // 2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=("mlp", "cnn"), default=["mlp", "cnn"], help="(default: %(default)s)")
    parser.add_argument("--steps", type=int, default=150, help="timed steps, a tenth for cnn (default: %(default)s)")
    parser.add_argument("--one", choices=("mlp", "cnn"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(step_ms(args.one, args.steps))
        return
    from _machine import machine

    cores = os.cpu_count() or 1
    result: dict = {"benchmark": "threads", **machine(), "copies_when_busy": cores}
    for kind in args.kinds:
        steps = args.steps if kind == "mlp" else max(args.steps // 10, 5)
        result[kind] = {
            setting: {
                "quiet_ms": round(timed(kind, setting, steps, 1), 1),
                "busy_ms": round(timed(kind, setting, steps, cores), 1),
            }
            for setting in SETTINGS
        }
        print(kind, result[kind], file=sys.stderr)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
