"""
Does PPO learn faster from the frozen encoder of an agent? Cartpole with noise dimensions and the standard reward.

For each seed, BisimSAC trains with the settings of zoo_configs/ for sparse cartpole, but the standard reward, and is exported.
Then PPO learns with its defaults: on the observations themselves, on the frozen encoder, and, as a control, on the frozen
encoder of an agent that has not been trained. A finished run leaves a JSON file and is not run again. Curves and a table are
drawn at the end. The last line printed is one JSON object.
"""

import argparse
import json
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # small nets

import gymnasium as gym
import numpy as np
from _aggregate import draw, of, series
from _figures import CARTPOLE, Figure, Method, Panel
from _machine import machine
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_robust_bisim import BisimSAC, PretrainedEncoder, export_agent
from sb3_robust_bisim.cli.zoo_config import DEFAULT_CONFIG, ZOO_KEYS, entry_of
from sb3_robust_bisim.runs.atomic import atomic_path

ROOT = Path(__file__).resolve().parent
SOURCE, PLAIN, PRETRAINED, UNTRAINED = "BisimSAC", "PPO", "PPO, encoder", "PPO, untrained encoder"
METHODS = (SOURCE, PLAIN, PRETRAINED, UNTRAINED)
EVAL_SEED = 10_000


def make_env(noise: int) -> gym.Env:
    return Monitor(gym.make(CARTPOLE, theta_rew_fraction=1.0, noise_multiplier=noise))


def make_source(args: argparse.Namespace, seed: int) -> BisimSAC:
    """The full method as zoo_configs/ has it."""
    entry = entry_of(str(DEFAULT_CONFIG), CARTPOLE)
    settings = {name: value for name, value in entry.items() if name not in ZOO_KEYS}
    return BisimSAC(entry["policy"], make_env(args.noise), seed=seed, device="cpu", **settings)


def encoder_folder(args: argparse.Namespace, method: str, seed: int) -> Path:
    return (
        args.out
        / "agents"
        / f"{'untrained' if method == UNTRAINED else f'{args.encoder_steps}steps'}_noise{args.noise}_seed{seed}"
    )


def make_ppo(args: argparse.Namespace, method: str, seed: int) -> PPO:
    kwargs: dict[str, Any] = {}
    if method == UNTRAINED:
        export_agent(make_source(args, seed), encoder_folder(args, method, seed))
    if method != PLAIN:
        path = encoder_folder(args, method, seed)
        kwargs = dict(features_extractor_class=PretrainedEncoder, features_extractor_kwargs=dict(path=path, freeze=True))
    return PPO("MlpPolicy", make_env(args.noise), seed=seed, device="cpu", policy_kwargs=kwargs)


def identity(args: argparse.Namespace, method: str, seed: int) -> dict[str, Any]:
    """What a result must agree with to be the one asked for."""
    known: dict[str, Any] = {"panel": f"N_m={args.noise}", "method": method, "seed": seed}
    known["steps"] = args.encoder_steps if method == SOURCE else args.steps
    if method in (SOURCE, PRETRAINED):
        known["encoder_steps"] = args.encoder_steps
    return {**known, "eval_freq": args.eval_freq, "eval_episodes": args.eval_episodes}


def run(args: argparse.Namespace, method: str, seed: int) -> dict[str, Any]:
    """Train and evaluate, unless that has been done."""
    wanted = identity(args, method, seed)
    path = args.out / "runs" / f"{method.replace(', ', '_').replace(' ', '_')}_noise{args.noise}_seed{seed}.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    if found.items() >= wanted.items():
        return found
    if found:
        sys.exit(f"{path} was made with other settings. Pass another --out, or move it away.")
    start = time.perf_counter()
    measured = machine()
    model: BaseAlgorithm = make_source(args, seed) if method == SOURCE else make_ppo(args, method, seed)
    evaluations = learn(model, args, wanted["steps"])
    if isinstance(model, BisimSAC):
        export_agent(model, encoder_folder(args, method, seed))
    result = {**wanted, **measured, "seconds": round(time.perf_counter() - start), "evaluations": evaluations}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(result).replace('{"step"', '\n{"step"') + "\n")
    return result


def learn(model: BaseAlgorithm, args: argparse.Namespace, steps: int) -> list[dict[str, Any]]:
    """:return: of each evaluation its step and the returns of its episodes, by the mean action"""
    eval_env = make_env(args.noise)
    eval_env.reset(seed=EVAL_SEED)
    warnings.filterwarnings("ignore", "Training and eval env are not of the same type")  # one pays the bonus
    with tempfile.TemporaryDirectory() as folder:
        model.learn(
            steps,
            callback=EvalCallback(
                eval_env, n_eval_episodes=args.eval_episodes, eval_freq=args.eval_freq, log_path=folder, verbose=0
            ),
        )
        with np.load(Path(folder) / "evaluations.npz") as archive:
            # PPO rounds its steps up to whole rollouts
            return [
                {"step": int(step), "returns": returns.tolist()}
                for step, returns in zip(archive["timesteps"], archive["results"], strict=True)
                if step <= steps
            ]


def table(results: list[dict[str, Any]], args: argparse.Namespace) -> str:
    """Where each method ended and how much it earned on the way, as mean ± standard error over the seeds."""

    def with_error(values: np.ndarray) -> str:
        error = f" ± {values.std(ddof=1) / np.sqrt(len(values)):.1f}" if len(values) > 1 else ""
        return f"{values.mean():.1f}{error}"

    lines = [
        "| method | runs | steps | last return of each | last return | mean return of all evaluations | minutes |",
        "|---" * 7 + "|",
    ]
    for method in METHODS:
        runs = of(results, method=method)
        returns = series(runs, "return")[1]
        last = ", ".join(f"{value:.4g}" for value in returns[:, -1])
        minutes = np.median([result["seconds"] for result in runs]) / 60
        cells = [method, len(runs), runs[0]["steps"], last, with_error(returns[:, -1]), with_error(returns.mean(axis=1))]
        lines.append("| " + " | ".join(map(str, [*cells, f"{minutes:.1f}"])) + " |")
    measured = sorted({f"commit {r['commit']}, {r['machine']}, torch {r['versions']['torch']}" for r in results})
    seeds = sorted({result["seed"] for result in results})
    lines += ["", f"Cartpole with standard reward (at most 200) and {args.noise} noise dimensions per state dimension."]
    lines += [f"± is the standard error over seeds. Seeds {seeds[0]} to {seeds[-1]}; {'; '.join(measured)}.", ""]
    return "\n".join(lines)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="how many (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=50_000, help="of PPO (default: %(default)s)")
    parser.add_argument("--encoder-steps", type=int, default=10_000, help="of BisimSAC (default: %(default)s)")
    parser.add_argument("--noise", type=int, default=2, help="noise dimensions per state dimension (default: %(default)s)")
    parser.add_argument("--eval-freq", type=int, default=2500, help="steps between evaluations (default: %(default)s)")
    parser.add_argument("--eval-episodes", type=int, default=10, help="per evaluation (default: %(default)s)")
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "results" / "pretrained_encoder",
        help="folder of results (default: benchmarks/results/pretrained_encoder)",
    )
    args = parser.parse_args()
    for name, least in (
        ("seeds", 1),
        ("steps", 1),
        ("encoder_steps", 1),
        ("noise", 0),
        ("eval_freq", 1),
        ("eval_episodes", 1),
    ):
        if getattr(args, name) < least:
            parser.error(f"--{name.replace('_', '-')} {getattr(args, name)}: must be at least {least}.")
    if args.eval_freq > min(args.steps, args.encoder_steps):
        parser.error(f"--eval-freq {args.eval_freq}: must be at most --steps and --encoder-steps.")
    return args


def main() -> None:
    args = parse_arguments()
    results = []
    for seed in range(args.seeds):
        for method in METHODS:
            results.append(run(args, method, seed))
            print(
                f"{method} seed {seed}: {np.mean(results[-1]['evaluations'][-1]['returns']):.1f}", file=sys.stderr, flush=True
            )
    panels = {results[0]["panel"]: Panel(CARTPOLE)}
    methods = {method: Method(()) for method in METHODS if method != SOURCE}
    figure = Figure(panels, methods, args.seeds, args.steps, args.eval_freq, args.eval_episodes, 0.0, rows=("mean_return",))
    draw(results, figure, args.out)
    with atomic_path(args.out / "table.md") as temporary:
        temporary.write_text(table(results, args))
    print(json.dumps({"benchmark": "pretrained_encoder", **{k: str(v) for k, v in vars(args).items()}, **machine()}))


if __name__ == "__main__":
    main()
