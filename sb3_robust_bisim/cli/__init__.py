"""The command line: rl-zoo's commands with BisimSAC, what the config files hold, and the report at the end of a run."""

from sb3_robust_bisim.cli.zoo import main

__all__ = ["main"]
