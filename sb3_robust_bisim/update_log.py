"""Updates that wait for no result of the device: what is logged stays there until the end, distributions are not checked."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from torch.distributions import Distribution


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
        values = iter(th.stack([value for steps in self._scalars.values() for _, value in steps]).tolist())
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

    def record(self, logger: Logger) -> None:
        """Record the means, and of the metric's means the ratio."""
        means = self.means()
        for name, mean in means.items():
            logger.record(name, mean)
        if means.get("bisim/mu_rd", 0.0) > 0:  # all rewards equal: no ratio
            logger.record("bisim/mu_ratio", means["bisim/mu_bd"] / means["bisim/mu_rd"])


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """
    Build distributions without validating their parameters: each check would wait for the device.

    What it would find is found at the end of ``train()``, where the losses are checked.
    """
    checked = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(checked)
