"""Find a trained agent in the folder of its run, and make its environment again."""

import argparse
import importlib
import os
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3 import ALGOS, create_test_env, get_saved_hyperparams
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import EnvironmentName, get_model_path
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_robust_bisim.cli.errors import UsageError, refusals
from sb3_robust_bisim.cli.settings import StoreSettings


def add_agent_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose an agent and its environment. They have the names of rl-zoo3's ``enjoy``."""
    parser.add_argument("--env", type=EnvironmentName, required=True, help="task")
    parser.add_argument("-f", "--folder", default="logs", help="folder with the runs (default: %(default)s)")
    parser.add_argument(
        "--exp-id",
        type=int,
        default=0,
        help="number of the run (default: the latest one with an agent; -1: no run folder)",
    )
    parser.add_argument("--load-best", action="store_true", help="play the best agent of the run, not the last one")
    parser.add_argument("--load-checkpoint", metavar="N", help="play the agent that was saved after N steps")
    parser.add_argument("--load-last-checkpoint", action="store_true", help="play the last of these agents")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="packages to import, which register tasks")
    parser.add_argument(
        "--env-kwargs",
        nargs="+",
        action=StoreSettings,
        default={},
        metavar="NAME:VALUE",
        help="arguments of the environment, merged into those of the training, for example theta_rew_fraction:1.0",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the environment (default: %(default)s)")
    parser.add_argument("--device", default="auto", help="device of the networks (default: %(default)s)")


@dataclass(frozen=True)
class Agent:
    """
    A saved agent, and the settings that it was trained with.

    :param algo: name of the algorithm
    :param env_id: id of its task
    :param path: file with the agent
    :param stats: folder with the settings and the statistics of VecNormalize; None: there are none
    :param hyperparams: saved hyperparameters, which name the wrappers of the environment
    :param env_kwargs: arguments of the environment
    """

    algo: str
    env_id: str
    path: Path
    stats: str | None
    hyperparams: dict[str, Any]
    env_kwargs: dict[str, Any]

    def make_env(self, env_kwargs: Mapping[str, Any], seed: int) -> VecEnv:
        """
        :param env_kwargs: arguments of the environment
        :param seed: seed of its first reset
        :return: one environment with the wrappers of the training
        """
        hyperparams = deepcopy(self.hyperparams)  # rl-zoo3 removes the wrappers from it
        make = ExperimentManager.default_vec_env_cls
        with refusals():
            return create_test_env(self.env_id, 1, self.stats, seed, None, False, hyperparams, dict(env_kwargs), make)

    def load(self, venv: VecEnv, device: str) -> BaseAlgorithm:
        """
        :param venv: an environment from :meth:`make_env`
        :param device: device of the networks
        :return: the agent, bound to the environment
        :raises ValueError: if its spaces are not those of the environment
        """
        algorithm = ALGOS[self.algo]
        # Evaluation needs no replay buffer and no schedules, which may not be loadable in this version of Python
        small: dict[str, Any] = {"buffer_size": 1} if issubclass(algorithm, OffPolicyAlgorithm) else {}
        unused = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
        return algorithm.load(self.path, venv, device, custom_objects=unused, verbose=0, **small)


def latest_run(folder: str, algo: str, env: EnvironmentName, load_best: bool = False, steps: str | None = None) -> int:
    """
    :param folder: folder with the runs
    :param algo: name of the algorithm
    :param env: task
    :param load_best: the best agent is wanted, not the last one
    :param steps: the agent after this number of steps is wanted; "*": after any
    :return: number of the latest run with such an agent; 0 if there is none. rl-zoo3 takes the latest folder
    """
    name = "best_model" if load_best else env if steps is None else f"rl_model_{steps}_steps"
    runs = Path(folder, algo).glob(f"{env}_*/{name}.zip")
    numbers = [suffix for run in runs if (suffix := run.parent.name.removeprefix(f"{env}_")).isdigit()]
    return max(map(int, numbers), default=0)


def find_file(args: argparse.Namespace) -> tuple[Path, int]:
    """
    Find the file of an agent as rl-zoo3's ``enjoy`` does.

    :param args: see :func:`add_agent_arguments`, and ``algo``
    :return: the file, and the number of its run; -1 if it is not in the folder of a run
    :raises UsageError: if there is no such agent
    """
    cause = f"--exp-id {args.exp_id}" if args.exp_id else f"--folder {args.folder}"
    steps = "*" if args.load_last_checkpoint else args.load_checkpoint
    exp_id = args.exp_id or latest_run(args.folder, args.algo, args.env, args.load_best, steps)
    which = (args.load_best, args.load_checkpoint, args.load_last_checkpoint)
    try:
        if exp_id == 0:
            raise ValueError(f"No run of {args.algo} on {args.env.gym_id} has an agent")
        _, model, _ = get_model_path(exp_id, args.folder, args.algo, args.env, *which)
    except (AssertionError, ValueError) as error:
        raise UsageError(
            f"{cause}: {error}. Pass the --folder, --algo and --exp-id of a run that has one, or train it: "
            f"robust-bisim train --env {args.env.gym_id}"
        ) from error
    return Path(model), exp_id


def chosen_agent(args: argparse.Namespace) -> Agent:
    """
    :param args: see :func:`add_agent_arguments`, and ``algo``
    :return: the agent
    :raises UsageError: see :func:`find_file`
    """
    for package in args.gym_packages:
        importlib.import_module(package)
    file, _ = find_file(args)
    stats = os.path.join(file.parent, args.env)
    hyperparams, found_stats = get_saved_hyperparams(stats, test_mode=True)
    env_kwargs = hyperparams.pop("env_kwargs", {})
    arguments = Path(stats, "args.yml")
    if arguments.is_file():  # --env-kwargs of the training replaces those of the configuration
        env_kwargs = yaml.unsafe_load(arguments.read_text())["env_kwargs"] or env_kwargs
    return Agent(args.algo, args.env.gym_id, file, found_stats, hyperparams, env_kwargs)
