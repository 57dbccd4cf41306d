"""Runs that survive interruptions: exact checkpoints, and files that are written completely or not at all."""

from sb3_robust_bisim.runs.checkpoint import Checkpoint, load_checkpoint, read_about, save_checkpoint
from sb3_robust_bisim.runs.pickling import ResumableSubprocVecEnv

__all__ = ["Checkpoint", "ResumableSubprocVecEnv", "load_checkpoint", "read_about", "save_checkpoint"]
