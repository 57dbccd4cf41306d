"""Updates are fast without a change of results: nothing waits for the device, and bf16 stays in the encoder."""

import re
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from small_models import images, make_model, with_data
from stable_baselines3.common.envs import FakeImageEnv
from torch.distributions import Distribution
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_robust_bisim.encoders import Encoder, PixelEncoder
from sb3_robust_bisim.update_log import unchecked_distributions

DYNAMICS = ("deterministic", "probabilistic")  # an ensemble draws its member on the CPU, which counts as a wait and is none
MICO = dict(successors="sample", target_encoder="both", loss="huber", pairs="all")


class Reads(TorchDispatchMode):
    """Counts operations that wait for a value, even inside PyTorch, such as `.item()` and `bool(tensor)`."""

    WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "unique")

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        masks = (
            [index for index in args[1] if index is not None and index.dtype == th.bool] if "index.Tensor" in str(func) else []
        )
        self.count += bool(masks) or any(name in str(func) for name in self.WAITING)
        return func(*args, **(kwargs or {}))


TRANSFERS = (th.Tensor.cpu, th.Tensor.numpy, th.Tensor.tolist, np.asarray)


class Transfers(TorchFunctionMode):
    """Counts transfers of whole tensors to the host. A tensor on the CPU does not dispatch them."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += func in (th.Tensor.cpu, th.Tensor.numpy, th.Tensor.tolist, th.Tensor.__array__)
        return func(*args, **(kwargs or {}))


SETTINGS: list[dict[str, Any]] = [
    *(dict(dynamics=dynamics, use_sde=use_sde) for dynamics in DYNAMICS for use_sde in (False, True)),
    dict(policy="CnnPolicy", env=images()),
    dict(metric_kwargs=dict(absorbing=True)),
    dict(distance="mico", norm_constraint=False, metric_kwargs=MICO),
    dict(distance="rap", dynamics="probabilistic", metric_kwargs=dict(loss="variance_corrected")),
]


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda settings: ", ".join(map(str, settings)))
def test_no_gradient_step_waits_for_the_device(settings: dict[str, Any]) -> None:
    # the entropy coefficient is fixed because Adam's default form reads its step counts on the CPU
    model = with_data(ent_coef=0.1, **settings)
    with Reads() as reads, Transfers() as transfers:
        model.train(gradient_steps=6, batch_size=8)
    assert reads.count == 0
    assert transfers.count == 1  # one transfer of all logged values at the end


@pytest.mark.parametrize("wait", [th.Tensor.item, bool, th.nonzero, lambda x: x[x > 0], *TRANSFERS])
def test_every_way_of_waiting_is_counted(wait: Callable[[th.Tensor], Any]) -> None:
    with Reads() as reads, Transfers() as transfers:
        wait(th.ones(1))
    assert reads.count + transfers.count > 0


def test_the_settings_of_torch_are_restored_even_after_an_error() -> None:
    def fail() -> None:
        with unchecked_distributions():
            assert Distribution._validate_args is False
            raise KeyError

    before = Distribution._validate_args
    with pytest.raises(KeyError):
        fail()
    assert Distribution._validate_args == before


def test_bf16_encodes_almost_like_fp32_and_learns_in_fp32() -> None:
    fp32, bf16 = (make_model("CnnPolicy", images(), bf16=on) for on in (False, True))
    space = images().observation_space
    obs = fp32.policy.obs_to_tensor(np.stack([space.sample() for _ in range(8)]))[0]
    with th.no_grad():
        exact, rounded = fp32.critic.features_extractor.encode(obs), bf16.critic.features_extractor.encode(obs)
    assert rounded.dtype == th.float32
    assert not th.equal(exact, rounded)
    assert (exact - rounded).norm() / exact.norm() < 0.05
    bf16.learn(30)
    assert {param.dtype for param in bf16.policy.parameters()} == {th.float32}
    assert {param.grad.dtype for param in bf16.critic.parameters() if param.grad is not None} == {th.float32}


def test_bf16_without_the_instructions_is_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: False)
    with pytest.warns(UserWarning, match="bf16=True: this CPU has no bfloat16 instructions"):
        make_model(bf16=True, device="cpu")


def test_bf16_takes_float_images_as_they_are() -> None:
    space = gym.spaces.Box(0, 1, (3, 36, 36), np.float32)
    extractor = PixelEncoder(space, normalized_image=True)
    encoders = [Encoder(extractor, space, None, False, bf16, normalize_images=True) for bf16 in (False, True)]
    obs = th.rand(2, 3, 36, 36)
    assert th.equal(encoders[0].preprocess(obs), encoders[1].preprocess(obs))


@pytest.mark.parametrize(("strides", "convolutions"), [((2, 1), [(2, 2), (1, 1)]), ([3, 2, 1], [(3, 3), (2, 2), (1, 1)])])
def test_the_pixel_encoder_has_one_convolution_for_each_stride(strides: Any, convolutions: list[tuple[int, int]]) -> None:
    model = make_model(
        "CnnPolicy", FakeImageEnv(discrete=False), policy_kwargs=dict(features_extractor_kwargs=dict(strides=strides))
    )
    found = [m.stride for m in model.critic.features_extractor.modules() if isinstance(m, th.nn.Conv2d)]
    assert found == convolutions
    model.learn(12)


@pytest.mark.parametrize("strides", [(0,), (2, -1), (2, 2, 2, 2), (12, 1)])
def test_strides_that_leave_no_pixels_are_refused(strides: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=re.escape(f"strides={strides} with images of shape (1, 12, 12): strides must be")):
        PixelEncoder(gym.spaces.Box(0, 255, (1, 12, 12), np.uint8), strides=strides)
