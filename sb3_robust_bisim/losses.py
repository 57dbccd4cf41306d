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
        x, y = th.broadcast_tensors(x, y)  # rewards of all pairs
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


def mico(x: th.Tensor, y: th.Tensor, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None) -> th.Tensor:
    """MICo's diffuse metric, (|x|^2 + |y|^2) / 2 + 0.1 theta(x, y), theta the angle. U(x, x) > 0. Spreads are ignored."""
    return _norms_and_angle(x, y, 0.5, 0.1)


def rap(x: th.Tensor, y: th.Tensor, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None) -> th.Tensor:
    """RAP's |x|^2 + |y|^2 + 1e-6 theta(x, y), theta the angle. Spreads are ignored."""
    return _norms_and_angle(x, y, 1.0, 1e-6)


def cosine(x: th.Tensor, y: th.Tensor, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None) -> th.Tensor:
    """SimSR's 1 - x . y, meant for the unit sphere. Spreads are ignored."""
    return 1 - _dot(x, y)


def _norms_and_angle(x: th.Tensor, y: th.Tensor, norms: float, angle: float) -> th.Tensor:
    x_squared, y_squared = x.square().sum(dim=-1, keepdim=True), y.square().sum(dim=-1, keepdim=True)
    cosine = _dot(x, y) / (x_squared * y_squared).clamp(min=1e-12).sqrt()
    # sqrt has no finite gradient at 0: parallel vectors get none
    squared_sine = 1 - cosine.square()
    sine = th.where(squared_sine > 1e-6, squared_sine, 1.0).sqrt() * (squared_sine > 1e-6)
    return norms * (x_squared + y_squared) + angle * th.atan2(sine, cosine)


def _dot(x: th.Tensor, y: th.Tensor) -> th.Tensor:
    """Inner products of matching rows; for (B, 1, n) and (1, B, n) those of all pairs, as one matrix product."""
    if x.dim() == 3:
        return (x[:, 0] @ y[0].T)[..., None]
    return (x * y).sum(dim=-1, keepdim=True)


# What `distance` may name. A new distance is one function of the same signature and one entry here
DISTANCES: dict[str, Callable[..., th.Tensor]] = {
    **{"huber": huber, "l1": l1, "l2": l2},
    **{"mico": mico, "cosine": cosine, "rap": rap},
}


def pairwise_distance(
    x: th.Tensor, y: th.Tensor, distance: str, x_std: th.Tensor | None = None, y_std: th.Tensor | None = None
) -> th.Tensor:
    """
    Distance between matching rows of two batches: of points, or of the diagonal Gaussians around them.

    :param x: (B, n); or (B, 1, n) where ``y`` is (1, B, n), for all pairs
    :param y: (B, n)
    :param distance: a key of ``DISTANCES``
    :param x_std: (B, n) standard deviations, None for points; likewise ``y_std``
    :return: (B, n) for "huber", which is elementwise, else (B, 1); (B, B, 1) for all pairs
    :raises ValueError: for another distance
    """
    if distance not in DISTANCES:
        raise ValueError(f"distance={distance!r}: it must be one of {', '.join(DISTANCES)}.")
    return DISTANCES[distance](x, y, x_std, y_std)


def dynamics_loss(mean: th.Tensor, std: th.Tensor | None, target: th.Tensor, beta: float = 0.0) -> th.Tensor:
    """
    Negative log-likelihood of the true next embedding, up to a constant, averaged over batch, coordinates and models.

    The likelihood of a Gaussian excuses means that are wrong by a large sigma, and then hardly corrects them. beta-NLL
    (Seitzer et al., 2022) weights each coordinate by sigma^(2 beta), without gradient.

    :param mean: (K, B, n)
    :param std: (K, B, n), or None for sigma = 1
    :param target: (B, n) next embeddings; no gradient flows into them
    :param beta: in [0, 1]; 0 is the likelihood, 1 corrects the means as the squared error does
    """
    error = mean - target.detach()
    if std is None:
        return 0.5 * error.square().mean()
    likelihood = 0.5 * (error / std).square() + std.log()
    return (likelihood * std.detach() ** (2 * beta)).mean() if beta else likelihood.mean()


def reward_loss(mean: th.Tensor, std: th.Tensor | None, rewards: th.Tensor) -> th.Tensor:
    """
    Squared error, or the negative log-likelihood of a Gaussian up to a constant; mean over the batch.

    :param mean: (B, 1)
    :param std: (B, 1), or None for the squared error
    :param rewards: (B, 1)
    """
    return F.mse_loss(mean, rewards) if std is None else (0.5 * ((mean - rewards) / std).square() + std.log()).mean()


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
