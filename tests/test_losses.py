"""Each loss agrees with an independent computation."""

from pathlib import Path

import numpy as np
import ot
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from small_models import EPISODE, events, make_model, parameters, pendulum

from sb3_robust_bisim import losses
from sb3_robust_bisim.callbacks import ValueBoundCallback
from sb3_robust_bisim.latent_models import DYNAMICS, DynamicsModel

SETTINGS = settings(max_examples=50, deadline=None, derandomize=True)


def normal(*shape: int, seed: int = 0) -> th.Tensor:
    return th.as_tensor(np.random.default_rng(seed).normal(size=shape))


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 12))
@SETTINGS
def test_w2_of_diagonal_gaussians_agrees_with_the_optimal_transport_of_pot(seed: int, n: int) -> None:
    mean_i, mean_j, raw_i, raw_j = normal(4, n, seed=seed)
    std_i, std_j = raw_i.exp(), raw_j.exp()
    expected = ot.gaussian.bures_wasserstein_distance(mean_i, mean_j, th.diag(std_i**2), th.diag(std_j**2))
    distance = losses.pairwise_distance(mean_i[None], mean_j[None], "l2", std_i[None], std_j[None])
    assert distance.shape == (1, 1)
    assert distance.item() == pytest.approx(float(expected), rel=1e-6, abs=1e-6)


def test_w2_of_each_coordinate_agrees_with_that_of_one_dimensional_gaussians() -> None:
    mean_i, mean_j, raw_i, raw_j = normal(4, 5)
    std_i, std_j = raw_i.exp(), raw_j.exp()
    expected = [
        float(
            ot.gaussian.bures_wasserstein_distance(*(x.reshape(1) for x in row[:2]), *(x.reshape(1, 1) ** 2 for x in row[2:]))
        )
        for row in zip(mean_i, mean_j, std_i, std_j, strict=True)
    ]
    (means, stds) = (mean_i[None], mean_j[None]), (std_i[None], std_j[None])
    np.testing.assert_allclose(losses.pairwise_distance(*means, "huber", *stds)[0], expected)
    assert losses.pairwise_distance(*means, "l1", *stds).item() == pytest.approx(sum(expected))


def test_w2_of_gaussians_of_equal_spread_is_the_distance_of_the_means() -> None:
    mean_i, mean_j, std = normal(3, 4, 6)
    for distance in ("l1", "l2"):
        w2 = losses.pairwise_distance(mean_i, mean_j, distance, std.exp(), std.exp())
        th.testing.assert_close(w2, losses.pairwise_distance(mean_i, mean_j, distance))


def test_huber_is_elementwise_and_the_norms_reduce_the_embedding() -> None:
    x, y = th.tensor([[0.0, 3.0, 0.5]]), th.zeros(1, 3)
    assert losses.pairwise_distance(x, y, "huber").tolist() == [[0.0, 2.5, 0.125]]
    assert losses.pairwise_distance(x, y, "l1").tolist() == [[3.5]]
    assert losses.pairwise_distance(x, y, "l2").item() == pytest.approx(np.sqrt(9.25))


@given(seed=st.integers(0, 2**32 - 1), radius=st.floats(0.1, 100), scale=st.floats(0.01, 1000))
@SETTINGS
def test_the_projection_ends_in_the_ball_and_keeps_directions_and_interior_points(
    seed: int, radius: float, scale: float
) -> None:
    x = (scale * normal(20, 7, seed=seed)).float()
    x[0] = 0
    projected, norm = losses.project_to_ball(x, radius), x.norm(dim=1)
    assert (projected.double().norm(dim=1) <= radius).all()
    inside = norm <= radius
    assert th.equal(projected[inside], x[inside])
    th.testing.assert_close(projected[~inside], x[~inside] / norm[~inside, None] * radius)
    assert th.equal(losses.project_to_ball(x, None), x)


def test_names_and_radii_without_a_meaning_are_refused() -> None:
    x = th.ones(2, 3)
    with pytest.raises(ValueError, match=r"radius=-1\.0"):
        losses.project_to_ball(x, -1.0)
    with pytest.raises(ValueError, match="distance='chebyshev'"):
        losses.pairwise_distance(x, x, "chebyshev")
    with pytest.raises(ValueError, match="distance='chebyshev'"):
        losses.pairwise_distance(x, x, "chebyshev", x, x)
    with pytest.raises(ValueError, match="kind='gaussian'"):
        DynamicsModel(3, 1, "gaussian", None)


@pytest.mark.parametrize("dynamics", DYNAMICS)
def test_a_distance_works_everywhere_once_distances_holds_its_function(
    dynamics: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new distance is half of l2, so a result of any other function would have the wrong ratio to that of l2."""
    monkeypatch.setitem(losses.DISTANCES, "half of l2", lambda *args: losses.l2(*args) / 2)
    found = []
    for distance in ("l2", "half of l2"):
        folder = tmp_path / distance
        # no reward and no bonus: the metric loss compares distances of embeddings alone
        settings = dict(distance=distance, dynamics=dynamics, intrinsic_reward_scale=0.0, tensorboard_log=str(folder))
        model = make_model(env=pendulum(reward=0.0), **settings)
        model.learn(EPISODE, callback=ValueBoundCallback(n_states=20))  # no update yet, so both models embed alike
        model.logger.close()
        model.train(gradient_steps=1, batch_size=8)
        logged = model.logger.name_to_value
        assert th.isfinite(parameters(model.policy)).all()
        bound = events(folder).Scalars("bisim/value_bound")[0].value
        found.append([bound, logged["bisim/mu_bd"], logged["train/bisim_loss"]])
    np.testing.assert_allclose(np.array(found[1]) / found[0], [0.5, 0.5, 0.25], rtol=1e-5)


def test_on_surface_picks_exactly_the_vectors_that_were_outside() -> None:
    x = th.stack([scale * th.nn.functional.normalize(th.randn(50), dim=0) for scale in (1e-3, 0.99, 0.9999, 1.01, 2.0, 1e3)])
    norm = losses.project_to_ball(7.0 * x, 7.0).norm(dim=1)
    assert losses.on_surface(norm, 7.0).tolist() == [False, False, False, True, True, True]


def test_the_gradient_of_the_projection_is_finite_at_the_origin() -> None:
    x = th.zeros(1, 3, requires_grad=True)
    losses.project_to_ball(x, 1.0).sum().backward()
    assert x.grad.tolist() == [[1.0, 1.0, 1.0]]


@pytest.mark.parametrize(
    ("c_r", "c_t", "reward_range", "radius"),
    [(1.0, 0.99, (0.0, 1.0), 50.0), (0.5, 0.5, (0.0, 1.0), 0.5), (1.0, 0.0, (-2.0, 4.0), 3.0), (2.0, 0.9, (0.0, 1.1), 11.0)],
)
def test_the_radius_follows_from_c_r_c_t_and_the_reward_range(
    c_r: float, c_t: float, reward_range: tuple[float, float], radius: float
) -> None:
    assert losses.ball_radius(c_r, c_t, reward_range) == pytest.approx(radius)


def test_the_dynamics_loss_is_the_gaussian_log_likelihood_and_sends_no_gradient_to_its_target() -> None:
    mean, raw = normal(2, 3, 5, 4)
    target = normal(5, 4, seed=2).requires_grad_()
    expected = -th.distributions.Normal(mean, raw.exp()).log_prob(target).mean() - 0.5 * np.log(2 * np.pi)
    mean.requires_grad_()
    loss = losses.dynamics_loss(mean, raw.exp(), target)
    assert loss.item() == pytest.approx(expected.item())
    assert losses.dynamics_loss(mean, None, target).item() == pytest.approx(0.5 * (mean - target).square().mean().item())
    loss.backward()
    assert mean.grad.abs().sum() > 0
    assert target.grad is None


def test_beta_nll_weights_each_coordinate_by_its_spread() -> None:
    mean, raw = normal(2, 3, 5, 4)
    target, std = normal(5, 4, seed=2), raw.exp().requires_grad_()
    loss = losses.dynamics_loss(mean, std, target, beta=0.5)
    expected = (std.detach() * (0.5 * ((mean - target) / std.detach()).square() + std.detach().log())).mean()
    assert loss.item() == pytest.approx(expected.item())
    loss.backward()
    # the weight carries no gradient: sigma's is that of the likelihood, weighted
    th.testing.assert_close(std.grad, (1 - ((mean - target) / std.detach()).square()) / std.numel())


def test_a_gaussian_reward_is_judged_by_its_likelihood() -> None:
    mean, raw, rewards = normal(3, 6, 1)
    expected = -th.distributions.Normal(mean, raw.exp()).log_prob(rewards).mean() - 0.5 * np.log(2 * np.pi)
    assert losses.reward_loss(mean, raw.exp(), rewards).item() == pytest.approx(expected.item())
    assert losses.reward_loss(mean, None, rewards).item() == pytest.approx((mean - rewards).square().mean().item())


def test_the_inverse_dynamics_loss_is_the_l1_distance_per_action_dimension() -> None:
    predicted, actions = th.tensor([[0.5, -1.0], [0.0, 0.0]]), th.tensor([[0.0, 1.0], [0.0, 1.0]])
    assert losses.inverse_dynamics_loss(predicted, actions).item() == pytest.approx((2.5 / 2 + 1 / 2) / 2)


def test_the_bonus_is_clamped_after_scaling() -> None:
    mean, next_z = th.tensor([[1.0, 0.0], [3.0, 1.0]]), th.zeros(2, 2)
    # eta_r |.|^2 / (2n): 4 * 1 / 4 and 4 * 10 / 4
    assert losses.intrinsic_reward(mean, next_z, scale=4.0, maximum=2.0).tolist() == [1.0, 2.0]
