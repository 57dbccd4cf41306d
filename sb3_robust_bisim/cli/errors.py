"""The error of a command that cannot do what its options ask for."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager


class UsageError(ValueError):
    """The message names the option, its value and the remedy; the shell shows it without a traceback."""


@contextmanager
def refusals() -> Iterator[None]:
    """
    While environments and agents are made from the user's settings, treat values that this package or SB3 refuses and unknown
    arguments as errors of usage. Other errors keep their traceback.

    :raises UsageError: with the message of the class that refuses
    """
    try:
        yield
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        raise UsageError(f"{error}. Check --env-kwargs, --eval-env-kwargs and the configuration.") from error
    except ValueError as error:
        *_, (raising_frame, _) = traceback.walk_tb(error.__traceback__)
        if raising_frame.f_globals["__name__"].partition(".")[0] not in ("sb3_robust_bisim", "stable_baselines3"):
            raise
        raise UsageError(str(error)) from error
