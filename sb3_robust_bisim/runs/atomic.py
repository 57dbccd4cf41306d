"""Files that are written completely or not at all."""

import errno
import io
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_WITHOUT_NAME = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # what Python's write() raises without a file name
PathOrStream = str | Path | io.BufferedIOBase


@contextmanager
def atomic_path(path: str | os.PathLike[str], alone: bool = False) -> Iterator[Path]:
    """
    Yield a temporary path next to ``path``. It is renamed to ``path`` if the block succeeds, and removed otherwise.

    :param path: the file to write; missing parent folders are created. An ``OSError`` names it, such as that of a full disk
    :param alone: True if no other process writes this file. The temporary file then always has the same name, so the next
        write replaces the leftover of a killed process
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    writer = "" if alone else f".{uuid.uuid4().hex}"  # process ids are not unique across threads and machines
    temporary = target.with_name(f".{target.stem}{writer}.tmp{target.suffix}")  # some writers choose the format by the suffix
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        if error.errno in _WITHOUT_NAME:
            error.filename = error.filename or str(target)
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_save(path: PathOrStream, suffix: str) -> Iterator[Path | io.BufferedIOBase]:
    """
    ``atomic_path`` for the arguments of SB3's ``save`` methods.

    :param path: path or stream; a stream is passed on unchanged
    :param suffix: suffix that SB3 adds to a path without one, such as ".zip"
    """
    if not isinstance(path, (str, os.PathLike)):
        yield path
        return
    with atomic_path(path if Path(path).suffix else f"{path}{suffix}") as temporary:
        yield temporary
