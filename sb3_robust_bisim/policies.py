"""SAC's policies with one encoder: the critic owns and trains it, the actor reads its detached output."""

from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples, Schedule
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_robust_bisim.augmentation import random_shift
from sb3_robust_bisim.encoders import CombinedEncoder, Encoded, Encoder, MlpEncoder, PixelEncoder
from sb3_robust_bisim.heads import BisimActor, BisimCritic
from sb3_robust_bisim.latent_models import RELU
from sb3_robust_bisim.objective import Objective
from sb3_robust_bisim.representation import Batch, Representation

INVERSE_DYNAMICS_ADAM = dict(lr=1e-4, weight_decay=1e-5)


class BisimPolicy(SACPolicy):
    """
    Actor, critic, target critic (each critic with its encoder) and the models of the representation.

    Encoder, critic, dynamics and reward model share ONE optimizer, ``critic.optimizer``, since one backward pass serves them
    all. The inverse-dynamics model has a slower one.

    :param objective: what shapes the embedding beside the critic. Set by BisimSAC
    :param bf16: run the encoder under bfloat16 autocast. Set by BisimSAC, likewise ``random_shift``
    :param share_features_extractor: True: the actor reads the critic's encoder and never trains it. False: it has one
        of its own, trained by the actor loss as in SB3's SAC; the metric then shapes the critic's alone
    :param inverse_dynamics_optimizer_kwargs: Adam's arguments for the inverse-dynamics model, which follows no schedule
    :param ortho_init: orthogonal initialisation of all weights, biases 0. False keeps weights that an encoder brings along

    All other parameters are those of :class:`stable_baselines3.sac.policies.SACPolicy`.
    """

    actor: BisimActor
    critic: BisimCritic
    critic_target: BisimCritic
    default_encoder: ClassVar[type[BaseFeaturesExtractor]] = MlpEncoder

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        objective: Objective,
        bf16: bool = False,
        random_shift: int = 0,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = True,
        inverse_dynamics_optimizer_kwargs: dict[str, Any] | None = None,
        ortho_init: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        encoder_class = features_extractor_class or self.default_encoder
        kwargs.setdefault("activation_fn", RELU)
        self.objective = objective
        self.bf16 = bf16
        self.random_shift = random_shift
        self.inverse_dynamics_optimizer_kwargs = {**INVERSE_DYNAMICS_ADAM, **(inverse_dynamics_optimizer_kwargs or {})}
        self.ortho_init = ortho_init
        if optimizer_class in (th.optim.Adam, th.optim.AdamW):
            optimizer_kwargs = _fused(optimizer_kwargs or {})
        if not kwargs.get("normalize_images", True) and issubclass(encoder_class, (PixelEncoder, CombinedEncoder)):
            # SB3 tells only its own extractors that images are floats already
            features_extractor_kwargs = {"normalized_image": True, **(features_extractor_kwargs or {})}
        kwargs |= dict(features_extractor_class=encoder_class, features_extractor_kwargs=features_extractor_kwargs)
        kwargs |= dict(optimizer_class=optimizer_class, optimizer_kwargs=optimizer_kwargs)
        kwargs["share_features_extractor"] = share_features_extractor
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic = self.make_critic()
        self.critic_target = self.make_critic()
        self.actor = self.make_actor(self.critic.features_extractor if self.share_features_extractor else None)
        features_dim, action_dim = self.critic.features_extractor.features_dim, get_action_dim(self.action_space)
        self.representation = Representation(features_dim, action_dim, self.objective)
        if self.ortho_init:
            # frozen weights have been learned before
            self.apply(lambda m: self.init_weights(m, gain=1.0) if all(p.requires_grad for p in m.parameters(False)) else None)
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.set_training_mode(False)

        models = (self.critic, self.representation.dynamics, self.representation.reward_model)
        own = [param for module in models for param in module.parameters()]
        adam: Any = partial(self.optimizer_class, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]
        self.critic.optimizer = adam(own)
        self.actor.optimizer = adam(self.actor_parameters())
        inverse_dynamics = self.representation.inverse_dynamics
        inverse_dynamics.optimizer = th.optim.Adam(
            inverse_dynamics.parameters(), **_fused(self.inverse_dynamics_optimizer_kwargs)
        )

    def encode(self, replay_data: ReplayBufferSamples) -> tuple[ReplayBufferSamples, Batch]:
        """
        Encode a batch, each observation once; images are shifted at random before, if that is asked for.

        :param replay_data: a batch of transitions
        :return: the batch for actor and critics, its observations encoded; and the same for the representation
        """
        encoder, target_encoder = self.critic.features_extractor, self.critic_target.features_extractor
        observations = (replay_data.observations, replay_data.next_observations)
        if self.random_shift:
            observations = tuple(random_shift(images, self.random_shift) for images in observations)  # type: ignore[assignment]
        obs, next_obs = (Encoded(encoder.preprocess(o)) for o in observations)
        z = obs[encoder]
        metric = self.objective.metric
        absorbing = metric.absorbing and self.objective.bisim_coef > 0
        with th.set_grad_enabled(self.objective.inverse_dynamics_coef > 0 or absorbing):
            next_z = next_obs[encoder]
        with th.no_grad():
            target_next_z = next_obs[target_encoder]
            target_z = obs[target_encoder] if metric.target_encoder == "both" else None
        batch = Batch(z, replay_data.actions, replay_data.rewards, replay_data.dones, next_z, target_next_z, target_z)
        return replay_data._replace(observations=obs, next_observations=next_obs), batch  # type: ignore[arg-type]

    @th.no_grad()
    def bonus(self, obs: Any, actions: np.ndarray, next_obs: Any) -> np.ndarray:
        """
        The intrinsic reward of transitions (sec:intrinsic).

        :param obs: observations as the policy takes them, n rows
        :param actions: (n, n_a) in the scale of the action space
        :param next_obs: true successors, n rows
        :return: (n,)
        """
        z, next_z = (self.critic.features_extractor.encode(self.obs_to_tensor(o)[0]) for o in (obs, next_obs))
        scaled = th.as_tensor(self.scale_action(actions), dtype=th.float32, device=self.device).flatten(1)
        return self.representation.bonus(z, scaled, next_z).cpu().numpy()

    def actor_parameters(self) -> list[nn.Parameter]:
        """What the actor loss trains: all of the actor but an encoder that the critic owns, and what has been frozen."""
        shared = set(self.critic.features_extractor.parameters()) if self.share_features_extractor else set()
        return [param for param in self.actor.parameters() if param not in shared and param.requires_grad]

    def make_features_extractor(self) -> Encoder:
        extractor = super().make_features_extractor()
        shape = (self.objective.radius, self.objective.norm_constraint == "sphere")
        return Encoder(extractor, self.observation_space, *shape, self.bf16, self.normalize_images)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> BisimActor:
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return BisimActor(**kwargs, detach_features=self.share_features_extractor).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> BisimCritic:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        # to SB3 a critic that shares the encoder is one that must not train it
        return BisimCritic(**{**kwargs, "share_features_extractor": False}).to(self.device)

    def set_training_mode(self, mode: bool) -> None:
        super().set_training_mode(mode)
        self.representation.train(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = (
            "objective",
            "bf16",
            "random_shift",
            "share_features_extractor",
            "inverse_dynamics_optimizer_kwargs",
            "ortho_init",
        )
        return {**super()._get_constructor_parameters(), **{name: getattr(self, name) for name in own}}


MlpPolicy = BisimPolicy


class CnnPolicy(BisimPolicy):
    """:class:`BisimPolicy` for images: the encoder is :class:`PixelEncoder` by default."""

    default_encoder = PixelEncoder


class MultiInputPolicy(BisimPolicy):
    """:class:`BisimPolicy` for Dict observations: the encoder is :class:`CombinedEncoder` by default."""

    default_encoder = CombinedEncoder


POLICIES: dict[str, type[BasePolicy]] = {"MlpPolicy": MlpPolicy, "CnnPolicy": CnnPolicy, "MultiInputPolicy": MultiInputPolicy}


def _fused(adam_kwargs: dict[str, Any]) -> dict[str, Any]:
    """One kernel for all tensors, which is faster than the default on a CPU; torch also has one for GPUs."""
    return adam_kwargs if {"foreach", "differentiable"} & adam_kwargs.keys() else {"fused": True, **adam_kwargs}
