"""The rl-zoo command line with BisimSAC known to it: training, resuming, tuning, playing and plotting are the zoo's."""

import argparse
import inspect
import sys
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any, ClassVar

import optuna
import rl_zoo3.enjoy
import rl_zoo3.train
import yaml
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER, convert_offpolicy_params, sample_sac_params
from rl_zoo3.utils import EnvironmentName, get_class_by_name
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.cli.report import report
from sb3_robust_bisim.cli.zoo_config import check_keys, check_task, entry_of, is_yaml, policy_kwargs_of, variant_settings
from sb3_robust_bisim.runs.checkpoint import Checkpoint, load_checkpoint, read_about

ALGO = "bisim_sac"
DEFAULT_CONFIG = Path("zoo_configs/bisim_sac.yml")
WEIGHTS = (("bisim_coef", 0.05, 5.0), ("intrinsic_reward_scale", 0.01, 20.0), ("inverse_dynamics_coef", 0.01, 20.0))


def sample_bisim_sac_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Optuna's search space: that of SAC, and the weights of metric, bonus and inverse dynamics where the method has them."""
    sampled = sample_sac_params(trial, n_actions, n_envs, additional_args)
    # SAC's sampler replaces all of policy_kwargs
    sampled["policy_kwargs"] = {**policy_kwargs_of(BisimExperimentManager.tuned), **sampled["policy_kwargs"]}
    for name, low, high in WEIGHTS:
        if BisimExperimentManager.tuned.get(name, inspect.signature(BisimSAC).parameters[name].default) > 0:
            sampled[name] = trial.suggest_float(name, low, high, log=True)
    return {**sampled, "policy_delay": trial.suggest_int("policy_delay", 1, 2)}


ALGOS[ALGO] = BisimSAC
HYPERPARAMS_SAMPLER[ALGO] = sample_bisim_sac_params
HYPERPARAMS_CONVERTER[ALGO] = convert_offpolicy_params


class BisimExperimentManager(ExperimentManager):
    """
    The zoo's experiment manager, plus named variants, evaluation in another task, key checks, exact continuation and a report
    at the end.
    """

    variants: ClassVar[list[str]] = []
    checkpoint: ClassVar[Path | None] = None
    checkpoint_freq: ClassVar[int] = 10_000
    seed_given: ClassVar[bool] = False
    tuned: ClassVar[dict[str, Any]] = {}  # hyperparameters of the method that Optuna tunes
    resumed = False

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        params = self.custom_hyperparams or {}
        if self.algo == ALGO:
            check_keys(params, "-params")
        if self.continue_training:
            params = self._restore_arguments(params)
        if self.algo == ALGO:
            check_task(self.env_name.gym_id, self.config)
        # entry < variants < Optuna's trial < -params
        settings = variant_settings(self.config, self.env_name.gym_id, *self.variants) if self.variants else {}
        self.custom_hyperparams = {**settings, **self._trial_settings(settings), **params}
        hyperparams, saved_hyperparams = super().read_hyperparameters()
        if self.algo == ALGO:
            check_keys(hyperparams, self.config)
        for settings in (hyperparams, saved_hyperparams):
            settings.pop("variants", None)
        buffer_class = hyperparams.get("replay_buffer_class")
        if isinstance(buffer_class, str) and "." in buffer_class:  # the zoo evaluates it where our classes are unknown
            hyperparams["replay_buffer_class"] = get_class_by_name(buffer_class)
        self.args.variant = self.variants  # kept in the run's args.yml
        env_kwargs = self.env_kwargs or hyperparams.get("env_kwargs", {})
        eval_kwargs = hyperparams.pop("eval_env_kwargs", {})
        BisimExperimentManager.tuned = dict(hyperparams)
        self.eval_env_kwargs = {**env_kwargs, **eval_kwargs, **(self._eval_env_kwargs_args or {})}
        return hyperparams, saved_hyperparams

    def _restore_arguments(self, params: dict[str, Any]) -> dict[str, Any]:
        """
        What an agent was trained with, for ``load`` takes the entry's settings in place of the saved ones. It is kept in the
        new run's args.yml, for the next time.

        :param params: those of the command line, which go before
        :return: ``params`` with the agent's below
        """
        arguments = Path(self.trained_agent).parent / self.env_name / "args.yml"
        if not arguments.is_file():
            return params
        trained = yaml.unsafe_load(arguments.read_text())
        if not self.env_kwargs:
            self.args.env_kwargs = trained.get("env_kwargs")
            self.env_kwargs = self.args.env_kwargs or {}
        if self._eval_env_kwargs_args is None:
            self.args.eval_env_kwargs = self._eval_env_kwargs_args = trained.get("eval_env_kwargs")
        if not self.variants:
            BisimExperimentManager.variants = trained.get("variant", [])
            self.args.hyperparams = params = {**(trained.get("hyperparams") or {}), **params}
        return params

    def _trial_settings(self, settings: dict[str, Any]) -> dict[str, Any]:
        """What Optuna found, if a trial was asked for, over the policy_kwargs that it was found with."""
        if self.algo != ALGO or not (self.storage and self.study_name and self.trial_id):
            return {}
        if not is_yaml(self.config):
            raise ValueError(f"-conf {self.config}: --trial-id needs a YAML file.")
        found = self.load_trial(self.storage, self.study_name, self.trial_id)
        entry = entry_of(self.config, self.env_name.gym_id)
        return {**found, "policy_kwargs": {**policy_kwargs_of({**entry, **settings}), **found["policy_kwargs"]}}

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        if self.checkpoint is None:
            return super().setup_experiment()
        if self.vec_env_class is SubprocVecEnv:
            raise ValueError("--checkpoint with --vec-env subproc: environments in other processes cannot be kept; use dummy.")
        if self.checkpoint.is_file():
            return self._continue(self.checkpoint)
        experiment = super().setup_experiment()
        assert experiment is not None  # the command line refuses -optimize
        run = {"save_path": self.save_path, "callbacks": self.callbacks}
        about = {"settings": self._settings(experiment[1])}
        self.callbacks.append(Checkpoint(self.checkpoint, self.checkpoint_freq, run, about))
        return experiment

    def _settings(self, hyperparams: dict[str, Any]) -> dict[str, Any]:
        """What must be the same for a run to be continued; it may become longer."""
        keys = ("eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "device")
        asked = {key: vars(self.args)[key] for key in keys}
        env_kwargs = {
            "env_kwargs": self.env_kwargs or hyperparams.get("env_kwargs", {}),
            "eval_env_kwargs": self.eval_env_kwargs,
        }
        seed = self.seed if self.seed_given else "random"  # the zoo draws one
        return {"env": str(self.env_name), "seed": seed, **hyperparams, **env_kwargs, **asked, "n_timesteps": None}

    def _continue(self, checkpoint: Path) -> tuple[BaseAlgorithm, dict[str, Any]]:
        hyperparams, saved_hyperparams = self.read_hyperparameters()
        about = read_about(checkpoint)
        if "settings" not in about:
            raise ValueError(f"--checkpoint {checkpoint}: not written by this command but in Python; go on with it there.")
        here, there = self._settings(saved_hyperparams), about["settings"]
        if differing := sorted(key for key in {*here, *there} if here.get(key) != there.get(key)):
            pairs = ", ".join(f"{key} is {there.get(key)} there and {here.get(key)} here" for key in differing)
            raise ValueError(
                f"--checkpoint {checkpoint}: it belongs to another run; {pairs}. Name another file, or delete it."
            )
        _, self.env_wrapper, _, self.vec_env_wrapper = self._preprocess_hyperparams(hyperparams)
        if self.n_timesteps < about["num_timesteps"]:
            raise ValueError(f"--n-timesteps {self.n_timesteps}: {checkpoint} is at step {about['num_timesteps']} already.")
        model, run = load_checkpoint(checkpoint)
        self.save_path, self.callbacks = run["save_path"], run["callbacks"]
        self.params_path = f"{self.save_path}/{self.env_name}"
        self.resumed = True
        print(f"Going on from step {model.num_timesteps}, in {self.save_path}")
        return model, saved_hyperparams

    def learn(self, model: BaseAlgorithm) -> None:
        if not self.resumed:
            return super().learn(model)
        # the zoo's meaning: -1 is the default of the algorithm, anything below turns it off
        log_interval = (
            {} if self.log_interval == -1 else {"log_interval": self.log_interval if self.log_interval > -1 else None}
        )
        try:
            rest = self.n_timesteps - model.num_timesteps
            model.learn(rest, self.callbacks, reset_num_timesteps=False, **log_interval)  # type: ignore[arg-type]
        except KeyboardInterrupt:  # as in the zoo: what was learned is saved
            pass
        finally:
            model.env.close()  # type: ignore[union-attr]

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        super().save_trained_model(model)
        title = f"{self.env_name} {' '.join(self.variants) or self.algo}"
        if model.num_timesteps < self.n_timesteps:
            print(f"Stopped at step {model.num_timesteps} of {self.n_timesteps}.")
        elif self.checkpoint is not None:
            self.checkpoint.unlink(missing_ok=True)  # nothing is left to go on with
        report(Path(self.save_path), title, -1 if self.continue_training else getattr(model, "learning_starts", -1))
        if self.algo == ALGO and is_image_space(model.observation_space):
            self._record(model)
        print(f"Model:          {self.save_path}/{self.env_name}.zip")
        if tensorboard_log := getattr(model, "tensorboard_log", None):  # of a run that went on: where it began
            print(f"TensorBoard:    tensorboard --logdir {tensorboard_log}")

    def _record(self, model: BaseAlgorithm) -> None:
        try:
            from sb3_robust_bisim.cli.record import record
        except ImportError as error:
            print(f"Agent at work:  not shown, {error.name} is missing: pip install sb3_robust_bisim[dmc]")
            return
        with closing(self._seen_by_the_agent()) as venv:
            print("Agent at work: ", *record(model, venv, Path(self.save_path)))

    def _seen_by_the_agent(self) -> VecEnv:
        """The evaluation environment, drawing what it shows."""
        eval_env_kwargs, self.eval_env_kwargs = self.eval_env_kwargs, {**self.eval_env_kwargs, "render_mode": "rgb_array"}
        try:
            return self.create_envs(1, eval_env=True)
        finally:
            self.eval_env_kwargs = eval_env_kwargs


def main(arguments: list[str] | None = None) -> None:
    """
    ``python -m sb3_robust_bisim COMMAND``: hand over to the zoo, with our defaults filled in.

    :param arguments: in place of those of the command line
    """
    if arguments is not None:
        sys.argv[1:] = arguments
    rl_zoo3.train.ExperimentManager = BisimExperimentManager  # type: ignore[misc]
    commands = ("train", "enjoy", "plot_train", "plot_from_file", "all_plots")
    if len(sys.argv) < 2 or sys.argv[1] not in commands:
        print(f"usage: python -m sb3_robust_bisim {{{','.join(commands)}}} ...\n\nEach command has --help.", file=sys.stderr)
        sys.exit(0 if sys.argv[1:] in (["-h"], ["--help"]) else 2)
    if sys.argv[1] == "train":
        sys.argv[2:] = _train_arguments(sys.argv[2:])
    elif sys.argv[1] == "enjoy":
        sys.argv[2:] = _enjoy_arguments(sys.argv[2:])
    command = sys.argv.pop(1)
    if command == "train":
        rl_zoo3.train.train()
    elif command == "enjoy":
        rl_zoo3.enjoy.enjoy()
    else:
        try:
            from rl_zoo3 import cli
        except ImportError as error:
            raise ImportError(f"{command} needs the extra `plots`: pip install sb3_robust_bisim[plots]") from error
        sys.argv.insert(1, command)
        cli.main()


def _enjoy_arguments(arguments: list[str]) -> list[str]:
    """
    Fill in ``--algo``, the folder that training writes to, and the newest run that has an agent: the zoo takes the newest
    folder, also one that Optuna or a run that failed has left.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default=ALGO)
    parser.add_argument("-f", "--folder", default="logs")
    parser.add_argument("--exp-id", type=int, default=0)
    parser.add_argument("--env", type=EnvironmentName, default=None)
    ours, theirs = parser.parse_known_args(arguments)
    if ours.exp_id == 0 and ours.env is not None:
        runs = Path(ours.folder, ours.algo).glob(f"{ours.env}_*/*.zip")
        numbers = [suffix for run in runs if (suffix := run.parent.name.removeprefix(f"{ours.env}_")).isdigit()]
        ours.exp_id = max(map(int, numbers), default=0)
    env = [] if ours.env is None else ["--env", ours.env.gym_id]
    return ["--algo", ours.algo, "-f", ours.folder, "--exp-id", str(ours.exp_id), *env, *theirs]


def _train_arguments(arguments: list[str]) -> list[str]:
    """Take out ``--variant``, which the zoo does not know, and fill in the defaults of ``--algo`` and ``--conf-file``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_robust_bisim train",
        add_help=False,
        allow_abbrev=False,
        description="The zoo's train command, plus:",
    )
    parser.add_argument(
        *("--variant", "--variants"),
        dest="variants",
        nargs="+",
        default=[],
        metavar="NAME",
        help="variants of the config file to lay over the task's entry, for example DBC, or SAC clean small",
    )
    parser.add_argument(
        "--checkpoint",
        type=Path,
        metavar="FILE",
        help="keep everything that the next step depends on in this file; the same command goes on from it, exactly, after an "
        "interruption (remove it to begin anew); where it logs and whether it shows a progress bar stay as they were",
    )
    parser.add_argument(
        "--checkpoint-freq", type=int, default=10_000, metavar="N", help="environment steps (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, help="of environments, networks and sampling (default: a random one)")
    parser.add_argument("--algo", default=ALGO, help="RL algorithm (default: %(default)s)")
    parser.add_argument(
        "-conf", "--conf-file", help=f"hyperparameters (default: {DEFAULT_CONFIG} for {ALGO}, if that file is here)"
    )
    if "-h" in arguments or "--help" in arguments:
        parser.print_help()
        print()
    ours, theirs = parser.parse_known_args(arguments)
    BisimExperimentManager.variants = ours.variants
    BisimExperimentManager.checkpoint, BisimExperimentManager.checkpoint_freq = ours.checkpoint, ours.checkpoint_freq
    BisimExperimentManager.seed_given = ours.seed is not None and ours.seed >= 0
    if ours.checkpoint_freq < 1:
        parser.error(f"--checkpoint-freq {ours.checkpoint_freq}: at least one step must lie between two checkpoints.")
    if ours.checkpoint is not None and {"-optimize", "--optimize-hyperparameters"} & set(arguments):
        parser.error("--checkpoint with -optimize: Optuna keeps its trials itself, see --storage.")
    if ours.checkpoint is not None:
        _check_writable(parser, ours.checkpoint)
    config = ours.conf_file or (str(DEFAULT_CONFIG) if ours.algo == ALGO and DEFAULT_CONFIG.is_file() else None)
    if ours.algo == ALGO and config is None and not {"-h", "--help"} & set(arguments):
        parser.error(f"-conf is needed: {DEFAULT_CONFIG} is not in this folder.")
    if config is not None and is_yaml(config) and not Path(config).is_file():
        parser.error(f"-conf {config}: there is no such file.")
    seed = [] if ours.seed is None else ["--seed", str(ours.seed)]
    return ["--algo", ours.algo, *(["-conf", config] if config else []), *seed, *theirs]


def _check_writable(parser: argparse.ArgumentParser, checkpoint: Path) -> None:
    """What would otherwise be found at the first checkpoint, thousands of steps later."""
    if checkpoint.is_dir():
        parser.error(f"--checkpoint {checkpoint}: this is a folder; name a file in it.")
    try:
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=checkpoint.parent):
            pass
    except OSError as error:
        parser.error(f"--checkpoint {checkpoint}: {error.strerror}; name a file where you may write.")
