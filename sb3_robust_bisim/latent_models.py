"""Models of the world in embedding space: dynamics P(z' | z, a), reward r(z') and inverse dynamics g_I(z, z')."""

from functools import partial
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_robust_bisim.losses import project_to_ball

DYNAMICS = ("deterministic", "probabilistic", "ensemble")
ENSEMBLE_SIZE = 5
STD_MIN, STD_MAX = 1e-4, 10.0
REWARD_STD_MAX = 1.0
# In place: one pass over memory and one allocation less for each layer, and the same numbers
RELU: Any = partial(nn.ReLU, inplace=True)
ELU: Any = partial(nn.ELU, inplace=True)


class Prediction(NamedTuple):
    """
    What the dynamics model says of z'.

    :param mean: (K, B, n), inside the ball; one row per model of the ensemble
    :param std: (K, B, n) in [1e-4, 10], or None: the model is deterministic
    """

    mean: th.Tensor
    std: th.Tensor | None

    def moments(self) -> tuple[th.Tensor, th.Tensor | None]:
        """Mean and standard deviation of the equal mixture of the K models, (B, n) each."""
        if self.mean.shape[0] == 1:
            return self.mean[0], None if self.std is None else self.std[0]
        assert self.std is not None
        variance = self.std.square().mean(dim=0) + self.mean.var(dim=0, unbiased=False)
        return self.mean.mean(dim=0), variance.sqrt()


class DynamicsModel(nn.Module):
    """
    Forward model with one hidden layer, LayerNorm and ReLU. Its mean is held inside the ball (eq:constraint).

    :param features_dim: width n of the embedding
    :param action_dim: n_a
    :param kind: "deterministic" (a point mass), "probabilistic" (a diagonal Gaussian) or "ensemble" (5 Gaussians)
    :param radius: radius of the ball, or None for no constraint
    :param hidden_dim: width of the hidden layer
    :raises ValueError: for another ``kind``
    """

    def __init__(self, features_dim: int, action_dim: int, kind: str, radius: float | None, hidden_dim: int = 512) -> None:
        if kind not in DYNAMICS:
            raise ValueError(f"kind={kind!r}: it must be one of {', '.join(DYNAMICS)}.")
        super().__init__()
        self.probabilistic = kind != "deterministic"
        self.radius = radius
        output_dim = 2 * features_dim if self.probabilistic else features_dim
        self.members = nn.ModuleList(
            nn.Sequential(
                *create_mlp(features_dim + action_dim, output_dim, [hidden_dim], RELU, post_linear_modules=[nn.LayerNorm])
            )
            for _ in range(ENSEMBLE_SIZE if kind == "ensemble" else 1)
        )

    def forward(self, z: th.Tensor, actions: th.Tensor) -> Prediction:
        """
        :param z: (B, n)
        :param actions: (B, n_a) in [-1, 1]
        """
        z_actions = th.cat([z, actions], dim=1)
        output = th.stack([member(z_actions) for member in self.members])
        if not self.probabilistic:
            return Prediction(project_to_ball(output, self.radius), None)
        mean, raw_std = output.chunk(2, dim=-1)
        return Prediction(project_to_ball(mean, self.radius), STD_MIN + (STD_MAX - STD_MIN) * raw_std.sigmoid())

    def sample(self, prediction: Prediction) -> th.Tensor:
        """Draw z' from one of the models, picked at random; inside the ball like everything else. (B, n)"""
        member = int(th.randint(len(self.members), (1,))) if len(self.members) > 1 else 0
        mean = prediction.mean[member]
        if prediction.std is None:
            return mean
        return project_to_ball(mean + prediction.std[member] * th.randn_like(mean), self.radius)


class RewardModel(nn.Module):
    """
    r(z') with one hidden layer, LayerNorm and ReLU: a number, or a Gaussian with standard deviation in [1e-4, 1].

    :param features_dim: width n of the embedding
    :param probabilistic: whether the standard deviation is predicted too
    :param hidden_dim: width of the hidden layer
    """

    def __init__(self, features_dim: int, probabilistic: bool = False, hidden_dim: int = 512) -> None:
        super().__init__()
        self.probabilistic = probabilistic
        output_dim = 2 if probabilistic else 1
        layers = create_mlp(features_dim, output_dim, [hidden_dim], RELU, post_linear_modules=[nn.LayerNorm])
        self.net = nn.Sequential(*layers)

    def forward(self, next_z: th.Tensor) -> tuple[th.Tensor, th.Tensor | None]:
        """(B, n) -> (B, 1), and (B, 1) or None"""
        output = self.net(next_z)
        if not self.probabilistic:
            return output, None
        mean, raw_std = output.chunk(2, dim=-1)
        return mean, STD_MIN + (REWARD_STD_MAX - STD_MIN) * raw_std.sigmoid()


class InverseDynamicsModel(nn.Module):
    """
    g_I: the action that led from z to z'; hidden layers of 256 and 128 with ELU.

    :param features_dim: width n of the embedding
    :param action_dim: n_a
    """

    optimizer: th.optim.Optimizer

    def __init__(self, features_dim: int, action_dim: int) -> None:
        super().__init__()
        self.net = nn.Sequential(*create_mlp(2 * features_dim, action_dim, [256, 128], ELU))

    def forward(self, z: th.Tensor, next_z: th.Tensor) -> th.Tensor:
        """(B, n), (B, n) -> (B, n_a)"""
        return self.net(th.cat([z, next_z], dim=1))
