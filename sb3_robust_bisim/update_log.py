"""What is logged of the updates of one call of ``train``."""

import numpy as np
import torch as th

from sb3_robust_bisim.losses import on_surface


class UpdateLog:
    """The numbers of each update, left on the device until all are fetched at once: every fetch stops a GPU."""

    def __init__(self) -> None:
        self._scalars: dict[str, list[tuple[int, th.Tensor]]] = {}

    def add(self, update: int, values: dict[str, th.Tensor]) -> None:
        """
        :param update: its number
        :param values: by TensorBoard key, of one element each
        """
        for name, value in values.items():
            self._scalars.setdefault(name, []).append((update, value.detach().reshape(())))

    def means(self) -> dict[str, float]:
        """
        Bring the numbers to the CPU, in one transfer.

        :return: by TensorBoard key the mean over the updates that gave a value
        :raises ValueError: if one of the numbers is not finite
        """
        values = iter(th.stack([value for steps in self._scalars.values() for _, value in steps]).cpu().tolist())
        numbers = {name: [(update, next(values)) for update, _ in steps] for name, steps in self._scalars.items()}
        broken = [
            (update, name, value) for name, steps in numbers.items() for update, value in steps if not np.isfinite(value)
        ]
        if broken:
            update, name, value = min(broken, key=lambda entry: entry[0])  # later ones follow from it
            raise ValueError(
                f"{name} became {value} at update {update}: training has stopped. Load the last checkpoint, and lower "
                "learning_rate, set norm_constraint=True or check the range of observations and rewards."
            )
        return {name: float(np.mean([value for _, value in steps])) for name, steps in numbers.items()}


def embedding_statistics(z: th.Tensor, radius: float | None) -> dict[str, th.Tensor]:
    """
    What tells a collapse (std and norm near 0) from an explosion (norm without bound) or a ball that is too small.

    :param z: (B, n)
    :param radius: of the ball that holds ``z``, None without one
    :return: by TensorBoard key
    """
    norm = z.norm(dim=1)
    statistics = {
        "bisim/embedding_norm_mean": norm.mean(),
        "bisim/embedding_norm_max": norm.max(),
        "bisim/embedding_std": z.std(dim=0, unbiased=False).mean(),
    }
    if radius is not None:
        statistics["bisim/clamp_fraction"] = on_surface(norm, radius).float().mean()
    return statistics
