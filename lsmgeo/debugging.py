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
    """Check the values of all arguments within this context, also on a GPU, which then has to synchronise.

    In eager mode, values (finite, rigid, ordered) of CPU tensors are always checked; within this context, those on
    other devices are too. Under ``torch.compile``, ``torch.export`` and ``torch.func`` values cannot be read, and are
    not checked.

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
    """Whether the code is being traced or transformed, so that control flow must not depend on values."""
    return torch.compiler.is_compiling() or has_function_transforms()


def can_inspect(*tensors: torch.Tensor) -> bool:
    """Whether the values of these tensors may be read without synchronising a GPU or breaking a trace."""
    # Tensors without values (meta, fake, distributed) cannot be read.
    if is_traced() or any(tensor.is_meta or type(tensor) not in PLAIN for tensor in tensors):
        return False
    return _debug.get() or all(tensor.device.type == "cpu" for tensor in tensors)
