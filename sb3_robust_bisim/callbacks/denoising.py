"""Whether the embedding tells states apart, or distractors."""

from collections import deque
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import torch as th

from sb3_robust_bisim.callbacks.diagnostic import EnvironmentCallback, Step, embed
from sb3_robust_bisim.envs.noise import NoiseObservation
from sb3_robust_bisim.frame_buffer import frames_per_observation

_STRIDE = 4  # steps of the walk from one anchor to the next: neighbours are nearly the same state


class DenoisingFactorCallback(EnvironmentCallback):
    """
    Does the embedding tell states apart, or distractors?

    Records ``bisim/denoising_factor``, (d_neg - d_pos) / (d_neg + d_pos) in [-1, 1], as the literature defines it: see
    :func:`denoising_factor`. 1: the noise is gone; 0: it matters as much as the state. The distances are L2 whatever distance
    the metric loss trains, so that the numbers of two agents, and those in the literature, can be compared.

    The anchors are every fourth state of a walk with the present policy. Anchors and positives are noisy alike: each one has
    noise of its own, drawn by :class:`~sb3_robust_bisim.envs.NoiseObservation` and mixed by its projection; in a stack of
    frames each frame is drawn again.

    Pixel tasks cannot show a state in front of a fresh background yet. There each state has a single positive,
    ``info["clean_obs"]``, the frame without a distractor, which the task writes if asked to:
    ``env_kwargs={"clean_obs": True}``. d_pos then holds the effect of one background where the literature's holds that of
    two, so these numbers do not compare with the literature's.

    ``eval_env_kwargs`` asks for ``bisim/denoising_factor_heldout`` as well, the same number on noise or backgrounds that the
    training does not show. It is measured in an environment of its own with the same start states, in which the policy acts
    on the held-out noise.

    :param every: environment steps of the training between two looks, >= 1
    :param n_states: anchors, >= 2 (literature: 125)
    :param env_id: another environment; None: that of the training
    :param env_kwargs: laid over the arguments of the environment
    :param seed: of the environment; every look begins with the same start states
    :param verbose: as in SB3
    :param n_positives: looks at each state besides the anchor, >= 1 (literature: 16); pixel tasks have one
    :param eval_env_kwargs: laid over ``env_kwargs`` for the held-out number, such as ``{"noise_mean": 1.0}`` or
        ``{"split": "eval"}``; None: no such number
    :raises ValueError: for an argument outside its range; at the start of training if the observations differ, or for an
        environment without noise or clean frames

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
        if not isinstance(n_positives, int) or n_positives < 1:
            raise ValueError(f"n_positives={n_positives!r}: {type(self).__name__} needs an integer >= 1.")
        self.n_positives = n_positives
        self._held_out: DenoisingFactorCallback | None = None
        if eval_env_kwargs is not None:
            self._held_out = DenoisingFactorCallback(
                every, n_states, env_id, {**self.env_kwargs, **eval_env_kwargs}, seed, n_positives=n_positives
            )

    def _prepare(self) -> None:
        super()._prepare()
        env = self.venv.unwrapped.envs[0]  # type: ignore[attr-defined]
        self._noise = _noise_layer(env)
        if self._noise is None and "clean_obs" not in next(self._walk()).info:
            raise ValueError(
                f'env_kwargs={self.env_kwargs}: no NoiseObservation and no info["clean_obs"], so no state can be seen with '
                "other noise. Noisy tasks need noise_multiplier > 0, pixel tasks env_kwargs={'clean_obs': True}."
            )
        if self._noise is not None and self._noise.observation_space != env.observation_space:
            raise ValueError(
                f"env_id={self.env_id!r}: its observations lie in {env.observation_space}, those of NoiseObservation in "
                f"{self._noise.observation_space}. Make NoiseObservation the outermost wrapper that changes observations."
            )
        if self._held_out is not None:
            self._held_out.model = self.model
            self._held_out._prepare()

    def _on_training_end(self) -> None:
        super()._on_training_end()
        if self._held_out is not None:
            self._held_out._on_training_end()

    def _measure(self) -> None:
        self.logger.record("bisim/denoising_factor", self._factor())
        if self._held_out is not None:
            self.logger.record("bisim/denoising_factor_heldout", self._held_out._factor())

    def _factor(self) -> float:
        states = islice(self._states(), 0, _STRIDE * (self.n_states - 1) + 1, _STRIDE)
        anchors, *positives = (embed(self.model, self._tensor(list(looks)))[0] for looks in zip(*states, strict=True))
        return denoising_factor(anchors, th.stack(positives))

    def _states(self) -> Iterator[list[np.ndarray]]:
        """Observations of each state of a walk: the one that the policy acts on, then the positives."""
        recent: deque[list[np.ndarray]] = deque(maxlen=frames_per_observation(self.venv))
        for step in self._walk():
            if step.done:
                recent.clear()
                continue
            recent.append(self._positives(step))
            if len(recent) == recent.maxlen:  # before that the stack still holds zeros
                yield [step.next_obs, *(_stack(frames, step.next_obs.shape) for frames in zip(*recent, strict=True))]

    def _positives(self, step: Step) -> list[np.ndarray]:
        """Single frames of the state that a step led to: with fresh noise, or one without a distractor."""
        if self._noise is not None:
            return [self._noise.look() for _ in range(self.n_positives)]
        return [step.info["clean_obs"]]


def denoising_factor(anchors: th.Tensor, positives: th.Tensor) -> float:
    """
    (d_neg - d_pos) / (d_neg + d_pos). d_pos is the mean L2 distance of an anchor to the positives of its own state, d_neg that
    to the positives of all other states.

    :param anchors: (N, n) embeddings, one for each of N >= 2 states
    :param positives: (K, N, n) embeddings of the same states with other noise
    :return: number in [-1, 1]; 0 when all embeddings are one point
    """
    # Without matrix products, which would leave equal embeddings a distance of up to a thousandth of their norm
    distances = th.stack([th.cdist(anchors, p, compute_mode="donot_use_mm_for_euclid_dist") for p in positives])
    own_state = th.eye(len(anchors), dtype=th.bool, device=anchors.device)
    positive, negative = distances[:, own_state].mean().item(), distances[:, ~own_state].mean().item()
    total = positive + negative
    return (negative - positive) / total if total > 0 else 0.0


def _noise_layer(env: Any) -> NoiseObservation | None:
    """
    :param env: outermost wrapper
    :return: the layer that adds noise, if there is one
    """
    while not isinstance(env, NoiseObservation):
        if not hasattr(env, "env"):
            return None
        env = env.env
    return env if env.noise_multiplier > 0 else None


def _stack(frames: tuple[np.ndarray, ...], shape: tuple[int, ...]) -> np.ndarray:
    """
    Stack as VecFrameStack does, and SB3's transposition of images after it.

    :param frames: oldest first
    :param shape: (1, ...) of the observation that they make
    """
    stack = np.concatenate(frames, axis=-1)[None]
    return stack if stack.shape == shape else stack.transpose(0, 3, 1, 2)
