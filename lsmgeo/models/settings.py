"""Settings of the two learnt stereo machines: frozen values that JSON can hold, checked when a model is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, TypeVar

from lsmgeo._checks import check_choice, check_flag, check_number, check_whole, describe
from lsmgeo.errors import OptionError

__all__ = ["VARIANTS", "DepthSettings", "MachineSettings", "VoxelSettings", "changed"]

VARIANTS = ("paper", "release")
LARGEST_SIDE = 4096


@dataclass(frozen=True)
class MachineSettings:
    """What both machines are built from. The defaults are the paper's.

    Attributes:
        variant: "paper" or "release", see the models.
        image_size: side of the square images in pixels that it is meant for; other sizes work.
        grid_size: voxels along a side of the grid on which views are fused.
        encoder_channels: of the image encoder's levels, each of half the size of the one before.
        feature_channels: of the features that are unprojected.
        feature_stride: pixels of the image to a pixel of the features, a power of 2.
        lift: samples of the features along a side of a voxel, whose values become channels of that voxel: a cheap way
            to detail finer than the grid on which views are fused. Depth and direction are appended once a voxel.
        fusion: "gru" or "lstm".
        input_kernel: side in voxels of the recurrence's kernels over a view's features.
        state_kernel: of those over its state.
        hidden_channels: of the recurrence's state.
        grid_channels: of the grid network's levels; 64^3 grids take a fourth of 256.
        output_channels: of the grid network's last layer.
        pixel_rules: "exact", or "release" for the rules of the released code, which are off: pixel j of the features is
            taken to lie at j times their stride, (stride - 1) / 2 pixels of the image aside; and of D-LSM alone, rays
            of the swept maps pass the corners of pixels, and read voxels half a voxel back. What right geometry buys
            is measured against it.
        grid_skip: whether the fused grid itself goes beside it; neither the paper nor the release has this skip, which
            small networks need: it is the one way for detail of the grid's own size.
    """

    variant: str = "paper"
    image_size: int = 224
    grid_size: int = 32
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256)
    feature_channels: int = 32
    feature_stride: int = 2
    lift: int = 1
    fusion: str = "gru"
    input_kernel: int = 3
    state_kernel: int = 3
    hidden_channels: int = 32
    grid_channels: tuple[int, ...] = (32, 64, 128)
    output_channels: int = 32
    pixel_rules: str = "exact"
    grid_skip: bool = False

    @property
    def image_stride(self) -> int:
        """What the sides of images must be divisible by."""
        return 1 << len(self.encoder_channels)

    def check(self, who: str) -> None:
        """Raise an `OptionError` that names the first impossible setting."""
        check_choice(who, "variant", self.variant, VARIANTS)
        check_choice(who, "fusion", self.fusion, ("gru", "lstm"))
        check_choice(who, "pixel_rules", self.pixel_rules, ("exact", "release"))
        for name in ("feature_channels", "hidden_channels", "output_channels"):
            check_whole(who, name, getattr(self, name), 1, LARGEST_SIDE)
        check_flag(who, "grid_skip", self.grid_skip)
        check_whole(who, "lift", self.lift, 1, 4)
        for name in ("input_kernel", "state_kernel"):
            if check_whole(who, name, getattr(self, name), 1, 15) % 2 == 0:
                raise OptionError(f"{who}: {name} must be odd; got {getattr(self, name)}")
        for name in ("encoder_channels", "grid_channels"):
            check_channels(who, name, getattr(self, name))
        check_whole(who, "image_size", self.image_size, 1, LARGEST_SIDE)
        check_whole(who, "grid_size", self.grid_size, 1, 256)
        # Maps of one pixel have no variance to be normalised by.
        if self.image_size % self.image_stride or self.image_size < 2 * self.image_stride:
            raise OptionError(
                f"{who}: image_size must be a multiple of {self.image_stride}, 2 to the number of encoder_channels, "
                f"and twice that at least; got {self.image_size}"
            )
        coarsest = 1 << len(self.grid_channels)
        if self.grid_size % coarsest or self.grid_size < 2 * coarsest:
            raise OptionError(
                f"{who}: grid_size must be a multiple of {coarsest}, 2 to the number of grid_channels, and twice that "
                f"at least; got {self.grid_size}"
            )
        check_stride(who, "feature_stride", self.feature_stride, len(self.encoder_channels))


@dataclass(frozen=True)
class VoxelSettings(MachineSettings):
    """What a `VoxelLSM` is built from: `MachineSettings`, and its own.

    Attributes:
        upsample: voxels of the occupancy along a side of one of the grid's: a cheap way to a finer output.
    """

    upsample: int = 1

    def check(self, who: str) -> None:
        """Raise an `OptionError` that names the first impossible setting."""
        super().check(who)
        check_whole(who, "upsample", self.upsample, 1, 4)
        if self.upsample > 1 and self.variant == "release":
            raise OptionError(f"{who}: upsample must be 1 in the variant 'release'; got {self.upsample}")


@dataclass(frozen=True)
class DepthSettings(MachineSettings):
    """What a `DepthLSM` is built from: `MachineSettings`, and its own.

    Attributes:
        near: depth of the first plane that is swept, world units.
        far: depth of the last.
        planes: how many.
        map_stride: pixels of the image to a pixel of the swept maps, a power of 2.
        projection: "nearest" or "trilinear".
        ray_channels: of the two layers that reduce what lies along a ray; the release has the first alone.
        skips: whether depth is made with the image encoder's early maps too; without, views that are no input can be
            predicted.
    """

    near: float = 1.0
    far: float = 3.0
    planes: int = 64
    map_stride: int = 4
    projection: str = "nearest"
    ray_channels: tuple[int, ...] = (512, 128)
    skips: bool = True

    def check(self, who: str) -> None:
        """Raise an `OptionError` that names the first impossible setting."""
        super().check(who)
        near, far = (check_number(who, name, getattr(self, name), "a depth") for name in ("near", "far"))
        if not 0 < near < far:
            raise OptionError(f"{who}: near and far must be depths with 0 < near < far; got {near} and {far}")
        check_whole(who, "planes", self.planes, 2, LARGEST_SIDE)
        check_stride(who, "map_stride", self.map_stride, len(self.encoder_channels))
        check_choice(who, "projection", self.projection, ("nearest", "trilinear"))
        check_channels(who, "ray_channels", self.ray_channels)
        check_flag(who, "skips", self.skips)
        if len(self.ray_channels) != (1 if self.variant == "release" else 2):
            raise OptionError(
                f"{who}: ray_channels must be two numbers, or one in the variant 'release'; got {self.ray_channels}"
            )


Settings = TypeVar("Settings")


def changed(who: str, settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Settings with changes, checked; lists, as JSON has them, become tuples.

    Args:
        who: the model, named in errors.
        settings: to begin with, a dataclass with a method ``check(who)``.
        changes: by name.

    Raises:
        OptionError: an unknown name, or an impossible value.
    """
    names = [field.name for field in fields(settings)]  # type: ignore[arg-type]
    for name in changes:
        if name not in names:
            close = get_close_matches(str(name), names, 1)
            hint = f"; is {close[0]!r} meant?" if close else f"; there are {', '.join(names)}"
            raise OptionError(f"{who}: there is no setting {name!r}{hint}")
    new: Any = replace(settings, **{name: tuple(v) if isinstance(v, list) else v for name, v in changes.items()})  # type: ignore[type-var]
    new.check(who)
    return new


def check_channels(who: str, name: str, value: object) -> None:
    """Require one to eight numbers of channels."""
    if not isinstance(value, tuple) or not 1 <= len(value) <= 8:
        raise OptionError(f"{who}: {name} must be one to eight whole numbers; got {describe(value)}")
    for item in value:
        check_whole(who, name, item, 1, LARGEST_SIDE)


def check_stride(who: str, name: str, value: object, levels: int) -> None:
    """Require the stride of one of the image encoder's levels."""
    strides = [2 << level for level in range(levels)]
    if check_whole(who, name, value, 1) not in strides:
        raise OptionError(f"{who}: {name} must be one of {', '.join(map(str, strides))}; got {value}")
