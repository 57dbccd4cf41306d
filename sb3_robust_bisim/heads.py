"""Actor and critic of SAC, which take observations that have been encoded as well."""

from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import Actor

from sb3_robust_bisim.encoders import Encoded, Encoder

# Bounds of the actor's log standard deviation, reached smoothly through a tanh
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0


class BisimActor(Actor):
    """
    SAC's actor, which takes observations that have been encoded as well.

    :param detach_features: whether the encoder belongs to the critic, so that no gradient may reach it from here
    """

    features_extractor: Encoder

    def __init__(self, *args: Any, detach_features: bool = True, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.detach_features = detach_features

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "detach_features": self.detach_features}

    def extract_features(self, obs: PyTorchObs | Encoded, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        with th.set_grad_enabled(th.is_grad_enabled() and not self.detach_features):
            features = self.features_extractor.encode(obs)
        return features.detach() if self.detach_features else features

    def get_action_dist_params(self, obs: PyTorchObs | Encoded) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        latent_pi = self.latent_pi(self.extract_features(obs, self.features_extractor))
        mean_actions = self.mu(latent_pi)
        if self.use_sde:
            return mean_actions, self.log_std, dict(latent_sde=latent_pi)
        log_std = th.tanh(self.log_std(latent_pi))  # type: ignore[operator]
        return mean_actions, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (log_std + 1), {}


class BisimCritic(ContinuousCritic):
    """SAC's critic, owner of the encoder, which takes observations that have been encoded as well."""

    features_extractor: Encoder

    def extract_features(self, obs: PyTorchObs | Encoded, features_extractor: BaseFeaturesExtractor) -> th.Tensor:
        return self.features_extractor.encode(obs)
