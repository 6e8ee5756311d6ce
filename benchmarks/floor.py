"""The floor: writing the output once.

A large block goes back to the system when it is freed, so that whoever makes a fresh output pays for its page faults.
Huge pages make that cheaper, and the library's CPU kernels ask for them; so does the floor.
"""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Callable
from functools import lru_cache
from math import prod
from typing import Any

import torch
from torch import Tensor

HUGE_FROM = 4 << 20  # bytes, as in the library's CPU kernels
_PAGE = 2 << 20


@lru_cache
def _madvise() -> Callable[..., Any] | None:
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return None
    try:
        return ctypes.CDLL(None).madvise
    except (OSError, AttributeError):
        return None


def fresh(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Uninitialised memory by the library's page policy, or the same policy written out."""
    try:
        from lsmgeo.kernels.cpu import fresh as allocate
    except ImportError:
        pass
    else:
        return allocate(shape, dtype)
    tensor = torch.empty(shape, dtype=dtype)
    count, madvise = prod(shape) * tensor.element_size(), _madvise()
    if count >= HUGE_FROM and madvise is not None:
        start = -(-tensor.data_ptr() // _PAGE) * _PAGE
        length = tensor.data_ptr() + count - start
        madvise(ctypes.c_void_p(start), ctypes.c_size_t(length), mmap.MADV_HUGEPAGE)
    return tensor


def cold(count: int) -> Callable[[], None]:
    """Allocate, write and free so many bytes."""

    def run() -> None:
        fresh((count // 4,), torch.float32).fill_(1.0)

    return run


def warm(count: int) -> Callable[[], None]:
    """Write so many bytes again and again into the same memory."""
    buffer = fresh((count // 4,), torch.float32)
    return lambda: buffer.fill_(1.0)  # type: ignore[return-value]
