"""SAC with robust bisimulation metric learning, for Stable-Baselines3."""

import sb3_robust_bisim.envs  # noqa: F401  (registers the environment ids)
from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.export import export_agent, load_agent
from sb3_robust_bisim.frame_buffer import FrameStackReplayBuffer
from sb3_robust_bisim.intrinsic_reward import IntrinsicRewardVecEnv
from sb3_robust_bisim.pretrained_encoder import PretrainedEncoder

__version__ = "0.2.0.dev0"
__all__ = [
    "BisimSAC",
    "FrameStackReplayBuffer",
    "IntrinsicRewardVecEnv",
    "PretrainedEncoder",
    "__version__",
    "export_agent",
    "load_agent",
]
