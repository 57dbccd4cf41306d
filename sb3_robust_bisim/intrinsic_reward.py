"""The intrinsic reward as a VecEnv wrapper. It calls a function and does not know the algorithm."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

BonusFn = Callable[[Any, np.ndarray, Any], np.ndarray]


class IntrinsicRewardVecEnv(VecEnvWrapper):
    """
    Adds a bonus to the reward of each transition when it is collected, and writes it to ``info["intrinsic_reward"]``.

    Until ``bind`` sets a function, the wrapper changes nothing, so training and evaluation can use the same chain of wrappers.
    :class:`~sb3_robust_bisim.BisimSAC` binds its bonus while ``learn()`` runs, and adds this wrapper as the outermost one if
    the chain has none. If you add it yourself, put it inside VecNormalize (off-policy algorithms ignore rewards that are
    changed outside of it) and outside of wrappers that change the shape of observations, such as VecFrameStack. Wrappers
    around it see rewards with the bonus, so evaluate in a separate environment, or with a Monitor inside this wrapper.

    Example::

        venv = VecNormalize(IntrinsicRewardVecEnv(venv), norm_reward=False)
        model = BisimSAC("MlpPolicy", venv, intrinsic_reward_scale=2.0)

    :param venv: the vectorised environment
    """

    only_while_learning: ClassVar = ("_bonus",)  # checkpoints leave it out: it holds the agent and its replay buffer

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self._bonus: BonusFn | None = None
        self._last_obs: VecEnvObs | None = None
        self._actions = np.empty(0)

    def bind(self, bonus: BonusFn | None) -> None:
        """
        :param bonus: function of the observations, the environment's actions and the true successors, each with n_envs
            rows. It returns (n_envs,) rewards. None: no bonus
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
    """The true successors. At the end of an episode, ``obs`` is already the first observation of the next one."""
    if not dones.any():
        return obs
    obs = deepcopy(obs)
    for i in np.flatnonzero(dones):
        terminal = infos[i].get("terminal_observation")
        if terminal is None:  # as in SB3's replay buffers: some third-party VecEnvs omit it
            continue
        if isinstance(obs, dict):
            for key in obs:
                obs[key][i] = terminal[key]
        else:
            obs[i] = terminal  # type: ignore[index]
    return obs


@contextmanager
def bound(env: VecEnv | None, bonus: BonusFn | None) -> Iterator[None]:
    """Bind a bonus to the wrapper in a chain, if there is one, while the block runs."""
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
    Check the order of the wrappers in a chain, and add the wrapper as the outermost one if it is needed and missing.

    :param env: the agent's chain of wrappers
    :param observation_space: the agent's observation space
    :param scale: weight of the bonus; 0: no wrapper is needed
    :return: the chain
    :raises ValueError: if rewards are normalised, if the wrapper's rewards would be ignored, or if its observations or
        VecNormalize's differ from the agent's
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
            "VecNormalize(norm_reward=True): it rescales rewards during training, so neither the metric nor reward_range "
            "has a fixed unit. Pass norm_reward=False."
        )
    if normalize is not None and _shapes(normalize.observation_space) != _shapes(env.observation_space):
        raise ValueError(
            f"VecNormalize inside of {type(env).__name__}, which changes the shape of observations: SB3 would store them as "
            "VecNormalize sees them. Make VecNormalize the outermost of both; for images with the channels last, use "
            "VecNormalize(VecTransposeImage(venv), norm_obs=False, norm_reward=False)."
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
            "wrapper that changes their shape, such as VecFrameStack."
        )
    return env


def _shapes(space: spaces.Space) -> Any:
    """Shape of an observation, per key."""
    return {key: _shapes(subspace) for key, subspace in space.items()} if isinstance(space, spaces.Dict) else space.shape


def _sizes(space: spaces.Space) -> Any:
    """Size of an observation, per key. A transposition does not change it."""
    if isinstance(space, spaces.Dict):
        return {key: _sizes(subspace) for key, subspace in space.items()}
    return int(np.prod(space.shape or ()))
