"""
The paper's theory figure (fig:theoretical): does the norm constraint stop the explosion, and does mu_bd / mu_rd go where
lemma:mean-lemma says?

Trains variants of zoo_configs/bisim_sac.yml on noisy sparse cartpole. Left: embedding norms of DBC and normed DBC with the
radius of the ball. Right: mini-batch estimates of mu_bd / mu_rd for c_T = 0.5 beside c_R / (1 - c_T), for two weights c_R,
the three distances and the ball.
Each run writes one file when it ends; a run that has its file is not run again. The last line printed is one JSON object.
"""

import argparse
import csv
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from _machine import machine
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.atomic import atomic_path
from sb3_robust_bisim.zoo import ZOO_KEYS, variant_settings

ROOT = Path(__file__).parent
CONFIG = ROOT.parent / "zoo_configs" / "bisim_sac.yml"
ENV_ID = "robust_bisim/SparseCartPole-v0"
# Name: variant of the config file and what is laid over it
RUNS: dict[str, tuple[str, dict]] = {
    "DBC": ("DBC", {}),
    "DBC-normed": ("DBC-normed", {}),
    "DBC-alt": ("DBC-alt", {}),
    "DBC-half": ("DBC", {"c_t": 0.5}),
    "DBC-half-l1": ("DBC", {"c_t": 0.5, "distance": "l1"}),
    "DBC-half-l2": ("DBC", {"c_t": 0.5, "distance": "l2"}),
    "DBC-normed-half": ("DBC-normed", {"c_t": 0.5}),
}
NORMS = ("DBC", "DBC-normed")
LOGGED = ("embedding_norm_mean", "embedding_norm_max", "mu_bd", "mu_rd")
EVERY = 50  # steps that one row of the result is the mean of


class Record(BaseCallback):
    """
    Means of the logged numbers over every 50 steps.

    :param bar: moved on by one per step
    """

    def __init__(self, bar: tqdm) -> None:
        super().__init__()
        self.bar = bar
        self.rows: list[dict[str, float]] = []
        self._values: list[list[float]] = []

    def _on_step(self) -> bool:
        self.bar.update()
        logged = self.logger.name_to_value
        if "bisim/mu_bd" in logged:
            self._values.append([float(logged[f"bisim/{name}"]) for name in LOGGED])
        if self._values and self.num_timesteps % EVERY == 0:
            means = np.mean(self._values, axis=0).tolist()
            self.rows.append({"step": self.num_timesteps, **dict(zip(LOGGED, means, strict=True))})
            self._values = []
        return True


def train(name: str, steps: int, noise: int, seed: int, path: Path, bar: tqdm) -> dict:
    """
    One run, or its file if there is one of the same settings.

    :param name: key of ``RUNS``
    """
    variant, changes = RUNS[name]
    settings = {**yaml.safe_load(CONFIG.read_text())[ENV_ID], **variant_settings(CONFIG, ENV_ID, variant), **changes}
    arguments = {key: value for key, value in settings.items() if key not in ZOO_KEYS}
    run = {"run": name, "seed": seed, "steps": steps, "noise_multiplier": noise, "arguments": arguments}
    if path.exists() and (finished := json.loads(path.read_text())).items() >= run.items():
        bar.update(steps)
        return finished
    model = BisimSAC("MlpPolicy", gym.make(ENV_ID, noise_multiplier=noise), seed=seed, **arguments)
    run |= {"radius": model.radius, "ratio_target": model.c_r / (1 - (model.gamma if model.c_t is None else model.c_t))}
    callback, started = Record(bar), time.perf_counter()
    try:
        model.learn(steps, callback)
    except ValueError as error:  # an embedding that explodes may end in a loss that is not finite: a result too
        run["stopped"] = str(error)
    run |= {"seconds": round(time.perf_counter() - started, 1), **machine(), "rows": callback.rows}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(run, indent=1))
    return run


def ratio(run: dict, last: int | None = None) -> np.ndarray | float:
    """mu_bd / mu_rd of every row (nan without reward), or of the last rows taken together."""
    mu_bd, mu_rd = (np.array([row[key] for row in run["rows"]]) for key in ("mu_bd", "mu_rd"))
    if last is not None:
        return float(mu_bd[-last:].mean() / mu_rd[-last:].mean())
    return np.divide(mu_bd, mu_rd, out=np.full_like(mu_bd, np.nan), where=mu_rd > 0)


def plot(runs: list[dict], noise: int, path: Path) -> None:
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for i, run in enumerate(runs):
        steps = [row["step"] for row in run["rows"]]
        if run["run"] in NORMS:
            left.plot(steps, [row["embedding_norm_mean"] for row in run["rows"]], color=f"C{i}", label=f"{run['run']}: mean")
            largest = [row["embedding_norm_max"] for row in run["rows"]]
            left.plot(steps, largest, color=f"C{i}", linestyle=":", label=f"{run['run']}: largest of the batch")
            if run["radius"] is not None:
                left.axhline(run["radius"], color="black", linestyle="--", label="radius of the ball")
        else:
            arguments = run["arguments"]
            parts = [f"$c_R$ = {arguments.get('c_r', 1.0)}", arguments.get("distance", "huber")]
            label = ", ".join([*parts, *(["normed"] if arguments["norm_constraint"] else [])])
            right.plot(steps, ratio(run), color=f"C{i}", label=label)
    for target in sorted({run["ratio_target"] for run in runs if run["run"] not in NORMS}):
        right.axhline(target, color="black", linestyle="--", linewidth=1)
    left.set(title=f"Embedding norm, sparse cartpole, $N_m$ = {noise}", xlabel="environment steps", yscale="log")
    right.set(
        title="$\\mu_{bd} / \\mu_{rd}$ for $c_T$ = 0.5 (dashed: $c_R / (1 - c_T)$)", xlabel="environment steps", yscale="log"
    )
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def write_csv(runs: list[dict], path: Path) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["run", "step", *LOGGED, "mu_ratio", "mu_ratio_target", "radius"])
        for run in runs:
            for row, value in zip(run["rows"], np.atleast_1d(ratio(run)), strict=True):
                writer.writerow([run["run"], *row.values(), value, run["ratio_target"], run["radius"]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=list(RUNS), help="(default: all)")
    parser.add_argument("--steps", type=int, default=4000, help="of the environment, per run (default: %(default)s)")
    parser.add_argument("--noise-multiplier", type=int, default=2, help="N_m, distractors per state dimension")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "theory_figure")
    args = parser.parse_args()
    th.set_num_threads(1)
    with tqdm(total=len(args.runs) * args.steps, unit="step", file=sys.stderr) as bar:
        runs = [
            train(name, args.steps, args.noise_multiplier, args.seed, args.out / f"{name}.json", bar) for name in args.runs
        ]
    plot(runs, args.noise_multiplier, args.out / "theory_figure.png")
    write_csv(runs, args.out / "theory_figure.csv")
    results = {
        run["run"]: {
            "final_norm_mean": run["rows"][-1]["embedding_norm_mean"],
            "largest_norm": max(row["embedding_norm_max"] for row in run["rows"]),
            "radius": run["radius"],
            "ratio_of_last_1000_steps": ratio(run, last=1000 // EVERY),
            "ratio_target": run["ratio_target"],
            "seconds": run["seconds"],
            "stopped": run.get("stopped"),
        }
        for run in runs
    }
    print(json.dumps({"benchmark": "theory_figure", "steps": args.steps, "seed": args.seed, **machine(), "runs": results}))


if __name__ == "__main__":
    main()
