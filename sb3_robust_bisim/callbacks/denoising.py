"""How well the embedding separates states, compared with how much it reacts to noise."""

from collections import deque
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import torch as th

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.callbacks.diagnostic import EnvironmentCallback, embed, undisturbed
from sb3_robust_bisim.envs.noise import NoiseObservation
from sb3_robust_bisim.envs.pixels import PixelTask
from sb3_robust_bisim.frame_buffer import frames_per_observation
from sb3_robust_bisim.values import is_whole

_STRIDE = 4  # steps between two anchors, because neighbours are nearly the same state


class DenoisingFactorCallback(EnvironmentCallback):
    """
    Records how well the embedding separates states, compared with how much it reacts to noise.

    ``bisim/denoising_factor`` is (d_neg - d_pos) / (d_neg + d_pos) in [-1, 1], as defined in the literature; see
    :func:`denoising_factor`. At 1 the embedding ignores the noise; at 0 the noise matters as much as the state. The distances
    are L2, independent of the distance that the metric loss trains. The numbers of different agents, and those in the
    literature, can therefore be compared.

    The anchors are every fourth state of a walk with the current policy. Every anchor and every positive has its own noise,
    drawn by :class:`~sb3_robust_bisim.envs.NoiseObservation` and mixed by its projection. In a stack of frames, each frame is
    drawn again.

    On pixel tasks the anchors keep the distractions of the walk: background, camera pose and colours. Each episode of the walk
    draws ``n_positives`` others, which its states share, and which move on from frame to frame as those of the walk do.

    ``eval_env_kwargs`` adds ``bisim/denoising_factor_heldout``: the same number for noise or backgrounds that training does
    not use. It is measured in a separate environment with the same start states, where the policy acts on the held-out noise.

    :param every: environment steps of the training between two measurements, >= 1
    :param n_states: number of anchors, >= 2 (literature: 125)
    :param env_id: id of the environment to measure in; None: that of the training
    :param env_kwargs: merged into the arguments of the environment
    :param seed: seed of the environment; every measurement begins with the same start states
    :param verbose: as in SB3
    :param n_positives: positives per state, >= 1 (literature: 16). From pixels, each one is another frame to be drawn
    :param eval_env_kwargs: merged into ``env_kwargs`` for the held-out number, such as ``{"noise_mean": 1.0}`` or
        ``{"split": "eval"}``; None: no held-out number
    :raises ValueError: for an argument outside its range; at the start of training if the observation spaces differ, or if
        the environment has neither noise nor a visual distraction

    Example::

        model = BisimSAC("MlpPolicy", gym.make("robust_bisim/SparseCartPole-v0", noise_multiplier=2))
        model.learn(10_000, callback=DenoisingFactorCallback(every=2000, eval_env_kwargs={"noise_mean": 1.0}))
    """

    def __init__(
        self,
        every: int = 5000,
        n_states: int = 125,
        env_id: str | None = None,
        env_kwargs: dict[str, Any] | None = None,
        seed: int = 0,
        verbose: int = 0,
        *,
        n_positives: int = 16,
        eval_env_kwargs: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(every, n_states, env_id, env_kwargs, seed, verbose)
        if not is_whole(n_positives, 1):
            raise ValueError(f"n_positives={n_positives!r}: {type(self).__name__} needs an integer >= 1.")
        self.n_positives = n_positives
        self._held_out: DenoisingFactorCallback | None = None
        if eval_env_kwargs is not None:
            self._held_out = DenoisingFactorCallback(
                every, n_states, env_id, {**self.env_kwargs, **eval_env_kwargs}, seed, n_positives=n_positives
            )

    def factor_of(self, model: BisimSAC) -> float:
        """
        Measure once, outside of a training. The model does not change.

        :param model: agent with an environment (see SB3's ``set_env``), which determines the one to measure in
        :return: denoising factor in [-1, 1]
        :raises ValueError: as at the start of training
        """
        self.model = model
        with undisturbed(model), th.no_grad():
            try:
                self._prepare()
                return self._factor()
            finally:
                self._close()

    def _prepare(self) -> None:
        super()._prepare()
        env = self.venv.unwrapped.envs[0]  # type: ignore[attr-defined]
        self._noise = _noise_layer(env)
        self._task = env.unwrapped
        if self._noise is None and not (isinstance(self._task, PixelTask) and self._task.distraction.parts):
            raise ValueError(
                f"env_kwargs={self.env_kwargs}: nothing distracts in this environment, so a state cannot be observed with "
                "different noise. Noisy tasks need noise_multiplier > 0, pixel tasks a distractor, such as 'video'."
            )
        if self._noise is not None and self._noise.observation_space != env.observation_space:
            raise ValueError(
                f"env_id={self.env_id!r}: its observation space is {env.observation_space}, that of NoiseObservation is "
                f"{self._noise.observation_space}. Make NoiseObservation the outermost wrapper that changes observations."
            )
        if self._held_out is not None:
            self._held_out.model = self.model
            self._held_out._prepare()

    def _close(self) -> None:
        super()._close()
        if self._held_out is not None:
            self._held_out._close()

    def _measure(self) -> None:
        self.logger.record("bisim/denoising_factor", self._factor())
        if self._held_out is not None:
            self.logger.record("bisim/denoising_factor_heldout", self._held_out._factor())

    def _factor(self) -> float:
        states = islice(self._states(), 0, _STRIDE * (self.n_states - 1) + 1, _STRIDE)
        anchors, *positives = (embed(self.model, self._tensor(list(looks)))[0] for looks in zip(*states, strict=True))
        return denoising_factor(anchors, th.stack(positives))

    def _states(self) -> Iterator[list[np.ndarray]]:
        """For each state of a walk: the observation that the policy acts on, then the positives."""
        recent: deque[list[np.ndarray]] = deque(maxlen=frames_per_observation(self.venv))
        for step in self._walk():
            if step.done:
                recent.clear()
                continue
            recent.append(self._positives(first=not recent))
            if len(recent) == recent.maxlen:  # until then the stack contains zeros
                yield [step.next_obs, *(_stack(frames, step.next_obs.shape) for frames in zip(*recent, strict=True))]

    def _positives(self, first: bool) -> list[np.ndarray]:
        """
        Single frames of the current state, each with its own noise or distraction.

        :param first: an episode has begun
        """
        if self._noise is not None:
            return [self._noise.look() for _ in range(self.n_positives)]
        if first:
            self._distractions = [self._task.distraction.another() for _ in range(self.n_positives)]
        else:
            for distraction in self._distractions:
                distraction.step()
        return [self._task.look(distraction) for distraction in self._distractions]


def denoising_factor(anchors: th.Tensor, positives: th.Tensor) -> float:
    """
    (d_neg - d_pos) / (d_neg + d_pos). d_pos is the mean L2 distance between an anchor and the positives of its own state.
    d_neg is the mean L2 distance between an anchor and the positives of all other states.

    :param anchors: (N, n) embeddings, one for each of N >= 2 states
    :param positives: (K, N, n) embeddings of the same states with different noise
    :return: number in [-1, 1]; 0 if all embeddings are equal
    """
    # Not with matrix products: they can give equal embeddings a distance of up to a thousandth of their norm
    distances = th.stack([th.cdist(anchors, p, compute_mode="donot_use_mm_for_euclid_dist") for p in positives])
    own_state = th.eye(len(anchors), dtype=th.bool, device=anchors.device)
    positive, negative = distances[:, own_state].mean().item(), distances[:, ~own_state].mean().item()
    total = positive + negative
    return (negative - positive) / total if total > 0 else 0.0


def _noise_layer(env: Any) -> NoiseObservation | None:
    """
    :param env: outermost wrapper
    :return: the wrapper that adds noise, if there is one
    """
    while not isinstance(env, NoiseObservation):
        if not hasattr(env, "env"):
            return None
        env = env.env
    return env if env.noise_multiplier > 0 else None


def _stack(frames: tuple[np.ndarray, ...], shape: tuple[int, ...]) -> np.ndarray:
    """
    Stack frames as VecFrameStack does, and transpose images as SB3 does.

    :param frames: oldest first
    :param shape: (1, ...), shape of the resulting observation
    """
    stack = np.concatenate(frames, axis=-1)[None]
    return stack if stack.shape == shape else stack.transpose(0, 3, 1, 2)
