"""The command line: `evaluate`, and rl-zoo3's commands with BisimSAC as the default algorithm and more options for `train`."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import rl_zoo3.enjoy
import rl_zoo3.train
from filelock import FileLock, Timeout
from rl_zoo3 import ALGOS
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER, convert_offpolicy_params
from rl_zoo3.utils import EnvironmentName

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.checks import closest
from sb3_robust_bisim.cli.agents import add_agent_arguments, find_file
from sb3_robust_bisim.cli.enjoy import record_episode, trained_run, trained_tasks
from sb3_robust_bisim.cli.errors import UsageError, refusals
from sb3_robust_bisim.cli.evaluate import DESCRIPTION, add_arguments, check_arguments, evaluate
from sb3_robust_bisim.cli.manager import ALGO, BisimExperimentManager, sample_bisim_sac_params
from sb3_robust_bisim.cli.options import check_writable, command_parser, parse, set_threads
from sb3_robust_bisim.cli.record import check_video
from sb3_robust_bisim.cli.settings import StoreSettings
from sb3_robust_bisim.cli.train_options import train_arguments
from sb3_robust_bisim.runs.allocator import keep_freed_memory

ALGOS[ALGO] = BisimSAC
HYPERPARAMS_SAMPLER[ALGO] = sample_bisim_sac_params
HYPERPARAMS_CONVERTER[ALGO] = convert_offpolicy_params

COMMANDS = {
    "train": "train an agent, or continue a run",
    "enjoy": "watch an agent, in a window or as a video",
    "evaluate": "play an agent under a list of distractors",
    "plot_train": "draw the training returns of runs",
    "plot_from_file": "draw what all_plots has collected",
    "all_plots": "draw and collect the evaluations of runs",
}


def shell(program: str = "robust-bisim") -> None:
    """Run the command of the process; what it cannot do is said in one line."""
    try:
        main(program=program)
    except UsageError as error:
        sys.exit(f"{program}: {error}")


def main(arguments: Sequence[str] | None = None, program: str = "robust-bisim") -> None:
    """
    Run one command.

    :param arguments: the command and its options; by default those of the process
    :param program: the name that usage and help show
    """
    command, *options = (sys.argv[1:] if arguments is None else arguments) or [""]
    if command not in COMMANDS:
        asked = command in ("-h", "--help")
        print(_usage(program, "" if asked else command), file=sys.stdout if asked else sys.stderr)
        sys.exit(0 if asked else 2)
    program = f"{program} {command}"
    if command == "train":
        ours, theirs = train_arguments(program, options)
        manager = partial(BisimExperimentManager, ours)
        keep_freed_memory()
        with (
            _replaced(sys, "argv", [program, *theirs]),
            _replaced(rl_zoo3.train, "ExperimentManager", manager),
            _replaced(rl_zoo3.train, "StoreDict", StoreSettings),
            _only_run(program, ours.checkpoint),
            _sigterm_as_ctrl_c(),
        ):
            rl_zoo3.train.train()
    elif command == "enjoy":
        _enjoy(program, options)
    elif command == "evaluate":
        with _no_window():
            evaluate(_evaluate_arguments(program, options))
    else:
        try:
            from rl_zoo3 import plots
        except ImportError as error:
            raise ImportError(f"{command} needs the extra `plots`: pip install sb3_robust_bisim[plots]") from error
        with _replaced(sys, "argv", [program, *options]):
            getattr(plots, command)()


def _usage(program: str, unknown: str) -> str:
    """What the program can do, after a word about a command that it does not have."""
    complaint = f"{program} {unknown}: there is no such command{closest(unknown, COMMANDS, '.')}\n\n" if unknown else ""
    listed = "\n".join(f"  {name:<16}{what}" for name, what in COMMANDS.items())
    return f"{complaint}usage: {program} COMMAND ...\n\n{listed}\n\nEach command has --help."


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Replace an attribute for the length of a command: rl-zoo3 reads its arguments from ``sys.argv``."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


@contextmanager
def _no_window() -> Iterator[None]:
    """Draw without a window for the length of a command: SDL would look for a display, and complain that there is none."""
    key = "SDL_VIDEODRIVER"
    if key in os.environ:
        yield
        return
    os.environ[key] = "dummy"
    try:
        yield
    finally:
        del os.environ[key]


@contextmanager
def _only_run(program: str, checkpoint: Path | None) -> Iterator[None]:
    """Refuse a checkpoint that another process is writing: two runs would mix in the checkpoint and in the run's folder."""
    if checkpoint is None:
        yield
        return
    lock = FileLock(checkpoint.with_name(f".{checkpoint.name}.lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        sys.exit(f"{program}: --checkpoint {checkpoint}: another process is writing it. Wait for it, or name another file.")
    try:
        yield
    finally:
        lock.release()  # a killed process releases it, too


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM, which batch systems send before they kill, end training as Ctrl-C does: with a saved agent."""
    if threading.current_thread() is not threading.main_thread():  # as in a worker of Dask; only main threads get signals
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)


def _enjoy(program: str, arguments: list[str]) -> None:
    """
    Play the latest run with a saved agent, where rl-zoo3 takes the latest folder; or an agent that comes with the package.
    With --video, one episode goes to a file, which rl-zoo3 cannot do.
    """
    parser = command_parser(program)
    folder = parser.add_mutually_exclusive_group()
    folder.add_argument("-f", "--folder", default="logs", help="folder with the runs (default: %(default)s)")
    folder.add_argument("--trained", action="store_true", help="play the trained agent that comes with the package")
    parser.add_argument("--exp-id", type=int, default=0, help="number of the run (default: the latest one with an agent)")
    parser.add_argument("--env", type=EnvironmentName, default=None, help="task")
    parser.add_argument("--video", type=Path, metavar="FILE", help="write one episode to an .mp4 or .gif, without a window")
    ours, theirs = parse(parser, arguments)
    if {"-h", "--help"} & set(arguments):  # rl-zoo3 prints the other half, and exits
        with _replaced(sys, "argv", [program, "--help"]):
            rl_zoo3.enjoy.enjoy()
    task = None if ours.env is None else ours.env.gym_id
    if ours.trained and (ours.algo != ALGO or task not in trained_tasks()):
        parser.error(f"--trained: the package has agents of {ALGO} for --env {', '.join(trained_tasks())}, and no others.")
    if task is None:
        parser.error("--env: name the task.")
    video = None if ours.video is None else _video_arguments(program, arguments)
    with trained_run(ALGO, ours.env) if ours.trained else nullcontext(ours.folder) as found:
        if video is not None:
            video.folder = found
            with _no_window():
                print(record_episode(video))
            return
        exp_id = ours.exp_id
        if "rl-trained-agents" not in found:  # rl-zoo3 downloads those
            try:
                exp_id = _run_to_play(program, arguments, found)
            except UsageError as error:
                tasks = ", ".join(trained_tasks())
                parser.error(f"{error}. --trained plays an agent that comes with the package, for {tasks}.")
        options = [*theirs, "-f", found, "--exp-id", str(exp_id), "--env", task]
        with (
            _replaced(sys, "argv", [program, *options]),
            _replaced(rl_zoo3.enjoy, "StoreDict", StoreSettings),
            _replaced(rl_zoo3.enjoy, "create_test_env", refusals()(rl_zoo3.enjoy.create_test_env)),
        ):
            rl_zoo3.enjoy.enjoy()


def _run_to_play(program: str, arguments: list[str], folder: str) -> int:
    """The number of the run whose agent `enjoy` is to play; rl-zoo3 would end with a traceback if there is none."""
    parser = command_parser(program)
    add_agent_arguments(parser)
    args, _ = parser.parse_known_args(arguments)
    args.folder = folder
    return find_file(args)[1]


def _video_arguments(program: str, arguments: list[str]) -> argparse.Namespace:
    """Parse the arguments of `enjoy --video`, and stop with a message before any work if no video can be written."""
    parser = command_parser(program, "Write a video of one episode.")
    add_agent_arguments(parser)
    parser.add_argument("--trained", action="store_true")
    parser.add_argument("--video", type=Path)
    args, others = parser.parse_known_args(arguments)
    if others:
        parser.error(f"--video writes one episode of the deterministic policy, so it does not take {' '.join(others)}.")
    if args.seed < 0:
        parser.error(f"--seed {args.seed}: must be at least 0.")
    try:
        check_video(args.video)
    except (ValueError, ImportError) as error:
        parser.error(f"--video {error}")
    check_writable(parser, "--video", args.video)
    set_threads(args)
    return args


def _evaluate_arguments(program: str, arguments: list[str]) -> argparse.Namespace:
    """Parse the arguments of `evaluate`, a command that rl-zoo3 does not have."""
    parser = command_parser(program, DESCRIPTION, add_help=True)
    add_arguments(parser)
    args = parser.parse_args(arguments)
    check_arguments(parser, args)
    set_threads(args)
    return args
