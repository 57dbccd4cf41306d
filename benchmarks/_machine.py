"""Where a number was measured: every result file and every closing JSON carries this."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import torch as th


def machine(device: str = "cpu") -> dict:
    """
    :param device: of the measurement; a GPU that it did not use is not named
    """
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    git = subprocess.run(describe, cwd=Path(__file__).parent, capture_output=True, text=True)
    gpu = th.cuda.get_device_name() if device != "cpu" and th.cuda.is_available() else "no GPU"
    packages = ("torch", "stable_baselines3", "gymnasium", "numpy", "sb3_robust_bisim")
    return {
        "commit": git.stdout.strip() or "unknown",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {gpu}",
        "versions": {"python": platform.python_version(), **{package: version(package) for package in packages}},
    }
