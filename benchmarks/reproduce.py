"""
Repeat a figure of the paper: every method, task and seed through the zoo's command line, then curves and tables.

Each run trains with zoo_configs/bisim_sac.yml and leaves one JSON file in benchmarks/results/FIGURE. A finished run is not run
again, and the repository has those of the published figures: --out FOLDER trains them again. An interrupted run goes on from
its checkpoint, exactly. --dry-run shows the commands. The last line printed is one JSON object.
"""

import argparse
import contextlib
import inspect
import json
import os
import shlex
import shutil
import sys
import tempfile
import traceback
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # runs are spread over processes, one thread each

import _machine
import cloudpickle
import joblib
import numpy as np
import torch as th
import yaml
from _aggregate import draw, tables
from _figures import FIGURES, Figure, Method, Panel
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.cli.zoo_config import check_keys, variant_settings
from sb3_robust_bisim.runs.checkpoint import differences

ROOT = Path(__file__).resolve().parent
CONFIG = ROOT.parent / "zoo_configs" / "bisim_sac.yml"
MOST_SEEDS = 50
DEFAULTS = {name: parameter.default for name, parameter in inspect.signature(BisimSAC).parameters.items()}
LOGGED = ("embedding_norm_mean", "embedding_norm_max", "mu_bd", "mu_rd", "mu_ratio_target")


@dataclass(frozen=True, eq=False)
class Run:
    """One curve of one seed."""

    figure: str
    panel_name: str
    method_name: str
    panel: Panel
    method: Method
    seed: int
    steps: int
    eval_freq: int
    eval_episodes: int
    eval_envs: int

    @property
    def name(self) -> str:
        return f"{self.panel_name.replace('=', '')}_{self.method_name}_seed{self.seed}"

    @property
    def identity(self) -> dict[str, Any]:
        """What a result must agree with to be this run's, as JSON gives it back; two figures may share a run."""
        identity = {
            "panel": self.panel_name,
            "method": self.method_name,
            "env": self.panel.env_id,
            "env_kwargs": self.panel.env_kwargs,
            "variants": [*self.method.variants, *self.panel.variants],
            "params": self.method.params,
            "seed": self.seed,
            "steps": self.steps,
            "eval_freq": self.eval_freq,
            "eval_episodes": self.eval_episodes,
        }
        return json.loads(json.dumps(identity))

    @property
    def settings(self) -> dict[str, Any]:
        """What the configuration makes of it; a result keeps the same under "arguments"."""
        settings = configured(self.panel.env_id, *self.method.variants, *self.panel.variants)
        return json.loads(json.dumps(without_identity({**settings, **self.method.params})))

    def command(self, folder: Path, device: str, vec_env: str) -> list[str]:
        """What follows ``python -m sb3_robust_bisim``."""
        return [
            *("train", "--env", self.panel.env_id, "--variant", *self.method.variants, *self.panel.variants),
            *("--conf-file", str(CONFIG), "--seed", str(self.seed), "--n-timesteps", str(self.steps)),
            *("--eval-freq", str(self.eval_freq), "--eval-episodes", str(self.eval_episodes)),
            *("--n-eval-envs", str(self.eval_envs)),
            *("--log-interval", "1", "--verbose", "0", "--num-threads", "1", "--log-folder", str(folder)),
            *("--tensorboard-log", str(folder / "tensorboard"), "--device", device, "--vec-env", vec_env),
            *("--checkpoint", str(folder / "checkpoint.pkl"), "--checkpoint-freq", str(self.eval_freq)),
            *_store_dict("--env-kwargs", self.panel.env_kwargs),
            *_store_dict("-params", self.method.params),
        ]


@cache
def configured(env_id: str, *variants: str) -> dict[str, Any]:
    return {**yaml.safe_load(CONFIG.read_text())[env_id], **variant_settings(CONFIG, env_id, *variants)}


def without_identity(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings but those that a run's identity names."""
    return {key: value for key, value in settings.items() if key not in ("env_kwargs", "variants", "n_timesteps")}


def _store_dict(option: str, values: dict[str, Any]) -> list[str]:
    return [option, *(f"{key}:{value!r}" for key, value in values.items())] if values else []


def adjusted(name: str, args: argparse.Namespace) -> tuple[str, Figure]:
    """The figure as the command line wants it; what differs from the published one has another name."""
    figure = FIGURES[name]
    steps = args.steps or figure.steps
    methods = {key: replace(method, params={**method.params, **args.params}) for key, method in figure.methods.items()}
    wanted = replace(figure, steps=steps, eval_freq=min(args.eval_freq or figure.eval_freq, steps), methods=methods)
    if wanted == figure:
        return name, figure
    return "_".join([name, f"{steps}steps", f"every{wanted.eval_freq}", *(f"{k}={v}" for k, v in args.params.items())]), wanted


def runs_of(name: str, figure: Figure, seeds: int) -> list[Run]:
    """All runs of a figure, seed by seed, so that an early look compares all methods."""
    length = (figure.steps, figure.eval_freq, figure.eval_episodes, figure.eval_envs)
    return [
        Run(name, panel_name, method_name, panel, method, seed, *length)
        for seed in range(seeds)
        for panel_name, panel in figure.panels.items()
        for method_name, method in figure.methods.items()
        if panel_name in (method.panels or figure.panels) and seed < (method.seeds or seeds)
    ]


def result_of(run: Run, out: Path) -> dict[str, Any] | None:
    """The result of a run that has ended, whichever figure it was made for."""
    for path in sorted(out.glob(f"*/{run.name}.json")):
        if result := finished(path, run.identity):
            check_settings(run, result, path)
            return result
    return None


def check_settings(run: Run, result: dict[str, Any], path: Path) -> None:
    """A result from before a change of the configuration is not the run's, and must not be drawn beside later ones."""
    here, there = {**DEFAULTS, **run.settings}, {**DEFAULTS, **result["arguments"]}
    if differing := differences(there, here, f"in {CONFIG.name}"):
        sys.exit(f"{path} was made with other settings: {differing}. Move the older results of this figure away.")


# --- what a worker does; it reaches other machines by value, and imports only what is installed there


def finished(path: Path, identity: dict[str, Any]) -> dict[str, Any] | None:
    """The result of a run that has ended, if the file holds the one asked for."""
    result = json.loads(path.read_text()) if path.exists() else {}
    return result if result.items() >= identity.items() else None


def train(command: list[str], folder: Path, result_path: Path, identity: dict, commit: str, splits: tuple) -> dict:
    """One run, from its checkpoint if it has one, or its result if it has ended; what went wrong under "failed"."""
    from filelock import FileLock

    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_name(f"{folder.name}.lock")):  # a scheduler may take a worker for dead that is not
        if result := finished(result_path, identity):
            return result
        try:
            measured = begin(folder, {**_machine.machine(command[command.index("--device") + 1]), "commit": commit})
            stopped = learn(command, folder, identity["steps"] - identity["eval_freq"])
            result = {**identity, **measured, **stopped, **collect(folder)}
            if splits and not stopped:
                result["final_return_by_split"] = {split: play(folder, identity, split) for split in splits}
        except Exception:  # the other runs go on
            return {**identity, "failed": traceback.format_exc()}
        write(result_path, json.dumps(result, indent=None).replace('{"step"', '\n{"step"') + "\n")
        return result


def write(path: Path, text: str) -> None:
    from sb3_robust_bisim.runs.atomic import atomic_path

    with atomic_path(path) as temporary:
        temporary.write_text(text)


def begin(folder: Path, measured: dict) -> dict:
    """Clear away what cannot be gone on with, and say which code and machine the run is made with."""
    path = folder / "measured.json"
    if (folder / "checkpoint.pkl").exists() or (folder / "trained.json").exists():
        measured = history(json.loads(path.read_text()) if path.exists() else {}, measured)
    else:
        shutil.rmtree(folder)
    write(path, json.dumps(measured))
    return measured


def history(before: dict, now: dict) -> dict:
    """The measurements of a run; where a value has changed, "old, then new"."""
    said = {}
    for key, value in now.items():
        earlier = before.get(key, {} if isinstance(value, dict) else "unknown")
        if isinstance(value, dict):
            said[key] = history(earlier, value)
        else:
            said[key] = earlier if earlier.split(", then ")[-1] == value else f"{earlier}, then {value}"
    return said


def learn(command: list[str], folder: Path, before_last: int) -> dict[str, str]:
    """Train past the step ``before_last``, unless that has been done; under "stopped" why it ended before."""
    from sb3_robust_bisim.cli.zoo import main

    if (folder / "trained.json").exists():
        return json.loads((folder / "trained.json").read_text())
    stopped = {}
    with (folder / "log.txt").open("a") as log, contextlib.redirect_stdout(log):
        try:
            main(command)
        except ValueError as error:  # an embedding that explodes may end in a loss that is not finite: a result too
            if "training has stopped" not in str(error):
                raise
            stopped = {"stopped": str(error)}
    if not stopped and ((folder / "checkpoint.pkl").exists() or last_evaluation(folder) <= before_last):
        raise KeyboardInterrupt  # the zoo ends such a run as if it were complete
    write(folder / "trained.json", json.dumps(stopped))
    return stopped


def last_evaluation(folder: Path) -> int:
    with np.load(run_folder(folder)[0] / "evaluations.npz") as archive:
        return int(archive["timesteps"][-1])


def steps_of(result: dict[str, Any]) -> list[int]:
    return [evaluation["step"] for evaluation in result["evaluations"]]


def run_folder(folder: Path) -> tuple[Path, dict[str, Any]]:
    """Where the zoo has put a run, and the settings it was made with."""
    (run,) = (folder / "bisim_sac").glob("*_1")
    return run, yaml.unsafe_load(next(run.glob("*/config.yml")).read_text())


def collect(folder: Path) -> dict[str, Any]:
    """What the zoo and TensorBoard have recorded of a run, evaluation by evaluation."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run, arguments = run_folder(folder)
    with np.load(run / "evaluations.npz") as archive:
        steps, returns = archive["timesteps"], archive["results"]
    logged: dict[str, dict[int, float]] = {name: {} for name in LOGGED}
    seconds = 0.0
    for path in sorted((folder / "tensorboard").rglob("events.*")):
        events = EventAccumulator(str(path), size_guidance={"scalars": 0})
        events.Reload()
        tags = events.Tags()["scalars"]
        times = [event.wall_time for tag in tags[:1] for event in events.Scalars(tag)]
        seconds += max(times, default=0) - events.FirstEventTimestamp() if times else 0
        for name in LOGGED:
            if f"bisim/{name}" in tags:
                logged[name].update((event.step, event.value) for event in events.Scalars(f"bisim/{name}"))
    evaluations = []
    for start, end, values in zip([0, *steps[:-1]], steps, returns, strict=True):
        between = {name: [v for step, v in series.items() if start < step <= end] for name, series in logged.items()}
        means = {name: float(f"{np.mean(values):.5g}") for name, values in between.items() if values}
        if between["embedding_norm_max"]:
            means["embedding_norm_max"] = float(f"{max(between['embedding_norm_max']):.5g}")
        evaluations.append({"step": int(end), "returns": np.round(values, 3).tolist(), **means})
    return {"arguments": without_identity(arguments), "seconds": round(seconds), "evaluations": evaluations}


def play(folder: Path, identity: dict, split: str, n_episodes: int = 20) -> list[float]:
    """Returns of the final agent in front of the clips of one split."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecFrameStack

    run, arguments = run_folder(folder)
    kwargs = {**arguments["env_kwargs"], "split": split}
    venv = VecFrameStack(make_vec_env(identity["env"], 1, env_kwargs=kwargs), n_stack=3)
    model = BisimSAC.load(next(run.glob("robust_bisim-*.zip")), env=venv, device="cpu", buffer_size=1)
    venv.seed(10_000)  # after loading, which sets the seed of the training
    returns, _ = evaluate_policy(model, model.get_env(), n_episodes, return_episode_rewards=True)  # type: ignore[arg-type]
    venv.close()
    return np.round(returns, 3).tolist()


# --- the sweep


def seconds_left(todo: list[Run], results: list[dict], figure: Figure) -> float:
    """Of all runs on one core, after the finished ones of the same method, or of any."""

    def per_step(method: str) -> float:
        known = [r["seconds"] / steps_of(r)[-1] for r in results if r["method"] == method and r["seconds"] > 0]
        known = known or [r["seconds"] / steps_of(r)[-1] for r in results if r["seconds"] > 0]
        return float(np.median(known)) if known else figure.seconds_per_1000_steps / 1000

    return sum(per_step(run.method_name) * run.steps for run in todo)


def backend(args: argparse.Namespace) -> Any:
    if args.backend == "dask":
        cloudpickle.register_pickle_by_value(_machine)  # the workers cannot import it
        return joblib.parallel_config(backend="dask", n_jobs=-1, scheduler_host=args.scheduler, wait_for_workers_timeout=60)
    return joblib.parallel_config(backend="loky", n_jobs=args.jobs)


def sweep(todo: list[Run], args: argparse.Namespace, out: Path, done: int) -> list[str]:
    """Do all runs; the names of those that failed."""
    failed: list[str] = []
    commit = _machine.machine()["commit"]  # of the code that the workers load, whatever is committed while they run
    work, out = args.work.resolve(), out.resolve()
    tasks = [
        joblib.delayed(train)(
            run.command(work / run.figure / run.name, args.device, args.vec_env),
            *(work / run.figure / run.name, out / run.figure / f"{run.name}.json"),
            *(run.identity, commit, run.panel.splits),
        )
        for run in todo
    ]
    with tqdm(total=done + sum(run.steps for run in todo), initial=done, unit="step", file=sys.stderr) as bar, backend(args):
        for result in joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="all")(tasks):
            name = f"{result['panel']} {result['method']} seed {result['seed']}"
            bar.set_postfix_str(name)
            if "failed" in result:
                failed.append(name)
                tqdm.write(f"{name} failed:\n{result['failed']}", file=sys.stderr)
            bar.update(result["steps"])
    return failed


def check_writable(option: str, folder: Path) -> None:
    """Say before the first run what would otherwise be said after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        sys.exit(f"{option} {folder}: {error.strerror}. Name a folder with write access.")


def setting(text: str) -> tuple[str, Any]:
    """``batch_size:128`` or ``distance:l1``"""
    key, colon, value = text.partition(":")
    check_keys({key: value}, "--params")
    if not colon:
        raise ValueError(f"{text}: write KEY:VALUE")
    parsed = yaml.safe_load(value)
    with contextlib.suppress(ValueError):  # to YAML, 1e-3 is text
        parsed = float(value) if isinstance(parsed, str) else parsed
    return key, parsed


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", choices=FIGURES)
    parser.add_argument("--seeds", type=int, help="how many (default: the figure's)")
    parser.add_argument("--steps", type=int, help="of the environment per run (default: the figure's)")
    parser.add_argument("--eval-freq", type=int, help="steps between evaluations and checkpoints (default: the figure's)")
    parser.add_argument("--params", nargs="+", default=[], metavar="KEY:VALUE", help="for all methods, batch_size:128 say")
    parser.add_argument("--panels", nargs="+", help="some of the tasks, N_m=2 for example (default: all)")
    parser.add_argument("--methods", nargs="+", help="some of the methods (default: all)")
    parser.add_argument("--jobs", type=int, default=joblib.cpu_count(), help="local processes (default: %(default)s)")
    parser.add_argument("--device", default="cpu", help="of every run; on one GPU --jobs 1 or a few (default: %(default)s)")
    parser.add_argument(
        "--vec-env", choices=("dummy", "subproc"), default="dummy", help="subproc: in processes (default: %(default)s)"
    )
    parser.add_argument("--backend", choices=("loky", "dask"), default="loky", help="local processes, or a Dask cluster")
    parser.add_argument("--scheduler", help="address of the Dask scheduler, host:port; its workers need --nthreads 1")
    parser.add_argument(
        "--out", type=Path, help="results (default: benchmarks/results; for other settings than the figure's, WORK/results)"
    )
    parser.add_argument("--work", type=Path, help="run folders (default: OUT/work if --out is given, else logs/reproduce)")
    parser.add_argument("--dry-run", action="store_true", help="show the commands and how long they should take")
    parser.add_argument("--only-draw", action="store_true", help="curves and tables of the runs that have ended")
    args = parser.parse_args()
    args.work = args.work or (args.out / "work" if args.out else Path("logs/reproduce"))
    try:
        args.params = dict(sorted(map(setting, args.params)))
    except ValueError as error:
        parser.error(str(error))
    figure = FIGURES[args.figure]
    for option, known in (("panels", figure.panels), ("methods", figure.methods)):
        if unknown := set(getattr(args, option) or ()) - set(known):
            parser.error(f"--{option} {' '.join(unknown)}: {args.figure} has {', '.join(known)}.")
    for option in ("seeds", "steps", "eval_freq", "jobs"):
        if (value := getattr(args, option)) is not None and value < 1:
            parser.error(f"--{option.replace('_', '-')} {value}: must be at least 1.")
    try:
        th.empty(0, device=args.device if args.backend == "loky" else "cpu")  # the workers' devices are not known here
    except (RuntimeError, AssertionError) as error:
        parser.error(f"--device {args.device}: there is none here ({str(error).splitlines()[0]}). Take cpu, say.")
    if (args.backend == "dask") != (args.scheduler is not None):
        parser.error("--backend dask and --scheduler ADDRESS belong together.")
    return args


def main() -> None:
    args = parse_arguments()
    name, figure = adjusted(args.figure, args)
    out = args.out or (ROOT / "results" if figure == FIGURES[args.figure] else args.work / "results")
    seeds, panels, methods = args.seeds or figure.seeds, args.panels or figure.panels, args.methods or figure.methods
    every = runs_of(name, figure, max(MOST_SEEDS, seeds))  # also what earlier sweeps have left and what is drawn with it
    results = {run: result_of(run, out) for run in every}  # which refuses results of other settings before anything runs
    runs = [run for run in every if run.seed < seeds and run.panel_name in panels and run.method_name in methods]
    todo = [run for run in runs if results[run] is None]
    done = [result for run in runs if (result := results[run]) is not None]
    minutes = seconds_left(todo, done, figure) / 60
    rest = f"{minutes:.0f} minutes" if minutes < 90 else f"{minutes / 60:.1f} hours"
    left = (
        f"the rest takes {rest} of one core"
        if todo
        else f"nothing is left to run (--out FOLDER trains again: {out} has the results)"
    )
    print(f"{len(done)} of {len(runs)} runs have ended; {left}.", file=sys.stderr)
    if args.dry_run:
        for run in todo:
            command = run.command(args.work / run.figure / run.name, args.device, args.vec_env)
            print(shlex.join(["python", "-m", "sb3_robust_bisim", *command]).replace(f"{Path.cwd()}/", ""))
        return
    failed = []
    if todo and not args.only_draw:
        check_writable("--out", out)
        check_writable("--work", args.work)
        failed = sweep(todo, args, out, sum(result["steps"] for result in done))
    done = [result for run in every if (result := result_of(run, out)) is not None]
    if not done:
        sys.exit("No run has ended yet.")
    draw(done, figure, out / name)
    summary = tables(done, figure, out / name)
    print(json.dumps({"benchmark": "reproduce", "figure": name, "runs": len(done), "failed": failed, **summary}))
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
