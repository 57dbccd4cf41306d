"""Files that appear whole or not at all."""

import io
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PathOrStream = str | Path | io.BufferedIOBase


@contextmanager
def atomic_path(path: str | os.PathLike[str], alone: bool = False) -> Iterator[Path]:
    """
    A temporary path beside ``path``, renamed to it when the block ends well and removed when it does not.

    :param path: where the file shall be; missing parent folders are created
    :param alone: nobody else writes this file: the temporary one always has the same name, so that what a kill has left is
        written over and does not pile up
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    writer = "" if alone else f".{uuid.uuid4().hex}"  # process ids repeat, between threads and between machines
    temporary = target.with_name(f".{target.stem}{writer}.tmp{target.suffix}")  # writers choose formats by suffix
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_save(path: PathOrStream, suffix: str) -> Iterator[Path | io.BufferedIOBase]:
    """
    ``atomic_path`` for what SB3's ``save`` methods take.

    :param path: a stream is handed on as it is
    :param suffix: what SB3 adds to a path that has none, ".zip" for example
    """
    if not isinstance(path, (str, os.PathLike)):
        yield path
        return
    with atomic_path(path if Path(path).suffix else f"{path}{suffix}") as temporary:
        yield temporary
