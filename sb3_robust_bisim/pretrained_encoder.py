"""The encoder of an exported agent as a features extractor of any other algorithm."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_robust_bisim import agent_files
from sb3_robust_bisim.encoders import Encoder

PREFIX = "critic.features_extractor.extractor."


class PretrainedEncoder(BaseFeaturesExtractor):
    """
    phi of an agent that :func:`sb3_robust_bisim.export_agent` wrote, with its projection onto the ball.

    A saved model of the other algorithm stores ``path``, not the files. Where they lie elsewhere, pass
    ``custom_objects=dict(policy_kwargs=...)`` with the new path to its ``load``.

    Nothing in its files is executed or imported. No initialisation of a policy, such as PPO's orthogonal one, changes its
    weights.

    :param observation_space: must be the space that the agent was trained with
    :param path: folder with ``weights.safetensors`` and ``config.json``
    :param freeze: True: the weights stay as they are, no gradient is computed, and layers such as dropout stay in evaluation
        mode. False: they are trained further
    :param features_extractor_class: the class of the encoder, if it is your own
    :param features_extractor_kwargs: replace the exported arguments of that class
    :raises FileNotFoundError: without one of the files
    :raises ValueError: for another space, a damaged or foreign file, an unknown class in it, or weights that do not fit or are
        not finite

    Example::

        encoder = dict(features_extractor_class=PretrainedEncoder, features_extractor_kwargs=dict(path="agent"))
        model = PPO("MlpPolicy", env, policy_kwargs=encoder)
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        path: str | Path,
        freeze: bool = True,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
    ) -> None:
        file = Path(path) / agent_files.CONFIG
        config, weights = agent_files.read(Path(path))
        exported_space = agent_files.space_from_json(config["observation_space"], file)
        if observation_space != exported_space:
            raise ValueError(
                f"observation_space={observation_space}: the encoder in {path} was trained with {exported_space}. Use the "
                "same observations, or another encoder."
            )
        own = dict(features_extractor_class=features_extractor_class, features_extractor_kwargs=features_extractor_kwargs)
        own = {name: value for name, value in own.items() if value is not None}
        settings = agent_files.settings_from_json(config["encoder"], own, file, "PretrainedEncoder(..., {})")
        images = [key for key, space in _parts(observation_space).items() if is_image_space(space)]
        if images and not settings["normalize_images"]:
            raise ValueError(
                f"{file}: normalize_images=False with images of bytes. SB3's policies divide those by 255, and the encoder "
                "was trained without. Train an encoder with normalize_images=True."
            )
        extractor_class, extractor_kwargs = (settings.pop(f"features_extractor_{name}") for name in ("class", "kwargs"))
        try:
            extractor = extractor_class(exported_space, **extractor_kwargs)
        except Exception as error:
            raise ValueError(f"{file}: no encoder can be built from this ({error!r}). Export again.") from error
        super().__init__(observation_space, extractor.features_dim)
        ours = {name.removeprefix(PREFIX): tensor for name, tensor in weights.items() if name.startswith(PREFIX)}
        agent_files.fill(agent_files.weights_of(extractor), ours, Path(path) / agent_files.WEIGHTS)
        self.encoder = Encoder(extractor, observation_space, **settings)
        self.freeze = freeze
        self.images = images
        self._scale_seen = False
        self.requires_grad_(not freeze)
        self.train(self.training)

    def apply(self, fn: Callable[[nn.Module], None]) -> Self:
        """Do nothing: policies initialise weights this way, and these have been learned."""
        return self

    def train(self, mode: bool = True) -> Self:
        """Like that of any module, but a frozen encoder stays in evaluation mode."""
        return super().train(mode and not self.freeze)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: as SB3's policies pass them on, images divided by 255; or as environments give them
        :return: z inside the ball, (B, n)
        :raises ValueError: for images of floats above 1 in the first batch that is not black
        """
        tensors = _parts(observations)
        with th.set_grad_enabled(th.is_grad_enabled() and not self.freeze):
            if not all(tensor.is_floating_point() for tensor in tensors.values()):
                return self.encoder.encode(observations)
            if not self._scale_seen:
                self._check_scale([tensors[key] for key in self.images])
            return self.encoder(observations)

    def _check_scale(self, images: list[th.Tensor]) -> None:
        """Until a batch is not black, because each look at the values waits for the device."""
        largest = max((float(image.max()) for image in images), default=1.0)
        if largest > 1:
            raise ValueError(f"observations: pixels up to {largest}, not in [0, 1]. Use normalize_images=True.")
        self._scale_seen = largest > 0


def _parts(whole: Any) -> dict[str, Any]:
    """The parts of a Dict, or the whole under an empty name; of spaces and of observations."""
    return dict(whole.items()) if isinstance(whole, (dict, spaces.Dict)) else {"": whole}
