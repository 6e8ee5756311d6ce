"""`CameraTensors`, the plain form of any number of pinhole cameras, and their stacking."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lsmgeo._checks import GEOMETRY, LARGEST_COUNT, check_devices, check_geometry, describe, is_whole
from lsmgeo.cameras.kornia_types import PinholeCamera, from_fields, to_fields
from lsmgeo.errors import CameraError, DTypeError, ShapeError

__all__ = ["CameraTensors", "Cameras", "as_tensors", "image_sizes", "select", "stack", "to"]


class CameraTensors(NamedTuple):
    """Pinhole cameras as four tensors: a pytree, for torch.export, vmap and data loaders (with sizes as tensors).

    Convention:
        ``x ~ K (R X + t)`` with OpenCV axes (x right, y down, z forward), world-to-camera extrinsics and integer pixel
        centres: pixel (0, 0) is centred at (0.0, 0.0) and the image covers [-0.5, width - 0.5) x [-0.5, height - 0.5).

    Attributes:
        intrinsics: (..., 3, 3) calibration matrices K in pixels, last row (0, 0, 1), skew allowed; the top-left 3x3 of
            4x4 matrices is used. float32 or float64.
        cam_from_world: (..., 4, 4) rigid world-to-camera transforms ``[[R, t], [0, 0, 0, 1]]``, of the same dtype.
        height: (...) image heights in pixels, (B,) if the views of a scene share them, or one int for all.
        width: (...) image widths in pixels, likewise.

    The leading shape is (B, V), or (B*V,) with the view fastest, for V views of B scenes; (B,) or () for one camera per
    scene. Indexing is that of a tuple of four fields: ``views[0]`` is the intrinsics of all cameras, ``views.at(0)``
    the first camera.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import CameraTensors
        >>> cameras = CameraTensors(torch.eye(3).expand(2, 4, 3, 3), torch.eye(4).expand(2, 4, 4, 4), 48, 64)
        >>> cameras.to_kornia().batch_size
        8
        >>> cameras.at((slice(None), 0)).shape  # the first view of each scene
        (2,)
    """

    intrinsics: Tensor
    cam_from_world: Tensor
    height: Tensor | int
    width: Tensor | int

    @property
    def shape(self) -> tuple[int, ...]:
        """The leading shape: (B, V), (V,), ()."""
        return leading_shape(self)

    @property
    def device(self) -> torch.device:
        """The device of the matrices."""
        return self.cam_from_world.device

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the matrices."""
        return self.cam_from_world.dtype

    def at(self, index: Any) -> CameraTensors:
        """The cameras at an index of the leading shape; the same index as for a tensor of that shape.

        Args:
            index: an int, a slice, a tensor or list of integers or booleans, ``None`` for a new axis, or a tuple of
                these: ``(slice(None), 0)`` is the first view of each scene of (B, V) cameras.

        Returns:
            `CameraTensors`; sizes that are ints stay ints.

        Raises:
            ShapeError: the index does not fit the leading shape.
        """
        cameras = as_tensors(self, "CameraTensors.at")
        places = index if isinstance(index, tuple) else (index,)
        rows = (*places, slice(None), slice(None))
        try:
            chosen = [size[places] for size in image_sizes(cameras)]
        except (IndexError, TypeError, ValueError, OverflowError) as error:
            raise ShapeError(
                f"CameraTensors.at: index must fit the leading shape {self.shape}; got {describe(index)}"
            ) from error
        height, width = (old if is_whole(old) else new for old, new in zip(self[2:], chosen, strict=True))
        return CameraTensors(cameras.intrinsics[rows], cameras.cam_from_world[rows], height, width)

    def map(self, function: Callable[[Tensor], Tensor]) -> CameraTensors:
        """The cameras with `function` applied to intrinsics and cam_from_world, and the same sizes."""
        return self._replace(intrinsics=function(self.intrinsics), cam_from_world=function(self.cam_from_world))

    def to(
        self, device: torch.device | torch.dtype | str | None = None, dtype: torch.dtype | None = None
    ) -> CameraTensors:
        """The cameras on a device, in a dtype (the first argument may be either) or both; see `lsmgeo.cameras.to`."""
        return to(self, device, dtype)

    @classmethod
    def from_kornia(cls, camera: PinholeCamera) -> CameraTensors:
        """The tensors of a kornia camera: leading shape (N,), or (B, V) where kornia stores (B, V, 4, 4)."""
        return as_tensors(camera)

    def to_kornia(self) -> PinholeCamera:
        """The same cameras as one kornia ``PinholeCamera``, leading axes flattened (view fastest)."""
        cameras = as_tensors(self)
        return from_fields(cameras.intrinsics, cameras.cam_from_world, *image_sizes(cameras))


def _field(cameras: CameraTensors, index: Any) -> Any:
    try:
        return tuple.__getitem__(cameras, index)
    except (IndexError, TypeError) as error:
        fields = ", ".join(CameraTensors._fields)
        raise type(error)(f"cameras[{index}]: the fields are {fields}; a view is cameras.at({index})") from None


def _no_field(cameras: CameraTensors, name: str) -> Any:
    raise AttributeError(
        f"CameraTensors has no {name!r}; it has {', '.join(CameraTensors._fields)}, shape, device, dtype, at, map, to "
        "and to_kornia, and lsmgeo.cameras has functions of cameras"
    )


# Assigned here: defined in the class, they would make type checkers accept any name and any index.
CameraTensors.__getitem__ = _field  # type: ignore[method-assign, assignment]
CameraTensors.__getattr__ = _no_field  # type: ignore[attr-defined]

Cameras = PinholeCamera | CameraTensors


def as_tensors(cameras: Cameras, who: str = "cameras") -> CameraTensors:
    """Convert any accepted form of cameras to `CameraTensors` with 3x3 intrinsics and sizes as tensors.

    Args:
        cameras: `CameraTensors`, a kornia ``PinholeCamera`` with (N, 4, 4) or (B, V, 4, 4) storage, or a kornia
            ``PinholeCamerasList``.
        who: the calling function, named in errors.

    Returns:
        The cameras, of the same leading shape. Values are not checked.

    Raises:
        DTypeError: another type, or not float32 or float64.
        ShapeError: shapes that do not agree.
        DeviceError: tensors on different devices.
    """
    if isinstance(cameras, PinholeCamera):
        cameras = CameraTensors(*to_fields(cameras))
    elif not isinstance(cameras, CameraTensors):
        raise DTypeError(
            f"{who}: cameras must be a kornia PinholeCamera, a PinholeCamerasList or lsmgeo.cameras.CameraTensors; "
            f"got {describe(cameras)}"
        )
    intrinsics, cam_from_world = cameras.intrinsics, cameras.cam_from_world
    check_geometry(who, "cameras.intrinsics", intrinsics, "(..., 3, 3) or (..., 4, 4)")
    check_geometry(who, "cameras.cam_from_world", cam_from_world, "(..., 4, 4)")
    if tuple(intrinsics.shape[-2:]) not in ((3, 3), (4, 4)):
        raise ShapeError(f"{who}: cameras.intrinsics must be (..., 3, 3) or (..., 4, 4); got {tuple(intrinsics.shape)}")
    if tuple(cam_from_world.shape[-2:]) != (4, 4):
        raise ShapeError(
            f"{who}: cameras.cam_from_world must be (..., 4, 4), the whole world-to-camera matrix; "
            f"got {tuple(cam_from_world.shape)}"
        )
    leading = leading_shape(cameras)
    if tuple(intrinsics.shape[:-2]) != leading:
        raise ShapeError(
            f"{who}: cameras.intrinsics and cameras.cam_from_world must agree in their leading shape; "
            f"got {tuple(intrinsics.shape)} and {tuple(cam_from_world.shape)}"
        )
    if intrinsics.dtype != cam_from_world.dtype:
        raise DTypeError(
            f"{who}: cameras.intrinsics and cameras.cam_from_world must be of one dtype; "
            f"got {intrinsics.dtype} and {cam_from_world.dtype}"
        )
    height = _size(who, "height", cameras.height, leading, intrinsics)
    width = _size(who, "width", cameras.width, leading, intrinsics)
    check_devices(who, intrinsics=intrinsics, cam_from_world=cam_from_world, height=height, width=width)
    return CameraTensors(intrinsics[..., :3, :3], cam_from_world, height, width)


def leading_shape(cameras: CameraTensors) -> tuple[int, ...]:
    """`CameraTensors.shape`, also under `torch.compile`: PyTorch 2.6 does not trace properties of named tuples."""
    return tuple(cameras.cam_from_world.shape[:-2])


def image_sizes(cameras: CameraTensors) -> tuple[Tensor, Tensor]:
    """Heights and widths of cameras from `as_tensors`, where they are tensors."""
    height, width = cameras.height, cameras.width
    assert isinstance(height, Tensor)
    assert isinstance(width, Tensor)
    return height, width


def _size(who: str, name: str, value: Any, leading: tuple[int, ...], like: Tensor) -> Tensor:
    if is_whole(value):
        if not 1 <= value <= LARGEST_COUNT:
            raise CameraError(f"{who}: cameras.{name} must be at least 1 pixel, 2^31 - 1 at most; got {value}")
        return torch.full(leading, value, dtype=torch.int64, device=like.device)
    if (
        not isinstance(value, Tensor)
        or value.dtype == torch.bool
        or value.is_complex()
        or value.layout != torch.strided
    ):
        raise DTypeError(f"{who}: cameras.{name} must be an int or a dense real tensor; got {describe(value)}")
    if len(leading) == 2 and tuple(value.shape) == leading[:1]:  # shared by the views of a scene
        value = value[:, None].expand(leading)
    if tuple(value.shape) != leading:
        raise ShapeError(
            f"{who}: cameras.{name} must have the cameras' leading shape {leading}; got {tuple(value.shape)}"
        )
    return value


def stack(cameras: Sequence[Cameras], dim: int = 0) -> CameraTensors:
    """Stack cameras of equal leading shape along a new leading axis, as ``torch.stack`` does.

    Args:
        cameras: at least one; V cameras with leading shape (B,) stacked with ``dim=1`` give (B, V).
        dim: position of the new axis, 0 to the number of leading axes.

    Returns:
        `CameraTensors` with the new leading axis.

    Raises:
        DTypeError: no camera, or items of another type.
        ShapeError: unequal leading shapes.

    Example:
        >>> from lsmgeo.cameras import orbit, stack
        >>> views = [orbit(a, 10.0, 2.0, focal_length=50.0, height=48, width=64) for a in (0.0, 45.0, 90.0)]
        >>> tuple(stack(views).intrinsics.shape)
        (3, 3, 3)
    """
    if not isinstance(cameras, (list, tuple)) or isinstance(cameras, CameraTensors) or not cameras:
        raise DTypeError(f"stack: cameras must be a list or tuple with at least one camera; got {describe(cameras)}")
    parts = [as_tensors(camera, "stack") for camera in cameras]
    leading = [part.shape for part in parts]
    if len(set(leading)) > 1:
        raise ShapeError(f"stack: cameras must have one leading shape; got {leading}")
    if not is_whole(dim) or not 0 <= dim <= len(leading[0]):
        raise ShapeError(f"stack: dim must be 0 to {len(leading[0])}; got {describe(dim)}")
    check_devices("stack", **{f"cameras[{i}]": part.intrinsics for i, part in enumerate(parts)})
    return CameraTensors(*(torch.stack(field, dim) for field in zip(*parts, strict=True)))


def select(cameras: Cameras, dim: int, index: int) -> CameraTensors:
    """One camera along a leading axis, as ``torch.select`` does; `CameraTensors.at` takes any index.

    Args:
        cameras: at least one leading axis; ``select(cameras, 1, 0)`` of (B, V) is the first view of each scene.
        dim: the axis to remove, 0 to the number of leading axes less 1.
        index: of the camera along that axis.

    Returns:
        `CameraTensors` without that axis.

    Raises:
        ShapeError: no such axis, or no such camera.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit, select
        >>> views = orbit(torch.zeros(2, 3), 10.0, 2.0, focal_length=50.0, height=48, width=64)
        >>> tuple(select(views, 1, 0).intrinsics.shape)
        (2, 3, 3)
    """
    tensors = as_tensors(cameras, "select")
    leading = leading_shape(tensors)
    if not is_whole(dim) or not 0 <= dim < len(leading):
        raise ShapeError(f"select: dim must be a leading axis of {leading}; got {describe(dim)}")
    if not is_whole(index) or not -leading[dim] <= index < leading[dim]:
        raise ShapeError(f"select: index must be one of {leading[dim]} cameras; got {describe(index)}")
    return tensors.at((slice(None),) * dim + (index,))


def to(
    cameras: Cameras, device: torch.device | torch.dtype | str | None = None, dtype: torch.dtype | None = None
) -> CameraTensors:
    """Move cameras to a device, convert their matrices to a dtype, or both; sizes keep their dtype.

    Args:
        cameras: any number of cameras.
        device: a device, or only a dtype.
        dtype: float32 or float64.

    Returns:
        `CameraTensors`.

    Raises:
        DTypeError: neither is given, or an invalid one.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit, to
        >>> to(orbit(0.0, 10.0, 2.0, focal_length=50.0, height=48, width=64), torch.float64).intrinsics.dtype
        torch.float64
    """
    tensors = as_tensors(cameras, "to")
    if isinstance(device, torch.dtype) and dtype is None:
        device, dtype = None, device
    if dtype is not None and (not isinstance(dtype, torch.dtype) or dtype not in GEOMETRY):
        raise DTypeError(f"to: dtype must be float32 or float64; got {describe(dtype)}")
    if device is not None and not isinstance(device, (str, torch.device)):
        raise DTypeError(f"to: device must be a torch.device or its name; got {describe(device)}")
    if device is None and dtype is None:
        raise DTypeError("to: device or dtype must be given; got neither")
    try:
        place = tensors.intrinsics.device if device is None else torch.device(device)
    except RuntimeError as error:
        raise DTypeError(f"to: device must be a torch.device or its name; got {describe(device)}") from error
    K, E = (matrix.to(place, dtype or matrix.dtype) for matrix in (tensors.intrinsics, tensors.cam_from_world))
    return CameraTensors(K, E, *(size.to(place) for size in image_sizes(tensors)))
