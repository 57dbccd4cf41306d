"""Images without content, for benchmarks of updates."""

import gymnasium as gym
import numpy as np


class RandomPixels(gym.Env):
    """Three stacked RGB frames of noise: what an update costs does not depend on what is to be seen."""

    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, size: int = 84) -> None:
        self.observation_space = gym.spaces.Box(0, 255, (9, size, size), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self.np_random.integers(0, 256, self.observation_space.shape, dtype=np.uint8), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        obs, _ = self.reset()
        return obs, 0.5, False, False, {}
