"""The intrinsic reward as a VecEnv wrapper: it knows a callable, not the algorithm."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

BonusFn = Callable[[Any, np.ndarray, Any], np.ndarray]


class IntrinsicRewardVecEnv(VecEnvWrapper):
    """
    Adds a bonus to the reward of each transition when it is collected, and writes it to ``info["intrinsic_reward"]``.

    Until something is bound it passes everything through, so the same chain of wrappers serves training and evaluation.
    :class:`~sb3_robust_bisim.BisimSAC` binds itself, and puts this wrapper outermost if the chain has none. Put it in
    yourself below VecNormalize (off-policy algorithms ignore rewards changed outside of it) and above anything that
    changes the shape of the observation, such as VecFrameStack. Rewards that pass through it count the bonus: evaluate in
    an environment of its own, or in one that has a Monitor inside.

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
        obs = self.venv.reset()
        self._last_obs = deepcopy(obs)  # some VecEnvs write every observation into the same array
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        # no previous observation: the environment was reset before this wrapper was put around it
        if self._bonus is not None and self._last_obs is not None:
            bonus = self._bonus(self._last_obs, self._actions, _successors(obs, dones, infos))
            rewards = rewards + bonus
            for info, value in zip(infos, bonus.tolist(), strict=True):
                info["intrinsic_reward"] = value
        self._last_obs = deepcopy(obs)
        return obs, rewards, dones, infos


def _successors(obs: VecEnvObs, dones: np.ndarray, infos: list[dict[str, Any]]) -> VecEnvObs:
    """Where the actions led: at the end of an episode ``obs`` is already the first observation of the next one."""
    if not dones.any():
        return obs
    obs = deepcopy(obs)
    for i in np.flatnonzero(dones):
        terminal = infos[i].get("terminal_observation")
        if terminal is None:  # as SB3's replay buffers take it: some VecEnvs of others do not tell
            continue
        if isinstance(obs, dict):
            for key in obs:
                obs[key][i] = terminal[key]
        else:
            obs[i] = terminal  # type: ignore[index]
    return obs


@contextmanager
def bound(env: VecEnv | None, bonus: BonusFn | None) -> Iterator[None]:
    """Bind a bonus to the wrapper in a chain, if it has one, for the length of the block."""
    wrapper = None if env is None else unwrap_vec_wrapper(env, IntrinsicRewardVecEnv)
    if wrapper is None:
        yield
        return
    wrapper.bind(bonus)
    try:
        yield
    finally:
        wrapper.bind(None)


def with_intrinsic_reward(env: VecEnv, observation_space: spaces.Space, scale: float) -> VecEnv:
    """
    Check the order of the wrappers in a chain, and put the wrapper outermost if there is none and one is needed.

    :param env: the chain of the agent
    :param observation_space: what the agent sees
    :param scale: weight of the bonus; 0: no wrapper is needed
    :return: the chain
    :raises ValueError: if rewards are normalised on the way, if the wrapper's rewards would be ignored, or if it sees
        other observations than the agent
    """
    chain, layer = [], env
    while isinstance(layer, VecEnvWrapper):
        chain.append(layer)
        layer = layer.venv
    wrapper = next((layer for layer in chain if isinstance(layer, IntrinsicRewardVecEnv)), None)
    normalize = next((layer for layer in chain if isinstance(layer, VecNormalize)), None)
    remedy = "use VecNormalize(IntrinsicRewardVecEnv(venv), norm_reward=False)."
    if normalize is not None and normalize.norm_reward:
        raise ValueError(
            "VecNormalize(norm_reward=True): it rescales the rewards while they come in, so that neither the metric nor "
            "reward_range has a fixed unit. Pass norm_reward=False."
        )
    if wrapper is not None and normalize is not None and chain.index(wrapper) < chain.index(normalize):
        raise ValueError(f"IntrinsicRewardVecEnv outside of VecNormalize: its rewards would be ignored; {remedy}")
    if scale == 0:
        return env
    if wrapper is None and normalize is not None:
        raise ValueError(f"intrinsic_reward_scale={scale} under VecNormalize: {remedy}")
    if wrapper is None:
        env = wrapper = IntrinsicRewardVecEnv(env)
    seen, wanted = _sizes(wrapper.observation_space), _sizes(observation_space)
    if seen != wanted:
        raise ValueError(
            f"IntrinsicRewardVecEnv sees observations of {seen} numbers, the agent of {wanted}: put it outside of the "
            "wrapper that changes them (VecFrameStack, for example)."
        )
    return env


def _sizes(space: spaces.Space) -> Any:
    """How many numbers an observation holds, per key: the same before and after a transposition."""
    if isinstance(space, spaces.Dict):
        return {key: _sizes(subspace) for key, subspace in space.items()}
    return int(np.prod(space.shape or ()))
