"""Whether the embedding tells states apart, or distractors."""

from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np

from sb3_robust_bisim.callbacks.diagnostic import EnvironmentCallback, embed
from sb3_robust_bisim.envs.noise import NoiseObservation
from sb3_robust_bisim.losses import pairwise_distance


class DenoisingFactorCallback(EnvironmentCallback):
    """
    Does the embedding tell states apart, or distractors?

    Records ``bisim/denoising_factor``, (d_neg - d_pos) / (d_neg + d_pos) in [-1, 1]: d_pos is the mean distance between two
    looks at the same state with other noise, d_neg that between different states. 1: the noise is gone; 0: it matters as
    much as the state. The distances are those that the metric loss trains, ``huber`` averaged over coordinates.

    The second look at a state has its noise drawn again by
    :class:`~sb3_robust_bisim.envs.NoiseObservation`, or is ``info["clean_obs"]``, the frame without a distractor: pixel tasks
    write it if asked to, ``env_kwargs={"clean_obs": True}``.

    The arguments are those of :class:`EnvironmentCallback`.

    :raises ValueError: also at the start of training, for an environment without noise or clean frames

    Example::

        model = BisimSAC("MlpPolicy", gym.make("robust_bisim/SparseCartPole-v0", noise_multiplier=2))
        model.learn(10_000, callback=DenoisingFactorCallback(every=2000))
    """

    def _prepare(self) -> None:
        super()._prepare()
        layer: Any = self.venv.unwrapped.envs[0]  # type: ignore[attr-defined]
        while not isinstance(layer, NoiseObservation) and hasattr(layer, "env"):
            layer = layer.env
        self.noise = layer if isinstance(layer, NoiseObservation) else None
        if self.noise is None and "clean_obs" not in next(self._walk()).info:
            raise ValueError(
                f'env_kwargs={self.env_kwargs}: no NoiseObservation and no info["clean_obs"], so no state can be seen with '
                "other noise. Noisy tasks need noise_multiplier > 0, pixel tasks env_kwargs={'clean_obs': True}."
            )
        if self.noise is not None and self.noise.observation_space.shape != self.model.observation_space.shape:
            raise ValueError(
                f"observations of shape {self.model.observation_space.shape}, where NoiseObservation gives "
                f"{self.noise.observation_space.shape}: in a stack of frames the noise of the older ones stays as it was. "
                "Use this callback without VecFrameStack."
            )

    def _measure(self) -> None:
        pairs = list(islice(self._pairs(), self.n_states))
        seen, other = (embed(self.model, self._tensor(list(obs)))[0] for obs in zip(*pairs, strict=True))
        first, second = np.triu_indices(len(pairs), 1)
        positive = pairwise_distance(seen, other, self.model.distance).mean().item()
        negative = pairwise_distance(seen[first], other[second], self.model.distance).mean().item()
        total = positive + negative
        self.logger.record("bisim/denoising_factor", (negative - positive) / total if total > 0 else 0.0)

    def _pairs(self) -> Iterator[tuple[Any, Any]]:
        """Two looks at each state of a walk."""
        if self.noise is not None:
            n_state = len(self.model.observation_space.low) - self.noise.noise_shape[0]  # type: ignore[attr-defined]
            for step in self._walk():
                yield step.obs, self.noise.observation(step.obs[0, :n_state])[None]
        frames: list[np.ndarray] = []
        for step in self._walk():
            frames = [] if step.done else [*frames, step.info["clean_obs"]]
            n_stack = step.next_obs.size // step.info["clean_obs"].size
            if len(frames) >= n_stack:
                stack = np.concatenate(frames[-n_stack:], axis=-1)
                yield step.next_obs, (stack if stack.shape == step.next_obs.shape[1:] else stack.transpose(2, 0, 1))[None]
