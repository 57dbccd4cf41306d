"""
Diagnostics of a running :class:`~sb3_robust_bisim.BisimSAC`, for TensorBoard and all other outputs of SB3's logger.

Their arguments are plain values, so RL Zoo's YAML files can use them::

    callback:
      - sb3_robust_bisim.callbacks.EmbeddingCallback
      - sb3_robust_bisim.callbacks.DenoisingFactorCallback: {every: 2000}
      - sb3_robust_bisim.callbacks.ValueBoundCallback: {n_states: 500}

None of them changes the run. The states come from a separate environment or from the replay buffer, and the global random
generators are restored.
"""

from sb3_robust_bisim.callbacks.denoising import DenoisingFactorCallback
from sb3_robust_bisim.callbacks.embedding import EmbeddingCallback
from sb3_robust_bisim.callbacks.value_bound import ValueBoundCallback

__all__ = ["DenoisingFactorCallback", "EmbeddingCallback", "ValueBoundCallback"]
