"""What all distraction is: drawn anew for every episode, and independent of the task."""

from abc import ABC, abstractmethod
from typing import ClassVar, Self

import numpy as np


class RandomSequence(ABC):
    """
    Something that is drawn anew for every episode and moves on by one with every step of the agent, from a random generator of
    its own. A pickled copy goes on exactly where the original stood.
    """

    # Marks the random numbers as a child stream of the seed: () is the stream of the seed itself
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
        Begin an independent sequence of the same kind; this one goes on as if nothing had happened.

        :return: sequence at the start of an episode
        """
        other = object.__new__(type(self))  # ``copy`` would load clips again
        other.__dict__.update(self.__dict__)
        (other._rng,) = self._rng.spawn(1)
        other.reset()
        return other

    @abstractmethod
    def reset(self) -> None:
        """Draw what an episode starts with, in new arrays: :meth:`another` shares the old ones."""

    @abstractmethod
    def step(self) -> None:
        """Move on by one step of the agent."""
