"""The error of a command that cannot do what its options ask for."""


class UsageError(ValueError):
    """The message names the option, its value and the remedy; the shell shows it without a traceback."""
