"""Options of the form NAME:VALUE, such as --env-kwargs and -params."""

import argparse
import re
from collections.abc import Sequence
from typing import Any

from rl_zoo3.utils import StoreDict

WORD = re.compile(r"[A-Za-z_~./][\w.+~/-]*")
CONSTANTS = ("True", "False", "None")


class StoreSettings(StoreDict):
    """
    Python values, as in rl-zoo3, and words, which need no quotes here: ``distractor:video``, ``ent_coef:auto_0.1``.
    What is neither is an error of usage; in rl-zoo3, it ends in a traceback.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Sequence[str] | Any,
        option_string: str | None = None,
    ) -> None:
        settings: dict[str, Any] = {}
        for argument in values:
            name, _, value = argument.partition(":")
            if value.title() in ("True", "False") and value not in CONSTANTS:  # as text, "false" would count as true
                parser.error(f"{option_string} {argument}: write {value.title()}")
            if value.isidentifier() and value not in CONSTANTS:  # rl-zoo3 would take the names of functions for them
                settings[name] = value
                continue
            try:
                super().__call__(parser, namespace, [argument], option_string)
                settings |= getattr(namespace, self.dest)
            except Exception as error:  # evaluating a value can raise any
                if not WORD.fullmatch(value):
                    parser.error(
                        f"{option_string} {argument}: write NAME:VALUE with a word, a path or a Python value ({error})"
                    )
                settings[name] = value
        setattr(namespace, self.dest, settings)
