"""The options of `train`: those that rl-zoo3 does not have, and a check of those that it does not check."""

import argparse
from pathlib import Path

import gymnasium as gym
import torch as th
from stable_baselines3.common.utils import get_device

from sb3_robust_bisim.checks import closest
from sb3_robust_bisim.cli.manager import ALGO, RunOptions
from sb3_robust_bisim.cli.options import check_folder, check_writable, command_parser, parse
from sb3_robust_bisim.cli.zoo_config import DEFAULT_CONFIG, is_yaml


def train_arguments(program: str, arguments: list[str]) -> tuple[RunOptions, list[str]]:
    """Split the arguments of `train` into the options that rl-zoo3 does not have, and rl-zoo3's with our defaults."""
    parser = command_parser(program)
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
        help="continue from a checkpoint of other package versions, of another --device or of a machine with more GPUs: with "
        "its agent, replay buffer and counters, but in new episodes and with a new log folder. The numbers differ from an "
        "uninterrupted run",
    )
    parser.add_argument(
        "--checkpoint-freq",
        type=int,
        metavar="N",
        help=f"environment steps between two checkpoints (default: {RunOptions.checkpoint_freq})",
    )
    parser.add_argument(
        "-n", "--n-timesteps", type=int, help="environment steps of the run, at least 1 (default: as in the config file)"
    )
    parser.add_argument("--seed", type=int, help="seed of environments, networks and sampling (default: a random one)")
    parser.add_argument("-conf", "--conf-file", help=f"file with hyperparameters (default for {ALGO}: {DEFAULT_CONFIG})")
    ours, theirs = parse(parser, arguments)
    if ours.env is not None:
        theirs += ["--env", ours.env]
    asks_for_help = bool({"-h", "--help"} & set(arguments))
    if not asks_for_help and not any(argument.startswith("--gym-p") for argument in arguments):
        if ours.env is None:
            parser.error("--env: name the task.")
        if ours.env not in gym.registry:
            guess = closest(ours.env, gym.registry, ".")
            parser.error(f"--env {ours.env}: no such task{guess} If your package registers it, add --gym-packages.")
    if ours.checkpoint_freq is not None and ours.checkpoint_freq < 1:
        parser.error(f"--checkpoint-freq {ours.checkpoint_freq}: must be at least 1.")
    if ours.n_timesteps is not None and ours.n_timesteps < 1:  # rl-zoo3 would take the config file's
        parser.error(f"--n-timesteps {ours.n_timesteps}: must be at least 1. Without it, the config file's number counts.")
    if not asks_for_help:
        _check_theirs(parser, theirs)
    for option in ("new_episodes", "checkpoint_freq"):
        if getattr(ours, option) and ours.checkpoint is None:
            parser.error(f"--{option.replace('_', '-')}: needs --checkpoint FILE.")
    if ours.checkpoint is not None:
        check_writable(parser, "--checkpoint", ours.checkpoint)
    config = ours.conf_file or (str(DEFAULT_CONFIG) if ours.algo == ALGO else None)
    if config is not None and is_yaml(config) and not Path(config).is_file():
        parser.error(f"-conf {config}: there is no such file.")
    if config is not None:
        theirs += ["-conf", config]
    for option in ("seed", "n_timesteps"):
        if (value := getattr(ours, option)) is not None:
            theirs += [f"--{option.replace('_', '-')}", str(value)]
    seed_given = ours.seed is not None and ours.seed >= 0
    checkpoint_freq = ours.checkpoint_freq or RunOptions.checkpoint_freq
    options = RunOptions(tuple(ours.variants), ours.checkpoint, checkpoint_freq, ours.new_episodes, seed_given)
    return options, theirs


def _check_theirs(parser: argparse.ArgumentParser, arguments: list[str]) -> None:
    """Refuse values of rl-zoo3's options that it ignores, or with which it fails after the start."""
    theirs = argparse.ArgumentParser(prog=parser.prog, add_help=False, allow_abbrev=False, usage=argparse.SUPPRESS)
    for option in ("--eval-episodes", "--n-eval-envs", "--n-trials"):
        theirs.add_argument(option, type=int, default=1)
    theirs.add_argument("-i", "--trained-agent", type=Path)
    theirs.add_argument("--device", default="auto")
    theirs.add_argument("-f", "--log-folder", type=Path, default="logs")
    theirs.add_argument("-tb", "--tensorboard-log", type=Path)
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
    try:  # SB3 takes the CPU in place of a missing GPU
        th.empty(0, device=get_device() if given.device == "auto" else given.device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        parser.error(f"--device {given.device}: no such device here ({reason}). Use cpu, or auto for a GPU if there is one.")
    check_folder(parser, "--log-folder", given.log_folder)
    if given.tensorboard_log is not None:
        check_folder(parser, "--tensorboard-log", given.tensorboard_log)
