"""
Diagnostics of a running :class:`~sb3_robust_bisim.BisimSAC`, for TensorBoard and every other output of SB3's logger.

Their arguments are plain values, so that a zoo YAML can name them::

    callback:
      - sb3_robust_bisim.callbacks.EmbeddingCallback
      - sb3_robust_bisim.callbacks.DenoisingFactorCallback: {every: 2000}
      - sb3_robust_bisim.callbacks.ValueBoundCallback: {n_states: 500}

None of them changes the run that it watches: evaluation states come from an environment of their own or from the replay
buffer, and the global random generators are put back.
"""

from sb3_robust_bisim.callbacks.denoising import DenoisingFactorCallback
from sb3_robust_bisim.callbacks.embedding import EmbeddingCallback
from sb3_robust_bisim.callbacks.value_bound import ValueBoundCallback

__all__ = ["DenoisingFactorCallback", "EmbeddingCallback", "ValueBoundCallback"]
