"""Who trains what: each loss moves the parameters it should and no others."""

from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_robust_bisim import BisimSAC

ENV = "robust_bisim/SparseCartPole-v0"
EVERYTHING: dict[str, Any] = dict(intrinsic_reward_scale=1.0, inverse_dynamics_coef=1.0)
SMALL: dict[str, Any] = dict(learning_starts=10, batch_size=16, seed=0, policy_kwargs=dict(net_arch=[16]))


def trained(**kwargs: object) -> BisimSAC:
    return BisimSAC("MlpPolicy", ENV, **{**EVERYTHING, **SMALL, **kwargs}).learn(20)


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
    """Names of the nets that hold a gradient other than 0."""
    return {
        name
        for name, net in nets(model).items()
        if any(param.grad is not None and param.grad.abs().sum() > 0 for param in net.parameters())
    }


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
    before = {name: [param.clone() for param in net.parameters()] for name, net in nets(model).items()}
    # the other optimizers stand still: whatever moves was moved by the actor loss
    for optimizer in (model.critic.optimizer, model.policy.representation.inverse_dynamics.optimizer):
        optimizer.step = lambda: None
    model.tau = 0.0
    original = model.actor.optimizer.zero_grad

    def spy() -> None:
        """Between the two backward passes: forget what the representation losses left."""
        model.policy.zero_grad()
        original()

    model.actor.optimizer.zero_grad = spy
    model.train(gradient_steps=1, batch_size=16)
    assert with_gradient(model) == {"actor"}
    moved = {
        name
        for name, net in nets(model).items()
        if any(not th.equal(old, new) for old, new in zip(before[name], net.parameters(), strict=True))
    }
    assert moved == {"actor"}


def test_an_actor_with_its_own_encoder_trains_that_one_alone() -> None:
    model = trained(policy_kwargs=dict(net_arch=[16], share_features_extractor=False), policy_delay=1)
    original = model.actor.optimizer.zero_grad
    model.actor.optimizer.zero_grad = lambda: (model.policy.zero_grad(), original())[1]
    own_before = [param.clone() for param in model.actor.features_extractor.parameters()]
    model.train(gradient_steps=1, batch_size=16)
    assert with_gradient(model) == {"actor"}
    assert any(
        not th.equal(old, new) for old, new in zip(own_before, model.actor.features_extractor.parameters(), strict=True)
    )


def test_training_moves_everything_and_the_target_follows() -> None:
    model = trained(dynamics="probabilistic", policy_delay=1)
    before = {name: [param.clone() for param in net.parameters()] for name, net in nets(model).items()}
    model.train(gradient_steps=1, batch_size=16)
    for name, net in nets(model).items():
        assert any(not th.equal(old, new) for old, new in zip(before[name], net.parameters(), strict=True)), name
    after = list(model.critic.parameters())
    for old, new, target in zip(before["critic_target"], after, model.critic_target.parameters(), strict=True):
        th.testing.assert_close(target, old + model.tau * (new - old))


def test_without_extras_only_sac_and_its_encoder_learn() -> None:
    model = trained(bisim_coef=0.0, norm_constraint=False, intrinsic_reward_scale=0.0, inverse_dynamics_coef=0.0)
    models = ("dynamics", "reward_model", "inverse_dynamics")
    before = {name: [param.clone() for param in nets(model)[name].parameters()] for name in (*models, "encoder")}
    model.train(gradient_steps=4, batch_size=16)
    for name in models:
        assert all(th.equal(old, new) for old, new in zip(before[name], nets(model)[name].parameters(), strict=True)), name
    assert any(not th.equal(old, new) for old, new in zip(before["encoder"], nets(model)["encoder"].parameters(), strict=True))


def test_each_batch_is_encoded_once() -> None:
    model = trained(policy_delay=1)
    passes = {"encoder": 0, "target": 0}

    def count(name: str) -> None:
        passes[name] += 1

    model.critic.features_extractor.register_forward_hook(lambda *_: count("encoder"))
    model.critic_target.features_extractor.register_forward_hook(lambda *_: count("target"))
    model.train(gradient_steps=1, batch_size=16)
    assert passes == {"encoder": 2, "target": 1}  # s and s', and s' by the target
