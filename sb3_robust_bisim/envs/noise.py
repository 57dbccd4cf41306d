"""Distraction of the paper's Gym tasks: numbers of pure noise appended to every observation."""

import math
from typing import Any, SupportsFloat, SupportsIndex

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

# Marks the noise as a child stream of the reset seed, with a number that no ``SeedSequence.spawn`` counting up from 0 reaches
# (the letters "NOIS").
_SPAWN_KEY = (0x4E4F4953,)


def check_noise(noise_multiplier: int, noise_std: float) -> None:
    """
    Check the two arguments that every noisy task takes.

    :param noise_multiplier: see :class:`NoiseObservation`
    :param noise_std: see :class:`NoiseObservation`
    :raises ValueError: when one of them has the wrong type or lies outside its range
    """
    if isinstance(noise_multiplier, bool) or not isinstance(noise_multiplier, SupportsIndex) or noise_multiplier < 0:
        raise ValueError(f"noise_multiplier must be an integer >= 0 (0: no noise), got {noise_multiplier!r}")
    if not isinstance(noise_std, SupportsFloat) or not 0 <= noise_std < math.inf:
        raise ValueError(f"noise_std must be a finite number >= 0, got {noise_std!r}")


class NoiseObservation(gym.ObservationWrapper[np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """
    Append ``noise_multiplier * dim(S)`` fresh numbers from an isotropic Gaussian to every observation, the one of ``reset``
    included (paper: "Sparse Noisy Cartpole" and the appendix on the Gym tasks; ``noise_multiplier`` is its N_m).

    The noise has a random generator of its own. ``reset(seed=s)`` seeds it with a child stream of ``s`` and the environment is
    never asked for a random number, so the states behind the observations are the same for every ``noise_multiplier``.
    The generator can be saved with :meth:`get_rng_state`; pickling or copying the wrapped environment takes it along too.

    Example::

        >>> import gymnasium as gym
        >>> from sb3_robust_bisim.envs import NoiseObservation
        >>> NoiseObservation(gym.make("Pendulum-v1"), noise_multiplier=2).observation_space.shape
        (9,)

    :param env: environment whose observations are vectors of real numbers: a Box of shape (dim(S),) with a float dtype
    :param noise_multiplier: N_m, noise numbers per state number; an integer >= 0
    :param noise_std: standard deviation of the noise, in the unit of the observations; finite and >= 0 (paper: 1)
    :raises ValueError: for an argument outside its range, or an observation space that is not a flat Box of floats
    """

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], noise_multiplier: int, noise_std: float = 1.0) -> None:
        check_noise(noise_multiplier, noise_std)
        space = env.observation_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
            raise ValueError(
                f"env must have a Box observation space of shape (n,) and a float dtype to append noise to, got {space}; "
                "flatten it first with gymnasium.wrappers.FlattenObservation"
            )
        RecordConstructorArgs.__init__(self, noise_multiplier=noise_multiplier, noise_std=noise_std)
        super().__init__(env)
        unbounded = np.full(noise_multiplier * space.shape[0], np.inf, dtype=space.dtype)
        low, high = np.concatenate([space.low, -unbounded]), np.concatenate([space.high, unbounded])
        self.observation_space = gym.spaces.Box(low, high, dtype=space.dtype.type)
        self.noise_std = noise_std
        self.noise_shape = unbounded.shape
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Reset the environment; a seed restarts the noise as well, None lets it run on.

        :param seed: seed of the environment and, through an independent stream, of the noise
        :param options: passed to the environment
        :return: observation of shape ((1 + noise_multiplier) * dim(S),) and the environment's info
        """
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=_SPAWN_KEY))
        return self.observation(observation), info

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """
        Append fresh noise.

        :param observation: of shape (dim(S),)
        :return: array of shape ((1 + noise_multiplier) * dim(S),): the observation unchanged, then the noise
        """
        noise = self._rng.normal(0.0, self.noise_std, self.noise_shape)
        return np.concatenate([observation, noise.astype(observation.dtype)])

    def get_rng_state(self) -> dict[str, Any]:
        """
        Read where the noise stream stands.

        :return: state for :meth:`set_rng_state`: plain numbers and strings, fit for JSON
        """
        return dict(self._rng.bit_generator.state)

    def set_rng_state(self, state: dict[str, Any]) -> None:
        """
        Let the noise go on from a saved place.

        :param state: what :meth:`get_rng_state` returned
        :raises ValueError: when the state belongs to another kind of generator
        """
        self._rng.bit_generator.state = state


class NoisyTask:
    """
    Entry point of an environment id: builds the task and appends noise to its observations where that is asked for.

    :param env_class: class of the task without noise; its ``metadata`` shows :func:`gymnasium.make` the render modes
    """

    def __init__(self, env_class: type[gym.Env[np.ndarray, np.ndarray]]) -> None:
        self.env_class = env_class
        self.metadata = env_class.metadata

    def __call__(self, *, noise_multiplier: int = 0, noise_std: float = 1.0, **kwargs: Any) -> gym.Env[np.ndarray, np.ndarray]:
        """
        Build the environment.

        :param noise_multiplier: see :class:`NoiseObservation`; 0 adds no wrapper
        :param noise_std: see :class:`NoiseObservation`
        :param kwargs: arguments of the task
        :return: the task, inside a :class:`NoiseObservation` when ``noise_multiplier`` is not 0
        :raises ValueError: for an argument outside its range
        """
        check_noise(noise_multiplier, noise_std)
        env = self.env_class(**kwargs)
        return NoiseObservation(env, noise_multiplier, noise_std) if noise_multiplier else env
