"""The intrinsic reward as a VecEnv wrapper: it knows a callable, not the algorithm."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

BonusFn = Callable[[Any, np.ndarray, Any], np.ndarray]


class IntrinsicRewardVecEnv(VecEnvWrapper):
    """
    Adds a bonus to the reward of each transition when it is collected, and writes it to ``info["intrinsic_reward"]``.

    Until something is bound it passes everything through, so the same chain of wrappers serves training and evaluation.
    :class:`~sb3_robust_bisim.BisimSAC` binds itself, and puts this wrapper outermost if the chain has none. Put it in
    yourself below VecNormalize (off-policy algorithms ignore rewards changed outside of it) and above anything that
    changes the shape of the observation, such as VecFrameStack.

    Example::

        venv = VecNormalize(IntrinsicRewardVecEnv(venv), norm_reward=False)
        model = BisimSAC("MlpPolicy", venv, intrinsic_reward_scale=2.0)

    :param venv: the vectorised environment
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self._bonus: BonusFn | None = None
        self._last_obs: VecEnvObs | None = None
        self._actions = np.empty(0)

    def bind(self, bonus: BonusFn | None) -> None:
        """
        :param bonus: maps observations, actions as the environment takes them, and true successors, each with n_envs
            rows, to (n_envs,) rewards. None: pass through
        """
        self._bonus = bonus

    def reset(self) -> VecEnvObs:
        self._last_obs = self.venv.reset()
        return self._last_obs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        # no previous observation: the environment was reset before this wrapper was put around it
        if self._bonus is not None and self._last_obs is not None:
            bonus = self._bonus(self._last_obs, self._actions, _successors(obs, dones, infos))
            rewards = rewards + bonus
            for info, value in zip(infos, bonus, strict=True):
                info["intrinsic_reward"] = float(value)
        self._last_obs = obs
        return obs, rewards, dones, infos


def _successors(obs: VecEnvObs, dones: np.ndarray, infos: list[dict[str, Any]]) -> VecEnvObs:
    """Where the actions led: at the end of an episode ``obs`` is already the first observation of the next one."""
    if not dones.any():
        return obs
    obs = deepcopy(obs)
    for i in np.flatnonzero(dones):
        terminal = infos[i]["terminal_observation"]
        if isinstance(obs, dict):
            for key in obs:
                obs[key][i] = terminal[key]
        else:
            obs[i] = terminal  # type: ignore[index]
    return obs
