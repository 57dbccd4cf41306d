"""What the options of all commands have in common."""

import argparse
import os
import tempfile
from pathlib import Path

import torch as th

from sb3_robust_bisim.cli.manager import ALGO

CHANGED = "rl-zoo3's command with these options changed or added:"
SET_BY_THE_USER = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OMP_WAIT_POLICY")


def command_parser(program: str, description: str = CHANGED, add_help: bool = False) -> argparse.ArgumentParser:
    """The options that all commands have, with a new meaning or a new default for those of rl-zoo3."""
    parser = argparse.ArgumentParser(prog=program, add_help=add_help, allow_abbrev=False, description=description)
    parser.add_argument("--algo", default=ALGO, help="RL algorithm (default: %(default)s)")
    parser.add_argument(
        "--num-threads",
        type=_threads,
        help="number of CPU threads of torch; -1 leaves the choice to torch, which may be faster on an idle machine. The "
        "default is 1, which is faster beside other work: torch's threads wait actively and slow each other down. If one of "
        f"{', '.join(SET_BY_THE_USER)} is set, the default is -1",
    )
    return parser


def parse(parser: argparse.ArgumentParser, arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Parse our options. The rest is for rl-zoo3, with ``--algo`` and ``--num-threads`` filled in."""
    if {"-h", "--help"} & set(arguments):
        parser.print_help()
        print("\nAll options of rl-zoo3:\n")
    ours, theirs = parser.parse_known_args(arguments)
    return ours, ["--algo", ours.algo, "--num-threads", str(_n_threads(ours)), *theirs]


def _threads(text: str) -> int:
    """A number of threads; rl-zoo3 ignores what is below 1."""
    if not text.removeprefix("-").isdecimal() or (int(text) < 1 and int(text) != -1):
        raise argparse.ArgumentTypeError(f"{text} must be an integer of at least 1, or -1")
    return int(text)


def _n_threads(args: argparse.Namespace) -> int:
    """The number of torch threads; -1: torch chooses."""
    if args.num_threads is not None:
        return args.num_threads
    return -1 if any(name in os.environ for name in SET_BY_THE_USER) else 1


def set_threads(args: argparse.Namespace) -> None:
    """Set torch's number of threads; rl-zoo3's commands do this themselves."""
    if (n_threads := _n_threads(args)) > 0:
        th.set_num_threads(n_threads)


def check_writable(parser: argparse.ArgumentParser, option: str, file: Path) -> None:
    """Report before any work what would otherwise fail at the end."""
    if file.is_dir():
        parser.error(f"{option} {file}: this is a folder; name a file in it.")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        parser.error(f"{option} {file}: {error.strerror}; name a file in a folder with write access.")


def check_folder(parser: argparse.ArgumentParser, option: str, folder: Path) -> None:
    """The same for a folder, which is made only when there is something to put into it."""
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        parser.error(f"{option} {folder}: {error.strerror}; name a folder with write access.")
