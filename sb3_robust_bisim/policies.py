"""SAC's policies with one encoder: the critic owns and trains it, the actor reads its detached output."""

from contextlib import nullcontext
from functools import partial
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_robust_bisim.encoders import CombinedEncoder, MlpEncoder, PixelEncoder
from sb3_robust_bisim.latent_models import DynamicsModel, InverseDynamicsModel, reward_model
from sb3_robust_bisim.losses import project_to_ball

# Bounds of the actor's log standard deviation, reached smoothly through a tanh
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0
INVERSE_DYNAMICS_ADAM = dict(lr=1e-4, weight_decay=1e-5)


def _fused(adam_kwargs: dict[str, Any]) -> dict[str, Any]:
    """One kernel for all tensors: a third of the time of the default, on CPU and GPU alike."""
    return adam_kwargs if {"foreach", "differentiable"} & adam_kwargs.keys() else {"fused": True, **adam_kwargs}


def _preprocess(model: "BisimActor | BisimCritic", obs: PyTorchObs) -> PyTorchObs:
    """SB3's ``preprocess_obs``; under bf16, images for our own encoder come at once as autocast would round them."""
    if model.bf16 and model.normalize_images and type(model.features_extractor) is PixelEncoder:
        assert isinstance(obs, th.Tensor)
        return obs.to(th.bfloat16, copy=True).div_(255)  # 0..255 are exact in bf16
    return preprocess_obs(obs, model.observation_space, model.normalize_images)


def _embed(model: "BisimActor | BisimCritic", preprocessed_obs: PyTorchObs) -> th.Tensor:
    """The encoder's output in fp32 and inside the ball; the encoder itself runs under autocast if asked to."""
    with th.autocast(model.device.type, th.bfloat16) if model.bf16 else nullcontext():
        features = model.features_extractor(preprocessed_obs)
    return project_to_ball(features.float(), model.radius)


class BisimActor(Actor):
    """
    SAC's actor, split where the encoder ends so that a batch encoded once can be given to it.

    :param radius: radius of the ball that holds the embeddings, None for no constraint
    :param bf16: run the encoder under bfloat16 autocast
    :param detach_features: whether the encoder belongs to the critic, so that no gradient may reach it from here
    """

    def __init__(
        self, *args: Any, radius: float | None = None, bf16: bool = False, detach_features: bool = True, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.radius = radius
        self.bf16 = bf16
        self.detach_features = detach_features

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"radius": self.radius, "bf16": self.bf16, "detach_features": self.detach_features}
        return {**super()._get_constructor_parameters(), **own}

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        """For SB3, which hands over the model's own extractor."""
        with th.set_grad_enabled(th.is_grad_enabled() and not self.detach_features):
            return _embed(self, _preprocess(self, obs))

    def features(self, preprocessed_obs: PyTorchObs, z: th.Tensor) -> th.Tensor:
        """
        What the heads read: the critic's embedding, detached, so that nothing is encoded twice; or, with
        ``share_features_extractor=False``, the output of the actor's own encoder.

        :param preprocessed_obs: output of the critic's ``preprocess``
        :param z: (B, n), the critic's embedding of them
        """
        return z.detach() if self.detach_features else _embed(self, preprocessed_obs)

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        return self._dist_params(self.extract_features(obs, self.features_extractor))

    def _dist_params(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        latent_pi = self.latent_pi(features)
        mean_actions = self.mu(latent_pi)
        if self.use_sde:
            return mean_actions, self.log_std, dict(latent_sde=latent_pi)
        log_std = th.tanh(self.log_std(latent_pi))  # type: ignore[operator]
        return mean_actions, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (log_std + 1), {}

    def sample(self, features: th.Tensor) -> th.Tensor:
        """Draw actions in [-1, 1] for features in place of observations: (B, n) -> (B, n_a)"""
        mean_actions, log_std, kwargs = self._dist_params(features)
        return self.action_dist.actions_from_params(mean_actions, log_std, **kwargs)  # type: ignore[arg-type]

    def features_log_prob(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Like ``action_log_prob``, for features in place of observations: (B, n) -> (B, n_a), (B,)"""
        mean_actions, log_std, kwargs = self._dist_params(features)
        return self.action_dist.log_prob_from_params(mean_actions, log_std, **kwargs)


class BisimCritic(ContinuousCritic):
    """
    SAC's critic, owner of the encoder, split where the encoder ends.

    :param radius: radius of the ball that holds the embeddings, None for no constraint
    :param bf16: run the encoder under bfloat16 autocast
    """

    def __init__(self, *args: Any, radius: float | None = None, bf16: bool = False, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.radius = radius
        self.bf16 = bf16

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        """For SB3, which hands over the model's own extractor."""
        return self.encode(obs)

    def preprocess(self, obs: PyTorchObs) -> PyTorchObs:
        """What the encoder reads of observations: floats, images in [0, 1]."""
        return _preprocess(self, obs)

    def embed(self, preprocessed_obs: PyTorchObs) -> th.Tensor:
        """z = phi(s) inside the ball, (B, n), for the output of :meth:`preprocess`."""
        return _embed(self, preprocessed_obs)

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        """z = phi(s) inside the ball, (B, n), for observations."""
        return self.embed(self.preprocess(obs))

    def q_values(self, z: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """One (B, 1) tensor per critic; z (B, n), actions (B, n_a) in [-1, 1]."""
        z_actions = th.cat([z, actions], dim=1)
        return tuple(q_net(z_actions) for q_net in self.q_networks)

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        return self.q_values(self.encode(obs), actions)


class BisimPolicy(SACPolicy):
    """
    Actor, critic, target critic (each critic with its encoder), dynamics, reward and inverse-dynamics model.

    The encoder, the critic, the dynamics and the reward model share ONE optimizer, ``critic.optimizer``, since one
    backward pass serves them all; the inverse-dynamics model has a slower one. All models are always built, so
    that each method of the paper starts from the same weights for the same seed, and loads the others' checkpoints.

    :param radius: radius of the ball (eq:constraint), None for no constraint. Set by BisimSAC, like ``dynamics``
    :param dynamics: "deterministic", "probabilistic" or "ensemble"
    :param bf16: run the encoder under bfloat16 autocast. Set by BisimSAC too
    :param share_features_extractor: True: the actor reads the critic's encoder and never trains it. False: it has one
        of its own, trained by the actor loss as in SB3's SAC; the metric then shapes the critic's alone
    :param inverse_dynamics_optimizer_kwargs: Adam's arguments for the inverse-dynamics model. Its learning rate is
        its own and follows no schedule
    :param ortho_init: orthogonal initialisation of all weights, biases 0. False where ``features_extractor_class`` brings
        weights that it has learned before

    All other parameters are those of :class:`stable_baselines3.sac.policies.SACPolicy`.
    """

    actor: BisimActor
    critic: BisimCritic
    critic_target: BisimCritic

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        features_extractor_class: type[BaseFeaturesExtractor] = MlpEncoder,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = True,
        radius: float | None = None,
        dynamics: str = "deterministic",
        bf16: bool = False,
        inverse_dynamics_optimizer_kwargs: dict[str, Any] | None = None,
        ortho_init: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        self.radius = radius
        self.dynamics_kind = dynamics
        self.bf16 = bf16
        self.inverse_dynamics_optimizer_kwargs = {**INVERSE_DYNAMICS_ADAM, **(inverse_dynamics_optimizer_kwargs or {})}
        self.ortho_init = ortho_init
        optimizer_kwargs = dict(optimizer_kwargs or {})
        if optimizer_class in (th.optim.Adam, th.optim.AdamW):
            optimizer_kwargs = _fused(optimizer_kwargs)
        if not kwargs.get("normalize_images", True) and issubclass(features_extractor_class, (PixelEncoder, CombinedEncoder)):
            # SB3 tells only its own extractors that images are floats already
            features_extractor_kwargs = {"normalized_image": True, **(features_extractor_kwargs or {})}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            share_features_extractor=share_features_extractor,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic = self.make_critic()
        self.critic_target = self.make_critic()
        self.actor = self.make_actor(self.critic.features_extractor if self.share_features_extractor else None)
        n, n_a = self.critic.features_extractor.features_dim, get_action_dim(self.action_space)
        self.dynamics = DynamicsModel(n, n_a, self.dynamics_kind, self.radius)
        self.reward_model = reward_model(n)
        self.inverse_dynamics = InverseDynamicsModel(n, n_a)
        if self.ortho_init:
            self.apply(partial(self.init_weights, gain=1.0))
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.set_training_mode(False)

        learning_rate = lr_schedule(1)
        own = [param for module in (self.critic, self.dynamics, self.reward_model) for param in module.parameters()]
        self.critic.optimizer = self.optimizer_class(own, lr=learning_rate, **self.optimizer_kwargs)  # type: ignore[call-arg]
        self.actor.optimizer = self.optimizer_class(
            self.actor_parameters(),
            lr=learning_rate,  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )
        self.inverse_dynamics.optimizer = th.optim.Adam(
            self.inverse_dynamics.parameters(), **_fused(self.inverse_dynamics_optimizer_kwargs)
        )

    def actor_parameters(self) -> list[nn.Parameter]:
        """What the actor loss trains: all of the actor but an encoder that the critic owns, and what has been frozen."""
        shared = set(self.critic.features_extractor.parameters()) if self.share_features_extractor else set()
        return [param for param in self.actor.parameters() if param not in shared and param.requires_grad]

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> BisimActor:
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        own: dict[str, Any] = dict(radius=self.radius, bf16=self.bf16, detach_features=self.share_features_extractor)
        return BisimActor(**kwargs, **own).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> BisimCritic:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return BisimCritic(**kwargs, radius=self.radius, bf16=self.bf16).to(self.device)

    def set_training_mode(self, mode: bool) -> None:
        super().set_training_mode(mode)
        for model in (self.dynamics, self.reward_model, self.inverse_dynamics):
            model.train(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "share_features_extractor": self.share_features_extractor,
            "radius": self.radius,
            "dynamics": self.dynamics_kind,
            "bf16": self.bf16,
            "inverse_dynamics_optimizer_kwargs": self.inverse_dynamics_optimizer_kwargs,
            "ortho_init": self.ortho_init,
        }


MlpPolicy = BisimPolicy


class CnnPolicy(BisimPolicy):
    """:class:`BisimPolicy` for images: the encoder is :class:`PixelEncoder` by default."""

    def __init__(
        self, *args: Any, features_extractor_class: type[BaseFeaturesExtractor] = PixelEncoder, **kwargs: Any
    ) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class MultiInputPolicy(BisimPolicy):
    """:class:`BisimPolicy` for Dict observations: the encoder is :class:`CombinedEncoder` by default."""

    def __init__(
        self, *args: Any, features_extractor_class: type[BaseFeaturesExtractor] = CombinedEncoder, **kwargs: Any
    ) -> None:
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)
