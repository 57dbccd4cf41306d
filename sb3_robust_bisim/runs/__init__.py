"""Runs that survive interruptions: exact checkpoints, and files that appear whole or not at all."""

from sb3_robust_bisim.runs.checkpoint import Checkpoint, load_checkpoint, read_about, save_checkpoint

__all__ = ["Checkpoint", "load_checkpoint", "read_about", "save_checkpoint"]
