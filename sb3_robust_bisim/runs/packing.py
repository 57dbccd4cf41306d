"""Pack frames for a file: compressed if this saves much, otherwise without a copy."""

import pickle
import zlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

BLOCK_BYTES = 2**26  # size of a block of frames: above 32 MiB malloc returns freed memory to the system
PROBE_FRAMES = 64  # frames that are compressed first, to decide whether to compress the whole block

Block = bytes | bytearray | pickle.PickleBuffer


def pack(frames: np.ndarray, in_place: bool) -> list[Block]:
    """
    :param frames: (N, C, H, W), uint8
    :param in_place: pass blocks that do not compress to pickle without a copy; needs protocol 5
    :return: blocks of frames
    """
    n_block = max(BLOCK_BYTES // frames[0].nbytes, 1)
    blocks = (frames[start : start + n_block] for start in range(0, len(frames), n_block))
    with ThreadPoolExecutor() as pool:
        return list(pool.map(partial(_pack_block, in_place=in_place), blocks))


def unpack(blocks: Iterable[bytes | bytearray], frames: np.ndarray) -> None:
    """
    :param blocks: result of :func:`pack`
    :param frames: (M, C, H, W), uint8, M >= N; its first N frames are overwritten
    """
    start = 0
    for block in blocks:
        start += _unpack_block(block, frames[start:])


def _pack_block(block: np.ndarray, in_place: bool) -> Block:
    """
    Compress frames to ``bytes`` if zlib at least halves them: rendered scenes become 8 times smaller, video only 1.3 times.
    Return other frames uncompressed, without a copy if ``in_place``.
    """
    probe = block[:PROBE_FRAMES]
    if 2 * len(zlib.compress(probe.data)) <= probe.nbytes:
        return zlib.compress(block.data)
    return pickle.PickleBuffer(block.data) if in_place else bytearray(block.data)


def _unpack_block(block: bytes | bytearray, frames: np.ndarray) -> int:
    """Write a block to ``frames`` and return its length. A ``PickleBuffer`` is unpickled as a ``bytearray``."""
    raw = zlib.decompress(block) if isinstance(block, bytes) else block
    n_frames = len(raw) // frames[0].nbytes
    frames[:n_frames] = np.frombuffer(raw, dtype=np.uint8).reshape(n_frames, *frames.shape[1:])
    if isinstance(block, bytearray):
        block.clear()  # the unpickler keeps all blocks until the end, which would need twice the memory
    return n_frames
