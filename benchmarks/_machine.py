"""Where a number was measured: every result file and every closing JSON carries this."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path


def machine() -> dict:
    git = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True)
    packages = ("torch", "stable_baselines3", "gymnasium", "numpy", "sb3_robust_bisim")
    return {
        "commit": git.stdout.strip() or "unknown",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, no GPU used",
        "versions": {"python": platform.python_version(), **{package: version(package) for package in packages}},
    }
