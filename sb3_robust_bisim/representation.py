"""What shapes the embedding beside the critic: metric, dynamics, reward and inverse dynamics, with their weights."""

from typing import NamedTuple

import torch as th
from torch import nn

from sb3_robust_bisim import losses
from sb3_robust_bisim.latent_models import DynamicsModel, InverseDynamicsModel, Prediction, RewardModel
from sb3_robust_bisim.metrics import METRIC_LOSSES
from sb3_robust_bisim.objective import Objective


class Batch(NamedTuple):
    """
    Everything that a representation loss may read. ``B`` is the batch size, ``n`` the width of the embedding.

    :param z: (B, n) embeddings of the observations, with gradient
    :param actions: (B, n_a) in [-1, 1]
    :param rewards: (B, 1), the bonus included
    :param dones: (B, 1), 1 where the episode ended by a true termination
    :param next_z: (B, n) embeddings of the successors; with gradient where a loss sends one through them
    :param target_next_z: (B, n) embeddings of the successors by the target encoder, without gradient
    :param target_z: (B, n) embeddings of the observations by the target encoder; None where no metric asks for them
    """

    z: th.Tensor
    actions: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor
    next_z: th.Tensor
    target_next_z: th.Tensor
    target_z: th.Tensor | None = None


class Representation(nn.Module):
    """
    Dynamics, reward and inverse-dynamics model, and the losses with which they and the metric shape the encoder.

    All models are built whatever the objective. So methods with the same kind of dynamics start from the same weights for the
    same seed, and load the checkpoints of each other.

    :param features_dim: width n of the embedding
    :param action_dim: n_a
    :param objective: its weights may be changed between two updates (``bisim_coef``, ``model_coef``, ``reward_coef``,
        ``inverse_dynamics_coef`` above 0, ``nll_beta``), as ``model.policy.objective.bisim_coef = 0.1``. Checkpoints keep
        such a change, ``model.save()`` does not
    """

    def __init__(self, features_dim: int, action_dim: int, objective: Objective) -> None:
        super().__init__()
        self.objective = objective
        self.dynamics = DynamicsModel(features_dim, action_dim, objective.dynamics, objective.radius)
        self.reward_model = RewardModel(features_dim, objective.metric.loss == "variance_corrected")
        self.inverse_dynamics = InverseDynamicsModel(features_dim, action_dim)

    def losses(self, batch: Batch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        What shapes the encoder beside the critic.

        :return: the weighted sum of the losses, and by TensorBoard key each loss without its weight, and the metric's means
        """
        objective = self.objective
        total, logged = batch.z.new_zeros(()), {}
        prediction = reward_variance = None
        if max(objective.model_weight, objective.reward_weight) > 0 or objective.needs_model:
            prediction = self.dynamics(batch.z, batch.actions)
            logged["train/dynamics_loss"] = losses.dynamics_loss(
                prediction.mean, prediction.std, batch.next_z, objective.nll_beta
            )
            total = total + objective.model_weight * logged["train/dynamics_loss"]
            if objective.reward_weight > 0:
                predicted_rewards, reward_std = self.reward_model(self.dynamics.sample(prediction))
                logged["train/reward_loss"] = losses.reward_loss(predicted_rewards, reward_std, batch.rewards)
                total = total + objective.reward_weight * logged["train/reward_loss"]
                reward_variance = None if reward_std is None else reward_std.detach().square()
        if objective.bisim_coef > 0:
            bisim_loss, means = self._metric_loss(batch, prediction, reward_variance)
            total = total + objective.bisim_coef * bisim_loss
            logged |= {"train/bisim_loss": bisim_loss, **means}
        if objective.inverse_dynamics_coef > 0:
            predicted_actions = self.inverse_dynamics(batch.z, batch.next_z)
            logged["train/inverse_dynamics_loss"] = losses.inverse_dynamics_loss(predicted_actions, batch.actions)
            total = total + objective.inverse_dynamics_coef * logged["train/inverse_dynamics_loss"]
        return total, logged

    def _metric_loss(
        self, batch: Batch, prediction: Prediction | None, variance: th.Tensor | None
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        :return: the loss and, for diagnosis, mu_bd and mu_rd (eq:reward-dependence2): mean distances of states and rewards
        """
        metric, z, rewards = self.objective.metric, batch.z, batch.rewards
        other_z = z
        if metric.target_encoder == "both":
            assert batch.target_z is not None
            other_z = batch.target_z
        following = batch.next_z.detach() if metric.target_encoder == "none" else batch.target_next_z
        if metric.successors == "sample":
            successors: tuple[th.Tensor, th.Tensor | None] = (following, None)
        else:
            assert prediction is not None
            successors = prediction.moments()
        weights = None
        if metric.absorbing:
            # every successor is a row of its own, which follows itself without reward; only terminal ones count
            weights = th.cat([th.ones_like(batch.dones), batch.dones])
            ends, other_ends = batch.next_z, batch.next_z if other_z is z else batch.target_next_z
            mean, std = successors
            successors = th.cat([mean, following]), None if std is None else th.cat([std, th.zeros_like(std)])
            z, other_z, rewards = th.cat([z, ends]), th.cat([other_z, other_ends]), th.cat([rewards, th.zeros_like(rewards)])
            variance = None if variance is None else th.cat([variance, th.zeros_like(variance)])
        gaps, (i, j) = metric.gaps(z, other_z, rewards, successors, variance, n_partners=len(batch.z))
        losses_of_pairs = METRIC_LOSSES[metric.loss](gaps, metric.c_r, metric.c_t)

        def mean_over_pairs(values: th.Tensor) -> th.Tensor:
            if weights is None:
                return values.mean()
            weight = weights[i] * weights[j]
            return (values * weight).sum() / (weight.sum() * values.shape[-1])

        means = {"bisim/mu_bd": mean_over_pairs(gaps.z.detach()), "bisim/mu_rd": mean_over_pairs(gaps.reward)}
        return mean_over_pairs(losses_of_pairs), means

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
