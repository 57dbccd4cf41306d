"""What BisimSAC checks while ``learn()`` runs: each transition before it is stored, and whether anything is trained at all."""

import math
import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback

ENVIRONMENT = (
    "The environment gave it, and nothing of this step has been stored. Correct the environment, or replace such values in a "
    "wrapper, for example with np.nan_to_num."
)
DIVERGED = "All observations were finite, so {} diverged: load the last checkpoint, and lower learning_rate."
ROUNDING = 1e-4  # more than adding a bonus in fp32 and subtracting it again changes the span of rewards


class DataChecks(BaseCallback):
    """
    Stops training at the first action, observation or reward that is not finite, before the replay buffer gets it.

    Warns once if no update can be made, and once if rewards span more than ``reward_range``. The rewards that count are those
    of the environment, as they are stored: without the bonus of :class:`~sb3_robust_bisim.IntrinsicRewardVecEnv`. Only the
    width of the range matters: it sets the radius of the ball. Rewards are compared after ``learning_starts`` steps, when most
    of them have been seen.

    SB3's VecCheckNan names neither environment nor step, sees no terminal observation, and as a wrapper it would make the
    chains of training and evaluation differ, which EvalCallback refuses.

    Under VecNormalize, an infinite terminal observation has been clipped before it is seen here.

    :raises ValueError: from ``learn()``, for a number that is not finite
    """

    def __init__(self) -> None:
        super().__init__()
        self.model: Any
        self._least, self._most = math.inf, -math.inf
        self._warned = False

    def _on_training_start(self) -> None:
        model, last_step = self.model, self.locals["total_timesteps"]
        if model.learning_starts >= last_step and model.gradient_steps != 0:
            warnings.warn(
                f"learning_starts={model.learning_starts}, and learn() ends at step {last_step}: actions are random, and "
                "nothing is trained. Lower learning_starts or raise total_timesteps.",
                stacklevel=2,
            )
        if model.buffer_size < model.batch_size:
            warnings.warn(
                f"buffer_size={model.buffer_size} is below batch_size={model.batch_size}: every batch repeats transitions. "
                "Raise buffer_size or lower batch_size.",
                stacklevel=2,
            )
        normalize = model.get_vec_normalize_env()
        self._check("observation", model._last_obs if normalize is None else model._last_original_obs, ENVIRONMENT)

    def _on_step(self) -> bool:
        new, normalize = self.locals, self.model.get_vec_normalize_env()
        obs, rewards = (new["new_obs"], new["rewards"]) if normalize is None else (normalize.old_obs, normalize.old_reward)
        bonus = np.array([info.get("intrinsic_reward", 0.0) for info in new["infos"]])
        self._check("action", new["buffer_actions"], DIVERGED.format("the actor (or action_noise)"))
        for i in np.flatnonzero(new["dones"]):
            self._check("terminal observation", new["infos"][i].get("terminal_observation"), ENVIRONMENT, i)
        self._check("observation", obs, ENVIRONMENT)
        self._check("intrinsic reward", bonus, DIVERGED.format("encoder or dynamics model"))
        self._check("reward", rewards, ENVIRONMENT)
        if not self._warned:
            self._compare_with_range((rewards - bonus).tolist())
        return True

    def _check(self, what: str, values: Any, remedy: str, env_idx: Any = None) -> None:
        """
        :param values: array, or dict of arrays, with one row per environment; of one environment if ``env_idx`` is given
        """
        named = values.items() if isinstance(values, dict) else [("", values)]
        for key, array in named:
            array = np.asarray(array)
            if array.dtype.kind != "f" or (finite := np.isfinite(array)).all():  # an image is never copied
                continue
            index = np.argwhere(~finite)[0].tolist()
            value = array[tuple(index)]
            if env_idx is None:
                env_idx, *index = index
            where = "".join([f" with key {key!r}" if key else "", f" at index {tuple(index)}" if index else ""])
            raise ValueError(f"The {what} of environment {env_idx} at step {self.num_timesteps} is {value}{where}. {remedy}")

    def _compare_with_range(self, rewards: list[float]) -> None:
        self._least, self._most = min(self._least, *rewards), max(self._most, *rewards)
        model, objective = self.model, self.model.policy.objective
        if self.num_timesteps <= model.learning_starts or objective.radius is None or objective.bisim_coef == 0:
            return
        seen = (self._least, self._most)
        needed = objective.radius_of(seen)
        if needed > objective.radius * (1 + ROUNDING):
            self._warned = True
            least, most = (float(f"{reward:.6g}") for reward in seen)
            warnings.warn(
                f"reward_range={tuple(model.reward_range)}: rewards from {least} to {most} have been seen, without the bonus. "
                f"They need a ball of radius {needed:.4g}, and it has {objective.radius:.4g}: states cannot get as far apart "
                f"as the metric asks. Pass reward_range=({least}, {most}), wider if others can come, or "
                "norm_constraint=False. The paper keeps (0, 1) for all its tasks.",
                stacklevel=2,
            )


def checked(callback: MaybeCallback) -> list[BaseCallback]:
    """
    :param callback: the argument of ``learn()``
    :return: the same, after the checks
    """
    if callback is None:
        callbacks = []
    elif isinstance(callback, list):
        callbacks = callback
    else:
        callbacks = [callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)]
    return [DataChecks(), *callbacks]
