"""Checked inputs of the renderers besides geometry: lights and backgrounds."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo._checks import check_float, describe
from lsmgeo.errors import DTypeError, ShapeError
from lsmgeo.scenes.lighting import Lights

__all__ = ["background_array", "checked_lights"]


def checked_lights(who: str, lights: Lights, count: int, device: torch.device, dtype: torch.dtype) -> Lights:
    """The lights with a leading axis of scenes, detached, on the rendering device.

    Args:
        who: the calling function, for messages.
        lights: directions and colours (S, L, 3), ambient (S, 3), or all without S.
        count: S.
        device: of the result.
        dtype: of the result.

    Raises:
        DTypeError: not `Lights` of floating-point tensors.
        ShapeError: inconsistent shapes.
    """
    if not isinstance(lights, Lights):
        raise DTypeError(f"{who}: lights must be Lights; got {describe(lights)}")
    whole = []
    for name, value, rank in zip(lights._fields, lights, (3, 3, 2), strict=True):
        check_float(who, f"lights.{name}", value, "(S, L, 3), ambient (S, 3)")
        value = value.expand(count, *value.shape) if value.dim() == rank - 1 else value
        if value.dim() != rank or value.shape[0] != count or value.shape[-1] != 3:
            raise ShapeError(
                f"{who}: lights.{name} must be {'(S, L, 3)' if rank == 3 else '(S, 3)'} with S = {count} scenes, or "
                f"without S; got {tuple(value.shape)}"
            )
        whole.append(value.detach().to(device, dtype))
    if whole[0].shape != whole[1].shape:
        raise ShapeError(
            f"{who}: lights.directions and lights.colours must agree; got "
            f"{tuple(lights.directions.shape)} and {tuple(lights.colours.shape)}"
        )
    return Lights(*whole)


def background_array(
    who: str, value: Tensor | Sequence[float], shape: tuple[int, ...], device: torch.device, dtype: torch.dtype
) -> Tensor:
    """The background as a new contiguous array of the images' shape (..., 3, H, W).

    Raises:
        ShapeError: not RGB (3,), and it does not broadcast to the shape.
    """
    try:
        colour = torch.as_tensor(value, device=device, dtype=dtype).detach()
        colour = colour[:, None, None] if colour.dim() == 1 else colour
        return colour.expand(shape).clone(memory_format=torch.contiguous_format)
    except (RuntimeError, TypeError, ValueError) as error:
        raise ShapeError(
            f"{who}: background must be RGB (3,) or broadcast to {shape}; got {describe(value)}"
        ) from error
