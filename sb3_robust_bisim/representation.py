"""What shapes the embedding beside the critic: metric, dynamics, reward and inverse dynamics, with their weights."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_robust_bisim import losses
from sb3_robust_bisim.latent_models import DYNAMICS, DynamicsModel, InverseDynamicsModel, reward_model
from sb3_robust_bisim.losses import DISTANCES


class Batch(NamedTuple):
    """
    Everything that a representation loss may read. ``B`` is the batch size, ``n`` the width of the embedding.

    :param z: (B, n) embeddings of the observations, with gradient
    :param actions: (B, n_a) in [-1, 1]
    :param rewards: (B, 1), the bonus included
    :param dones: (B, 1), 1 where the episode ended by a true termination
    :param next_z: (B, n) embeddings of the successors; with gradient where a loss sends one through them
    :param target_next_z: (B, n) embeddings of the successors by the target encoder, without gradient
    """

    z: th.Tensor
    actions: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor
    next_z: th.Tensor
    target_next_z: th.Tensor


@dataclass
class Objective:
    """
    Settings of the representation, checked when they are made. BisimSAC documents them; c_T is a number here.

    :raises ValueError: for a setting outside its range, or settings that contradict each other
    """

    bisim_coef: float
    c_r: float
    c_t: float
    reward_range: tuple[float, float]
    norm_constraint: bool
    distance: str
    dynamics: str
    model_coef: float | None
    intrinsic_reward_scale: float
    intrinsic_reward_max: float
    inverse_dynamics_coef: float

    def __post_init__(self) -> None:
        for name in ("bisim_coef", "c_r", "intrinsic_reward_scale", "intrinsic_reward_max", "inverse_dynamics_coef"):
            self._require(_is_number(getattr(self, name), 0), name, "a finite number >= 0")
        self._require(_is_number(self.model_weight, 0), "model_coef", "None or a finite number >= 0")
        remedy = "above 0 where bisim_coef or intrinsic_reward_scale needs the dynamics model"
        self._require(self.model_coef != 0 or not self._needs_model, "model_coef", remedy)
        self._require(_is_number(self.c_t, 0) and self.c_t < 1, "c_t", "None (gamma) or in [0, 1), else no metric exists")
        ordered = bool(
            isinstance(self.reward_range, (tuple, list))
            and len(self.reward_range) == 2
            and all(map(_is_number, self.reward_range))
            and self.reward_range[0] < self.reward_range[1]
        )
        self._require(ordered, "reward_range", "(R_min, R_max), finite, with R_min < R_max")
        self._require(isinstance(self.norm_constraint, (bool, np.bool_)), "norm_constraint", "True or False")
        point = self.norm_constraint and self.c_r == 0
        self._require(not point, "c_r", "above 0, or norm_constraint=False: the ball is a point")
        self._require(self.distance in DISTANCES, "distance", f"one of {', '.join(DISTANCES)}")
        self._require(self.dynamics in DYNAMICS, "dynamics", f"one of {', '.join(DYNAMICS)}")

    def _require(self, condition: bool, name: str, remedy: str) -> None:
        if not condition:
            raise ValueError(f"{name}={getattr(self, name)!r}: it must be {remedy}.")

    @property
    def model_weight(self) -> float:
        """Weight of dynamics and reward loss: ``model_coef``, or if that is None 1 where a model is needed, else 0."""
        return float(self._needs_model) if self.model_coef is None else self.model_coef

    @property
    def _needs_model(self) -> bool:
        return self.bisim_coef > 0 or self.intrinsic_reward_scale > 0

    @property
    def radius(self) -> float | None:
        """Radius of the ball that holds the embeddings (eq:constraint), None without ``norm_constraint``."""
        return losses.ball_radius(self.c_r, self.c_t, self.reward_range) if self.norm_constraint else None

    @property
    def ratio_target(self) -> float:
        """c_R / (1 - c_T), where mu_bd / mu_rd converges to (eq:reward-dependence2)."""
        return self.c_r / (1 - self.c_t)


class Representation(nn.Module):
    """
    Dynamics, reward and inverse-dynamics model, and the losses with which they and the metric shape the encoder.

    All models are built whatever the objective, so that every method starts from the same weights for the same seed and
    loads the checkpoints of the others.

    :param features_dim: width n of the embedding
    :param action_dim: n_a
    :param objective: its settings may be changed between two updates, to anneal a weight for example
    """

    def __init__(self, features_dim: int, action_dim: int, objective: Objective) -> None:
        super().__init__()
        self.objective = objective
        self.dynamics = DynamicsModel(features_dim, action_dim, objective.dynamics, objective.radius)
        self.reward_model = reward_model(features_dim)
        self.inverse_dynamics = InverseDynamicsModel(features_dim, action_dim)

    def losses(self, batch: Batch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        What shapes the encoder beside the critic.

        :return: the weighted sum of the losses, and by TensorBoard key each loss without its weight, and the metric's means
        """
        objective = self.objective
        total, logged = batch.z.new_zeros(()), {}
        if objective.bisim_coef > 0 or objective.model_weight > 0:
            prediction = self.dynamics(batch.z, batch.actions)
        if objective.model_weight > 0:
            predicted_rewards = self.reward_model(self.dynamics.sample(prediction))
            logged["train/dynamics_loss"] = losses.dynamics_loss(prediction.mean, prediction.std, batch.next_z)
            logged["train/reward_loss"] = F.mse_loss(predicted_rewards, batch.rewards)
            total = total + objective.model_weight * (logged["train/dynamics_loss"] + logged["train/reward_loss"])
        if objective.bisim_coef > 0:
            mean, std = prediction.moments()
            pairs = th.randperm(len(batch.z), device=batch.z.device)
            logged["train/bisim_loss"], logged["bisim/mu_bd"], logged["bisim/mu_rd"] = losses.bisim_loss(
                batch.z, batch.rewards, mean, std, pairs, objective.c_r, objective.c_t, objective.distance
            )
            total = total + objective.bisim_coef * logged["train/bisim_loss"]
        if objective.inverse_dynamics_coef > 0:
            predicted_actions = self.inverse_dynamics(batch.z, batch.next_z)
            logged["train/inverse_dynamics_loss"] = losses.inverse_dynamics_loss(predicted_actions, batch.actions)
            total = total + objective.inverse_dynamics_coef * logged["train/inverse_dynamics_loss"]
        return total, logged

    def bonus(self, z: th.Tensor, actions: th.Tensor, next_z: th.Tensor) -> th.Tensor:
        """
        The intrinsic reward of transitions (sec:intrinsic).

        :param z: (B, n)
        :param actions: (B, n_a) in [-1, 1]
        :param next_z: (B, n)
        :return: (B,)
        """
        mean, _ = self.dynamics(z, actions).moments()
        objective = self.objective
        return losses.intrinsic_reward(mean, next_z, objective.intrinsic_reward_scale, objective.intrinsic_reward_max)

    def statistics(self, z: th.Tensor) -> dict[str, th.Tensor]:
        """
        What tells a collapse (std and norm near 0) from an explosion (norm without bound) and from a ball that is too small.

        :param z: (B, n)
        :return: by TensorBoard key
        """
        norm = z.norm(dim=1)
        statistics = {
            "bisim/embedding_norm_mean": norm.mean(),
            "bisim/embedding_norm_max": norm.max(),
            "bisim/embedding_std": z.std(dim=0, unbiased=False).mean(),
        }
        if (radius := self.objective.radius) is not None:
            statistics["bisim/clamp_fraction"] = losses.on_surface(norm, radius).float().mean()
        return statistics


def _is_number(value: Any, least: float = -np.inf) -> bool:
    """Whether a value is a finite number (a bool is none) and at least ``least``."""
    return (
        isinstance(value, (int, float, np.number))
        and not isinstance(value, bool)
        and bool(np.isfinite(value) and value >= least)
    )
