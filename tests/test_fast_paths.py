"""Speed that leaves the result alone: nothing waits for the device, products stay exact, bf16 stays in the encoder."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import FakeImageEnv
from torch.distributions import Distribution
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.fast_paths import exact_onednn_matmul, unchecked_distributions

ENV = "robust_bisim/SparseCartPole-v0"
EVERYTHING: dict[str, Any] = dict(
    intrinsic_reward_scale=1.0, inverse_dynamics_coef=1.0, learning_starts=20, batch_size=8, seed=0
)


class Waits(TorchDispatchMode):
    """Counts what reads a tensor's value on the host: `.item()`, `bool(tensor)`, `if tensor`."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += func is th.ops.aten._local_scalar_dense.default
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("dynamics", ["deterministic", "probabilistic"])
@pytest.mark.parametrize("use_sde", [False, True])
def test_no_gradient_step_waits_for_the_device(dynamics: str, use_sde: bool) -> None:
    # a fixed entropy coefficient: Adam keeps the step counts of its default form on the CPU, and reads them there
    model = BisimSAC("MlpPolicy", ENV, ent_coef=0.1, dynamics=dynamics, use_sde=use_sde, **EVERYTHING).learn(20)
    model.train(gradient_steps=1, batch_size=8)  # the accuracy of the processor's products is tested once
    with Waits() as waits:
        model.train(gradient_steps=6, batch_size=8)
    assert waits.count == 0
    with Waits() as waits:
        bool(th.ones(1) > 0)
    assert waits.count == 1  # it does count


def test_the_settings_of_torch_are_restored_also_after_an_error() -> None:
    def fail() -> None:
        with unchecked_distributions(), exact_onednn_matmul(th.device("cpu")):
            assert Distribution._validate_args is False
            raise KeyError

    matmul: Any = th.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = Distribution._validate_args, matmul.fp32_precision
    with pytest.raises(KeyError):
        fail()
    assert (Distribution._validate_args, matmul.fp32_precision) == before


def test_products_keep_the_accuracy_of_fp32() -> None:
    generator = th.Generator().manual_seed(1)
    for shape in ((512, 51, 256), (51, 512, 256), (512, 256, 51), (512, 256, 1), (512, 256, 256)):
        x, w = th.randn(shape[0], shape[1], generator=generator), th.randn(shape[1], shape[2], generator=generator)
        exact = x.double().mm(w.double())
        with exact_onednn_matmul(th.device("cpu")):
            assert (x.mm(w) - exact).norm() / exact.norm() < 1e-6
    assert (x.bfloat16().mm(w.bfloat16()) - exact).norm() / exact.norm() > 1e-3  # what it must not be


def test_bf16_encodes_almost_the_same_and_learns_in_fp32() -> None:
    def make_env() -> gym.Env:
        return FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)

    fp32, bf16 = (BisimSAC("CnnPolicy", make_env(), buffer_size=100, bf16=on, **EVERYTHING) for on in (False, True))
    obs = fp32.policy.obs_to_tensor(np.stack([make_env().observation_space.sample() for _ in range(8)]))[0]
    with th.no_grad():
        exact, rounded = fp32.critic.encode(obs), bf16.critic.encode(obs)
    assert rounded.dtype == th.float32
    assert not th.equal(exact, rounded)
    assert (exact - rounded).norm() / exact.norm() < 0.05
    bf16.learn(30)
    assert {param.dtype for param in bf16.policy.parameters()} == {th.float32}
    assert {param.grad.dtype for param in bf16.critic.parameters() if param.grad is not None} == {th.float32}
