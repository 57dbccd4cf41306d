"""Files that begin with the SHA-256 of their content, so that damage is found. The version before is kept beside them."""

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from sb3_robust_bisim.runs.atomic import atomic_path

_FIRST_LINE = b"sb3_robust_bisim checkpoint 2\n"  # the number is that of the format
_CONTENT = len(_FIRST_LINE) + 64 + 1  # where the content begins, after the hash and a newline


class HashedFile:
    """
    Hashes what is written.

    :param file: empty file; the hash is written by ``finish``
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._hash = hashlib.sha256()
        file.seek(_CONTENT)

    def write(self, data: bytes) -> int:
        self._hash.update(data)
        return self._file.write(data)

    def finish(self) -> None:
        """Write the hash, and wait until everything is on the disk."""
        self._file.seek(0)
        self._file.write(_FIRST_LINE + self._hash.hexdigest().encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())


@contextmanager
def replaced(path: Path) -> Iterator[HashedFile]:
    """
    Yield a file to write. At the end it takes the place of ``path``, and the file that was there becomes the previous one.

    :param path: file that no other process writes. There is no previous one without hard links or with too little disk space
    """
    older = previous(path)
    if path.exists() and shutil.disk_usage(path.parent).free < 1.2 * path.stat().st_size:
        older.unlink(missing_ok=True)
    with atomic_path(path, alone=True) as temporary, temporary.open("wb") as file:
        hashed = HashedFile(file)
        yield hashed
        hashed.finish()
        older.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # there is no file yet, or the file system has no hard links
            os.link(path, older)


def previous(path: Path) -> Path:
    """The name of the file before, such as ``run.previous.pkl`` for ``run.pkl``."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def damage(path: Path) -> str:
    """What is wrong with a file, for a message; empty if it is whole."""
    with path.open("rb") as file:
        if file.read(len(_FIRST_LINE)) != _FIRST_LINE:
            return "this is no checkpoint, or one of another version of this package"
        stored = file.read(64)
        file.seek(_CONTENT)
        if hashlib.file_digest(file, "sha256").hexdigest().encode() != stored:
            return "this checkpoint is torn or altered (its content does not have the SHA-256 that it begins with)"
    return ""


def opened(path: Path) -> BinaryIO:
    """Open a whole file at its content."""
    file = path.open("rb")
    file.seek(_CONTENT)
    return file
