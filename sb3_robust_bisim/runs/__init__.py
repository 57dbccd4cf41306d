"""Runs that survive interruptions: exact checkpoints, and files that are written completely or not at all."""

from sb3_robust_bisim.runs.checkpoint import Checkpoint, load_checkpoint, read_about, save_checkpoint

__all__ = ["Checkpoint", "load_checkpoint", "read_about", "save_checkpoint"]
