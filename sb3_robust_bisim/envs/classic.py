"""
The Gym tasks of the paper (appendix "OpenAI Gym"). Dynamics, reset and rendering are Gymnasium's. This file contains only what
the paper changes.

A pickled or copied environment continues exactly where the original was. It contains the physical state, the random generators
(also that of the noise) and the time limit.
"""

import math
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.envs.classic_control.continuous_mountain_car import Continuous_MountainCarEnv
from gymnasium.envs.classic_control.pendulum import PendulumEnv, angle_normalize

from sb3_robust_bisim.envs.noise import NoisyTask

Transition = tuple[np.ndarray, float, bool, bool, dict[str, Any]]

_FULL_PUSH = np.ones(1, dtype=np.float32)


class _ClassicTask(gym.Env[np.ndarray, np.ndarray]):
    """Common parts of the three tasks: a check of the action, and pickling after rendering."""

    def __getstate__(self) -> dict[str, Any]:
        """
        :return: the attributes without pygame's surfaces and clock, which cannot be pickled or copied; ``render`` creates new
            ones
        """
        state = {name: value for name, value in self.__dict__.items() if name != "surf"}
        return {**state, "screen": None, "clock": None}

    def _check_action(self, action: np.ndarray) -> None:
        """
        :param action: the argument of ``step``
        :raises ValueError: unless it is one finite number in an array of shape (1,)
        """
        if np.shape(action) != (1,) or not math.isfinite(action[0]):
            raise ValueError(
                f"action must hold one finite number in an array of shape (1,), got {action!r}; "
                "a NaN or an infinity usually comes from a policy whose training diverged"
            )


class SparseCartPoleEnv(_ClassicTask, CartPoleEnv):
    """
    Cart-pole with a continuous force, rewarded only close to upright and to the middle (paper: "Sparse Noisy Cartpole").

    The action in [-1, 1] (other values are clipped) is the force on the cart as a fraction of 30 N. The dynamics, the start,
    the observation (cart position in m, its velocity, pole angle in rad, its velocity) and the end of an episode
    (|theta| > 12 deg or |x| > 2.4 m) are those of Gymnasium's CartPole. The id adds the limit of 200 steps of CartPole-v0.

    The reward of a step is 1 if the next state has |theta| <= theta_rew_fraction * 12 deg and |x| <= x_rew_fraction * 2.4 m,
    and 0 otherwise. The step that ends an episode by failing has reward 1 in any case, as in CartPole. With
    ``theta_rew_fraction=1`` the rewards are therefore exactly CartPole-v0's, and a return is at most 200. The paper evaluates
    in this task. Its text mentions only theta; the condition on x and the reward for the failing step follow its published
    code.

    :param theta_rew_fraction: rewarded fraction of the 12 degrees, in (0, 1] (paper: 0.01 for training, 1 for evaluation)
    :param x_rew_fraction: rewarded fraction of the 2.4 m, in (0, 1]; None: as ``theta_rew_fraction`` (published code);
        1: no condition on x (paper's text)
    :param render_mode: None, "human" or "rgb_array"
    :raises ValueError: for a fraction outside (0, 1]
    """

    max_force = 30.0  # N
    state: np.ndarray  # None only before the first reset, when CartPole raises an error on a step

    def __init__(
        self, theta_rew_fraction: float = 0.01, x_rew_fraction: float | None = None, render_mode: str | None = None
    ) -> None:
        if x_rew_fraction is None:
            x_rew_fraction = theta_rew_fraction
        for name, fraction in (("theta_rew_fraction", theta_rew_fraction), ("x_rew_fraction", x_rew_fraction)):
            if not isinstance(fraction, SupportsFloat) or not 0 < fraction <= 1:
                raise ValueError(f"{name} must lie in (0, 1] (1: the standard task), got {fraction!r}")
        super().__init__(render_mode=render_mode)
        self.action_space = gym.spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
        self.theta_rew = theta_rew_fraction * self.theta_threshold_radians
        self.x_rew = x_rew_fraction * self.x_threshold

    def step(self, action: np.ndarray) -> Transition:
        """
        Push the cart for 0.02 s.

        :param action: fraction of 30 N, array of shape (1,)
        :return: observation of shape (4,), reward 0 or 1, terminated, truncated (always False here), info
        :raises ValueError: if the action is not one finite number
        """
        self._check_action(action)
        # CartPole's action 1 pushes with force_mag to the right, so a signed force_mag gives any force
        self.force_mag = self.max_force * min(max(float(action[0]), -1.0), 1.0)
        observation, standard_reward, terminated, truncated, info = super().step(_FULL_PUSH)
        x, _, theta, _ = self.state
        rewarded = terminated or (abs(theta) <= self.theta_rew and abs(x) <= self.x_rew)
        return observation, standard_reward if rewarded else 0.0, terminated, truncated, info


class SparsePendulumEnv(_ClassicTask, PendulumEnv):
    """
    Pendulum swing-up whose reward is 1 while the pendulum is upright, and 0 otherwise (paper: "Sparse Pendulum").

    Dynamics, start, observation (cos theta, sin theta, velocity in rad/s) and action (torque in [-2, 2] N m, clipped) are
    those of Gymnasium's Pendulum-v1; the id adds its limit of 200 steps. The reward depends on the angle after the step,
    wrapped to [-180, 180) degrees. Pendulum-v1 uses the angle before the step. With the angle after the step, as in cart-pole,
    the reward is a consequence of the action, and the last state of an episode counts instead of the random first one.

    :param tolerance_degrees: the reward is 1 if |theta| is smaller than this, in (0, 180] (paper: 1 or less for training,
        1 for evaluation)
    :param render_mode: None, "human" or "rgb_array"
    :raises ValueError: for a tolerance outside (0, 180]
    """

    def __init__(self, tolerance_degrees: float = 1.0, render_mode: str | None = None) -> None:
        if not isinstance(tolerance_degrees, SupportsFloat) or not 0 < tolerance_degrees <= 180:
            raise ValueError(f"tolerance_degrees must lie in (0, 180], got {tolerance_degrees!r}")
        super().__init__(render_mode=render_mode)
        self.tolerance = math.radians(tolerance_degrees)

    def step(self, action: np.ndarray) -> Transition:
        """
        Apply the torque for 0.05 s.

        :param action: torque in N m, array of shape (1,)
        :return: observation of shape (3,), reward 0 or 1, terminated and truncated (always False here), info
        :raises ValueError: when the action is not one finite number
        """
        self._check_action(action)
        observation, _, terminated, truncated, info = super().step(action)
        upright = abs(angle_normalize(self.state[0])) < self.tolerance
        return observation, float(upright), terminated, truncated, info


class MountainCarContinuousEnv(_ClassicTask, Continuous_MountainCarEnv):
    """
    Gymnasium's MountainCarContinuous-v0 (paper: "Noisy Mountain Car"; solved when the return exceeds 90).

    :param render_mode: None, "human" or "rgb_array"
    """

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)

    def step(self, action: np.ndarray) -> Transition:
        """
        Drive for one step.

        :param action: force in [-1, 1] (clipped), array of shape (1,)
        :return: observation of shape (2,), reward (100 at the goal, less 0.1 * action^2), terminated, truncated (always False
            here), info
        :raises ValueError: when the action is not one finite number
        """
        self._check_action(action)
        observation, reward, terminated, truncated, info = super().step(action)
        # Gymnasium returns its own state array: an agent that scales observations in place would move the car
        return observation.copy(), reward, terminated, truncated, info


sparse_cart_pole = NoisyTask(SparseCartPoleEnv)
sparse_pendulum = NoisyTask(SparsePendulumEnv)
mountain_car_continuous = NoisyTask(MountainCarContinuousEnv)
