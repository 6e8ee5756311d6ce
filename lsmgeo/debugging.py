"""Whether values, not only shapes and types, are checked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

from lsmgeo._torch_compat import has_function_transforms

__all__ = ["can_inspect", "debug"]

PLAIN = (torch.Tensor, torch.nn.Parameter)
_debug: ContextVar[bool] = ContextVar("lsmgeo_debug", default=False)


@contextmanager
def debug() -> Iterator[None]:
    """Check the values of every argument while the context is open, also where that makes a GPU wait.

    Values (finite, rigid, ordered) of tensors on the CPU are always checked in eager mode; inside this context those
    on other devices are too. Nothing is checked under ``torch.compile``, ``torch.export`` and ``torch.func``, where
    values cannot be read.

    Example:
        >>> import torch, lsmgeo
        >>> with lsmgeo.debug():
        ...     planes = lsmgeo.depth_planes(1.0, 2.0, 3)
        >>> planes
        tensor([1.0000, 1.5000, 2.0000])
    """
    token = _debug.set(True)
    try:
        yield
    finally:
        _debug.reset(token)


def is_traced() -> bool:
    """Whether the running code is being traced or transformed, so that no value may steer it."""
    return torch.compiler.is_compiling() or has_function_transforms()


def can_inspect(*tensors: torch.Tensor) -> bool:
    """Whether the values of these tensors may be read without a GPU waiting or a trace breaking."""
    # Tensors without values of their own (meta, fake, distributed) cannot be read.
    if is_traced() or any(tensor.is_meta or type(tensor) not in PLAIN for tensor in tensors):
        return False
    return _debug.get() or all(tensor.device.type == "cpu" for tensor in tensors)
