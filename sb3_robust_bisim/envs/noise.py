"""The distraction of the paper's Gym tasks: noise dimensions in every observation, appended or mixed with the state."""

import math
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs

from sb3_robust_bisim.values import is_whole

# The noise is a child stream of the reset seed. Its number (the letters "NOIS") is too large to be reached by
# ``SeedSequence.spawn``, which counts from 0. In the same way, the projection ("PROJ") is a child stream of its own seed.
_SPAWN_KEY = (0x4E4F4953,)
_PROJECTION_SPAWN_KEY = (0x50524F4A,)
# With a larger condition number, float32 observations have less than two digits of the direction that shrinks most
_LARGEST_CONDITION = 1e5


def check_noise(
    noise_multiplier: int, noise_std: float, noise_mean: float, random_projection: bool, projection_seed: int
) -> None:
    """
    Check the arguments of all noisy tasks.

    :param noise_multiplier: see :class:`NoiseObservation`, likewise the others
    :param noise_std: standard deviation of the noise
    :param noise_mean: mean of the noise
    :param random_projection: whether state and noise are mixed
    :param projection_seed: seed of the mixing matrix
    :raises ValueError: if one of them has the wrong type or is outside its range
    """
    if not is_whole(noise_multiplier, 0):
        raise ValueError(f"noise_multiplier must be an integer >= 0 (0: no noise), got {noise_multiplier!r}")
    if not isinstance(noise_std, SupportsFloat) or not 0 <= noise_std < math.inf:
        raise ValueError(f"noise_std must be a finite number >= 0, got {noise_std!r}")
    if not isinstance(noise_mean, SupportsFloat) or not math.isfinite(noise_mean):
        raise ValueError(f"noise_mean must be a finite number (0: noise around zero), got {noise_mean!r}")
    if not isinstance(random_projection, bool):
        raise ValueError(f"random_projection must be True or False, got {random_projection!r}")
    if not is_whole(projection_seed, 0):
        raise ValueError(
            f"projection_seed must be an integer >= 0, the same in training and evaluation, got {projection_seed!r}"
        )


def _draw_projection(size: int, seed: int) -> np.ndarray:
    """
    :param size: rows and columns
    :param seed: integer >= 0
    :return: (size, size) matrix of full rank, float64, with N(0, 1) entries
    """
    # RandomState instead of Generator, because NumPy guarantees the same numbers in later versions
    rng = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed, spawn_key=_PROJECTION_SPAWN_KEY)))
    while True:
        matrix = rng.standard_normal((size, size))
        if np.linalg.cond(matrix) <= _LARGEST_CONDITION:
            return matrix


class NoiseObservation(gym.ObservationWrapper[np.ndarray, np.ndarray, np.ndarray], RecordConstructorArgs):
    """
    Append ``noise_multiplier * dim(S)`` new numbers from an isotropic Gaussian to every observation, including that of
    ``reset`` (paper: "Sparse Noisy Cartpole" and the appendix on the Gym tasks; ``noise_multiplier`` is N_m in the paper).

    ``random_projection`` mixes state and noise, so that no coordinate of the observation is free of noise. The observation is
    y = A [x; eps] with the state x, the noise eps and a square matrix A of full rank. The entries of A are N(0, 1). Nothing is
    rescaled, as in the literature. Each number of y is a weighted sum of all n = (1 + noise_multiplier) * dim(S) numbers, and
    its variance over draws of A is the sum of their squares. Observations therefore grow with sqrt(n). Use SB3's
    ``VecNormalize(norm_reward=False)`` to rescale them.

    A depends only on ``projection_seed`` and n. It is the same in training and evaluation, in worker processes, and in a later
    process with a reloaded agent. ``reset(seed=...)`` does not change it. Pickling or copying an environment keeps it. The
    attribute ``projection`` holds it, and is None without a projection.

    The noise has its own random generator. ``reset(seed=s)`` seeds it with a child stream of ``s``, and the generator of the
    environment is not used, so the underlying states are the same with all settings. Pickling or copying an environment
    keeps the generator.

    Example::

        >>> import gymnasium as gym
        >>> from sb3_robust_bisim.envs import NoiseObservation
        >>> NoiseObservation(gym.make("Pendulum-v1"), noise_multiplier=2, random_projection=True).observation_space.shape
        (9,)

    :param env: environment that observes a vector: its observation space is a Box of shape (dim(S),) with a float dtype
    :param noise_multiplier: N_m, noise dimensions per state dimension; an integer >= 0
    :param noise_std: standard deviation of the noise, in the unit of the observations; finite and >= 0 (paper: 1)
    :param noise_mean: mean of the noise, in the unit of the observations; finite. A different mean in evaluation tests
        generalisation to noise outside the training distribution
    :param random_projection: observe A [x; eps] instead of [x; eps]; the observation space then has no bounds
    :param projection_seed: seed of A, an integer >= 0; ignored if ``random_projection`` is False
    :raises ValueError: for an argument outside its range, or an observation space that is not a flat Box of floats
    """

    def __init__(
        self,
        env: gym.Env[np.ndarray, np.ndarray],
        noise_multiplier: int,
        noise_std: float = 1.0,
        noise_mean: float = 0.0,
        random_projection: bool = False,
        projection_seed: int = 0,
    ) -> None:
        check_noise(noise_multiplier, noise_std, noise_mean, random_projection, projection_seed)
        space = env.observation_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
            raise ValueError(
                f"env must have a Box observation space of shape (n,) and a float dtype to add noise to, got {space}; "
                "flatten it first with gymnasium.wrappers.FlattenObservation"
            )
        RecordConstructorArgs.__init__(
            self,
            noise_multiplier=noise_multiplier,
            noise_std=noise_std,
            noise_mean=noise_mean,
            random_projection=random_projection,
            projection_seed=projection_seed,
        )
        super().__init__(env)
        unbounded = np.full(noise_multiplier * space.shape[0], np.inf, dtype=space.dtype)
        low, high = np.concatenate([space.low, -unbounded]), np.concatenate([space.high, unbounded])
        self.projection = _draw_projection(len(low), projection_seed) if random_projection else None
        if random_projection:
            low, high = np.full_like(low, -np.inf), np.full_like(high, np.inf)
        self.observation_space = gym.spaces.Box(low, high, dtype=space.dtype.type)
        self.noise_multiplier = noise_multiplier
        self.noise_std = noise_std
        self.noise_mean = noise_mean
        self._noise_shape = unbounded.shape
        self._dtype = space.dtype
        self._state: np.ndarray | None = None
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Reset the environment. A seed restarts the noise as well; None continues it. The projection stays the same.

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
        Add new noise to an observation of the environment.

        :param observation: of shape (dim(S),)
        :return: array of shape ((1 + noise_multiplier) * dim(S),): the unchanged observation, then the noise; with a
            projection, A times this vector
        """
        self._state = np.array(observation)
        return self.look()

    def look(self) -> np.ndarray:
        """
        Observe the current state again, with new noise. The state does not change; the noise of later steps does.

        :return: array of shape ((1 + noise_multiplier) * dim(S),)
        :raises ResetNeeded: before the first ``reset``
        """
        if self._state is None:
            raise ResetNeeded("look() observes the current state: call reset() first")
        noise = self._rng.normal(self.noise_mean, self.noise_std, self._noise_shape)
        numbers = np.concatenate([self._state, noise])
        if self.projection is not None:
            numbers = self.projection @ numbers
        return numbers.astype(self._dtype)


class NoisyTask:
    """
    Entry point of an environment id: creates the task, and adds noise to its observations on request.

    :param env_class: class of the task without noise; :func:`gymnasium.make` reads the render modes from its ``metadata``
    """

    def __init__(self, env_class: type[gym.Env[np.ndarray, np.ndarray]]) -> None:
        self.env_class = env_class
        self.metadata = env_class.metadata

    def __call__(
        self,
        *,
        noise_multiplier: int = 0,
        noise_std: float = 1.0,
        noise_mean: float = 0.0,
        random_projection: bool = False,
        projection_seed: int = 0,
        **kwargs: Any,
    ) -> gym.Env[np.ndarray, np.ndarray]:
        """
        Create the environment.

        :param noise_multiplier: see :class:`NoiseObservation`, likewise the next four; 0 adds no noise
        :param noise_std: standard deviation of the noise
        :param noise_mean: mean of the noise
        :param random_projection: mix state and noise; also without noise
        :param projection_seed: seed of the mixing matrix
        :param kwargs: arguments of the task
        :return: the task, wrapped in :class:`NoiseObservation` if there is noise or a projection
        :raises ValueError: for an argument outside its range
        """
        noise = (noise_multiplier, noise_std, noise_mean, random_projection, projection_seed)
        check_noise(*noise)
        env = self.env_class(**kwargs)
        return NoiseObservation(env, *noise) if noise_multiplier or random_projection else env
