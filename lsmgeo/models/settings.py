"""Settings: frozen values that JSON can hold, checked at construction; those of V-LSM and D-LSM."""

from __future__ import annotations

import collections.abc
import contextlib
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from lsmgeo._checks import describe
from lsmgeo.errors import OptionError

__all__ = ["DepthSettings", "TrunkSettings", "VoxelSettings", "check_settings", "replace_settings", "suggestion"]

LARGEST_SIDE = 4096
LONGEST_LIST = 64
NUMBERS: dict[Any, Any] = {int: Integral, float: Real}

Settings = TypeVar("Settings")
Limits = tuple[float, float]


def check_settings(who: str, settings: Any, whole: Limits = (1, LARGEST_SIDE), **limits: Limits) -> None:
    """Require that settings are of their annotated types and within limits.

    Where the annotation says so, lists (from JSON) become tuples, and integers floats.

    Args:
        who: named in errors.
        settings: a dataclass whose fields are text, literals, flags, numbers, tuples, mappings or None.
        whole: the least and the largest integer, unless `limits` says otherwise. Floats are positive.
        limits: by the names of settings, the least and the largest number.

    Raises:
        OptionError: the first invalid setting, with what was expected and what came.
    """
    kinds = get_type_hints(type(settings))
    for item in fields(settings):
        value, words = getattr(settings, item.name), str(item.type)
        least, most = limits.get(item.name) or (whole if "int" in words else (math.ulp(0.0), math.inf))
        try:
            object.__setattr__(settings, item.name, _convert(value, kinds[item.name], least, most))
        except TypeError:
            if "..." in words:
                words += f" of length 1 to {LONGEST_LIST}"
            if "int" in words or "float" in words:
                bounds = f"at least {least}" if most >= 2**63 - 1 else f"from {least} to {most}"
                words += f", {'above 0' if least == math.ulp(0.0) else bounds}"
            raise OptionError(f"{who}: {item.name} must be {words}; got {describe(value)}") from None


def _convert(value: Any, kind: Any, least: float, most: float) -> Any:
    """A value as a kind of setting; a TypeError where that is impossible."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (UnionType, Union):
        for one in inner:
            with contextlib.suppress(TypeError):
                return _convert(value, one, least, most)
    elif origin is tuple and isinstance(value, (list, tuple)):
        if inner[-1] is Ellipsis and 1 <= len(value) <= LONGEST_LIST:
            inner = inner[:1] * len(value)
        if len(inner) == len(value) and Ellipsis not in inner:
            return tuple(_convert(one, of, least, most) for one, of in zip(value, inner, strict=True))
    elif origin is collections.abc.Mapping and isinstance(value, Mapping):
        return dict(value)
    elif origin is Literal and isinstance(value, str) and value in inner:
        return value
    elif kind in (str, bool, NoneType) and isinstance(value, kind):
        return value
    elif kind in NUMBERS and isinstance(value, NUMBERS[kind]) and not isinstance(value, bool):
        # An int of any length compares as below infinity.
        if least <= value <= min(most, sys.float_info.max):
            return kind(value)
    raise TypeError


def suggestion(name: object, known: Sequence[str]) -> str:
    """The end of an error about an unknown name: the closest known one, or all of them."""
    close = get_close_matches(str(name), known, 1)
    return f"; did you mean {close[0]}?" if close else f"; there are {', '.join(known)}"


@dataclass(frozen=True)
class TrunkSettings:
    """The settings of what V-LSM and D-LSM share. The defaults are the paper's.

    Attributes:
        variant: "paper" or "release", see the models.
        image_size: side in pixels of the square images that it is made for; other sizes work.
        grid_size: voxels along a side of the grid on which views are fused.
        encoder_channels: of the image encoder's levels, each of half the size of the one before.
        feature_channels: of the features that are unprojected.
        feature_stride: pixels of the image to a pixel of the features, a power of 2.
        lift: samples of the features along a side of a voxel, which become channels of that voxel: a cheap way to
            detail finer than the grid on which views are fused. Depth and direction are appended once per voxel.
        fusion: "gru" or "lstm", see `lsmgeo.fusion`, or "mean", "variance" or "max", which have no weights.
        input_kernel: side in voxels of the recurrence's kernels over a view's features.
        state_kernel: of those over its state.
        hidden_channels: of the recurrence's state.
        grid_channels: of the grid network's levels; 64^3 grids need a fourth, 256.
        output_channels: of the grid network's last layer.
        pixel_rules: "exact", or "release" for the inexact rules of the released code: pixel j of the features lies at
            j times their stride, which is (stride - 1) / 2 image pixels off; and in D-LSM, rays of the swept maps pass
            the corners of pixels and read half a voxel back. The difference shows what correct geometry is worth.
        grid_skip: whether the fused grid is appended to the grid network's output; neither the paper nor the release
            has this skip. Small networks need it: nothing else carries detail at the grid's own resolution.
    """

    variant: Literal["paper", "release"] = "paper"
    image_size: int = 224
    grid_size: int = 32
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256)
    feature_channels: int = 32
    feature_stride: int = 2
    lift: int = 1
    fusion: Literal["gru", "lstm", "mean", "variance", "max"] = "gru"
    input_kernel: int = 3
    state_kernel: int = 3
    hidden_channels: int = 32
    grid_channels: tuple[int, ...] = (32, 64, 128)
    output_channels: int = 32
    pixel_rules: Literal["exact", "release"] = "exact"
    grid_skip: bool = False

    @property
    def image_stride(self) -> int:
        """What the sides of images must be divisible by."""
        return 1 << len(self.encoder_channels)

    @property
    def volume_channels(self) -> int:
        """Channels of a view's volume: samples of features, depth and, in the variant "paper", ray direction."""
        return self.feature_channels * self.lift**3 + (1 if self.variant == "release" else 4)

    @property
    def fused_channels(self) -> int:
        """Channels of the fused grid."""
        return self.hidden_channels if self.fusion in ("gru", "lstm") else self.volume_channels

    def __post_init__(self) -> None:
        who = type(self).__name__
        kernels: dict[str, Limits] = {"input_kernel": (1, 15), "state_kernel": (1, 15)}
        check_settings(who, self, lift=(1, 4), upsample=(1, 4), grid_size=(1, 256), planes=(2, LARGEST_SIDE), **kernels)
        for name in kernels:
            if getattr(self, name) % 2 == 0:
                raise OptionError(f"{who}: {name} must be odd; got {getattr(self, name)}")
        # Maps of one pixel have no variance to normalise by.
        if self.image_size % self.image_stride or self.image_size < 2 * self.image_stride:
            raise OptionError(
                f"{who}: image_size must be a multiple of {self.image_stride}, 2 to the number of encoder_channels, "
                f"and at least twice that; got {self.image_size}"
            )
        coarsest = 1 << len(self.grid_channels)
        if self.grid_size % coarsest or self.grid_size < 2 * coarsest:
            raise OptionError(
                f"{who}: grid_size must be a multiple of {coarsest}, 2 to the number of grid_channels, and at "
                f"least twice that; got {self.grid_size}"
            )
        self._check_stride("feature_stride")

    def _check_stride(self, name: str) -> None:
        strides = [2 << level for level in range(len(self.encoder_channels))]
        if (stride := getattr(self, name)) not in strides:
            allowed = ", ".join(map(str, strides))
            raise OptionError(f"{type(self).__name__}: {name} must be one of {allowed}; got {stride}")


@dataclass(frozen=True)
class VoxelSettings(TrunkSettings):
    """The settings of a `VoxelLSM`: `TrunkSettings` and its own.

    Attributes:
        upsample: voxels of the occupancy along a side of one of the grid's: a cheap way to a finer output.
    """

    upsample: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.upsample > 1 and self.variant == "release":
            raise OptionError(f"VoxelSettings: upsample must be 1 in the variant 'release'; got {self.upsample}")


@dataclass(frozen=True)
class DepthSettings(TrunkSettings):
    """The settings of a `DepthLSM`: `TrunkSettings` and its own.

    Attributes:
        near: depth of the first plane of the sweep, world units.
        far: depth of the last.
        planes: how many there are.
        map_stride: pixels of the image to a pixel of the swept maps, a power of 2.
        projection: "nearest" or "trilinear".
        ray_channels: of the two layers that reduce the features along a ray; the release has only the first.
        skips: whether the depth layers also read the image encoder's early maps; without them, depth can be predicted
            for views without an image.
    """

    near: float = 1.0
    far: float = 3.0
    planes: int = 64
    map_stride: int = 4
    projection: Literal["nearest", "trilinear"] = "nearest"
    ray_channels: tuple[int, ...] = (512, 128)
    skips: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        who = type(self).__name__
        if not self.near < self.far:
            raise OptionError(f"{who}: near must be less than far = {self.far}; got {self.near}")
        self._check_stride("map_stride")
        if len(self.ray_channels) != (1 if self.variant == "release" else 2):
            raise OptionError(
                f"{who}: ray_channels must be two numbers, or one in the variant 'release'; got {self.ray_channels}"
            )


def replace_settings(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Settings with changes.

    Args:
        settings: a dataclass that checks itself.
        changes: by name.

    Raises:
        OptionError: an unknown name, or an invalid value.
    """
    names = [item.name for item in fields(settings)]  # type: ignore[arg-type]
    for name in changes:
        if name not in names:
            raise OptionError(f"{type(settings).__name__}: there is no setting {name!r}{suggestion(name, names)}")
    return replace(settings, **changes)  # type: ignore[type-var]
