"""One gradient step agrees with the equations of SAC and of the paper in every term, weight and sign."""

import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import configure

from sb3_robust_bisim import BisimSAC

ENV = "robust_bisim/SparseCartPole-v0"
GAMMA, TAU, LEARNING_RATE, ALPHA, C_R, C_T = 0.9, 0.1, 0.01, 0.2, 2.0, 0.6
BISIM_COEF, MODEL_COEF, INVERSE_DYNAMICS_COEF = 0.3, 0.7, 1.3


def model_with_a_batch(**kwargs: Any) -> tuple[BisimSAC, Any]:
    """A model and one batch of its random transitions. Half of the transitions end an episode."""
    weights = dict(bisim_coef=BISIM_COEF, model_coef=MODEL_COEF, inverse_dynamics_coef=INVERSE_DYNAMICS_COEF)
    # plain gradient descent moves each parameter by its gradient
    policy_kwargs = dict(net_arch=[16], optimizer_class=th.optim.SGD)
    settings: dict[str, Any] = dict(gamma=GAMMA, tau=TAU, c_r=C_R, c_t=C_T, ent_coef=f"auto_{ALPHA}", policy_delay=1)
    settings |= dict(distance="l2", learning_rate=LEARNING_RATE, device="cpu", seed=0, policy_kwargs=policy_kwargs)
    model = BisimSAC("MlpPolicy", ENV, **{**settings, **weights, **kwargs})
    model.set_logger(configure(format_strings=[]))
    rng = np.random.default_rng(0)
    for step in range(64):
        obs, next_obs = rng.standard_normal((2, 1, *model.observation_space.shape))
        action, reward = rng.uniform(-1, 1, (1, 1)), rng.uniform(size=1)
        model.replay_buffer.add(obs, next_obs, action, reward, np.array([step % 2]), [{}])
    with th.no_grad():
        for param in model.critic_target.parameters():
            param.add_(0.1 * th.randn_like(param))  # so that critic and target give different values
    batch = model.replay_buffer.sample(32)
    model.replay_buffer.sample = lambda *args, **kwargs: batch
    return model, batch


def q_values(critic: Any, z: th.Tensor, actions: th.Tensor) -> list[th.Tensor]:
    return [q_net(th.cat([z, actions], dim=1)) for q_net in critic.q_networks]


def descended(loss: th.Tensor, params: list[th.Tensor]) -> list[th.Tensor]:
    return [param - LEARNING_RATE * grad for param, grad in zip(params, th.autograd.grad(loss, params), strict=True)]


def assert_close(actual: Any, expected: Any) -> None:
    th.testing.assert_close(list(actual), list(expected), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("dynamics", ["deterministic", "probabilistic"])
def test_an_update_follows_the_equations(dynamics: str) -> None:
    model, (obs, actions, next_obs, dones, rewards, *_) = model_with_a_batch(dynamics=dynamics)
    old: Any = copy.deepcopy(model.policy)
    th.manual_seed(1)
    model.train(gradient_steps=1)
    logged = model.logger.name_to_value

    th.manual_seed(1)  # actions, next actions, a sample of the model and pairs are drawn in this order
    sampled_actions, log_prob = old.actor.action_log_prob(obs)
    z, next_z = old.critic.features_extractor.encode(obs), old.critic.features_extractor.encode(next_obs)
    with th.no_grad():
        next_actions, next_log_prob = old.actor.action_log_prob(next_obs)
        next_q = th.minimum(*old.critic_target(next_obs, next_actions)) - ALPHA * next_log_prob[:, None]
        target = rewards + GAMMA * (1 - dones) * next_q
    critic_loss = sum((q - target).square().mean() for q in old.critic(obs, actions))
    mean, std = (None if moment is None else moment[0] for moment in old.representation.dynamics(z, actions))
    sampled, spread, error = mean, 0.0, (mean - next_z.detach()).square() / 2
    if std is not None:
        sampled = mean + std * th.randn_like(mean)
        sampled = sampled * (model.radius / sampled.norm(dim=1, keepdim=True)).clamp(max=1)
        error = std.detach() ** 2 * (error / std.square() + std.log())  # beta-NLL with beta = 1
    dynamics_loss, reward_loss = error.mean(), (old.representation.reward_model(sampled)[0] - rewards).square().mean()
    other = th.randperm(len(z))
    if std is not None:
        spread = (std - std[other]).square().sum(dim=1)
    gap = (mean - mean[other]).square().sum(dim=1).add(spread).sqrt()
    wanted = (C_R * (rewards - rewards[other]).abs()[:, 0] + C_T * gap).detach()
    bisim_loss = ((z - z[other]).norm(dim=1) - wanted).square().mean()  # norm is safe for rows that are paired with themselves
    inverse_dynamics_loss = (old.representation.inverse_dynamics(z, next_z) - actions).abs().mean()
    names = ("critic_loss", "dynamics_loss", "reward_loss", "bisim_loss", "inverse_dynamics_loss")
    terms = (critic_loss, dynamics_loss, reward_loss, bisim_loss, inverse_dynamics_loss)
    for name, term in zip(names, terms, strict=True):
        assert logged[f"train/{name}"] == pytest.approx(term.item(), rel=1e-4), name

    total = critic_loss + MODEL_COEF * (dynamics_loss + reward_loss) + BISIM_COEF * bisim_loss
    total = total + INVERSE_DYNAMICS_COEF * inverse_dynamics_loss
    trained = [[*policy.critic.parameters(), *policy.representation.dynamics.parameters()] for policy in (model.policy, old)]
    assert_close(trained[0], descended(total, trained[1]))

    # the actor loss uses the new critics on embeddings of the old encoder
    q = th.minimum(*q_values(model.critic, z.detach(), sampled_actions))
    actor_loss = (ALPHA * log_prob[:, None] - q).mean()
    assert logged["train/actor_loss"] == pytest.approx(actor_loss.item(), rel=1e-4)
    assert_close(model.policy.actor_parameters(), descended(actor_loss, old.actor_parameters()))

    # more entropy than the target lowers its weight. SB3 trains the logarithm by Adam, whose first step is the sign
    surplus = (-log_prob.mean() - model.target_entropy).item()
    assert logged["train/ent_coef_loss"] == pytest.approx(np.log(ALPHA) * surplus, rel=1e-4)
    assert model.log_ent_coef.item() == pytest.approx(np.log(ALPHA) - LEARNING_RATE * np.sign(surplus), rel=1e-4)

    followed = [
        (1 - TAU) * a + TAU * b for a, b in zip(old.critic_target.parameters(), model.critic.parameters(), strict=True)
    ]
    assert_close(model.critic_target.parameters(), followed)
