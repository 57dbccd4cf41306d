"""Faster updates from pixels: the process keeps the memory of tensors that it will need again."""

import ctypes
import platform

# of glibc's malloc.h
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
LARGEST_KEPT = 32 * 2**20  # glibc accepts no more


def keep_freed_memory() -> bool:
    """
    Let glibc keep freed blocks of up to 32 MiB in place of returning them to the system.

    From pixels, an update frees and requests hundreds of megabytes. By default, the system takes them back and provides them
    again, page by page, which costs about a tenth of an update (docs/performance.md). Larger blocks, such as replay
    buffers, are returned as before. The setting holds for the whole process until it ends. So ``robust-bisim train`` makes it,
    and ``BisimSAC`` does not: call this function in a script of your own.

    :return: whether the setting was made; False without glibc, as on macOS and Windows
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)) and bool(mallopt(M_TRIM_THRESHOLD, -1))
