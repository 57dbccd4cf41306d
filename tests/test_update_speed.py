"""Speed that leaves the result alone: nothing waits for the device, bf16 stays in the encoder."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import FakeImageEnv
from torch.distributions import Distribution
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.update_log import unchecked_distributions

ENV = "robust_bisim/SparseCartPole-v0"
EVERYTHING: dict[str, Any] = dict(
    intrinsic_reward_scale=1.0, inverse_dynamics_coef=1.0, learning_starts=20, batch_size=8, seed=0
)


class Reads(TorchDispatchMode):
    """Counts what waits for a value: `.item()`, `bool(tensor)`, also inside PyTorch, and shapes that depend on values."""

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


class Transfers(TorchFunctionMode):
    """Counts transfers of whole tensors to the host, which a tensor on the CPU does not dispatch."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += func in (th.Tensor.cpu, th.Tensor.numpy)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("dynamics", ["deterministic", "probabilistic"])
@pytest.mark.parametrize("use_sde", [False, True])
def test_no_gradient_step_waits_for_the_device(dynamics: str, use_sde: bool) -> None:
    # a fixed entropy coefficient: Adam keeps the step counts of its default form on the CPU, and reads them there
    model = BisimSAC("MlpPolicy", ENV, ent_coef=0.1, dynamics=dynamics, use_sde=use_sde, **EVERYTHING).learn(20)
    with Reads() as reads, Transfers() as transfers:
        model.train(gradient_steps=6, batch_size=8)
    assert reads.count == 0
    assert transfers.count == 1  # at the end, of everything to be logged


@pytest.mark.parametrize("wait", [th.Tensor.item, bool, th.nonzero, lambda x: x[x > 0], th.Tensor.cpu, th.Tensor.numpy])
def test_what_would_wait_is_counted(wait: Callable[[th.Tensor], Any]) -> None:
    with Reads() as reads, Transfers() as transfers:
        wait(th.ones(1))
    assert reads.count + transfers.count > 0


def test_the_settings_of_torch_are_restored_also_after_an_error() -> None:
    def fail() -> None:
        with unchecked_distributions():
            assert Distribution._validate_args is False
            raise KeyError

    before = Distribution._validate_args
    with pytest.raises(KeyError):
        fail()
    assert Distribution._validate_args == before


def test_bf16_encodes_almost_the_same_and_learns_in_fp32() -> None:
    def make_env() -> gym.Env:
        return FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)

    fp32, bf16 = (BisimSAC("CnnPolicy", make_env(), buffer_size=100, bf16=on, **EVERYTHING) for on in (False, True))
    obs = fp32.policy.obs_to_tensor(np.stack([make_env().observation_space.sample() for _ in range(8)]))[0]
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
        BisimSAC("MlpPolicy", ENV, bf16=True, device="cpu")
