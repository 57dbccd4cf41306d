"""What counts as a number where an argument is checked; a bool is none."""

from typing import Any

import numpy as np


def is_number(value: Any, least: float = -np.inf) -> bool:
    """Whether a value is a finite number and at least ``least``."""
    is_real = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    return is_real and bool(-np.inf < value < np.inf and value >= least)


def is_whole(value: Any, least: int, most: float = np.inf) -> bool:
    """Whether a value is an integer from ``least`` to ``most``."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return is_integer and bool(least <= value <= most)
