"""The small BisimSAC, with every extra on, and its short episodes that several test files share."""

from typing import Any

import gymnasium as gym

EPISODE = 10
SMALL: dict[str, Any] = dict(
    policy_kwargs=dict(net_arch=[16]),
    learning_starts=EPISODE,
    batch_size=8,
    buffer_size=50,
    seed=0,
    intrinsic_reward_scale=1.0,
    inverse_dynamics_coef=1.0,
)


def pendulum() -> gym.Env:
    """Actions in [-2, 2]; its short episodes end by time-out."""
    return gym.make("Pendulum-v1", max_episode_steps=EPISODE)
