"""The error of a command that cannot do what its options ask for."""

from collections.abc import Iterator
from contextlib import contextmanager


class UsageError(ValueError):
    """The message names the option, its value and the remedy; the shell shows it without a traceback."""


@contextmanager
def refusals() -> Iterator[None]:
    """
    While environments and agents are made from the user's settings, treat a refused value and an unknown argument as errors of
    usage. Other errors keep their traceback.

    :raises UsageError: with the message of the class that refuses
    """
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        raise UsageError(str(error)) from error
