"""The objectives of the paper, one pure function per equation.

Shapes: ``B`` is the batch size, ``n`` the width of the embedding, ``K`` the number of dynamics models.
"""

from collections.abc import Callable
from typing import Any

import torch as th
from torch.nn import functional as F

ROUNDING = 1e-6  # more than fp32 errs in the norm of an embedding


def ball_radius(c_r: float, c_t: float, reward_range: tuple[float, float]) -> float:
    """
    Radius of the ball that holds every embedding, eq:constraint: half the largest diameter that a bisimulation
    metric can have (lemma:diam).

    The ball is one of the L2 norm whatever the distance, as in the published experiments. So it is l2 distances that it
    keeps within that diameter; l1 distances in it reach sqrt(n) times as far.

    :param c_r: weight of the reward term, c_R >= 0
    :param c_t: weight of the transition term, c_T in [0, 1)
    :param reward_range: (R_min, R_max) per agent step
    :return: c_R (R_max - R_min) / (2 (1 - c_T))
    """
    r_min, r_max = reward_range
    return c_r * (r_max - r_min) / (2 * (1 - c_t))


def project_to_ball(x: th.Tensor, radius: float | None) -> th.Tensor:
    """
    Scale the vectors that lie outside the closed L2 ball onto its surface; leave all others bit for bit as they are.

    The surface is meant up to rounding, from the inside: what comes out is never longer than ``radius``.

    :param x: (..., n)
    :param radius: above 0; None leaves everything as it is
    :return: (..., n)
    :raises ValueError: for a radius of 0 or less
    """
    if radius is None:
        return x
    if radius <= 0:
        raise ValueError(f"radius={radius}: the ball needs a radius above 0, or None for no ball.")
    excess = x.norm(dim=-1, keepdim=True) / radius
    return x / th.where(excess > 1, excess * (1 + ROUNDING), 1.0)


def on_surface(norm: Any, radius: float) -> Any:
    """
    Which vectors lie on the surface of the ball, where :func:`project_to_ball` brings what was outside.

    :param norm: L2 norms of projected vectors, a tensor or an array
    :param radius: of the ball
    :return: booleans in the shape of ``norm``
    """
    return norm > radius * (1 - 2 * ROUNDING)


def huber(x: th.Tensor, y: th.Tensor, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None) -> th.Tensor:
    """
    Elementwise Huber distance, as in the paper's experiments: every coordinate is a distance of its own. Gaussians keep
    their coordinates apart too: each coordinate has its own W2, sqrt(dmu^2 + dsigma^2).
    """
    if x_std is None or y_std is None:
        return F.smooth_l1_loss(x, y, reduction="none")
    return _squared_w2(x, y, x_std, y_std).sqrt()


def l1(x: th.Tensor, y: th.Tensor, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None) -> th.Tensor:
    """L1 norm. The coordinates' W2 are summed: an upper bound of W2 under the L1 ground metric, exact for point masses."""
    if x_std is None or y_std is None:
        return (x - y).norm(p=1, dim=-1, keepdim=True)
    return _squared_w2(x, y, x_std, y_std).sqrt().sum(dim=-1, keepdim=True)


def l2(x: th.Tensor, y: th.Tensor, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None) -> th.Tensor:
    """L2 norm, and the closed form of W2 between diagonal Gaussians, sqrt(|dmu|^2 + |dsigma|^2)."""
    if x_std is None or y_std is None:
        return (x - y).norm(p=2, dim=-1, keepdim=True)
    return _squared_w2(x, y, x_std, y_std).sum(dim=-1, keepdim=True).sqrt()


def _squared_w2(x: th.Tensor, y: th.Tensor, x_std: th.Tensor, y_std: th.Tensor) -> th.Tensor:
    """Squared 2-Wasserstein distance of each coordinate's Gaussians, (B, n)."""
    return (x - y).square() + (x_std - y_std).square()


# What `distance` may name. A new distance is one function of the same signature and one entry here
DISTANCES: dict[str, Callable[..., th.Tensor]] = {"huber": huber, "l1": l1, "l2": l2}


def pairwise_distance(
    x: th.Tensor, y: th.Tensor, distance: str, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None
) -> th.Tensor:
    """
    Distance between matching rows of two batches: of points, or of the diagonal Gaussians around them.

    :param x: (B, n)
    :param y: (B, n)
    :param distance: a key of ``DISTANCES``
    :param x_std: (B, n) standard deviations, None for points; likewise ``y_std``
    :return: (B, n) for "huber", which is elementwise, else (B, 1)
    :raises ValueError: for another distance
    """
    if distance not in DISTANCES:
        raise ValueError(f"distance={distance!r}: it must be one of {', '.join(DISTANCES)}.")
    return DISTANCES[distance](x, y, x_std, y_std)


def bisim_loss(
    z: th.Tensor,
    rewards: th.Tensor,
    mean: th.Tensor,
    std: th.Tensor | None,
    pairs: th.Tensor,
    c_r: float,
    c_t: float,
    distance: str,
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """
    Metric loss, eq:general-bisim-loss: mean over pairs of (d(z_i, z_j) - c_R |r_i - r_j| - c_T W(P_i, P_j))^2.
    The target, reward gap plus transition term, carries no gradient.

    With "huber" the reward gap is the Huber distance too, a (B, 1) column broadcast over the n coordinates.

    :param z: (B, n) embeddings, the only input that receives gradient
    :param rewards: (B, 1)
    :param mean: (B, n) predicted next embeddings
    :param std: (B, n), or None for point masses, where W is the distance between the means
    :param pairs: (B,) row j that is paired with row i
    :return: the loss and, for diagnosis and without gradient, the mean distances mu_bd and mu_rd (eq:reward-dependence2)
    """
    z_distance = pairwise_distance(z, z[pairs], distance)
    with th.no_grad():
        reward_distance = pairwise_distance(rewards, rewards[pairs], distance)
        paired_std = None if std is None else std[pairs]
        target = c_r * reward_distance + c_t * pairwise_distance(mean, mean[pairs], distance, std, paired_std)
    return F.mse_loss(z_distance, target), z_distance.detach().mean(), reward_distance.mean()


def dynamics_loss(mean: th.Tensor, std: th.Tensor | None, target: th.Tensor) -> th.Tensor:
    """
    Negative log-likelihood of the true next embedding, up to a constant, averaged over batch, coordinates and models.

    :param mean: (K, B, n)
    :param std: (K, B, n), or None for sigma = 1
    :param target: (B, n) next embeddings; no gradient flows into them
    """
    error = mean - target.detach()
    if std is None:
        return 0.5 * error.square().mean()
    return (0.5 * (error / std).square() + std.log()).mean()


def inverse_dynamics_loss(predicted_actions: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    J_d = |a - g_I(z, z')|_1 / n_a, mean over the batch.

    :param predicted_actions: (B, n_a)
    :param actions: (B, n_a) in [-1, 1]
    """
    return F.l1_loss(predicted_actions, actions)


def intrinsic_reward(mean: th.Tensor, next_z: th.Tensor, scale: float, maximum: float) -> th.Tensor:
    """
    Forward-prediction bonus of sec:intrinsic: min(R_max_I, eta_r |mu(z, a) - phi(s')|^2 / (2n)), clamped after scaling.

    :param mean: (B, n) predicted next embeddings
    :param next_z: (B, n) embeddings of the true successors
    :param scale: eta_r >= 0
    :param maximum: R_max_I >= 0, in units of reward
    :return: (B,)
    """
    return (0.5 * scale * (mean - next_z).square().mean(dim=-1)).clamp(max=maximum)
