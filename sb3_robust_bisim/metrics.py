"""Behavioural metrics as settings: which distance is to equal which target, over which pairs (see :class:`Metric`)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch as th
from torch.nn import functional as F

from sb3_robust_bisim.losses import pairwise_distance


class Gaps(NamedTuple):
    """
    What a metric loss compares, for each pair (i, j). P is the number of pairs; elementwise distances have n columns.

    :param z: (P, 1) or (P, n) distance of the embeddings, the only part with gradient
    :param reward: (P, 1) distance of the rewards
    :param successor: (P, 1) or (P, n) distance of what follows
    :param variance: (P, 1) sum of both predicted reward variances; None without such a model
    """

    z: th.Tensor
    reward: th.Tensor
    successor: th.Tensor
    variance: th.Tensor | None


def squared(gaps: Gaps, c_r: float, c_t: float) -> th.Tensor:
    """(U - c_R |r_i - r_j| - c_T U')^2, eq:general-bisim-loss."""
    return F.mse_loss(gaps.z, c_r * gaps.reward + c_t * gaps.successor, reduction="none")


def huber(gaps: Gaps, c_r: float, c_t: float) -> th.Tensor:
    """H(U - c_R |r_i - r_j| - c_T U'), H the Huber loss: MICo (Castro et al., 2021) and SimSR (Zang et al., 2022)."""
    return F.smooth_l1_loss(gaps.z, c_r * gaps.reward + c_t * gaps.successor, reduction="none")


def variance_corrected(gaps: Gaps, c_r: float, c_t: float) -> th.Tensor:
    """H((U - c_T U')^2 - c_R^2 (|r_i - r_j|^2 - s_i^2 - s_j^2)): RAP (Chen and Pan, 2022). s^2 is the predicted variance."""
    assert gaps.variance is not None
    target = c_r**2 * (gaps.reward.square() - gaps.variance)
    return F.smooth_l1_loss((gaps.z - c_t * gaps.successor).square(), target, reduction="none")


# What `loss` may name. A new metric target is one function of the same signature and one entry here
METRIC_LOSSES: dict[str, Callable[[Gaps, float, float], th.Tensor]] = {
    "squared": squared,
    "huber": huber,
    "variance_corrected": variance_corrected,
}
CHOICES = {
    "successors": ("model", "sample"),
    "target_encoder": ("none", "successors", "both"),
    "loss": tuple(METRIC_LOSSES),
    "pairs": ("permutation", "all"),
}


@dataclass
class Metric:
    """
    How embeddings become a metric. The defaults are the paper's. BisimSAC takes the last five as ``metric_kwargs``.

    :param distance: U, a key of :data:`~sb3_robust_bisim.losses.DISTANCES`
    :param c_r: c_R >= 0, weight of the reward gap
    :param c_t: c_T in [0, 1), weight of the successor gap
    :param successors: what follows a state: "model", the prediction of the dynamics model, or "sample", the embedding of the
        sampled next state
    :param target_encoder: what the target encoder embeds: "none"; "successors", the sampled next states; or "both", state j
        too, so that gradient flows through state i alone
    :param loss: a key of :data:`METRIC_LOSSES`
    :param pairs: "permutation", each state of a batch with one other; or "all", each with each
    :param absorbing: treat true terminations, not time-outs, as absorbing states with reward 0. Otherwise nothing says where a
        terminal state is to be embedded, as it is never the first state of a transition
    :raises ValueError: for a value that is not known, or settings that contradict each other
    """

    distance: str = "huber"
    c_r: float = 1.0
    c_t: float = 0.99
    successors: str = "model"
    target_encoder: str = "none"
    loss: str = "squared"
    pairs: str = "permutation"
    absorbing: bool = False

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"metric_kwargs with {name}={getattr(self, name)!r}: it must be one of {', '.join(choices)}.")
        if not isinstance(self.absorbing, bool):
            raise ValueError(f"metric_kwargs with absorbing={self.absorbing!r}: it must be True or False.")
        contradictions = {
            f"distance={self.distance!r} with pairs='all'": (
                self.distance == "huber" and self.pairs == "all",
                "it keeps all coordinates of each pair; use pairs='permutation' or another distance",
            ),
            f"distance={self.distance!r} with successors='model'": (
                self.distance == "cosine" and self.successors == "model",
                "predictions are no unit vectors; use successors='sample'",
            ),
            f"target_encoder={self.target_encoder!r} with successors='model'": (
                self.target_encoder != "none" and self.successors == "model",
                "the model predicts from the online encoder; use successors='sample' or target_encoder='none'",
            ),
            f"loss={self.loss!r} with distance={self.distance!r}": (
                self.loss == "variance_corrected" and self.distance == "huber",
                "it corrects |r_i - r_j|^2, and huber measures rewards differently; use distance='rap'",
            ),
        }
        for settings, (contradict, remedy) in contradictions.items():
            if contradict:
                raise ValueError(f"{settings}: {remedy}.")

    def gaps(
        self,
        z: th.Tensor,
        other_z: th.Tensor,
        rewards: th.Tensor,
        successors: tuple[th.Tensor, th.Tensor | None],
        variance: th.Tensor | None = None,
        n_partners: int | None = None,
    ) -> tuple[Gaps, tuple[th.Tensor, th.Tensor]]:
        """
        Pair the rows of a batch, at random where ``pairs`` is "permutation".

        :param z: (B, n) embeddings of the states i
        :param other_z: (B, n) those of the states j: the same, or the target encoder's
        :param rewards: (B, 1)
        :param successors: mean and standard deviation of what follows, (B, n) each, or None for points
        :param variance: (B, 1) predicted variance of the rewards, or None
        :param n_partners: the first rows, from which "permutation" draws partners; B is a multiple of it. None: all
        :return: the gaps, and the numbers of the rows i and j of each pair, in shapes that broadcast to that of the pairs
        """
        rows = th.arange(len(z), device=z.device)
        if self.pairs == "all":
            i, j = rows[:, None], rows[None]
        else:
            n = n_partners or len(z)
            i, j = rows, th.cat([th.randperm(n, device=z.device) for _ in range(len(z) // n)])
        mean, std = successors
        distance = pairwise_distance(self._first(z), other_z[j], self.distance)
        with th.no_grad():
            reward = pairwise_distance(self._first(rewards), rewards[j], self.distance if self.distance == "huber" else "l1")
            stds = (None, None) if std is None else (self._first(std), std[j])
            between = "l2" if self.distance == "rap" else self.distance  # RAP: W2 between Gaussians
            successor = pairwise_distance(self._first(mean), mean[j], between, *stds)
            both = None if variance is None else self._first(variance) + variance[j]
        return Gaps(distance, reward, successor, both), (i, j)

    def _first(self, x: th.Tensor) -> th.Tensor:
        """Row i of each pair: indexing would copy."""
        return x[:, None] if self.pairs == "all" else x
