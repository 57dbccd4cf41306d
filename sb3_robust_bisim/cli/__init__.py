"""The command line: rl-zoo3's commands with BisimSAC, checks of its config files, and the report at the end of a run."""

from sb3_robust_bisim.cli.zoo import main

__all__ = ["main"]
