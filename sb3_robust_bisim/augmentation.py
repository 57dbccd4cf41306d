"""Image augmentation of replay batches."""

import torch as th


def random_shift(images: th.Tensor, pad: int) -> th.Tensor:
    """
    Shift each image by up to ``pad`` pixels in each direction, repeating the pixels of its edge (DrQ: Kostrikov et al., 2021).

    All channels of a sample, and so all frames of a stack, share one offset.

    :param images: (B, C, H, W), of any dtype; bytes stay bytes
    :param pad: largest shift in pixels, >= 0
    :return: a new tensor of the same shape, drawn with the generator of the CPU
    """
    n, channels, height, width = images.shape
    padded = images.new_empty(n, channels, height + 2 * pad, width + 2 * pad)
    padded[:, :, pad : pad + height, pad : pad + width] = images
    padded[:, :, pad : pad + height, :pad] = images[..., :1]
    padded[:, :, pad : pad + height, pad + width :] = images[..., -1:]
    padded[:, :, :pad] = padded[:, :, pad : pad + 1]
    padded[:, :, pad + height :] = padded[:, :, pad + height - 1 : pad + height]
    offsets = th.randint(2 * pad + 1, (n, 2))
    windows = _windows_by_index if images.is_cuda else _windows_by_copy
    return windows(padded, offsets, height, width)


def _windows_by_copy(padded: th.Tensor, offsets: th.Tensor, height: int, width: int) -> th.Tensor:
    """One block copy per image: on a CPU much faster than indexing pixel by pixel."""
    windows = padded.new_empty(*padded.shape[:2], height, width)
    for i, (top, left) in enumerate(offsets.tolist()):
        windows[i] = padded[i, :, top : top + height, left : left + width]
    return windows


def _windows_by_index(padded: th.Tensor, offsets: th.Tensor, height: int, width: int) -> th.Tensor:
    """One operation for all images, because a GPU would start each copy by itself."""
    images = th.arange(len(padded))[:, None, None]
    rows = offsets[:, :1] + th.arange(height)
    columns = offsets[:, 1:] + th.arange(width)
    indices = (index.to(padded.device, non_blocking=True) for index in (images, rows[:, :, None], columns[:, None, :]))
    return padded.movedim(1, -1)[tuple(indices)].movedim(-1, 1).contiguous()
