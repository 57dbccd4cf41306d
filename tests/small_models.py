"""The small BisimSAC of the tests, its small environments, and what several test files ask about a model."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from sb3_robust_bisim import BisimSAC

EPISODE = 10
# Small nets and buffers; training starts after one episode
SMALL: dict[str, Any] = dict(policy_kwargs=dict(net_arch=[16]), learning_starts=EPISODE, batch_size=8, buffer_size=100, seed=0)
# The parts of the method that are off by default
EVERYTHING: dict[str, Any] = dict(intrinsic_reward_scale=1.0, inverse_dynamics_coef=1.0)


class StopAt(BaseCallback):
    """Ends training at a step, by its return value or by an error."""

    def __init__(self, step: int, error: type[BaseException] | None = None) -> None:
        super().__init__()
        self.step, self.error = step, error

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.step and self.error is not None:
            raise self.error
        return self.num_timesteps < self.step


class NormDropout(BaseFeaturesExtractor):
    """An encoder that behaves differently in training."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, observation_space.shape[0])
        self.norm = nn.BatchNorm1d(observation_space.shape[0])
        self.net = nn.Sequential(nn.Flatten(), self.norm, nn.Dropout(0.5))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.net(observations)


def pendulum(reward: float | None = None) -> gym.Env:
    """Actions in [-2, 2]. Short episodes that end by time-out, in which every step pays ``reward`` if one is given."""
    env = gym.make("Pendulum-v1", max_episode_steps=EPISODE)
    return env if reward is None else gym.wrappers.TransformReward(env, lambda _: reward)


def images() -> gym.Env:
    """Random grey images of 12 x 12 pixels, channel last."""
    return FakeImageEnv(screen_height=12, screen_width=12, n_channels=1, discrete=False)


def dicts() -> gym.Env:
    """Observations that are dicts of a vector and an image."""
    return SimpleMultiObsEnv(discrete_actions=False)


def make_model(policy: Any = "MlpPolicy", env: Any = None, **kwargs: Any) -> Any:
    """A small BisimSAC with every part switched on. Its type is Any because many attributes of an algorithm are Optional."""
    return BisimSAC(policy, pendulum() if env is None else env, **{**SMALL, **EVERYTHING, **kwargs})


def with_data(*args: Any, **kwargs: Any) -> Any:
    """A model with 20 random transitions and no update yet, for tests that call ``train`` themselves."""
    return make_model(*args, **{"learning_starts": 1000, "gradient_steps": 0, **kwargs}).learn(20)


def parameters(module: nn.Module) -> th.Tensor:
    """A copy of all parameters of a module as one vector."""
    return nn.utils.parameters_to_vector(module.parameters()).detach().clone()


def layers(env: VecEnv | None) -> list[VecEnv]:
    """The wrappers of a VecEnv from the outside in, and last the VecEnv inside of them."""
    found = []
    while env is not None:
        found.append(env)
        env = getattr(env, "venv", None)
    return found


def events(folder: Path, run: int = 1) -> EventAccumulator:
    """What a run of BisimSAC with this ``tensorboard_log`` has written."""
    accumulator = EventAccumulator(str(folder / f"BisimSAC_{run}"), size_guidance={"images": 0})
    accumulator.Reload()
    return accumulator


def logged_steps(folder: Path, key: str, run: int = 1) -> list[int]:
    """Where a scalar was logged; files of the same second are read in the order of their names, which is not that of time."""
    return sorted(event.step for event in events(folder, run).Scalars(key))
