"""rl-zoo3's experiment manager, extended with named variants, evaluation in another task, exact continuation and a report."""

import inspect
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import optuna
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER, sample_sac_params
from rl_zoo3.utils import get_class_by_name
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.cli.errors import UsageError, refusals
from sb3_robust_bisim.cli.record import record_or_explain
from sb3_robust_bisim.cli.report import report
from sb3_robust_bisim.cli.zoo_config import check_keys, check_task, entry_of, is_yaml, merged_policy_kwargs, variant_settings
from sb3_robust_bisim.runs.checkpoint import (
    Checkpoint,
    delete_checkpoint,
    differences,
    load_checkpoint,
    obstacle,
    read_about,
)
from sb3_robust_bisim.runs.pickling import ResumableSubprocVecEnv

ALGO = "bisim_sac"
WEIGHTS = (("bisim_coef", 0.05, 5.0), ("intrinsic_reward_scale", 0.01, 20.0), ("inverse_dynamics_coef", 0.01, 20.0))


def sample_bisim_sac_params(
    trial: optuna.Trial,
    n_actions: int,
    n_envs: int,
    additional_args: dict[str, Any],
    tuned: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """
    Optuna's search space: that of SAC, and the coefficients of the metric, the bonus and inverse dynamics if they are on.

    :param tuned: hyperparameters of the method to tune; by default those of BisimSAC
    """
    tuned = tuned or {}
    sampled = sample_sac_params(trial, n_actions, n_envs, additional_args)
    # rl-zoo3 replaces policy_kwargs with the sampled ones
    sampled["policy_kwargs"] = {**tuned.get("policy_kwargs", {}), **sampled["policy_kwargs"]}
    for name, low, high in WEIGHTS:
        if tuned.get(name, inspect.signature(BisimSAC).parameters[name].default) > 0:
            sampled[name] = trial.suggest_float(name, low, high, log=True)
    return {**sampled, "policy_delay": trial.suggest_int("policy_delay", 1, 2)}


@dataclass(frozen=True)
class RunOptions:
    """
    Options of the train command that rl-zoo3 does not have.

    :param variants: names of variants in the config file; the last one has the highest priority
    :param checkpoint: file from which an interrupted run continues
    :param checkpoint_freq: environment steps between two checkpoints
    :param new_episodes: continue in new episodes if an exact continuation is not possible
    :param seed_given: the user has set a seed; otherwise rl-zoo3 draws one
    """

    variants: tuple[str, ...] = ()
    checkpoint: Path | None = None
    checkpoint_freq: int = 10_000
    new_episodes: bool = False
    seed_given: bool = False


class BisimExperimentManager(ExperimentManager):
    """
    Adds to rl-zoo3's experiment manager what BisimSAC's commands need.

    :param options: our options of the command
    :param args: rl-zoo3's arguments, as its ``train`` passes them
    """

    def __init__(self, options: RunOptions, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.options = options
        self.variants = list(options.variants)
        self.resumed = False
        self.made_folder: Path | None = None
        self.new_parents: list[Path] = []

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        params = self.custom_hyperparams or {}
        if self.algo == ALGO:
            check_keys(params, "-params")
        if self.continue_training:
            params = self._restore_arguments(params)
        if self.algo == ALGO:
            check_task(self.env_name.gym_id, self.config)
        # priority: entry < variants < Optuna's trial < -params
        settings = variant_settings(self.config, self.env_name.gym_id, *self.variants) if self.variants else {}
        self.custom_hyperparams = {**settings, **self._trial_settings(settings), **params}
        hyperparams, saved_hyperparams = super().read_hyperparameters()
        if self.algo == ALGO:
            check_keys(hyperparams, self.config)
        for settings in (hyperparams, saved_hyperparams):
            settings.pop("variants", None)
        buffer_class = hyperparams.get("replay_buffer_class")
        if isinstance(buffer_class, str) and "." in buffer_class:  # rl-zoo3 evaluates it without our package
            hyperparams["replay_buffer_class"] = get_class_by_name(buffer_class)
        self.args.variant = self.variants  # saved in the run's args.yml
        env_kwargs = self.env_kwargs or hyperparams.get("env_kwargs", {})
        eval_kwargs = hyperparams.pop("eval_env_kwargs", {})
        self.eval_env_kwargs = {**env_kwargs, **eval_kwargs, **(self._eval_env_kwargs_args or {})}
        return hyperparams, saved_hyperparams

    def _restore_arguments(self, params: dict[str, Any]) -> dict[str, Any]:
        """
        Restore the arguments that a pretrained agent was trained with. Without them, the settings of the config file would
        replace the agent's. They are saved in the args.yml of the new run as well.

        :param params: hyperparameters on the command line, which have priority
        :return: these and the agent's
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
            self.variants = trained.get("variant", [])
            self.args.hyperparams = params = {**(trained.get("hyperparams") or {}), **params}
        return params

    def _trial_settings(self, settings: dict[str, Any]) -> dict[str, Any]:
        """The hyperparameters of --trial-id, if given. Its policy_kwargs extend those of the entry and the variants."""
        if self.algo != ALGO or not (self.storage and self.study_name and self.trial_id is not None):
            return {}
        if not is_yaml(self.config):
            raise UsageError(f"-conf {self.config}: --trial-id needs a YAML file.")
        found = self.load_trial(self.storage, self.study_name, self.trial_id)
        configured = {**entry_of(self.config, self.env_name.gym_id), **settings}.get("policy_kwargs", {})
        return {**found, "policy_kwargs": merged_policy_kwargs(configured, found["policy_kwargs"])}

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        if self.vec_env_class is SubprocVecEnv:  # ours can be saved, and closed after its workers have ended
            self.vec_env_class = ResumableSubprocVecEnv
        try:
            with refusals():
                return self._set_up()
        except BaseException:  # no run has begun, so it leaves no folder
            if self.made_folder is not None:
                shutil.rmtree(self.made_folder, ignore_errors=True)
            for folder in self.new_parents:
                with suppress(OSError):  # another run has begun in it
                    folder.rmdir()
            raise

    def _set_up(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """Create the run, with a checkpoint if asked for, or continue it."""
        checkpoint = self.options.checkpoint
        if checkpoint is None:
            return super().setup_experiment()
        if self.optimize_hyperparameters:
            raise UsageError("--checkpoint with -optimize: not supported. Optuna saves its trials itself, see --storage.")
        if checkpoint.is_file():
            return self._continue(checkpoint)
        return self._begin(checkpoint)

    def create_log_folder(self) -> None:
        """Take the next free number: rl-zoo3 chose one before it made the folder, and another run may have begun since."""
        stem, number = self.save_path.rsplit("_", 1)
        if number.isdigit():  # not with -uuid
            folder = Path(self.log_path)
            self.new_parents = [parent for parent in (folder, *folder.parents) if not parent.exists()]
            folder.mkdir(parents=True, exist_ok=True)
            for free in count(int(number)):
                try:
                    Path(f"{stem}_{free}").mkdir()
                except FileExistsError:
                    continue
                self.save_path = f"{stem}_{free}"
                self.params_path = f"{self.save_path}/{self.env_name}"
                break
        super().create_log_folder()
        self.made_folder = Path(self.save_path)

    def _begin(self, checkpoint: Path) -> tuple[BaseAlgorithm, dict[str, Any]]:
        """Create a run that writes checkpoints."""
        experiment = super().setup_experiment()
        assert experiment is not None  # it is only with -optimize
        run = {"save_path": self.save_path, "callbacks": self.callbacks}
        about = {"settings": self._settings(experiment[1])}
        self.callbacks.append(Checkpoint(checkpoint, self.options.checkpoint_freq, run, about))
        return experiment

    def hyperparameters_optimization(self) -> None:
        if self.algo == ALGO:  # the sampler has no other way to see the method that is tuned
            HYPERPARAMS_SAMPLER[ALGO] = partial(sample_bisim_sac_params, tuned=self._hyperparams)
        super().hyperparameters_optimization()

    def _settings(self, hyperparams: dict[str, Any]) -> dict[str, Any]:
        """The settings that must stay the same for a run to be continued; it may become longer."""
        keys = ("eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "device", "vec_env")
        asked = {key: vars(self.args)[key] for key in keys}
        env_kwargs = {
            "env_kwargs": self.env_kwargs or hyperparams.get("env_kwargs", {}),
            "eval_env_kwargs": self.eval_env_kwargs,
        }
        seed = self.seed if self.options.seed_given else "random"
        return {"env": str(self.env_name), "seed": seed, **hyperparams, **env_kwargs, **asked, "n_timesteps": None}

    def _continue(self, checkpoint: Path) -> tuple[BaseAlgorithm, dict[str, Any]]:
        """Load an interrupted run, in place of creating one."""
        hyperparams, saved_hyperparams = self.read_hyperparameters()
        about = read_about(checkpoint)
        if "settings" not in about:
            raise UsageError(f"--checkpoint {checkpoint}: saved from Python, not by this command. Continue it in Python.")
        here, there, reason = self._settings(saved_hyperparams), about["settings"], obstacle(about)
        if self.options.new_episodes and here["device"] != there["device"]:
            reason = reason or f"it was written with --device {there['device']}"
            there = {**there, "device": here["device"]}
        if differing := differences(there, here):
            raise UsageError(
                f"--checkpoint {checkpoint}: belongs to another run: {differing}. Name another file, or delete it. "
                "--new-episodes allows another --device."
            )
        _, self.env_wrapper, _, self.vec_env_wrapper = self._preprocess_hyperparams(hyperparams)
        if self.n_timesteps < about["num_timesteps"]:
            raise UsageError(f"--n-timesteps {self.n_timesteps}: {checkpoint} is at step {about['num_timesteps']} already.")
        if self.options.new_episodes and reason:
            new_model, saved_hyperparams = self._begin(checkpoint)
            model, _ = load_checkpoint(checkpoint, env=new_model.env, device=self.device)
            print(f"New episodes and a new log folder, because {reason}")
        else:
            model, run = load_checkpoint(checkpoint)
            self.save_path, self.callbacks = run["save_path"], run["callbacks"]
            for callback in self.callbacks:  # the file may have been moved since, and the interval may be another one
                if isinstance(callback, Checkpoint):
                    callback.path, callback.every = checkpoint, self.options.checkpoint_freq
            self.params_path = f"{self.save_path}/{self.env_name}"
        self.resumed = True
        print(f"Going on from step {model.num_timesteps}, in {self.save_path}")
        return model, saved_hyperparams

    def learn(self, model: BaseAlgorithm) -> None:
        if not self.resumed:
            return super().learn(model)
        # as in rl-zoo3: -1 is the default of the algorithm, and lower values disable logging
        log_interval = (
            {} if self.log_interval == -1 else {"log_interval": self.log_interval if self.log_interval > -1 else None}
        )
        try:
            rest = self.n_timesteps - model.num_timesteps
            model.learn(rest, self.callbacks, reset_num_timesteps=False, **log_interval)  # type: ignore[arg-type]
        except KeyboardInterrupt:  # as in rl-zoo3, the agent is saved
            pass
        finally:
            model.env.close()  # type: ignore[union-attr]

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        super().save_trained_model(model)
        title = f"{self.env_name} {' '.join(self.variants) or self.algo}"
        if model.num_timesteps < self.n_timesteps:
            print(f"Stopped at step {model.num_timesteps} of {self.n_timesteps}.")
        report(Path(self.save_path), title, -1 if self.continue_training else getattr(model, "learning_starts", -1))
        print(f"Model:          {self.save_path}/{self.env_name}.zip")
        if tensorboard_log := getattr(model, "tensorboard_log", None):  # a continued run logs where it began
            print(f"TensorBoard:    tensorboard --logdir {tensorboard_log}")
        if self.algo == ALGO and is_image_space(model.observation_space):  # an episode can take minutes
            print(f"Video:          {record_or_explain(model, self._rendered_eval_env, Path(self.save_path))}")
        if self.options.checkpoint is not None and model.num_timesteps >= self.n_timesteps:
            delete_checkpoint(self.options.checkpoint)  # last: if the report fails, the run can go on

    def _rendered_eval_env(self) -> VecEnv:
        """An evaluation environment that renders RGB frames."""
        eval_env_kwargs, self.eval_env_kwargs = self.eval_env_kwargs, {**self.eval_env_kwargs, "render_mode": "rgb_array"}
        try:
            return self.create_envs(1, eval_env=True)
        finally:
            self.eval_env_kwargs = eval_env_kwargs
