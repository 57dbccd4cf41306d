"""SAC with robust bisimulation metric learning, for Stable-Baselines3."""

import sb3_robust_bisim.envs  # noqa: F401  (registers the environment ids)
from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.frame_buffer import FrameStackReplayBuffer
from sb3_robust_bisim.intrinsic_reward import IntrinsicRewardVecEnv

__version__ = "0.1.0"
__all__ = ["BisimSAC", "FrameStackReplayBuffer", "IntrinsicRewardVecEnv", "__version__"]
