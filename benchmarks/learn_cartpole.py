"""
Does the full method learn noisy sparse cartpole where SAC and unnormed DBC do not?

Trains the methods of zoo_configs/bisim_sac.yml on several seeds with two noise dimensions per state dimension and evaluates
in the standard task every 500 steps. Each run writes one file as it goes; a finished run is not run again. The last
line printed is one JSON object.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # runs are spread over processes, one thread each

import gymnasium as gym
import joblib
import numpy as np
import torch as th
import yaml
from _machine import machine
from matplotlib.figure import Figure
from rl_zoo3.utils import StoreDict
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.atomic import atomic_path
from sb3_robust_bisim.zoo import ZOO_KEYS, variant_settings

ROOT = Path(__file__).parent
CONFIG = ROOT.parent / "zoo_configs" / "bisim_sac.yml"
ENV_ID = "robust_bisim/SparseCartPole-v0"
METHODS = ("normed-IR-ID", "SAC", "DBC")


class Record(BaseCallback):
    """Evaluates every 500 steps and keeps the largest embedding norm seen, in a file rewritten each time."""

    def __init__(self, run: dict, path: Path, eval_env: gym.Env, every: int = 500) -> None:
        super().__init__()
        self.run, self.path, self.eval_env, self.every = run, path, eval_env, every
        self.largest_norm = 0.0
        self.started = time.perf_counter()

    def _on_step(self) -> bool:
        norm = self.logger.name_to_value.get("bisim/embedding_norm_max", 0.0)
        self.largest_norm = max(self.largest_norm, float(norm))
        if self.num_timesteps % self.every == 0:
            returns, _ = evaluate_policy(self.model, self.eval_env, n_eval_episodes=10, return_episode_rewards=True)
            self.run["evaluations"].append(
                {
                    "step": self.num_timesteps,
                    "mean_return": float(np.mean(returns)),
                    "largest_norm_so_far": self.largest_norm,
                }
            )
            self.run["seconds"] = time.perf_counter() - self.started
            write(self.run, self.path)
        return True


def write(run: dict, path: Path) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(run, indent=1))


def train(method: str, seed: int, steps: int, noise: int, overrides: dict, measured: dict, path: Path) -> dict:
    if path.exists() and json.loads(path.read_text())["finished"]:
        return json.loads(path.read_text())
    th.set_num_threads(1)
    settings = {**yaml.safe_load(CONFIG.read_text())[ENV_ID], **variant_settings(CONFIG, ENV_ID, method)}
    settings |= overrides
    run = {"method": method, "seed": seed, "noise_multiplier": noise, **measured, "finished": False, "evaluations": []}
    run["arguments"] = {key: value for key, value in settings.items() if key not in ZOO_KEYS}
    eval_env = Monitor(gym.make(ENV_ID, noise_multiplier=noise, **settings["eval_env_kwargs"]))
    eval_env.reset(seed=10_000 + seed)
    model = BisimSAC("MlpPolicy", gym.make(ENV_ID, noise_multiplier=noise), seed=seed, **run["arguments"])
    run["radius"] = model.radius
    try:
        model.learn(steps, callback=Record(run, path, eval_env))
    except ValueError as error:  # an embedding that explodes may end in a loss that is not finite: that is a result too
        run["stopped"] = str(error)
    run["finished"] = True
    write(run, path)
    return run


def summary(runs: list[dict]) -> dict:
    """Per method: what the seeds reached, and the largest embedding norm of any of them."""
    methods = {}
    for method in dict.fromkeys(run["method"] for run in runs):
        mine = [run for run in runs if run["method"] == method]
        returns = [[evaluation["mean_return"] for evaluation in run["evaluations"]] for run in mine]
        methods[method] = {
            "seeds": [run["seed"] for run in mine],
            "final_return": [values[-1] for values in returns],
            "best_of_last_three": [max(values[-3:]) for values in returns],
            "seeds_at_least_190": sum(max(values[-3:]) >= 190 for values in returns),
            "first_step_at_195": [
                next((e["step"] for e in run["evaluations"] if e["mean_return"] >= 195), None) for run in mine
            ],
            "largest_embedding_norm": [run["evaluations"][-1]["largest_norm_so_far"] for run in mine],
            "radius": mine[0]["radius"],
            "stopped": [run.get("stopped") for run in mine],
            "minutes": [round(run["seconds"] / 60, 1) for run in mine],
        }
    return methods


def plot(runs: list[dict], path: Path, noise: int) -> None:
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for method in dict.fromkeys(run["method"] for run in runs):
        mine = [run["evaluations"] for run in runs if run["method"] == method]
        length = min(map(len, mine))
        steps = [evaluation["step"] for evaluation in mine[0][:length]]
        for axes, key in ((left, "mean_return"), (right, "largest_norm_so_far")):
            values = np.array([[evaluation[key] for evaluation in run[:length]] for run in mine])
            mean, error = values.mean(axis=0), values.std(axis=0) / np.sqrt(len(mine))
            axes.plot(steps, mean, label=f"{method} ({len(mine)} seeds)")
            axes.fill_between(steps, mean - error, mean + error, alpha=0.25)
    left.set(title=f"Sparse cartpole, N_m = {noise}", xlabel="environment steps", ylabel="return in the standard task")
    right.axhline(50, color="black", linestyle="--", linewidth=1, label="radius of the ball")
    right.set(title="Largest embedding norm so far", xlabel="environment steps", yscale="log")
    left.legend()
    right.legend()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), help="variants of the config (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--noise-multiplier", type=int, default=2, help="N_m, distractors per state dimension")
    parser.add_argument("--params", nargs="+", action=StoreDict, default={}, help="overrides, e.g. initial_gradient_steps:0")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "learn_cartpole")
    args = parser.parse_args()
    measured = machine()  # the code that the workers load, whatever is committed while they run
    todo = [(method, seed) for seed in range(args.seeds) for method in args.methods]
    tasks = [
        joblib.delayed(train)(
            *(method, seed, args.steps, args.noise_multiplier, args.params, measured),
            args.out / f"{method}_seed{seed}.json",
        )
        for method, seed in todo
    ]
    parallel = joblib.Parallel(n_jobs=args.jobs, return_as="generator")
    runs = list(tqdm(parallel(tasks), total=len(tasks), unit="run", file=sys.stderr))
    plot(runs, args.out / "curves.png", args.noise_multiplier)
    print(json.dumps({"benchmark": "learn_cartpole", "steps": args.steps, **measured, "methods": summary(runs)}))


if __name__ == "__main__":
    main()
