"""pytest plugin: whatever imports SAC from stable_baselines3 after this gets BisimSAC."""

import stable_baselines3

from sb3_robust_bisim import BisimSAC

stable_baselines3.SAC = BisimSAC  # type: ignore[misc]
