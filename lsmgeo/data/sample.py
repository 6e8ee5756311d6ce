"""The input of models: `Sample`, one shape with its views, and `Batch`, several samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import default_collate

from lsmgeo._checks import check_devices, check_float, check_mask, check_whole, describe
from lsmgeo.cameras import CameraTensors, as_tensors
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import DTypeError, ShapeError

__all__ = ["MAX_VIEWS", "Batch", "Sample", "check_sample", "collate", "first_views", "pad_with_first", "pad_with_zeros"]


MAX_VIEWS = 1000  # of a shape in a set


class Sample(NamedTuple):
    """One shape, or one scene, and V views of it; all views are of one size.

    Convention:
        Depth is camera z in world units, 0 for background. Occupancy fills [-0.5, 0.5]^3 of the world, voxel i
        of n centred at ``-0.5 + (i + 0.5) / n``.

    Attributes:
        images: (V, 3, H, W) float32 in [0, 1], RGB.
        cameras: leading shape (V,), sizes as tensors.
        depth: (V, H, W) float32, or None.
        mask: (V, H, W) bool, True on the object, or None.
        occupancy: (D, H, W) bool, or None.
        mesh: path of the mesh that it was made from, or None.
        category: name of its category, or None.
        name: unique in its set.
    """

    images: Tensor
    cameras: CameraTensors
    depth: Tensor | None
    mask: Tensor | None
    occupancy: Tensor | None
    mesh: str | None
    category: str | None
    name: str


class Batch(NamedTuple):
    """B samples, padded to V views, the most of any sample. A pytree: data loaders can pin it and compilers trace it.

    Padding views have images and depth 0, mask False and a copy of the first camera. `view_mask` marks the views that
    exist; every operator of the library takes it.

    Attributes:
        images: (B, V, 3, H, W) float32 in [0, 1].
        cameras: leading shape (B, V), sizes as tensors.
        depth: (B, V, H, W) float32, or None.
        mask: (B, V, H, W) bool, or None.
        occupancy: (B, D, H, W) bool, or None.
        mesh: B paths or Nones. A loader that pins memory returns this and the next two as lists.
        category: B names or Nones.
        name: B names.
        view_mask: (B, V) bool.
    """

    images: Tensor
    cameras: CameraTensors
    depth: Tensor | None
    mask: Tensor | None
    occupancy: Tensor | None
    mesh: tuple[str | None, ...]
    category: tuple[str | None, ...]
    name: tuple[str, ...]
    view_mask: Tensor

    def first_views(self, views: int) -> Batch:
        """The same shapes with only their first views.

        Args:
            views: how many, at least 1; all views if there are fewer.

        Returns:
            A batch of min(views, V) views, whose tensors are views of this one's.

        Raises:
            OptionError: not such a number.
        """
        check_whole("Batch", "views", views, 1)
        return self._replace(
            images=self.images[:, :views],
            cameras=first_views(self.cameras, views),
            depth=None if self.depth is None else self.depth[:, :views],
            mask=None if self.mask is None else self.mask[:, :views],
            view_mask=self.view_mask[:, :views],
        )


def first_views(cameras: CameraTensors, views: int) -> CameraTensors:
    """The first views of cameras with the leading shape (B, V)."""
    return cameras.at((slice(None), slice(views)))


def check_sample(sample: Sample, who: str = "sample") -> CameraTensors:
    """Check the types, shapes and dtypes of a sample's fields, and that cameras and images are of one size.

    Args:
        sample: of a reader or a renderer.
        who: the function's name in errors.

    Returns:
        The cameras, with sizes as tensors.

    Raises:
        DTypeError: a field has another type or dtype.
        ShapeError: shapes do not match.
        DeviceError: tensors are on different devices.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> cameras = orbit(torch.tensor([0.0, 90.0]), 10.0, 2.0, focal_length=90.0, height=48, width=48)
        >>> sample = Sample(torch.rand(2, 3, 48, 48), cameras, None, None, None, None, "chair", "chair-0")
        >>> tuple(check_sample(sample).height.shape)
        (2,)
    """
    if not isinstance(sample, Sample):
        raise DTypeError(f"{who} must be a lsmgeo.data.Sample; got {describe(sample)}")
    check_float(who, "images", sample.images, "(V, 3, H, W)", 4, (torch.float32,))
    views, channels, height, width = sample.images.shape
    if channels != 3 or 0 in sample.images.shape:
        raise ShapeError(f"{who}: images must be (V, 3, H, W) with V, H, W >= 1; got {tuple(sample.images.shape)}")
    cameras = as_tensors(sample.cameras, who)
    if tuple(cameras.cam_from_world.shape) != (views, 4, 4):
        raise ShapeError(f"{who}: cameras must have leading shape (V,) = ({views},); got {cameras.shape}")
    sizes = torch.stack([torch.as_tensor(cameras.height), torch.as_tensor(cameras.width)], -1)
    if can_inspect(sizes) and not bool((sizes == sizes.new_tensor([height, width])).all()):
        other = next(tuple(size) for size in sizes.tolist() if tuple(size) != (height, width))
        raise ShapeError(f"{who}: images are {(height, width)} (height, width), a camera is for {other}")
    if sample.depth is not None:
        check_float(who, "depth", sample.depth, "(V, H, W)", 3, (torch.float32,))
        if tuple(sample.depth.shape) != (views, height, width):
            expected = (views, height, width)
            raise ShapeError(f"{who}: depth must be (V, H, W) = {expected}; got {tuple(sample.depth.shape)}")
    if sample.mask is not None:
        check_mask(who, "mask", sample.mask, (views, height, width), "(V, H, W)")
    if sample.occupancy is not None:
        if not isinstance(sample.occupancy, Tensor) or sample.occupancy.dtype != torch.bool:
            raise DTypeError(f"{who}: occupancy must be a bool tensor (D, H, W); got {describe(sample.occupancy)}")
        if sample.occupancy.dim() != 3 or sample.occupancy.numel() == 0:
            raise ShapeError(f"{who}: occupancy must be (D, H, W); got {tuple(sample.occupancy.shape)}")
    for field in ("mesh", "category", "name"):
        value = getattr(sample, field)
        if not isinstance(value, str) and (value is not None or field == "name"):
            raise DTypeError(f"{who}: {field} must be a string{' or None' * (field != 'name')}; got {describe(value)}")
    tensors = {field: getattr(sample, field) for field in ("images", "depth", "mask", "occupancy")}
    check_devices(who, **tensors, cameras=cameras.intrinsics)
    return cameras


def collate(samples: Sequence[Sample]) -> Batch:
    """Make a batch of samples, padded to the most views of any; for ``DataLoader(collate_fn=...)``.

    Args:
        samples: at least one; images of one size, cameras of one dtype, occupancy of one shape. A field is None in all
            samples or in none of them.

    Returns:
        The batch.

    Raises:
        DTypeError: no samples, other objects, or cameras of different dtypes.
        ShapeError: sizes differ, or a field is None in only some samples.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> def sample(views, name):
        ...     cameras = orbit(torch.zeros(views), 10.0, 2.0, focal_length=90.0, height=48, width=48)
        ...     return Sample(torch.rand(views, 3, 48, 48), cameras, None, None, None, None, None, name)
        >>> batch = collate([sample(1, "a"), sample(3, "b")])
        >>> batch.view_mask.tolist(), batch.name
        ([[True, False, False], [True, True, True]], ('a', 'b'))
    """
    if not isinstance(samples, Sequence) or isinstance(samples, (Sample, str)) or not samples:
        raise DTypeError(f"collate: samples must be a list or tuple with at least one Sample; got {describe(samples)}")
    cameras = [check_sample(sample, f"collate: samples[{i}]") for i, sample in enumerate(samples)]
    first = samples[0]
    for i, sample in enumerate(samples):
        _agree(i, "images' (height, width)", tuple(sample.images.shape[2:]), tuple(first.images.shape[2:]))
        for field in ("depth", "mask", "occupancy"):
            ours, theirs = getattr(sample, field), getattr(first, field)
            if (ours is None) != (theirs is None):
                given, missing = (i, 0) if theirs is None else (0, i)
                raise ShapeError(
                    f"collate: {field} must be given in all samples or in none; "
                    f"samples[{given}] ({samples[given].name!r}) has it, samples[{missing}] "
                    f"({samples[missing].name!r}) has not"
                )
        if sample.occupancy is not None and first.occupancy is not None:
            _agree(i, "occupancy's (D, H, W)", tuple(sample.occupancy.shape), tuple(first.occupancy.shape))
        if cameras[i].intrinsics.dtype != cameras[0].intrinsics.dtype:
            raise DTypeError(
                f"collate: cameras must be of one dtype (lsmgeo.cameras.to); samples[{i}] has "
                f"{cameras[i].intrinsics.dtype}, samples[0] {cameras[0].intrinsics.dtype}"
            )
    counts = torch.tensor([len(sample.images) for sample in samples])
    depth, mask, occupancy = (
        [tensor for sample in samples if (tensor := getattr(sample, field)) is not None]
        for field in ("depth", "mask", "occupancy")
    )
    view_mask = torch.arange(int(counts.max())) < counts[:, None]
    return Batch(
        pad_with_zeros([sample.images for sample in samples]),
        CameraTensors(*(pad_with_first(list(fields)) for fields in zip(*cameras, strict=True))),
        pad_with_zeros(depth) if depth else None,
        pad_with_zeros(mask) if mask else None,
        _stacked(occupancy) if occupancy else None,
        tuple(sample.mesh for sample in samples),
        tuple(sample.category for sample in samples),
        tuple(sample.name for sample in samples),
        view_mask.to(first.images.device),
    )


def _agree(index: int, what: str, ours: tuple[int, ...], theirs: tuple[int, ...]) -> None:
    if ours != theirs:
        raise ShapeError(f"collate: {what} must be equal; samples[{index}] has {ours}, samples[0] {theirs}")


def _stacked(parts: list[Tensor]) -> Tensor:
    """Stack tensors; in a worker of a loader directly into shared memory."""
    return default_collate(parts)


def pad_with_zeros(parts: Sequence[Tensor]) -> Tensor:
    """Stack (V_i, ...) tensors as (B, V, ...), padded with 0."""
    return _padded(parts, [part.new_zeros((1, *part.shape[1:])) for part in parts])


def pad_with_first(parts: Sequence[Tensor]) -> Tensor:
    """Stack (V_i, ...) tensors as (B, V, ...), padded with copies of the first entry of each."""
    return _padded(parts, [part[:1] for part in parts])


def _padded(parts: Sequence[Tensor], fillings: Sequence[Tensor]) -> Tensor:
    most = max(map(len, parts))
    return _stacked(
        [
            part if len(part) == most else torch.cat((part, filling.expand(most - len(part), *part.shape[1:])))
            for part, filling in zip(parts, fillings, strict=True)
        ]
    )
