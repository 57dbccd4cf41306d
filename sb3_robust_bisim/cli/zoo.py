"""The command line: `evaluate`, and rl-zoo3's commands with BisimSAC as the default algorithm and more options for `train`."""

import argparse
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import rl_zoo3.enjoy
import rl_zoo3.train
import torch as th
from filelock import FileLock, Timeout
from rl_zoo3 import ALGOS
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER, convert_offpolicy_params
from rl_zoo3.utils import EnvironmentName
from stable_baselines3.common.utils import get_device

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.checks import closest
from sb3_robust_bisim.cli.agents import add_agent_arguments, find_file
from sb3_robust_bisim.cli.enjoy import record_episode, trained_run, trained_tasks
from sb3_robust_bisim.cli.errors import UsageError, refusals
from sb3_robust_bisim.cli.evaluate import DESCRIPTION, add_arguments, check_arguments, evaluate
from sb3_robust_bisim.cli.manager import ALGO, BisimExperimentManager, RunOptions, sample_bisim_sac_params
from sb3_robust_bisim.cli.record import check_video
from sb3_robust_bisim.cli.settings import StoreSettings
from sb3_robust_bisim.cli.zoo_config import DEFAULT_CONFIG, is_yaml
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
CHANGED = "rl-zoo3's command with these options changed or added:"
SET_BY_THE_USER = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OMP_WAIT_POLICY")


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
        ours, theirs = _train_arguments(program, options)
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


def _train_arguments(program: str, arguments: list[str]) -> tuple[RunOptions, list[str]]:
    """Split the arguments of `train` into the options that rl-zoo3 does not have, and rl-zoo3's with our defaults."""
    parser = _parser(program)
    parser.add_argument("--env", help="task, for example robust_bisim/SparseCartPole-v0")
    parser.add_argument(
        *("--variant", "--variants"),
        dest="variants",
        nargs="+",
        default=[],
        metavar="NAME",
        help="variants in the config file that override the settings of the task, for example DBC, or SAC clean small",
    )
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="FILE",
        help="save the complete state of the run to this file. After an interruption, the same command continues from it and "
        "gives the same numbers as an uninterrupted run. The log folder and the progress bar stay as they were. Delete the "
        "file to start again",
    )
    parser.add_argument(
        "--new-episodes",
        action="store_true",
        help="continue from a checkpoint of other package versions or of a machine with more GPUs: with its agent, replay "
        "buffer and counters, but in new episodes and with a new log folder. The numbers differ from an uninterrupted run",
    )
    parser.add_argument(
        "--checkpoint-freq",
        type=int,
        default=10_000,
        metavar="N",
        help="environment steps between two checkpoints (default: %(default)s)",
    )
    parser.add_argument(
        "-n", "--n-timesteps", type=int, help="environment steps of the run, at least 1 (default: as in the config file)"
    )
    parser.add_argument("--seed", type=int, help="seed of environments, networks and sampling (default: a random one)")
    parser.add_argument("-conf", "--conf-file", help=f"file with hyperparameters (default for {ALGO}: {DEFAULT_CONFIG})")
    ours, theirs = _parse(parser, arguments)
    if ours.env is not None:
        theirs += ["--env", ours.env]
    if not any(argument in ("-h", "--help") or argument.startswith("--gym-p") for argument in arguments):
        if ours.env is None:
            parser.error("--env: name the task.")
        if ours.env not in gym.registry:
            guess = closest(ours.env, gym.registry, ".")
            parser.error(f"--env {ours.env}: no such task{guess} If your package registers it, add --gym-packages.")
    if ours.checkpoint_freq < 1:
        parser.error(f"--checkpoint-freq {ours.checkpoint_freq}: must be at least 1.")
    if ours.n_timesteps is not None and ours.n_timesteps < 1:  # rl-zoo3 would take the config file's
        parser.error(f"--n-timesteps {ours.n_timesteps}: must be at least 1. Without it, the config file's number counts.")
    _check_theirs(parser, theirs)
    if ours.new_episodes and ours.checkpoint is None:
        parser.error("--new-episodes: needs --checkpoint FILE.")
    if ours.checkpoint is not None:
        _check_writable(parser, "--checkpoint", ours.checkpoint)
    config = ours.conf_file or (str(DEFAULT_CONFIG) if ours.algo == ALGO else None)
    if config is not None and is_yaml(config) and not Path(config).is_file():
        parser.error(f"-conf {config}: there is no such file.")
    if config is not None:
        theirs += ["-conf", config]
    for option in ("seed", "n_timesteps"):
        if (value := getattr(ours, option)) is not None:
            theirs += [f"--{option.replace('_', '-')}", str(value)]
    seed_given = ours.seed is not None and ours.seed >= 0
    options = RunOptions(tuple(ours.variants), ours.checkpoint, ours.checkpoint_freq, ours.new_episodes, seed_given)
    return options, theirs


def _check_theirs(parser: argparse.ArgumentParser, arguments: list[str]) -> None:
    """Refuse values of rl-zoo3's options that it ignores, or with which it fails after the start."""
    theirs = argparse.ArgumentParser(prog=parser.prog, add_help=False, allow_abbrev=False, usage=argparse.SUPPRESS)
    for option in ("--eval-episodes", "--n-eval-envs", "--n-trials"):
        theirs.add_argument(option, type=int, default=1)
    theirs.add_argument("-i", "--trained-agent", type=Path)
    theirs.add_argument("--device", default="auto")
    for option in ("--trial-id", "--storage", "--study-name"):
        theirs.add_argument(option)
    given, _ = theirs.parse_known_args(arguments)
    for option in ("eval_episodes", "n_eval_envs", "n_trials"):
        if (value := getattr(given, option)) < 1:
            parser.error(f"--{option.replace('_', '-')} {value}: must be at least 1.")
    if given.trained_agent is not None and not given.trained_agent.is_file():
        parser.error(f"-i {given.trained_agent}: there is no such file. Pass the .zip of a saved agent.")
    if given.trial_id is not None and not (given.storage and given.study_name):
        parser.error(f"--trial-id {given.trial_id}: needs --storage and --study-name.")
    try:
        get_device(given.device)
    except RuntimeError:
        parser.error(f"--device {given.device}: torch knows no such device. Use cpu, cuda or auto.")


def _enjoy(program: str, arguments: list[str]) -> None:
    """
    Play the latest run with a saved agent, where rl-zoo3 takes the latest folder; or an agent that comes with the package.
    With --video, one episode goes to a file, which rl-zoo3 cannot do.
    """
    parser = _parser(program)
    folder = parser.add_mutually_exclusive_group()
    folder.add_argument("-f", "--folder", default="logs", help="folder with the runs (default: %(default)s)")
    folder.add_argument("--trained", action="store_true", help="play the trained agent that comes with the package")
    parser.add_argument("--exp-id", type=int, default=0, help="number of the run (default: the latest one with an agent)")
    parser.add_argument("--env", type=EnvironmentName, default=None, help="task")
    parser.add_argument("--video", type=Path, metavar="FILE", help="write one episode to an .mp4 or .gif, without a window")
    ours, theirs = _parse(parser, arguments)
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
    parser = _parser(program)
    add_agent_arguments(parser)
    args, _ = parser.parse_known_args(arguments)
    args.folder = folder
    return find_file(args)[1]


def _video_arguments(program: str, arguments: list[str]) -> argparse.Namespace:
    """Parse the arguments of `enjoy --video`, and stop with a message before any work if no video can be written."""
    parser = _parser(program, "Write a video of one episode.")
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
    _check_writable(parser, "--video", args.video)
    _set_threads(args)
    return args


def _evaluate_arguments(program: str, arguments: list[str]) -> argparse.Namespace:
    """Parse the arguments of `evaluate`, a command that rl-zoo3 does not have."""
    parser = _parser(program, DESCRIPTION, add_help=True)
    add_arguments(parser)
    args = parser.parse_args(arguments)
    check_arguments(parser, args)
    _set_threads(args)
    return args


def _parser(program: str, description: str = CHANGED, add_help: bool = False) -> argparse.ArgumentParser:
    """The options that all commands have, with a new meaning or a new default for those of rl-zoo3."""
    parser = argparse.ArgumentParser(prog=program, add_help=add_help, allow_abbrev=False, description=description)
    parser.add_argument("--algo", default=ALGO, help="RL algorithm (default: %(default)s)")
    parser.add_argument(
        "--num-threads",
        type=int,
        help="number of CPU threads of torch; -1 leaves the choice to torch, which may be faster on an idle machine. The "
        "default is 1, which is faster beside other work: torch's threads wait actively and slow each other down. If one of "
        f"{', '.join(SET_BY_THE_USER)} is set, the default is -1",
    )
    return parser


def _parse(parser: argparse.ArgumentParser, arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Parse our options. The rest is for rl-zoo3, with ``--algo`` and ``--num-threads`` filled in."""
    if {"-h", "--help"} & set(arguments):
        parser.print_help()
        print("\nAll options of rl-zoo3:\n")
    ours, theirs = parser.parse_known_args(arguments)
    return ours, ["--algo", ours.algo, "--num-threads", str(_n_threads(ours)), *theirs]


def _n_threads(args: argparse.Namespace) -> int:
    """The number of torch threads; -1: torch chooses."""
    if args.num_threads is not None:
        return args.num_threads
    return -1 if any(name in os.environ for name in SET_BY_THE_USER) else 1


def _set_threads(args: argparse.Namespace) -> None:
    """For the commands that are not rl-zoo3's."""
    if (n_threads := _n_threads(args)) > 0:
        th.set_num_threads(n_threads)


def _check_writable(parser: argparse.ArgumentParser, option: str, file: Path) -> None:
    """Report before any work what would otherwise fail at the end."""
    if file.is_dir():
        parser.error(f"{option} {file}: this is a folder; name a file in it.")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        parser.error(f"{option} {file}: {error.strerror}; name a file in a folder with write access.")
