"""The private names of PyTorch that the library uses, each with the version in which it was last seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils._pytree import tree_map  # 2.15

__all__ = [
    "as_constant",
    "has_forward_derivatives",
    "has_function_transforms",
    "is_exporting",
    "is_jit_traced",
    "multiply_all",
    "tree_map",
]

Function = TypeVar("Function", bound=Callable[..., Any])

# Public from 2.7 on. PyTorch 2.6 does not distinguish export from compile: both count as export there.
is_exporting: Callable[[], bool] = getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)


def has_function_transforms() -> bool:
    """Whether a transform of torch.func is active."""
    return torch._C._are_functorch_transforms_active()  # 2.15


def has_forward_derivatives() -> bool:
    """Whether forward-mode derivatives are computed."""
    return forward_ad._current_level >= 0  # 2.15


def is_jit_traced() -> bool:
    """Whether torch.jit traces the running code."""
    return torch._C._get_tracing_state() is not None  # 2.15


def as_constant(function: Function) -> Function:
    """Have torch.compile call a function while it traces, and treat the result as a constant.

    `torch.compiler.assume_constant_result` also imports dynamo, which takes seconds.
    """
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]  # 2.15
    return function


def multiply_all(tensors: list[Tensor], factor: float) -> None:
    """Multiply tensors by a factor, in place, with few kernel launches."""
    torch._foreach_mul_(tensors, factor)  # 2.15
