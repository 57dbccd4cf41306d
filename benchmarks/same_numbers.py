"""
Do two commits compute the same numbers?

Each commit trains the same twelve configurations for 300 updates. A configuration is the same if all parameters and all
logged values are equal to the last bit. Bits differ between processors, so this compares two commits on one machine and is
no test. The last line printed is one JSON object; the exit code is 1 if anything differs.

    python benchmarks/same_numbers.py HEAD~1 HEAD
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

UPDATES = 300
OFF = dict(bisim_coef=0.0, norm_constraint=False)
FULL = dict(intrinsic_reward_scale=2.0, inverse_dynamics_coef=1.0)
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "SAC": OFF,
    "DBC": dict(norm_constraint=False),
    "normed": {},
    "full": FULL,
    "full l1": dict(distance="l1", **FULL),
    "full l2, c_t 0.5, schedule of SAC": dict(distance="l2", c_t=0.5, policy_delay=1, **FULL),
    "full Gaussian": dict(dynamics="probabilistic", **FULL),
    "full ensemble": dict(dynamics="ensemble", **FULL),
    "full gSDE": dict(use_sde=True, **FULL),
    "full two encoders": dict(policy_kwargs=dict(share_features_extractor=False), **FULL),
    "full pixels": dict(policy="CnnPolicy", **FULL),
    "full Dict": dict(policy="MultiInputPolicy", **FULL),
}


def record(names: list[str]) -> dict[str, dict[str, Any]]:
    """Train configurations with the package that Python finds."""
    import gymnasium as gym
    import torch as th
    from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv

    from sb3_robust_bisim import BisimSAC

    th.set_num_threads(1)
    environments = {
        "MlpPolicy": lambda: gym.make("robust_bisim/SparseCartPole-v0", noise_multiplier=1, theta_rew_fraction=1.0),
        "CnnPolicy": lambda: FakeImageEnv(screen_height=36, screen_width=36, n_channels=3, discrete=False),
        "MultiInputPolicy": lambda: SimpleMultiObsEnv(discrete_actions=False),
    }
    settings: dict[str, Any] = dict(learning_starts=50, batch_size=32, buffer_size=1000, learning_rate=1e-3, seed=0)
    recorded = {}
    for name in names:
        arguments = CONFIGURATIONS[name]
        policy, kwargs = arguments.get("policy", "MlpPolicy"), {k: v for k, v in arguments.items() if k != "policy"}
        env = environments[policy]()
        env.observation_space.seed(0)  # images are drawn from it
        model = BisimSAC(policy, env, device="cpu", **settings, **kwargs)
        model.learn(settings["learning_starts"] + UPDATES, log_interval=10**9)  # nothing leaves the logger
        # sorted: what counts is the numbers, not the names and the order of the modules
        hashes = sorted(hashlib.sha256(p.detach().numpy().tobytes()).hexdigest() for p in model.policy.parameters())
        logged = {
            key: float(value) for key, value in sorted(model.logger.name_to_value.items()) if not key.startswith("time/")
        }
        recorded[name] = {"parameters": hashlib.sha256("".join(hashes).encode()).hexdigest()[:16], **logged}
    return recorded


def record_commit(commit: str, names: list[str]) -> dict[str, dict[str, Any]]:
    """What :func:`record` gives for the package of a commit; "." is the working tree."""
    root = Path(__file__).resolve().parents[1]
    with tempfile.TemporaryDirectory() as folder:
        if commit == ".":
            package = root
        else:
            package = Path(folder, "tree")
            subprocess.run(["git", "-C", root, "worktree", "add", "--detach", "-q", package, commit], check=True)
        try:
            # from the folder of the package: it goes before an installed one
            out = subprocess.run(
                [sys.executable, Path(__file__).resolve(), "--record", "--only", *names],
                **{"cwd": package, "env": {**os.environ, "PYTHONPATH": str(package)}},
                **{"stdout": subprocess.PIPE, "text": True, "check": True},
            ).stdout
        finally:
            if commit != ".":
                subprocess.run(["git", "-C", root, "worktree", "remove", "--force", package], check=True)
    return json.loads(out.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commits", nargs="*", help='two commits; "." is the working tree')
    parser.add_argument(
        "--only",
        nargs="+",
        default=[*CONFIGURATIONS],
        metavar="NAME",
        choices=CONFIGURATIONS,
        help="some of the configurations",
    )
    parser.add_argument("--record", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.record:
        print(json.dumps(record(args.only)))
        return
    if len(args.commits) != 2:
        parser.error(f"commits {' '.join(args.commits)}: name two.")
    before, after = (record_commit(commit, args.only) for commit in args.commits)
    differing = {}
    for name in args.only:
        keys = sorted({*before[name], *after[name]})
        pairs = {key: (before[name].get(key), after[name].get(key)) for key in keys}
        differing[name] = {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
        print(f"{name:36}{'differs' if differing[name] else 'same'}")
        for key, pair in differing[name].items():
            print(f"    {key}: {pair[0]} {pair[1]}")
    same = [name for name in args.only if not differing[name]]
    print(json.dumps({"benchmark": "same_numbers", "commits": args.commits, "same": same, "of": len(args.only)}))
    sys.exit(0 if len(same) == len(args.only) else 1)


if __name__ == "__main__":
    main()
