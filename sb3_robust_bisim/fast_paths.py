"""What makes a gradient step faster without changing its result. Each is in force for the length of a ``train()`` call."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch as th
from torch.distributions import Distribution


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """
    Build distributions without validating their parameters: each check would wait for the device.

    What it would find is found at the end of the call, where the losses are checked.
    """
    checked = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(checked)


@contextmanager
def exact_onednn_matmul(device: th.device) -> Iterator[None]:
    """
    On a CPU, take oneDNN's matrix product in place of MKL's where it is as exact and therefore only faster.

    MKL does not use AVX-512 on processors of other makers; oneDNN does, but PyTorch gives it fp32 products only when lower
    precision is allowed. Whether oneDNN then makes use of the permission is tried once: where its products stay exact,
    this takes them. Everywhere else, and on a GPU, nothing changes.

    :param device: where the model is
    """
    if device.type != "cpu" or not _onednn_is_exact():
        yield
        return
    with _bf16_allowed():
        yield


@contextmanager
def _bf16_allowed() -> Iterator[None]:
    matmul: Any = th.backends.mkldnn.matmul  # type: ignore[attr-defined]
    precision, inherited = matmul.fp32_precision, th.backends.mkldnn.fp32_precision
    matmul.fp32_precision = "bf16"
    try:
        yield
    finally:
        # what is read may be the parent's: written back as our own, it would not follow the parent any more
        matmul.fp32_precision = "none" if precision == inherited else precision


@cache
def _onednn_is_exact(rounding: float = 1e-6) -> bool:
    """
    Whether oneDNN, allowed to round to bf16, still gives fp32's accuracy on the three products of a linear layer.

    :param rounding: largest relative error taken for fp32's own; bf16 has about 3e-3
    """
    if not th.backends.mkldnn.is_available() or not hasattr(getattr(th.backends.mkldnn, "matmul", None), "fp32_precision"):
        return False
    generator = th.Generator().manual_seed(0)
    x, w = (th.randn(256, 256, generator=generator) for _ in range(2))
    pairs = ((x, w), (x, w.T), (x.T, w))
    exact = [a.double().mm(b.double()) for a, b in pairs]
    with _bf16_allowed():
        errors = [(a.mm(b) - product).norm() / product.norm() for (a, b), product in zip(pairs, exact, strict=True)]
    return bool(max(errors) < rounding)
