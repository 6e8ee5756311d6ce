"""The pixel rule: points to pixels, depth to points, pixels to rays, and the camera centres.

Everything is computed in float64, elementwise, and cast to the dtype of the input.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo._checks import check_finite, check_geometry, check_number
from lsmgeo._dtypes import saturating_cast
from lsmgeo.cameras.camera_checks import check_cameras, check_views, image_size, views_per_scene
from lsmgeo.cameras.matrices import camera_matrices
from lsmgeo.cameras.tensors import Cameras, as_tensors, image_sizes
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import GridError, ShapeError

__all__ = ["ProjectedPoints", "centers", "project", "rays", "unproject_depth"]


class ProjectedPoints(NamedTuple):
    """N points in the images of V views."""

    pixels: Tensor  # (B, V, N, 2) as u, v
    depth: Tensor  # (B, V, N)
    visible: Tensor  # (B, V, N) bool


def project(cameras: Cameras, points: Tensor, *, near: float = 1e-6) -> ProjectedPoints:
    """Project world points to the pixels of each camera's own image.

    Equation: ``depth (u, v, 1) = K (R X + t)`` (Hartley and Zisserman, "Multiple View Geometry", equation 6.8).

    Convention:
        Integer pixel centres. Depth is camera z. A point is visible where its depth is more than `near` and its pixel
        lies in [-0.5, width - 0.5) x [-0.5, height - 0.5); occlusion is not considered.

    Args:
        cameras: B*V cameras with the leading shape (B, V), or (B*V,) with the view fastest.
        points: (B, N, 3) as x, y, z in world units, float32 or float64.
        near: least depth, world units.

    Returns:
        ``pixels`` (B, V, N, 2) as u, v, (0, 0) with zero gradient where the depth is not more than `near`; ``depth``
        (B, V, N), negative behind the camera; ``visible`` (B, V, N) bool. Of the points' dtype; differentiable in
        points, K, R and t.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, GridError, OptionError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit, project
        >>> view = orbit(torch.zeros(1), 0.0, 2.0, focal_length=10.0, height=5, width=7)
        >>> project(view, torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.2, -0.4], [3.0, 0.0, 0.0]]]))
        ProjectedPoints(pixels=tensor([[[[3., 2.],
                  [5., 1.],
                  [0., 0.]]]]), depth=tensor([[[ 2.,  2., -1.]]]), visible=tensor([[[ True,  True, False]]]))
    """
    who = "project"
    near = check_number(who, "near", near, "a finite number, at least 0", 0)
    check_geometry(who, "points", points, "(B, N, 3)", rank=3)
    if points.shape[2] != 3:
        raise ShapeError(f"{who}: points must be (B, N, 3); got {tuple(points.shape)}")
    tensors = as_tensors(cameras, who)
    tensors = check_views(who, tensors, views_per_scene(who, tensors, points.shape[0], "points'"), points=points)
    if can_inspect(points):
        check_finite(who, "points", points, GridError)
    homogeneous = camera_matrices(tensors).homogeneous_pixels(points.double()[:, None])  # (B, V, N, 3)
    distance = homogeneous[..., 2]
    depth = saturating_cast(distance, points.dtype)
    front = depth > near
    pixels = homogeneous[..., :2] / torch.where(front, distance, 1.0)[..., None]
    pixels = torch.where(front[..., None], saturating_cast(pixels, points.dtype), 0.0)
    # The returned pixels are tested: rounding may move one to the border.
    height, width = image_sizes(tensors)
    inside = (pixels >= -0.5) & (pixels < torch.stack((width, height), -1)[:, :, None].double() - 0.5)
    return ProjectedPoints(pixels, depth, front & inside.all(-1))


def unproject_depth(cameras: Cameras, depth: Tensor) -> Tensor:
    """World points of the pixels of depth maps; the inverse of `project` at a map's pixels.

    Equation: ``X = C + depth R^T K^-1 (u, v, 1)`` at integer (u, v), with the camera centre ``C = -R^T t``.

    Convention:
        Depth is camera z. Integer pixel centres; for maps of another size than the camera's image, K is resized.

    Args:
        cameras: B*V cameras with the leading shape (B, V), or (B*V,) with the view fastest.
        depth: (B, V, h, w) in world units, float32 or float64, any finite numbers; 0 gives the camera centre.

    Returns:
        (B, V, h, w, 3) as x, y, z, of the depth's dtype; differentiable in depth, K, R and t.

    Raises:
        ShapeError, DTypeError, DeviceError, CameraError, GridError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit, unproject_depth
        >>> view = orbit(torch.zeros(1), 0.0, 2.0, focal_length=10.0, height=3, width=3)
        >>> unproject_depth(view, torch.full((1, 1, 3, 3), 1.0))[0, 0, 1]
        tensor([[ 1.0000,  0.0000,  0.1000],
                [ 1.0000,  0.0000,  0.0000],
                [ 1.0000,  0.0000, -0.1000]])
    """
    who = "unproject_depth"
    check_geometry(who, "depth", depth, "(B, V, h, w)", rank=4)
    B, V, height, width = depth.shape
    if V < 1 or height < 1 or width < 1:
        raise ShapeError(f"{who}: depth must be (B, V, h, w), V, h and w at least 1; got {tuple(depth.shape)}")
    tensors = check_views(who, as_tensors(cameras, who), (B, V), depth=depth)
    if can_inspect(depth):
        check_finite(who, "depth", depth, GridError)
    matrices = camera_matrices(tensors, (height, width))
    steps = matrices.pixel_steps(height, width)
    points = (matrices.center + 0.0)[:, :, None, None] + depth.double()[..., None] * steps
    return saturating_cast(points, depth.dtype)


def centers(cameras: Cameras) -> Tensor:
    """Camera centres in the world, ``C = -R^T t``.

    Args:
        cameras: leading shape (...).

    Returns:
        (..., 3) as x, y, z, of the cameras' dtype; differentiable in R and t.

    Raises:
        DTypeError, ShapeError, CameraError: see `lsmgeo.errors`.

    Example:
        >>> from lsmgeo.cameras import centers, orbit
        >>> centers(orbit(0.0, 0.0, 2.0, focal_length=10.0, height=3, width=3))
        tensor([2., 0., 0.])
    """
    tensors = as_tensors(cameras, "centers")
    check_cameras("centers", tensors)
    return (camera_matrices(tensors).center + 0.0).to(tensors.intrinsics.dtype)


def rays(cameras: Cameras, size: tuple[int, int] | None = None) -> tuple[Tensor, Tensor]:
    """The ray of every pixel, in the world.

    Equation: C = -R^T t, d = normalize(R^T K^-1 (u, v, 1)) at integer (u, v).

    Args:
        cameras: leading shape (...).
        size: (h, w) of the images, for which K is resized; by default the cameras' own, which must then be one size.

    Returns:
        Camera centres (..., 3) in world units, and unit directions (..., h, w, 3). Differentiable in K, R and t.

    Raises:
        CameraError: invalid cameras, or no size given for views of different sizes.

    Example:
        >>> from lsmgeo.cameras import orbit, rays
        >>> origins, directions = rays(orbit(0.0, 0.0, 2.0, focal_length=10.0, height=3, width=3))
        >>> origins
        tensor([2., 0., 0.])
        >>> directions[1, 1]
        tensor([-1.,  0.,  0.])
    """
    who = "rays"
    tensors = as_tensors(cameras, who)
    check_cameras(who, tensors)
    size = image_size(who, tensors, size)
    matrices = camera_matrices(tensors, size)
    steps = matrices.pixel_steps(*size)
    directions = steps / torch.linalg.vector_norm(steps, dim=-1, keepdim=True)
    return (matrices.center + 0.0).to(tensors.intrinsics.dtype), directions.to(tensors.intrinsics.dtype)
