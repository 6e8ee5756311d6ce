"""Checks of cameras: their values, their common image size, and how many scenes and views they are of."""

from __future__ import annotations

from math import prod

import torch
from torch import Tensor

from lsmgeo._checks import check_devices, check_mask, check_size
from lsmgeo._linalg import multiply
from lsmgeo.cameras.tensors import CameraTensors, image_sizes, leading_shape
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import CameraError, ShapeError

__all__ = ["check_cameras", "check_views", "image_size", "rotation_error", "views_of", "views_per_scene"]


def rotation_error(R: Tensor) -> Tensor:
    """``max |R^T R - I|`` of (..., 3, 3), (...)."""
    return (multiply(R.transpose(-1, -2), R) - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))


def check_cameras(who: str, cameras: CameraTensors, view_mask: Tensor | None = None) -> None:
    """Raise a `CameraError` that names the first bad camera, if the values may be read (see `lsmgeo.debug`).

    Checked: finite values; K invertible, with last row (0, 0, 1): images may be flipped or rolled; rigid, unmirrored
    extrinsics (``max |R^T R - I| <= 1e-3``, det R > 0) with last row (0, 0, 0, 1); sizes of at least one pixel.

    Args:
        who: the calling function, named in errors.
        cameras: from `as_tensors`.
        view_mask: bool, of the cameras' leading shape; cameras where it is False are not checked.
    """
    intrinsics, cam_from_world = cameras.intrinsics, cameras.cam_from_world
    height, width = image_sizes(cameras)
    if not can_inspect(intrinsics) or intrinsics.numel() == 0:
        return
    with torch.no_grad():
        K, E = intrinsics.double(), cam_from_world.double()
        R = E[..., :3, :3]
        residual = rotation_error(R)
        triple = (R[..., 0, :] * torch.linalg.cross(R[..., 1, :], R[..., 2, :])).sum(-1)
        determinant = K[..., 0, 0] * K[..., 1, 1] - K[..., 0, 1] * K[..., 1, 0]
        smallest = 1e-12 * torch.maximum(height, width).double().square()
        last_k = (K[..., 2, :] - K.new_tensor([0.0, 0.0, 1.0])).abs().amax(-1)
        last_e = (E[..., 3, :] - E.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().amax(-1)
        rules = (
            # A NaN fails the rule of its own field before the others.
            ("intrinsics must be finite", K.isfinite().all(-1).all(-1), None),
            ("cam_from_world must be finite", E.isfinite().all(-1).all(-1), None),
            ("height and width must be at least 1 pixel", (height >= 1) & (width >= 1), None),
            ("intrinsics must have the last row (0, 0, 1); its largest deviation is", last_k <= 1e-3, last_k),
            (
                "intrinsics must be invertible; the determinant of [:2, :2] is",
                determinant.abs() > smallest,
                determinant,
            ),
            ("cam_from_world must have the last row (0, 0, 0, 1); its largest deviation is", last_e <= 1e-3, last_e),
            ("the rotation must be orthonormal (a scale in it?); max |R^T R - I| is", residual <= 1e-3, residual),
            ("the rotation must not mirror (is an axis flipped?); its determinant is", triple > 0, triple),
        )
        good = torch.stack([rule for _, rule, _ in rules])
        if view_mask is not None:
            good = good | ~view_mask
        if bool(good.all()):
            return
        for (text, _, value), passed in zip(rules, good, strict=True):
            if not bool(passed.all()):
                index = tuple((~passed).nonzero()[0].tolist())
                came = "" if value is None else f" {value[index].item():.6g}"
                raise CameraError(f"{who}: cameras{list(index) if index else ''}: {text}{came}")


def image_size(who: str, cameras: CameraTensors, size: tuple[int, int] | None = None) -> tuple[int, int]:
    """The checked `size` (h, w); where it is None, the size of all cameras' images, an error if there are several."""
    if size is not None:
        height, width = check_size(who, "size", size, 2, "(h, w)")
        return height, width
    if torch.compiler.is_compiling():
        raise CameraError(f"{who}: size must be given under torch.compile and torch.export; got None")
    heights, widths = (side.unique().tolist() for side in image_sizes(cameras))
    if len(heights) != 1 or len(widths) != 1:
        raise CameraError(
            f"{who}: size must be given where views differ in size; got heights {heights}, widths {widths}"
        )
    if heights[0] != int(heights[0]) or widths[0] != int(widths[0]):
        raise CameraError(f"{who}: size must be given where the cameras' is fractional; got {heights[0]} x {widths[0]}")
    return int(heights[0]), int(widths[0])


def views_per_scene(who: str, cameras: CameraTensors, scenes: int, whose: str) -> tuple[int, int]:
    """(B, V) of cameras (B, V) or (B*V,) beside B scenes of another argument, which `whose` names in errors."""
    leading = leading_shape(cameras)
    if len(leading) == 2:
        views = (leading[0], leading[1])
        if leading[0] != scenes:
            raise ShapeError(f"{who}: cameras must be (B, V) with the {whose} B = {scenes}; got {leading}")
    else:
        count = prod(leading)
        # With no scene the number of views cannot be inferred, and 1 is as good as any.
        if scenes == 0 and count == 0:
            views = (0, 1)
        elif scenes == 0 or count % scenes:
            raise ShapeError(f"{who}: cameras must be B*V with the {whose} B = {scenes}; got {count}")
        else:
            views = (scenes, count // scenes)
    if views[1] < 1:
        raise ShapeError(f"{who}: cameras must hold at least one view per scene; got none")
    return views


def views_of(who: str, cameras: CameraTensors, views: tuple[int, int]) -> CameraTensors:
    """Cameras (B, V) or (B*V,), view fastest, with leading shape (B, V)."""
    leading = leading_shape(cameras)
    if leading != views and leading != (views[0] * views[1],):
        raise ShapeError(
            f"{who}: cameras must have leading shape (B, V) = {views}, or (B*V,) with the view fastest; got {leading}"
        )
    if leading == views:
        return cameras
    height, width = (size.reshape(views) for size in image_sizes(cameras))
    matrices = (cameras.intrinsics.reshape(*views, 3, 3), cameras.cam_from_world.reshape(*views, 4, 4))
    return CameraTensors(*matrices, height, width)


def check_views(
    who: str, cameras: CameraTensors, views: tuple[int, int], view_mask: Tensor | None = None, **tensors: Tensor
) -> CameraTensors:
    """Cameras with leading shape (B, V), see `views_of`, checked and on the device of the mask and other tensors."""
    cameras = views_of(who, cameras, views)
    if view_mask is not None:
        check_mask(who, "view_mask", view_mask, views, "(B, V)")
    check_devices(who, **tensors, cameras=cameras.intrinsics, view_mask=view_mask)
    check_cameras(who, cameras, view_mask)
    return cameras
