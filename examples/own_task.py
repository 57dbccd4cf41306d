"""Train on a task of your own: a small Gymnasium environment in which eight of nine observed numbers are noise.
With the default of 3,000 steps: about a minute on one core."""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_robust_bisim import BisimSAC


class Room(gym.Env[np.ndarray, np.ndarray]):
    """
    Heat or cool a room until its temperature is right. The first observed number is the difference from the wanted temperature
    in units of ten degrees. The others are noise, which the agent has to learn to ignore.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (9,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.difference = self.np_random.uniform(-1, 1)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        draught = 0.05 * self.np_random.standard_normal()
        self.difference += 0.3 * float(np.clip(action[0], -1, 1)) + draught
        return self._observation(), float(abs(self.difference) < 0.1), False, False, {}

    def _observation(self) -> np.ndarray:
        return np.append(self.difference, self.np_random.standard_normal(8)).astype(np.float32)


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=3000)
args = parser.parse_args()

# With an id, the task also works on the command line and in callbacks that make an environment of their own
gym.register("Room-v0", Room, max_episode_steps=50)
model = BisimSAC(
    "MlpPolicy",
    gym.make("Room-v0"),
    reward_range=(0, 1),  # of one step
    learning_rate=1e-3,
    learning_starts=args.steps // 10,
    seed=0,
)
room = Monitor(gym.make("Room-v0"))
before, _ = evaluate_policy(model, room, n_eval_episodes=10)
model.learn(args.steps, progress_bar=True)
after, _ = evaluate_policy(model, room, n_eval_episodes=10)
print(f"Return before training: {before:.0f}, after: {after:.0f} of 50")
