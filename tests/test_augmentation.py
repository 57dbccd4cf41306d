"""Random shift: against a slow reference, per sample, for s and s' apart, and never when acting."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import dicts, images, make_model, pendulum
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.augmentation import _by_copy, _by_index, random_shift


@pytest.mark.parametrize("dtype", [th.uint8, th.float32])
def test_each_image_is_a_window_of_its_padded_self(dtype: th.dtype) -> None:
    batch, pad = (255 * th.rand(20, 6, 9, 7)).to(dtype), 3
    shifted = random_shift(batch, pad)
    assert shifted.dtype == dtype
    offsets = set()
    for image, found in zip(batch.numpy(), shifted.numpy(), strict=True):
        padded = np.pad(image, ((0, 0), (pad, pad), (pad, pad)), mode="edge")
        windows = {
            (top, left): padded[:, top : top + 9, left : left + 7] for top in range(2 * pad + 1) for left in range(2 * pad + 1)
        }
        (offset,) = [offset for offset, window in windows.items() if np.array_equal(window, found)]
        offsets.add(offset)
    assert len(offsets) > 10


def test_every_offset_is_equally_likely_in_both_directions() -> None:
    batch = th.arange(5, dtype=th.uint8).repeat(4000, 1, 5, 1)
    centre = random_shift(batch, 2)[:, 0, 2, 2]  # the column that is now in the middle
    np.testing.assert_allclose(th.bincount(centre.long()) / 4000, 0.2, atol=0.03)


def test_a_gpu_would_cut_the_same_windows() -> None:
    batch, offsets = (255 * th.rand(20, 6, 9, 7)).to(th.uint8), th.randint(-6, 7, (20, 2))
    by_copy, by_index = (cut(batch, offsets) for cut in (_by_copy, _by_index))
    assert th.equal(by_index, by_copy)
    assert by_index.is_contiguous(memory_format=th.channels_last)
    assert by_copy.is_contiguous(memory_format=th.channels_last)


def test_no_padding_changes_nothing() -> None:
    batch = (255 * th.rand(4, 3, 6, 6)).to(th.uint8)
    assert th.equal(random_shift(batch, 0), batch)


def test_training_shifts_both_observations_apart_and_acting_does_not() -> None:
    model = make_model("CnnPolicy", images(), random_shift=4).learn(12)
    seen: list[th.Tensor] = []
    model.critic.features_extractor.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0].clone()))
    data = model.replay_buffer.sample(8)
    same = data._replace(next_observations=data.observations)
    model.policy.encode(same)
    original = data.observations.float() / 255
    assert not th.equal(seen[0], original)
    assert not th.equal(seen[1], original)
    assert not th.equal(seen[0], seen[1])
    seen.clear()
    model.predict(data.observations.numpy())
    assert th.equal(seen[0], original)


class Views(BaseFeaturesExtractor):
    """As users write one: `view` needs the usual order in memory."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, 50)
        self.linear = th.nn.Linear(int(np.prod(observation_space.shape)), 50)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.linear(observations.view(len(observations), -1))


def test_other_encoders_get_shifted_images_in_the_usual_order_in_memory() -> None:
    env = FakeImageEnv(screen_height=12, screen_width=12, n_channels=3, discrete=False)
    make_model("CnnPolicy", env, random_shift=4, policy_kwargs=dict(features_extractor_class=Views)).learn(12)


def test_without_a_shift_the_batch_stays_as_it_is() -> None:
    model = make_model("CnnPolicy", images()).learn(12)
    data = model.replay_buffer.sample(8)
    encoded, _ = model.policy.encode(data)
    assert th.equal(encoded.observations.preprocessed, data.observations.float() / 255)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(random_shift=-1), "random_shift=-1: it must be an integer in"),
        (dict(random_shift=1.5), r"random_shift=1\.5: it must be an integer in"),
        (dict(random_shift=12), r"random_shift=12: it must be an integer in \[0, 11\]"),
        (dict(random_shift=4, policy="MlpPolicy", env=pendulum()), "random_shift=4 .* it needs images"),
        (dict(random_shift=4, policy="MultiInputPolicy", env=dicts()), "random_shift=4"),
    ],
)
def test_a_shift_that_makes_no_sense_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(**{"policy": "CnnPolicy", "env": images(), **arguments})


def test_the_setting_survives_saving(tmp_path: Any) -> None:
    make_model("CnnPolicy", images(), random_shift=2).save(tmp_path / "model")
    assert BisimSAC.load(tmp_path / "model", env=images()).policy.random_shift == 2
