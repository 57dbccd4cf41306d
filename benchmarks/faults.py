"""
Faults: kills, torn writes, a full disk, a read-only folder, two processes, a dead worker or scheduler, signals, a wrong clock.

    python benchmarks/faults.py                                # all of them, about 10 minutes on a quiet core
    python benchmarks/faults.py --only kills --kills 5

Processes, signals and file systems are real. "Nothing lost" is a comparison: bit by bit with a run that was left alone, or
with the number of the last write that had ended. Results go to --out as they come, as JSON and as a Markdown table. A fault
that has been tried at this commit is not tried again, unless --only names it. The last line printed is one JSON object.

Processes that are killed in a loop are forks of this one, which has imported everything. They run the command line as a user
does. A full disk is a small tmpfs, which needs root; without root, that fault is left out.
"""

import argparse
import contextlib
import datetime
import hashlib
import json
import multiprocessing
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # forks of a process with thread pools would hang

import numpy as np
import psutil
import reproduce
import torch as th
from _machine import machine
from stable_baselines3.common.save_util import load_from_pkl
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.cli.zoo import main as command_line
from sb3_robust_bisim.envs.video import load_clip, split_clips
from sb3_robust_bisim.runs.atomic import atomic_path
from sb3_robust_bisim.runs.checkpoint import load_checkpoint, read_about, save_checkpoint
from sb3_robust_bisim.runs.hashed_file import damage

HERE = Path(__file__).resolve().parent
FORK = multiprocessing.get_context("fork")
LONGEST = 900.0  # seconds that any process may take; one that takes longer counts as hanging
STEPS, EVERY = 600, 10  # a checkpoint every 10 steps, so that kills also hit the writing
SMALL = [
    "initial_gradient_steps:0",
    "learning_starts:100",
    "batch_size:16",
    "buffer_size:1500",
    "policy_kwargs:dict(net_arch=[32])",
]
CLIP_SIZE = 64
Measured = dict[str, Any]


class Lost(Exception):
    """A fault was not survived; the message says what was lost."""


def check(holds: object, message: str) -> None:
    if not holds:
        raise Lost(message)


# --- processes


def forked(log: Path, function: Callable[..., Any], *args: Any) -> BaseProcess:
    """Call a function in another process, which writes what it prints to a file."""

    def run() -> None:
        with log.open("a") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        function(*args)

    log.parent.mkdir(parents=True, exist_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    process = FORK.Process(target=run)
    process.start()
    return process


def ended(process: BaseProcess, name: str) -> int:
    """The exit code of a process."""
    process.join(LONGEST)
    if process.exitcode is None:
        process.kill()
        raise Lost(f"{name} was still running after {LONGEST:.0f} s")
    return process.exitcode


def started(log: Path, *command: str) -> subprocess.Popen:
    """A process of its own group, so that a signal can reach all of it as a terminal's Ctrl-C does."""
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])}
    with log.open("a") as file:
        return subprocess.Popen([sys.executable, *command], stdout=file, stderr=file, env=environment, start_new_session=True)


@contextlib.contextmanager
def no_survivors(*processes: subprocess.Popen) -> Iterator[None]:
    """End the groups of processes, whatever happens."""
    try:
        yield
    finally:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def wait_until(condition: Callable[[], Any], what: str, process: Any = None) -> None:
    end = time.monotonic() + LONGEST
    while not condition():
        over = (
            process is not None and (process.poll() if isinstance(process, subprocess.Popen) else process.exitcode) is not None
        )
        check(not over, f"the process ended before {what}")
        check(time.monotonic() < end, f"waited in vain until {what}")
        time.sleep(0.01)


# --- runs of the command line


def arguments(folder: Path, *more: str) -> list[str]:
    return [
        *("train", "--env", "robust_bisim/SparseCartPole-v0", "--seed", "0", "--n-timesteps", str(STEPS), "--verbose", "0"),
        *("--eval-freq", "100", "--eval-episodes", "1", "--num-threads", "1", "--log-folder", str(folder)),
        *("--checkpoint", str(folder / "run.pkl"), "--checkpoint-freq", str(EVERY), "-params", *SMALL, *more),
    ]


def run_folder(folder: Path) -> Path:
    """The last run: a process that is killed before its first checkpoint leaves a folder without a run that goes on."""
    return max((folder / "bisim_sac").glob("*-v0_*"), key=lambda path: int(path.name.rpartition("_")[2]))


def outcome(folder: Path) -> dict[str, Any]:
    """All numbers of a run that has ended: weights, optimizers, evaluations and episodes, the wall-clock times left out."""
    run = run_folder(folder)
    found = dict(flat(BisimSAC.load(next(run.glob("robust_bisim-*.zip")), device="cpu").get_parameters(), "agent"))
    with np.load(run / "evaluations.npz") as archive:
        found.update({f"evaluations {key}": archive[key] for key in archive.files})
    for path in sorted(run.glob("*.monitor.csv")):
        found[path.name] = np.array([line.split(",")[:2] for line in path.read_text().splitlines()[1:]])
    return found


def flat(tree: Any, name: str) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(tree, dict | list | tuple):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from flat(value, f"{name} {key}")
    else:
        yield name, tree.detach().numpy() if isinstance(tree, th.Tensor) else np.asarray(tree)


def check_same(folder: Path, alone: dict[str, Any]) -> None:
    found = outcome(folder)
    check(found.keys() == alone.keys(), f"other numbers: {sorted(found.keys() ^ alone.keys())[:5]}")
    unequal = [
        name for name in alone if found[name].tobytes() != alone[name].tobytes() or found[name].shape != alone[name].shape
    ]
    check(not unequal, f"{len(unequal)} of {len(alone)} arrays differ from the run left alone, such as {unequal[:3]}")


_alone: dict[tuple[str, ...], tuple[dict[str, Any], float, float]] = {}


def left_alone(folder: Path, *more: str) -> tuple[dict[str, Any], float, float]:
    """The numbers of a run that nothing disturbs, its seconds, and those before it had its folder."""
    if more not in _alone:
        place = folder.parent / "alone" / str(len(_alone))
        start = time.monotonic()
        process = forked(place / "log.txt", command_line, arguments(place, *more))
        wait_until(lambda: list(place.glob("bisim_sac/*/0.monitor.csv")), "the run had its folder", process)
        begun = time.monotonic() - start
        check(ended(process, "the run left alone") == 0, (place / "log.txt").read_text()[-2000:])
        _alone[more] = outcome(place), time.monotonic() - start, begun
    return _alone[more]


def completed(folder: Path) -> bool:
    """A run deletes its checkpoint after it has saved its agent."""
    return not (folder / "run.pkl").exists() and bool(list(folder.glob("bisim_sac/*/robust_bisim-*.zip")))


def continued(folder: Path, alone: dict[str, Any], *more: str) -> None:
    """Repeat the command of an interrupted run, and compare its end."""
    log = folder / "log.txt"
    check((folder / "run.pkl").exists(), "the interrupted run has no checkpoint")
    code = ended(forked(log, command_line, arguments(folder, *more)), "the continued run")
    check(code == 0, log.read_text()[-2000:])
    check("Going on from step" in log.read_text(), "the run began anew")
    check_same(folder, alone)


# --- faults


def kills(folder: Path, args: argparse.Namespace) -> Measured:
    """SIGKILL at random moments of one run with checkpoints; it ends bit-identical to a run left alone"""
    alone, seconds, begun = left_alone(folder)
    longest = begun + 1.5 * seconds / args.kills  # the run should not end before the last kill
    rng, tried, in_a_write, before_the_first = random.Random(0), 0, 0, 0
    while tried < args.kills:
        process = forked(folder / "log.txt", command_line, arguments(folder))
        process.join(rng.uniform(0, longest))
        if process.exitcode is not None:
            check(completed(folder), (folder / "log.txt").read_text()[-2000:])
            break
        process.kill()
        process.join()
        tried += 1
        in_a_write += (folder / ".run.tmp.pkl").exists()
        before_the_first += not (folder / "run.pkl").exists()
    if not completed(folder):
        process = forked(folder / "log.txt", command_line, arguments(folder))
        check(ended(process, "the last attempt") == 0, (folder / "log.txt").read_text()[-2000:])
    check_same(folder, alone)
    return {
        **{"tried": tried, "survived": tried, "arrays_compared": len(alone)},
        **{"left_a_half_written_checkpoint": in_a_write, "before_the_first_checkpoint": before_the_first},
    }


def small_model(number: int) -> BisimSAC:
    model = BisimSAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [16]}, buffer_size=20_000, seed=0, device="cpu")
    return numbered(model, number)


def numbered(model: BisimSAC, number: int) -> BisimSAC:
    model.num_timesteps = number
    model.replay_buffer.rewards[:] = number  # type: ignore[union-attr]
    return model


def clip() -> Path:
    return split_clips(None)["train"][0]


def clip_hash(cache: Path) -> str:
    return hashlib.sha256(load_clip(clip(), CLIP_SIZE, cache_dir=cache).data).hexdigest()


def save_clip(path: Path, model: BisimSAC) -> None:
    for cached in path.parent.glob("*.raw"):
        cached.unlink()
    load_clip(clip(), CLIP_SIZE, cache_dir=path.parent)


def save_result(path: Path, model: BisimSAC) -> None:
    reproduce.write(
        path, json.dumps({"number": model.num_timesteps, "returns": list(range(20_000)), "end": model.num_timesteps})
    )


def read_result(path: Path) -> int:
    result = json.loads(path.read_text())
    check(result["number"] == result["end"], "a mixed result")
    return result["number"]


def read_checkpoint(path: Path) -> int:
    check(not damage(path), damage(path))
    model, _ = load_checkpoint(path)
    check((model.replay_buffer.rewards == model.num_timesteps).all(), "a mixed checkpoint")
    return read_about(path)["num_timesteps"]


def read_replay_buffer(path: Path) -> int:
    (number,) = np.unique(load_from_pkl(path).rewards)
    return int(number)


# What is written: the file's name, how a numbered version is written, and how the number is read from a whole file
WRITERS: dict[str, tuple[str, Callable[[Path, Any], Any], Callable[[Path], int]]] = {
    "checkpoint": ("run.pkl", save_checkpoint, read_checkpoint),
    "agent": ("agent.zip", lambda path, model: model.save(path), lambda path: BisimSAC.load(path, device="cpu").num_timesteps),
    "replay buffer": ("buffer.pkl", lambda path, model: model.save_replay_buffer(path), read_replay_buffer),
    "result": ("result.json", save_result, read_result),
}


def write_on(path: Path, write: Callable[[Path, Any], Any], model: BisimSAC, acknowledge: int) -> None:
    """Write one version after another, and say which writes have ended."""
    for number in range(model.num_timesteps + 1, 10**9):
        write(path, numbered(model, number))
        os.write(acknowledge, b"%d\n" % number)


def torn_writes(folder: Path, args: argparse.Namespace) -> Measured:
    """SIGKILL while a checkpoint, agent, replay buffer, result or decoded clip is written: old or new file, whole"""
    rng, counts, leftovers = random.Random(1), {}, 0
    model = small_model(1)
    for kind, (name, write, read) in WRITERS.items():
        path, last = folder / kind / name, 1
        path.parent.mkdir(parents=True)
        write(path, numbered(model, last))
        for _ in tqdm(range(args.writes), desc=kind, leave=False):
            reader, writer = os.pipe()
            process = forked(folder / "log.txt", write_on, path, write, numbered(model, last), writer)
            os.close(writer)
            process.join(rng.uniform(0.02, 0.4))
            check(process.exitcode is None, (folder / "log.txt").read_text()[-2000:])
            process.kill()
            process.join()
            with os.fdopen(reader) as acknowledged:
                done = max([last, *map(int, acknowledged.read().split())])
            last = read(path)
            check(last in (done, done + 1), f"{kind}: the write of version {done} had ended, the file holds {last}")
        counts[kind] = args.writes
        leftovers += len(list(path.parent.glob(".*.tmp*")))
    expected = clip_hash(folder / "whole")
    for _ in tqdm(range(args.writes), desc="clip", leave=False):
        process = forked(
            folder / "log.txt", write_on, folder / "cache" / "clip", save_clip, model, os.open(os.devnull, os.O_WRONLY)
        )
        process.join(rng.uniform(0.02, 0.4))
        process.kill()
        process.join()
        check(clip_hash(folder / "cache") == expected, "the cached clip differs from one that was decoded undisturbed")
    counts["clip"] = args.writes
    leftovers += len(list((folder / "cache").glob(".*.tmp*")))
    total = sum(counts.values())
    return {"tried": total, "survived": total, **counts, "temporary_files_left": leftovers}


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[Path]:
    """A tmpfs; :raises PermissionError: without root"""
    folder.mkdir(parents=True)
    if (
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", folder], capture_output=True).returncode
        != 0
    ):
        raise PermissionError("mounting a tmpfs needs root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def fill(disk: Path) -> Path:
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    return filler


def full_disk(folder: Path, args: argparse.Namespace) -> Measured:
    """A full disk while writing: the old file survives, the message names the file, and a run continues afterwards"""
    messages: dict[str, str] = {}
    writers: dict[str, Any] = {**WRITERS, "clip": ("clip", save_clip, None)}
    for kind, (name, write, read) in writers.items():
        with small_disk(folder / kind, 24) as disk:
            path = disk / name
            if read is not None:
                write(path, small_model(1))
            filler = fill(disk)
            log = folder / f"{kind} log.txt"
            code = ended(forked(log, write, path, small_model(2)), f"writing the {kind}")
            messages[kind] = log.read_text().strip().splitlines()[-1].replace(str(disk), "DISK")
            check(code != 0, f"{kind}: no error on a full disk")
            check("DISK" in messages[kind], f"{kind}: the message does not name the file: {messages[kind]}")
            check(read is None or read(path) == 1, f"{kind}: the old file is gone")
            check(not list(disk.glob(".*.tmp*")), f"{kind}: a temporary file is left")
            filler.unlink()
            check(ended(forked(log, write, path, small_model(2)), kind) == 0, f"{kind}: no write after space was made")
            check(read is None or read(path) == 2, f"{kind}: the new file is not there")
    alone, *_ = left_alone(folder)
    with small_disk(folder / "run", 40) as disk:
        process = forked(disk / "log.txt", command_line, arguments(disk))
        wait_until((disk / "run.pkl").exists, "the first checkpoint", process)
        filler = fill(disk)
        check(ended(process, "the run on a full disk") != 0, "the run went on without checkpoints")
        filler.unlink()
        continued(disk, alone)
    return {"tried": len(messages) + 1, "survived": len(messages) + 1, "messages": messages}


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[Path]:
    """A folder without write access; root, who may write everywhere, gets a read-only tmpfs."""
    if os.geteuid() != 0:
        folder.mkdir(parents=True)
        folder.chmod(0o555)
        yield folder
        return
    with small_disk(folder, 1):
        subprocess.run(["mount", "-o", "remount,ro", folder], check=True)
        yield folder


def read_only_folders(folder: Path, args: argparse.Namespace) -> Measured:
    """A folder without write access: a message with its name before training starts"""
    messages: dict[str, str] = {}
    pixels = ["train", "--env", "robust_bisim/cartpole-swingup-pixels-v0", "--variant", "small", "--verbose", "0", "-n", "50"]
    sweep = [str(HERE / "reproduce.py"), "cartpole", "--panels", "N_m=2", "--methods", "SAC", "--seeds", "1", "--steps", "400"]
    with read_only(folder / "read-only") as place:
        cases: dict[str, Callable[[Path], Any]] = {
            "train --log-folder": lambda work: command_line([*arguments(work), "--log-folder", str(place)]),
            "train --checkpoint": lambda work: command_line([*arguments(work), "--checkpoint", str(place / "run.pkl")]),
            "train --tensorboard-log": lambda work: command_line([*arguments(work), "--tensorboard-log", str(place)]),
            "SB3_ROBUST_BISIM_CACHE": lambda work: (
                os.environ.update(SB3_ROBUST_BISIM_CACHE=str(place)),
                command_line([*pixels, "--log-folder", str(work)]),
            ),
            "reproduce.py --work": lambda work: os.execv(
                sys.executable, [sys.executable, *sweep, "--jobs", "1", "--work", str(place), "--out", str(work)]
            ),
            "reproduce.py --out": lambda work: os.execv(
                sys.executable, [sys.executable, *sweep, "--jobs", "1", "--work", str(work), "--out", str(place)]
            ),
        }
        for name, run in cases.items():
            work = folder / re.sub(r"\W+", "_", name)
            code = ended(forked(work / "log.txt", run, work), name)
            printed = (work / "log.txt").read_text()
            messages[name] = printed.strip().splitlines()[-1].replace(str(place), "FOLDER")
            check(code != 0, f"{name}: no error")
            check("FOLDER" in messages[name], f"{name}: the message does not name the folder: {printed[-1500:]}")
            episodes = [path for path in work.rglob("*.monitor.csv") if len(path.read_text().splitlines()) > 2]
            check(not episodes, f"{name}: training had started")
    return {"tried": len(cases), "survived": len(cases), "messages": messages}


def two_processes(folder: Path, args: argparse.Namespace) -> Measured:
    """Two processes on one checkpoint, one result and one video cache: one works, one waits or is refused, nothing mixes"""
    alone, *_ = left_alone(folder)
    first = forked(folder / "log.txt", command_line, arguments(folder))
    wait_until((folder / "run.pkl").exists, "the first checkpoint", first)
    code = ended(forked(folder / "second.txt", command_line, arguments(folder)), "the second run")
    message = (folder / "second.txt").read_text().strip().splitlines()[-1]
    check(code != 0 and "another process is writing it" in message, f"the second run was not refused: {message}")
    check(ended(first, "the first run") == 0, (folder / "log.txt").read_text()[-2000:])
    check_same(folder, alone)

    sweeps = [started(folder / f"sweep{number}.txt", *sweep_command(folder / "sweep")) for number in range(2)]
    with no_survivors(*sweeps):
        codes = [sweep.wait(LONGEST) for sweep in sweeps]
    check(codes == [0, 0], (folder / "sweep0.txt").read_text()[-1500:] + (folder / "sweep1.txt").read_text()[-1500:])
    logs = list(folder.glob("sweep/work/*/*/log.txt"))
    check([log.read_text().count("Saving to") for log in logs] == [1], "the run of the sweep was not made once")

    expected, cache = clip_hash(folder / "whole"), folder / "cache"
    readers = [forked(folder / "clips.txt", lambda: sys.exit(clip_hash(cache) != expected)) for _ in range(4)]
    check([ended(reader, "decoding") for reader in readers] == [0] * 4, "a clip that was decoded four times at once differs")
    check(len(list(cache.iterdir())) == 1, "more than one file for one clip")
    return {"tried": 3, "survived": 3, "message": message.replace(str(folder), "FOLDER")}


def killed_worker(folder: Path, args: argparse.Namespace) -> Measured:
    """SIGKILL of an environment's process during training: an error within seconds, and the checkpoint continues"""
    more = ("n_envs:2", "--vec-env", "subproc")
    alone, *_ = left_alone(folder, *more)
    process = forked(folder / "log.txt", command_line, arguments(folder, *more))
    wait_until((folder / "run.pkl").exists, "the first checkpoint", process)
    workers = list(filter(is_worker, psutil.Process(process.pid).children(recursive=True)))
    check(len(workers) == 3, f"{len(workers)} workers, not two of training and one of evaluation")
    random.Random(3).choice(workers).kill()
    start = time.monotonic()
    code = ended(process, "the run whose worker was killed")
    seconds = time.monotonic() - start
    message = (folder / "log.txt").read_text().strip().splitlines()[-1]
    check(code != 0 and "has ended" in message, f"no clear error: {message}")
    check(seconds < 30, f"the error came after {seconds:.0f} s")
    continued(folder, alone, *more)
    return {"tried": 1, "survived": 1, "seconds_until_the_error": round(seconds, 2), "message": message}


def is_worker(process: psutil.Process) -> bool:
    """True for what the fork server has forked."""
    parent = process.parent()
    return parent is not None and "forkserver" in " ".join(parent.cmdline())


def sweep_command(folder: Path, *more: str) -> list[str]:
    return [
        *(str(HERE / "reproduce.py"), "cartpole", "--panels", "N_m=2", "--methods", "SAC", "--seeds", "1", "--steps", "600"),
        *("--eval-freq", "100", "--params", "learning_starts:100", "initial_gradient_steps:0", "batch_size:16"),
        *("--out", str(folder / "results"), "--work", str(folder / "work"), *(more or ("--jobs", "1"))),
    ]


def evaluations(folder: Path) -> list[Any]:
    (path,) = folder.glob("results/*/N_m2_SAC_seed0.json")
    return json.loads(path.read_text())["evaluations"]


@contextlib.contextmanager
def dask_cluster(log: Path, port: int) -> Iterator[list[subprocess.Popen]]:
    """A scheduler and two workers; with one, joblib would do the runs itself."""
    address = f"127.0.0.1:{port}"
    scheduler = started(log, "-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
    worker = ("-m", "dask", "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
    processes = [scheduler, *(started(log, *worker) for _ in range(2))]
    with no_survivors(*processes):
        yield processes


def lost_scheduler(folder: Path, args: argparse.Namespace) -> Measured:
    """A Dask scheduler and its workers are killed during a sweep, and come back: the same evaluations as without a cluster"""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    dask = ("--backend", "dask", "--scheduler", f"127.0.0.1:{port}")
    alone = started(folder / "alone.txt", *sweep_command(folder / "alone"))
    with no_survivors(alone):
        check(alone.wait(LONGEST) == 0, (folder / "alone.txt").read_text()[-2000:])
    with dask_cluster(folder / "dask.txt", port) as cluster:
        sweep = started(folder / "log.txt", *sweep_command(folder, *dask))
        with no_survivors(sweep):
            wait_until(lambda: list(folder.glob("work/*/*/checkpoint.pkl")), "the first checkpoint", sweep)
            for process in cluster:
                process.kill()
            start = time.monotonic()
            try:
                code = sweep.wait(LONGEST)
            except subprocess.TimeoutExpired:
                raise Lost(f"the sweep was still waiting {LONGEST:.0f} s after its scheduler had been killed") from None
            seconds = time.monotonic() - start
    message = (folder / "log.txt").read_text().strip().splitlines()[-1] if code else "none"
    with dask_cluster(folder / "dask.txt", port):
        again = started(folder / "again.txt", *sweep_command(folder, *dask))
        with no_survivors(again):
            check(again.wait(LONGEST) == 0, (folder / "again.txt").read_text()[-2000:])
    check(evaluations(folder) == evaluations(folder / "alone"), "other evaluations than those of a sweep left alone")
    (log,) = folder.glob("work/*/*/log.txt")
    check(log.read_text().count("Going on from step") == 1, "the run did not go on from its checkpoint")
    return {"tried": 1, "survived": 1, "seconds_until_the_sweep_ended": round(seconds, 1), "message": message}


def signals(folder: Path, args: argparse.Namespace) -> Measured:
    """SIGTERM and Ctrl-C, with environments in this or other processes: a loadable agent, and the output says where"""
    tried = 0
    for more in ((), ("n_envs:2", "--vec-env", "subproc")):
        alone, *_ = left_alone(folder, *more)
        for name in ("SIGTERM", "SIGINT"):
            work = folder / f"{name}{len(more)}"
            process = started(work / "log.txt", "-m", "sb3_robust_bisim", *arguments(work, *more))
            with no_survivors(process):
                wait_until((work / "run.pkl").exists, "the first checkpoint", process)
                os.killpg(process.pid, getattr(signal, name))
                code = process.wait(LONGEST)
            printed = (work / "log.txt").read_text()
            said = re.search(r"Stopped at step (\d+) of.*^Model: +(\S+)$", printed, re.DOTALL | re.MULTILINE)
            check(code == 0 and said, f"{name} {' '.join(more)}: exit status {code}: {printed[-2000:]}")
            assert said is not None
            check(
                BisimSAC.load(said[2], device="cpu").num_timesteps == int(said[1]),
                f"{name}: another agent than the output says",
            )
            continued(work, alone, *more)
            tried += 1
    return {"tried": tried, "survived": tried}


def jumping_clock(rng: random.Random) -> None:
    """Make Python's clock jump by up to a year, backward or forward, at every tenth look at it on average."""
    seconds, nanoseconds, offset = time.time, time.time_ns, 0.0

    def jumped() -> float:
        nonlocal offset
        if rng.random() < 0.1:
            offset = rng.uniform(-1, 1) * 365 * 86400
        return offset

    time.time = lambda: seconds() + jumped()
    time.time_ns = lambda: nanoseconds() + int(jumped() * 1e9)


def clock(folder: Path, args: argparse.Namespace) -> Measured:
    """A clock that jumps by up to a year during training, backward and forward: the same numbers as with a right clock"""
    alone, *_ = left_alone(folder)

    def train() -> None:
        jumping_clock(random.Random(2))
        command_line(
            [*arguments(folder), "--tensorboard-log", str(folder / "tensorboard"), "--log-interval", "1", "--progress"]
        )

    check(ended(forked(folder / "log.txt", train), "the run") == 0, (folder / "log.txt").read_text()[-2000:])
    check_same(folder, alone)
    times = [float(line.split(",")[2]) for line in next(run_folder(folder).glob("*.csv")).read_text().splitlines()[2:]]
    backward = int((np.diff(times) < 0).sum())
    check(backward > 0, "the clock did not jump")
    return {"tried": 1, "survived": 1, "episodes_that_ended_before_the_one_before": backward}


FAULTS: dict[str, Callable[[Path, argparse.Namespace], Measured]] = {
    "kills": kills,
    "torn-writes": torn_writes,
    "full-disk": full_disk,
    "read-only": read_only_folders,
    "two-processes": two_processes,
    "killed-worker": killed_worker,
    "lost-scheduler": lost_scheduler,
    "signals": signals,
    "clock": clock,
}


def attempt(name: str, args: argparse.Namespace, work: Path) -> Measured:
    start = time.monotonic()
    (work / name).mkdir()
    try:
        measured = FAULTS[name](work / name, args)
    except PermissionError as error:
        measured = {"left_out": str(error)}
    except Lost as error:
        measured = {"lost": str(error)}
    except Exception:  # the other faults are tried all the same
        measured = {"lost": traceback.format_exc()}
    print(f"{name}: {measured}", file=sys.stderr)
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    return {**measured, "seconds": round(time.monotonic() - start), "date": day, **machine()}


def table(results: dict[str, Measured]) -> str:
    lines = ["| fault | survived | date | commit |", "|---|---|---|---|"]
    for name, result in results.items():
        count = (
            f"{result['survived']} of {result['tried']}" if "tried" in result else "left out" if "left_out" in result else "no"
        )
        lines.append(f"| {FAULTS[name].__doc__} | {count} | {result['date']} | {result['commit']} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=FAULTS, metavar="NAME", help=f"some of {', '.join(FAULTS)}")
    parser.add_argument("--kills", type=int, default=30, help="of one training run (default: %(default)s)")
    parser.add_argument("--writes", type=int, default=20, help="kills of each kind of write (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "faults.json", help="default: %(default)s")
    args = parser.parse_args()
    for option in ("kills", "writes"):
        if getattr(args, option) < 1:
            parser.error(f"--{option} {getattr(args, option)}: must be at least 1.")
    results = json.loads(args.out.read_text()) if args.out.exists() else {}
    commit = machine()["commit"]
    with tempfile.TemporaryDirectory() as work:
        # a commit with later changes says nothing about those of now
        tried = [name for name in results if results[name]["commit"] == commit and not commit.endswith("-dirty")]
        for name in dict.fromkeys(args.only or [name for name in FAULTS if name not in tried]):
            results[name] = attempt(name, args, Path(work))
            results = {key: results[key] for key in FAULTS if key in results}
            with atomic_path(args.out) as file:
                file.write_text(json.dumps(results, indent=1) + "\n")
            with atomic_path(args.out.with_suffix(".md")) as file:
                file.write_text(table(results))
    lost = [name for name, result in results.items() if "lost" in result]
    print(json.dumps({"benchmark": "faults", "lost": lost, "results": results}))
    sys.exit(1 if lost else 0)


if __name__ == "__main__":
    main()
