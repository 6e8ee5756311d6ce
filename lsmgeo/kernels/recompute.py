"""Memory for time: keep a function's inputs instead of what it computes on the way.

`torch.utils.checkpoint` does the same, and imports the whole of dynamo at its first call.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lsmgeo._torch_compat import has_forward_derivatives
from lsmgeo.debugging import is_traced

__all__ = ["recomputed"]

Piece = Callable[..., tuple[Tensor, Tensor]]


class _Recomputed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, function: Piece, *inputs: Tensor | None) -> tuple[Tensor, Tensor]:
        ctx.function = function
        ctx.save_for_backward(*inputs)
        values, visible = function(*inputs)
        ctx.mark_non_differentiable(visible)
        return values, visible

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        inputs, needed = ctx.saved_tensors, ctx.needs_input_grad[1:]
        twice = torch.is_grad_enabled()
        if not twice:
            pairs = zip(inputs, needed, strict=True)
            inputs = [x if x is None else x.detach().requires_grad_(need) for x, need in pairs]
        with torch.enable_grad():
            values, _ = ctx.function(*inputs)
            if not values.requires_grad:  # nearest sampling, say, does not depend on the geometry
                return (None,) * len(ctx.needs_input_grad)
            wanted = [x for x, need in zip(inputs, needed, strict=True) if need]
            found = iter(torch.autograd.grad(values, wanted, gradients[0], create_graph=twice, allow_unused=True))
        return (None, *(next(found) if need else None for need in needed))


def recomputed(function: Piece, *inputs: Tensor | None) -> tuple[Tensor, Tensor]:
    """Call `function(*inputs)`, whose first result is differentiable, and in backward call it again.

    Every tensor that needs a gradient must be among the inputs. Differentiable twice. Under tracing a plain call.
    """
    needed = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs)
    if is_traced() or has_forward_derivatives() or not needed:  # forward-mode derivatives want every step
        return function(*inputs)
    return _Recomputed.apply(function, *inputs)
