"""Operators called without PyTorch's dispatch, which costs more than the kernels do on small grids."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lsmgeo._torch_compat import below_autograd, has_dispatch_modes
from lsmgeo.debugging import PLAIN

__all__ = ["direct", "is_direct", "save", "saved"]


def save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    """Save the arguments; backward recomputes the rest, so that nothing of the output's size is kept."""
    ctx.save_for_backward(*(value if isinstance(value, Tensor) else None for value in inputs))
    ctx.others = [None if isinstance(value, Tensor) else value for value in inputs]


def saved(ctx: Any) -> list[Any]:
    """The arguments, in the order of the schema."""
    pairs = zip(ctx.saved_tensors, ctx.others, strict=True)
    return [other if tensor is None else tensor for tensor, other in pairs]


def direct(operator: Any) -> Callable[..., Any]:
    """An operator of torch_ops.py for calls that `is_direct` allows."""

    def forward(ctx: Any, *inputs: Any) -> Any:
        with below_autograd():
            output = operator.forward(*inputs)
        save(ctx, inputs, output)
        return output

    members = {"forward": staticmethod(forward), "backward": staticmethod(operator.autograd)}
    function = type(operator.name, (torch.autograd.Function,), members)

    def run(*inputs: Any) -> Any:
        if torch.is_grad_enabled() and any(isinstance(value, Tensor) and value.requires_grad for value in inputs):
            return function.apply(*inputs)  # type: ignore[attr-defined]
        with below_autograd():
            return operator.forward(*inputs)

    return run


def is_direct(*inputs: Any) -> bool:
    """Whether nothing but autograd has to see a call: plain CPU tensors, no trace, no mode."""
    if torch.compiler.is_compiling() or has_dispatch_modes():
        return False
    tensors = [value for value in inputs if isinstance(value, Tensor)]
    return all(type(tensor) in PLAIN and tensor.is_cpu and not tensor.is_neg() for tensor in tensors)
