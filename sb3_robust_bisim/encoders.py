"""Encoders phi: observation -> embedding z. Any features extractor may be one; :class:`Encoder` makes it so."""

import math
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_robust_bisim.losses import project_to_ball

LEAKY_RELU: Any = partial(nn.LeakyReLU, inplace=True)


class Encoder(BaseFeaturesExtractor):
    """
    phi: a features extractor, with what happens before it (cast, autocast) and after it (projection onto the ball).

    :param extractor: gives the features, (B, n)
    :param observation_space: what it reads
    :param radius: of the ball that holds the embeddings, None for no constraint
    :param sphere: scale all embeddings to length 1 instead
    :param bf16: run the extractor under bfloat16 autocast
    :param normalize_images: whether images are to be divided by 255
    """

    def __init__(
        self,
        extractor: BaseFeaturesExtractor,
        observation_space: spaces.Space,
        radius: float | None,
        sphere: bool,
        bf16: bool,
        normalize_images: bool,
    ) -> None:
        super().__init__(observation_space, extractor.features_dim)
        self.extractor = extractor
        self.radius = radius
        self.sphere = sphere
        self.bf16 = bf16
        self.normalize_images = normalize_images
        self.of_bytes = normalize_images and is_image_space(observation_space)

    def __getattr__(self, name: str) -> Any:
        """Attributes of the extractor are found here too, as code written for SB3 expects."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("extractor"), name)

    def encode(self, obs: "PyTorchObs | Encoded") -> th.Tensor:
        """z = phi(s) in fp32 and inside the ball, (B, n). What has been encoded before is looked up."""
        return obs[self] if isinstance(obs, Encoded) else self(self.preprocess(obs))

    def preprocess(self, obs: PyTorchObs) -> PyTorchObs:
        """Floats, images in [0, 1]. Images for our own extractor come in its memory format, and under bf16 at once rounded."""
        if self.of_bytes and type(self.extractor) is PixelEncoder:
            assert isinstance(obs, th.Tensor)
            dtype = th.bfloat16 if self.bf16 else th.float32  # 0..255 are exact in both
            return obs.contiguous(memory_format=th.channels_last).to(dtype, copy=True).div_(255)
        if isinstance(obs, th.Tensor):
            obs = obs.contiguous()  # others may use views, and images that have been shifted are channels last
        return preprocess_obs(obs, self._observation_space, self.normalize_images)

    def forward(self, preprocessed: PyTorchObs) -> th.Tensor:
        """:param preprocessed: output of :meth:`preprocess`"""
        device = next(iter(preprocessed.values())).device if isinstance(preprocessed, dict) else preprocessed.device
        with th.autocast(device.type, th.bfloat16) if self.bf16 else nullcontext():
            features = self.extractor(preprocessed)
        features = features.float()
        return F.normalize(features, dim=-1) if self.sphere else project_to_ball(features, self.radius)


class Encoded(dict[Encoder, th.Tensor]):
    """
    Observations that actor and critics take in place of tensors: each encoder encodes them once, when it is first asked for.

    :param preprocessed: output of ``Encoder.preprocess``, the same for all encoders of a policy
    """

    def __init__(self, preprocessed: PyTorchObs) -> None:
        super().__init__()
        self.preprocessed = preprocessed

    def __missing__(self, encoder: Encoder) -> th.Tensor:
        self[encoder] = encoder(self.preprocessed)
        return self[encoder]


class MlpEncoder(BaseFeaturesExtractor):
    """
    Encoder for flat observations: linear layers of one width with LeakyReLU between them.

    :param observation_space: anything that flattens
    :param features_dim: width n of the embedding and of the hidden layers
    :param n_layers: linear layers, at least 1
    :param layer_norm: normalise the embedding (and each hidden layer)
    :raises ValueError: for ``n_layers`` below 1
    """

    def __init__(
        self, observation_space: spaces.Space, features_dim: int = 50, n_layers: int = 3, layer_norm: bool = False
    ) -> None:
        if n_layers < 1:
            raise ValueError(f"n_layers={n_layers}: an encoder needs at least one layer.")
        super().__init__(observation_space, features_dim)
        input_dim = get_flattened_obs_dim(observation_space)
        self.net = nn.Sequential(nn.Flatten(), *_mlp(input_dim, features_dim, n_layers, layer_norm))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.net(observations)


class PixelEncoder(BaseFeaturesExtractor):
    """
    Encoder for images: convolutions of 32 filters 3x3 with ReLU, linear to n, LayerNorm. The paper's has strides 2 and 1.

    :param observation_space: channel-first image stack, (C, H, W)
    :param features_dim: width n of the embedding
    :param strides: one convolution for each. Larger strides first make it cheaper: (3, 2, 1) costs a third of (2, 1)
    :param layer_norm: normalise the embedding
    :param normalized_image: whether the space holds floats in [0, 1] already, see SB3's NatureCNN
    :raises ValueError: for a space without images or with the channels last, or if its images are too small for ``strides``
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 50,
        strides: Sequence[int] = (2, 1),
        layer_norm: bool = True,
        normalized_image: bool = False,
    ) -> None:
        if not is_image_space(observation_space, check_channels=False, normalized_image=normalized_image):
            raise ValueError(
                f"CnnPolicy needs images, the observation space is {observation_space}: use MlpPolicy, or MultiInputPolicy "
                "for a Dict. For images that are floats already, put the channels first and pass "
                "policy_kwargs=dict(normalize_images=False)."
            )
        super().__init__(observation_space, features_dim)
        channels, *size = observation_space.shape
        if size[1] < min(channels, size[0]):  # SB3 puts the channels of byte images first, and leaves floats as they are
            raise ValueError(
                f"CnnPolicy needs images with the channels first, the observation space is {observation_space}. Transpose "
                "them, for example with gymnasium.wrappers.TransformObservation."
            )
        convs: list[nn.Module] = []
        for stride in strides:
            if stride < 1 or min(size) < 3:
                raise ValueError(
                    f"strides={tuple(strides)} with images of shape {observation_space.shape}: strides must be at least 1, "
                    "and each convolution needs 3 pixels. Take fewer or smaller strides, or larger images."
                )
            convs += [nn.Conv2d(channels, 32, kernel_size=3, stride=stride), nn.ReLU(inplace=True)]
            channels, size = 32, [(pixels - 3) // stride + 1 for pixels in size]
        self.convs = nn.Sequential(*convs, nn.Flatten())
        norm = nn.LayerNorm(features_dim) if layer_norm else nn.Identity()
        self.head = nn.Sequential(nn.Linear(channels * math.prod(size), features_dim), norm)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        # With the channels side by side in memory, convolutions are up to twice as fast on CPUs, and on GPUs under autocast
        return self.head(self.convs(observations.to(memory_format=th.channels_last)))


class CombinedEncoder(BaseFeaturesExtractor):
    """
    Encoder for Dict observations: SB3's CombinedExtractor, then an MLP down to the embedding.

    :param observation_space: Dict of images and flat spaces
    :param features_dim: width n of the embedding
    :param cnn_output_dim: features per image
    :param normalized_image: whether images are floats in [0, 1] already
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        features_dim: int = 50,
        cnn_output_dim: int = 256,
        normalized_image: bool = False,
    ) -> None:
        super().__init__(observation_space, features_dim)
        self.combined = CombinedExtractor(observation_space, cnn_output_dim, normalized_image)
        self.head = nn.Sequential(*_mlp(self.combined.features_dim, features_dim, n_layers=3, layer_norm=False))

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return self.head(self.combined(observations))


def _mlp(input_dim: int, width: int, n_layers: int, layer_norm: bool) -> list[nn.Module]:
    norm = [nn.LayerNorm] if layer_norm else []
    layers = create_mlp(input_dim, -1, [width] * n_layers, LEAKY_RELU, post_linear_modules=norm)  # type: ignore[arg-type]
    return layers[:-1]  # the embedding itself is linear (or normalised)
