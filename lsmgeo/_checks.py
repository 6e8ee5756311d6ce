"""Checks of arguments, shared by all public functions; each names what was expected and what was received."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from math import prod
from numbers import Real
from typing import Any, TypeGuard

import numpy as np
import torch
from torch import Tensor

from lsmgeo.errors import DeviceError, DTypeError, OptionError, ShapeError

__all__ = [
    "LARGEST_COUNT",
    "check_broadcast",
    "check_choice",
    "check_choices",
    "check_devices",
    "check_finite",
    "check_flag",
    "check_float",
    "check_geometry",
    "check_last_axes",
    "check_mask",
    "check_number",
    "check_positive",
    "check_size",
    "check_whole",
    "is_whole",
    "moved",
]

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
GEOMETRY = (torch.float32, torch.float64)
LARGEST_COUNT = 2**31 - 1
LARGEST = sys.float_info.max


def describe(value: Any) -> str:
    """A short description of a value for an error message."""
    if isinstance(value, Tensor):
        return f"a tensor {tuple(value.shape)} of {value.dtype}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{type(value).__name__} {tuple(value.shape)} of {value.dtype}"
    text = " ".join(repr(value).split())
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '...'}"


def check_float(
    who: str, name: str, value: Any, expected: str, rank: int | None = None, dtypes: Sequence[torch.dtype] = FLOATS
) -> None:
    """Require a floating-point tensor, of the given rank if any."""
    if not isinstance(value, Tensor):
        raise DTypeError(f"{who}: {name} must be a tensor {expected}; got {describe(value)}")
    if value.dtype not in dtypes:
        allowed = ", ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
        raise DTypeError(f"{who}: {name} must be of {allowed}; got {value.dtype}")
    if value.layout != torch.strided:
        raise DTypeError(f"{who}: {name} must be a dense tensor; got layout {value.layout}")
    if rank is not None and value.dim() != rank:
        raise ShapeError(f"{who}: {name} must be {expected}; got {tuple(value.shape)}")


def check_geometry(
    who: str,
    name: str,
    value: Any,
    expected: str,
    rank: int | None = None,
    dtypes: Sequence[torch.dtype] = GEOMETRY,
) -> None:
    """Require a float32 or float64 tensor of at most 2^31 - 1 numbers: cameras, poses, depths, points."""
    check_float(who, name, value, expected, rank, dtypes)
    if value.numel() > LARGEST_COUNT:
        raise ShapeError(f"{who}: {name} must be {expected}, 2^31 - 1 numbers at most; got {tuple(value.shape)}")


def check_last_axes(who: str, name: str, value: Any, *shape: int) -> Tensor:
    """Require a float32 or float64 tensor (..., *shape): matrices, vectors."""
    expected = f"(..., {', '.join(map(str, shape))})"
    check_geometry(who, name, value, expected)
    if tuple(value.shape[-len(shape) :]) != shape:
        raise ShapeError(f"{who}: {name} must be {expected}; got {tuple(value.shape)}")
    return value


def check_finite(who: str, name: str, value: Tensor, error: type[Exception] = OptionError) -> None:
    """Require a tensor without NaNs and infinities."""
    if not bool(value.isfinite().all()):
        raise error(f"{who}: {name} must be finite; got a NaN or an infinity")


def check_mask(who: str, name: str, value: Any, shape: tuple[int, ...], expected: str) -> None:
    """Require a boolean tensor of exactly this shape."""
    if not isinstance(value, Tensor) or value.dtype != torch.bool:
        raise DTypeError(f"{who}: {name} must be a bool tensor {expected}; got {describe(value)}")
    if tuple(value.shape) != tuple(shape):
        raise ShapeError(f"{who}: {name} must be {expected} = {tuple(shape)}; got {tuple(value.shape)}")


def check_choice(who: str, name: str, value: Any, choices: Sequence[str]) -> str:
    """Require one of the named options."""
    if not isinstance(value, str) or value not in choices:
        raise OptionError(f"{who}: {name} must be one of {', '.join(map(repr, choices))}; got {describe(value)}")
    return value


def check_choices(who: str, name: str, value: Any, choices: Sequence[str]) -> tuple[str, ...]:
    """Require one or an iterable of different named options; return a tuple."""
    if isinstance(value, str):
        value = (value,)
    if not isinstance(value, Iterable) or isinstance(value, Tensor):
        raise OptionError(f"{who}: {name} must be names out of {', '.join(map(repr, choices))}; got {describe(value)}")
    names = tuple(check_choice(who, name, item, choices) for item in value)
    if len(set(names)) != len(names):
        raise OptionError(f"{who}: {name} must not repeat a name; got {names}")
    return names


def check_flag(who: str, name: str, value: Any) -> bool:
    """Require True or False."""
    if not isinstance(value, bool):
        raise OptionError(f"{who}: {name} must be True or False; got {describe(value)}")
    return value


def check_broadcast(who: str, **shapes: Sequence[int]) -> tuple[int, ...]:
    """Require leading shapes that broadcast, and return their common shape."""
    common: list[int] = []
    for sizes in zip_longest(*(reversed(shape) for shape in shapes.values()), fillvalue=1):
        others = [size for size in sizes if size != 1]
        if any(size != others[0] for size in others):
            came = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
            raise ShapeError(f"{who}: leading shapes must broadcast; got {came}")
        common.append(others[0] if others else 1)
    return tuple(reversed(common))


def check_number(
    who: str,
    name: str,
    value: Any,
    expected: str,
    least: float = -LARGEST,
    most: float = LARGEST,
    error: type[Exception] = OptionError,
) -> float:
    """Require a finite real number in a range, both ends included."""
    try:
        number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.inf
    if not least <= number <= most:
        raise error(f"{who}: {name} must be {expected}; got {describe(value)}")
    return number


def is_whole(value: Any) -> TypeGuard[int]:
    """Whether a value is an integer, Python's or numpy's, and not a boolean."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def check_positive(who: str, name: str, value: Any) -> float:
    """Require a finite number above 0."""
    return check_number(who, name, value, "a positive number", math.ulp(0.0))


def check_whole(who: str, name: str, value: Any, least: int, most: int = 2**63 - 1) -> int:
    """Require a whole number (see `is_whole`) in a range; return a Python int."""
    if not is_whole(value) or not least <= value <= most:
        expected = (
            f"a whole number, at least {least}" if most == 2**63 - 1 else f"a whole number from {least} to {most}"
        )
        raise OptionError(f"{who}: {name} must be {expected}; got {describe(value)}")
    return int(value)


def check_size(
    who: str, name: str, value: Any, length: int, expected: str, error: type[Exception] = ShapeError
) -> tuple[int, ...]:
    """Require `length` positive integers; if `length` is 3, one int may be given for all."""
    if is_whole(value) and length == 3:
        value = (value,) * 3
    if (
        not isinstance(value, Sequence)
        or isinstance(value, str)
        or len(value) != length
        or not all(is_whole(item) or isinstance(item, torch.SymInt) for item in value)
    ):
        raise error(f"{who}: {name} must be {expected}; got {describe(value)}")
    if any(item < 1 for item in value):
        raise error(f"{who}: {name} must be {expected}, each at least 1; got {tuple(value)}")
    sizes: tuple[int, ...] = tuple(item if isinstance(item, torch.SymInt) else int(item) for item in value)  # type: ignore[misc]
    if prod(sizes) > LARGEST_COUNT:
        raise error(f"{who}: {name} must be {expected}, 2^31 - 1 cells at most; got {sizes}")
    return sizes


def check_devices(who: str, **tensors: Tensor | None) -> None:
    """Require all tensors on one device; None is skipped."""
    given = {name: tensor.device for name, tensor in tensors.items() if tensor is not None}
    if len(set(given.values())) > 1:
        places = ", ".join(f"{name} on {device}" for name, device in given.items())
        raise DeviceError(f"{who}: all tensors must be on one device; got {places}")


def moved(who: str, name: str, tensor: Tensor, device: torch.device) -> Tensor:
    """Move a tensor to a device; one on the meta device has no values to move."""
    if tensor.is_meta and device.type != "meta":
        raise DeviceError(f"{who}: {name} must hold values; got a tensor on the meta device")
    return tensor.to(device)
