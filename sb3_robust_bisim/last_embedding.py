"""One embedding kept while collecting: policy and bonus ask for it in turn, and it is computed once under the same weights."""

from typing import Any

import numpy as np
import torch as th


class LastEmbedding:
    """The last observation that was embedded, its embedding, and the number of updates that its weights had seen."""

    def __init__(self) -> None:
        self._kept: tuple[Any, th.Tensor, int] | None = None

    def keep(self, obs: Any, z: th.Tensor, n_updates: int) -> None:
        """
        :param obs: n_envs rows
        :param z: (n_envs, n)
        :param n_updates: gradient steps so far
        """
        self._kept = obs, z, n_updates

    def find(self, obs: Any, n_updates: int) -> th.Tensor | None:
        """The embedding of ``obs``, (n_envs, n), if it is the one that is kept and no update has come since."""
        if self._kept is None:
            return None
        embedded, z, then = self._kept
        return z if n_updates == then and _is_same(obs, embedded) else None

    def forget(self) -> None:
        self._kept = None


def _is_same(obs: Any, other: Any) -> bool:
    """Whether both are one observation: one object, or one the channels-first view of the other (VecTransposeImage)."""
    return obs is other or _is_channels_first_view(obs, other) or _is_channels_first_view(other, obs)


def _is_channels_first_view(view: Any, images: Any) -> bool:
    if not (isinstance(view, np.ndarray) and isinstance(images, np.ndarray) and view.ndim == images.ndim == 4):
        return False
    expected = images.transpose(0, 3, 1, 2)
    same_layout = (view.shape, view.strides) == (expected.shape, expected.strides)
    return same_layout and view.ctypes.data == expected.ctypes.data
