"""
A soak: long training with checkpoints, evaluations and many resets; memory, open files, threads and speed meanwhile.

    python benchmarks/soak.py                       # an hour of cartpole, then an hour of pixels with video
    python benchmarks/soak.py pixels --minutes 10

Each run is the command line in a process of its own, looked at from outside. It ends by SIGTERM, which acts like Ctrl-C but
reaches a background process as well, and must leave a whole agent. Speed is also given in steps per unit of CPU work: a fixed
product of matrices is timed at every look, so that programs which take turns on the cores and share their caches do not count.
Writes ``TASK.json`` and ``TASK.png`` to --out. The last line printed is one JSON object.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # here, and in the runs

import numpy as np
import psutil
from _machine import machine
from matplotlib.figure import Figure
from scipy.stats import theilslopes
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.runs.atomic import atomic_path

TARGETS = {"growth_at_most_mb_per_10000_steps": 1.0, "speed_at_least_of_middle": 0.97}
# Small buffers, so that they are full early; evaluations and checkpoints often
COMMON = ["--verbose", "0", "--log-interval", "1", "--seed", "0", "--num-threads", "1", "--n-timesteps", "100000000"]
RUNS: dict[str, tuple[int, list[str]]] = {
    "cartpole": (2000, ["--env", "robust_bisim/SparseCartPole-v0", "--eval-freq", "2000", "--checkpoint-freq", "1000"]),
    "pixels": (
        2000,
        [
            *("--env", "robust_bisim/cartpole-swingup-pixels-v0", "--variant", "small", "--eval-freq", "2000"),
            *("--eval-episodes", "1", "--checkpoint-freq", "1000"),
            *("--env-kwargs", "distractor:'video'", "size:48", "action_repeat:20", "color_distraction:'easy'"),
        ],
    ),
}


def reference_seconds(matrix: np.ndarray) -> float:
    """CPU time that a fixed piece of work takes now."""
    start = time.process_time()
    for _ in range(4):
        matrix @ matrix
    return time.process_time() - start


def watch(command: list[str], folder: Path, minutes: float) -> list[dict[str, float]]:
    """Run a command for some minutes, then end it; what it took every few seconds."""
    samples: list[dict[str, float]] = []
    matrix = np.random.default_rng(0).standard_normal((600, 600))
    with (folder / "log.txt").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            inside, end = psutil.Process(process.pid), time.time() + 60 * minutes
            with tqdm(total=round(60 * minutes), unit="s") as bar:
                while time.time() < end and process.poll() is None:
                    with inside.oneshot():
                        sample = {
                            "time": time.time(),
                            "rss_mb": inside.memory_info().rss / 1e6,
                            "cpu_seconds": sum(inside.cpu_times()[:2]),
                            "open_files": inside.num_fds(),
                            "threads": inside.num_threads(),
                        }
                    samples.append({**sample, "reference_seconds": reference_seconds(matrix)})
                    time.sleep(min(5.0, 0.6 * minutes))
                    bar.update(min(bar.total, round(time.time() - end + 60 * minutes)) - bar.n)
        finally:
            process.send_signal(signal.SIGTERM)
            code = process.wait(timeout=300)
    if code != 0 or len(samples) < 10:
        sys.exit(f"{' '.join(command)} ended with exit status {code}:\n{(folder / 'log.txt').read_text()[-3000:]}")
    return samples


def steps_over_time(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times and environment steps as TensorBoard has them."""
    points = []
    for path in folder.rglob("events.*"):
        events = EventAccumulator(str(path), size_guidance={"scalars": 0})
        events.Reload()
        points += [(e.wall_time, e.step) for e in events.Scalars("rollout/ep_rew_mean")]
    times, steps = zip(*sorted(points), strict=True)
    return np.array(times), np.array(steps)


def last_over_middle(clock: np.ndarray, steps: np.ndarray) -> float | None:
    """Steps per unit of a clock in the last quarter of a run, over those in the middle quarter."""
    marks = clock[0] + np.array([0.375, 0.625, 0.75, 1.0]) * (clock[-1] - clock[0])
    middle, _, last = np.diff(np.interp(marks, clock, steps))
    return round(float(last / middle), 3) if middle > 0 else None


def slopes(steps: np.ndarray, memory: np.ndarray) -> list[float]:
    """Median of the slopes between all pairs of points, and its 95 % interval, per 10,000 steps."""
    found = theilslopes(memory, steps)
    return [round(10_000 * float(slope), 3) for slope in (found.slope, found.low_slope, found.high_slope)]


def summary(samples: list[dict[str, float]], times: np.ndarray, steps: np.ndarray, filled: int) -> dict[str, Any]:
    """Growth in the second half, when the buffer has long been full, and the speed of the last quarter over the middle one."""
    when = np.array([sample["time"] for sample in samples])
    at, memory = np.interp(when, times, steps), np.array([sample["rss_mb"] for sample in samples])
    later = at > max(1.5 * filled, at[-1] / 2)
    # the median of all slopes: writing a checkpoint takes memory for a moment
    growth = slopes(at[later], memory[later]) if later.sum() > 2 else None
    cpu = np.array([sample["cpu_seconds"] for sample in samples])
    work = np.cumsum(np.diff(cpu, prepend=cpu[0]) / [sample["reference_seconds"] for sample in samples])
    return {
        "steps": int(steps[-1]),
        "minutes": round((when[-1] - when[0]) / 60, 1),
        "cpu_minutes": round(cpu[-1] / 60, 1),
        "growth_mb_per_10000_steps": growth,  # with its 95 % interval
        "speed_of_middle": last_over_middle(when, at),
        "speed_of_middle_per_work": last_over_middle(work, at),
        **{f"{key}_at_most": max(sample[key] for sample in samples) for key in ("rss_mb", "open_files", "threads")},
    }


def draw(name: str, samples: list[dict[str, float]], times: np.ndarray, steps: np.ndarray, out: Path) -> None:
    start = times[0]
    minutes = [(sample["time"] - start) / 60 for sample in samples]
    picture = Figure(figsize=(8, 7), layout="constrained")
    axes = picture.subplots(4, 1, sharex=True)
    for ax, key, label in zip(
        axes, ("rss_mb", "open_files", "threads"), ("memory, MB", "open files", "threads"), strict=False
    ):
        ax.plot(minutes, [sample[key] for sample in samples])
        ax.set_ylabel(label)
    bins = np.linspace(times[0], times[-1], 41)
    speed = np.diff(np.interp(bins, times, steps)) / np.diff(bins)
    axes[3].plot((bins[1:] - start) / 60, speed)
    axes[3].set(ylabel="steps per second", xlabel="minutes", ylim=(0, 1.1 * speed.max()))
    axes[0].set_title(name)
    with atomic_path(out / f"{name}.png") as temporary:
        picture.savefig(temporary, dpi=90, format="png")


def soak(name: str, minutes: float, out: Path) -> dict[str, Any]:
    buffer_size, arguments = RUNS[name]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        command = [sys.executable, "-m", "sb3_robust_bisim", "train", *arguments, *COMMON]
        command += ["--log-folder", str(folder), "--tensorboard-log", str(folder / "tensorboard")]
        command += ["--checkpoint", str(folder / "checkpoint.pkl"), "-params", f"buffer_size:{buffer_size}"]
        samples = watch(command, folder, minutes)
        times, steps = steps_over_time(folder)
        BisimSAC.load(next((folder / "bisim_sac").glob("*_1/robust_bisim-*.zip")))  # what Ctrl-C has left
    result = {"task": name, **summary(samples, times, steps, buffer_size), **machine()}
    draw(name, samples, times, steps, out)
    with atomic_path(out / f"{name}.json") as file:
        file.write_text(json.dumps({**result, "samples": samples}, indent=None) + "\n")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", choices=[[], *RUNS], default=[], help="default: all")
    parser.add_argument("--minutes", type=float, default=60.0, help="of each task (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "soak", help="default: %(default)s")
    args = parser.parse_args()
    if not args.minutes > 0:
        parser.error(f"--minutes {args.minutes}: it must be above 0.")
    args.out.mkdir(parents=True, exist_ok=True)
    results = [soak(name, args.minutes, args.out) for name in args.tasks or RUNS]
    print(json.dumps({"targets": TARGETS, "results": results}))


if __name__ == "__main__":
    main()
