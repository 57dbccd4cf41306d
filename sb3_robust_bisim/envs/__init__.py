"""
The tasks. Importing this package registers their ids with Gymnasium.

A worker process that has not imported it needs the long form of an id, which imports it:
``sb3_robust_bisim.envs:robust_bisim/SparseCartPole-v0``.
"""

from gymnasium import register

from sb3_robust_bisim.envs.dmc import register_suite
from sb3_robust_bisim.envs.noise import NoiseObservation

__all__ = ["NoiseObservation"]

# No reward_threshold for the sparse tasks: they are evaluated with other arguments than the defaults
register("robust_bisim/SparseCartPole-v0", "sb3_robust_bisim.envs.classic:sparse_cart_pole", max_episode_steps=200)
register("robust_bisim/SparsePendulum-v0", "sb3_robust_bisim.envs.classic:sparse_pendulum", max_episode_steps=200)
register(
    "robust_bisim/MountainCarContinuous-v0",
    "sb3_robust_bisim.envs.classic:mountain_car_continuous",
    reward_threshold=90.0,
    max_episode_steps=999,
)
register_suite()
