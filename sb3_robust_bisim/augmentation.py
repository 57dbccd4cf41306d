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
    shifted = th.empty_like(images)
    # one block copy per sample: much faster than indexing pixel by pixel
    for i, (top, left) in enumerate(th.randint(2 * pad + 1, (n, 2)).tolist()):
        shifted[i] = padded[i, :, top : top + height, left : left + width]
    return shifted
