"""Each loss trains the parameters that it should train and no others."""

from typing import Any

import pytest
import torch as th
from small_models import EPISODE, make_model, parameters
from torch import nn

from sb3_robust_bisim import BisimSAC


def trained(**kwargs: Any) -> Any:
    return make_model(**kwargs).learn(2 * EPISODE)


def nets(model: BisimSAC) -> dict[str, nn.Module]:
    return {
        "encoder": model.critic.features_extractor,
        "q_networks": nn.ModuleList(model.critic.q_networks),
        "critic_target": model.critic_target,
        "actor": nn.ModuleList([model.actor.latent_pi, model.actor.mu, model.actor.log_std]),
        "dynamics": model.policy.representation.dynamics,
        "reward_model": model.policy.representation.reward_model,
        "inverse_dynamics": model.policy.representation.inverse_dynamics,
    }


def with_gradient(model: BisimSAC) -> set[str]:
    """Names of the nets with a gradient other than 0."""
    return {
        name
        for name, net in nets(model).items()
        if any(param.grad is not None and param.grad.abs().sum() > 0 for param in net.parameters())
    }


def all_parameters(model: BisimSAC) -> dict[str, th.Tensor]:
    return {name: parameters(net) for name, net in nets(model).items()}


def moved(model: BisimSAC, before: dict[str, th.Tensor]) -> set[str]:
    """Names of the nets whose parameters have changed."""
    return {name for name, now in all_parameters(model).items() if not th.equal(before[name], now)}


def representation_losses(model: BisimSAC) -> dict[str, th.Tensor]:
    _, batch = model.policy.encode(model.replay_buffer.sample(16))
    _, logged = model.policy.representation.losses(batch)
    model.policy.zero_grad()
    return logged


@pytest.mark.parametrize("dynamics", ["deterministic", "probabilistic", "ensemble"])
@pytest.mark.parametrize(
    ("loss", "moved"),
    [
        ("bisim_loss", {"encoder"}),
        ("dynamics_loss", {"encoder", "dynamics"}),
        ("reward_loss", {"encoder", "dynamics", "reward_model"}),
        ("inverse_dynamics_loss", {"encoder", "inverse_dynamics"}),
    ],
)
def test_each_representation_loss_moves_the_encoder_and_its_own_model(loss: str, moved: set[str], dynamics: str) -> None:
    model = trained(dynamics=dynamics)
    representation_losses(model)[f"train/{loss}"].backward()
    assert with_gradient(model) == moved


def test_the_inverse_loss_reaches_the_encoder_through_both_observations() -> None:
    model = trained()
    _, batch = model.policy.encode(model.replay_buffer.sample(16))
    z, next_z = batch.z.detach().requires_grad_(), batch.next_z.detach().requires_grad_()
    _, logged = model.policy.representation.losses(batch._replace(z=z, next_z=next_z))
    logged["train/inverse_dynamics_loss"].backward()
    assert z.grad.abs().sum() > 0
    assert next_z.grad.abs().sum() > 0


def test_the_actor_loss_leaves_no_gradient_outside_the_actor() -> None:
    model = trained(policy_delay=1)
    before = all_parameters(model)
    # the other optimizers do nothing, so only the actor loss can move parameters
    for optimizer in (model.critic.optimizer, model.policy.representation.inverse_dynamics.optimizer):
        optimizer.step = lambda: None
    model.tau = 0.0
    original = model.actor.optimizer.zero_grad

    def spy() -> None:
        """Runs between the two backward passes and forgets the gradients of the representation losses."""
        model.policy.zero_grad()
        original()

    model.actor.optimizer.zero_grad = spy
    model.train(gradient_steps=1, batch_size=16)
    assert with_gradient(model) == {"actor"}
    assert moved(model, before) == {"actor"}


def test_an_actor_with_its_own_encoder_trains_only_that_encoder() -> None:
    model = trained(policy_kwargs=dict(net_arch=[16], share_features_extractor=False), policy_delay=1)
    original = model.actor.optimizer.zero_grad
    model.actor.optimizer.zero_grad = lambda: (model.policy.zero_grad(), original())[1]
    before = parameters(model.actor.features_extractor)
    model.train(gradient_steps=1, batch_size=16)
    assert with_gradient(model) == {"actor"}
    assert not th.equal(before, parameters(model.actor.features_extractor))


def test_training_moves_everything_and_the_target_follows_by_tau() -> None:
    # steps this large reveal a target that follows by more or less than tau
    model = trained(dynamics="probabilistic", policy_delay=1, tau=0.3, learning_rate=0.01)
    before = all_parameters(model)
    model.train(gradient_steps=1, batch_size=16)
    assert moved(model, before) == nets(model).keys()
    old, new, target = before["critic_target"], parameters(model.critic), parameters(model.critic_target)
    assert (new - old).abs().mean() > 1e-3
    th.testing.assert_close(target, old + model.tau * (new - old), rtol=1e-5, atol=1e-7)


def test_only_sac_and_its_encoder_learn_without_extras() -> None:
    model = trained(bisim_coef=0.0, norm_constraint=False, intrinsic_reward_scale=0.0, inverse_dynamics_coef=0.0)
    before = all_parameters(model)
    model.train(gradient_steps=4, batch_size=16)
    assert moved(model, before) == {"encoder", "q_networks", "critic_target", "actor"}


def test_each_batch_is_encoded_once() -> None:
    model = trained(policy_delay=1)
    passes = {"encoder": 0, "target": 0}

    def count(name: str) -> None:
        passes[name] += 1

    model.critic.features_extractor.register_forward_hook(lambda *_: count("encoder"))
    model.critic_target.features_extractor.register_forward_hook(lambda *_: count("target"))
    model.train(gradient_steps=1, batch_size=16)
    assert passes == {"encoder": 2, "target": 1}  # s and s', and s' by the target
