"""Base class of all distractions: random sequences that are independent of the task."""

from abc import ABC, abstractmethod
from typing import ClassVar, Self

import numpy as np


class RandomSequence(ABC):
    """
    A sequence that starts at random in every episode and advances with every agent step. It has its own random generator. A
    pickled copy continues exactly where the original was.
    """

    # Spawn key of the random numbers: a child stream of the seed; () is the stream of the seed itself
    stream: ClassVar[tuple[int, ...]] = ()

    def __init__(self) -> None:
        self._rng = np.random.default_rng()

    def seed(self, seed: int) -> None:
        """
        Restart the random generator.

        :param seed: integer >= 0
        """
        self._rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=self.stream))

    def another(self) -> Self:
        """
        Create an independent sequence of the same kind. This sequence is not affected.

        :return: a sequence at the start of an episode
        """
        other = object.__new__(type(self))  # ``copy`` would load clips again
        other.__dict__.update(self.__dict__)
        (other._rng,) = self._rng.spawn(1)
        other.reset()
        return other

    @abstractmethod
    def reset(self) -> None:
        """Draw the start of an episode. Create new arrays, because :meth:`another` shares the old ones."""

    @abstractmethod
    def step(self) -> None:
        """Advance by one agent step."""
