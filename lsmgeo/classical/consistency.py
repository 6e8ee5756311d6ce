"""Whether the depth maps of several views agree."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo import functional
from lsmgeo._checks import check_float, check_positive
from lsmgeo.cameras import CameraTensors, centers, project, resize, unproject_depth
from lsmgeo.errors import ShapeError

__all__ = ["consistent_views"]


def consistent_views(
    depth: Tensor,
    camera: CameraTensors,
    other_depths: Sequence[Tensor],
    other_cameras: Sequence[CameraTensors],
    *,
    pixels: float = 1.0,
    relative: float = 0.01,
) -> Tensor:
    """Count the other depth maps that agree with one, pixel by pixel.

    Equation: the point X of pixel p at depth d projects to q in the other view; the point that the other map has at q,
    projected back into the first view, is at p' with depth d'. They agree where ``|p' - p| <= pixels`` and
    ``|d' - d| <= relative d`` (Yao et al., "MVSNet", ECCV 2018, section 4.2). Between the
    pixels of the other map inverse depth is interpolated, which is exact on planes; a sample next to a pixel without
    depth is not used.

    Convention:
        Depth is camera z, 0 where there is none. Integer pixel centres; cameras are resized to the depth maps.

    Args:
        depth: (h, w) of the view to check.
        camera: its camera, leading shape ().
        other_depths: (h', w') each, of any size.
        other_cameras: their cameras, leading shape () each.
        pixels: largest distance between p' and p.
        relative: largest relative difference between d' and d.

    Returns:
        (h, w) int64, from 0 to the number of other views; 0 where `depth` is. Not differentiable.

    Raises:
        ShapeError, DTypeError: the numbers of cameras and depth maps differ, or a map is not (h, w).
        OptionError: a tolerance that is not positive.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import CameraTensors
        >>> from lsmgeo.classical import consistent_views
        >>> K = torch.tensor([[4.0, 0.0, 1.5], [0.0, 4.0, 1.0], [0.0, 0.0, 1.0]])
        >>> E = torch.eye(4)
        >>> moved = E.clone()
        >>> moved[0, 3] = -0.5  # one pixel at depth 2
        >>> wall = torch.full((3, 4), 2.0)
        >>> first, second = CameraTensors(K, E, 3, 4), CameraTensors(K, moved, 3, 4)
        >>> consistent_views(wall, first, [wall], [second])
        tensor([[0, 1, 1, 1],
                [0, 1, 1, 1],
                [0, 1, 1, 1]])
    """
    if len(other_depths) != len(other_cameras):
        raise ShapeError(
            f"consistent_views: other_cameras must be as many as other_depths, {len(other_depths)}; "
            f"got {len(other_cameras)}"
        )
    for name, value in (("depth", depth), *(("other_depths", other) for other in other_depths)):
        check_float("consistent_views", name, value, "(h, w)", rank=2)
    for name, number in (("pixels", pixels), ("relative", relative)):
        check_positive("consistent_views", name, number)
    height, width = depth.shape
    camera = resize(camera.to(torch.float64), height, width).at(None)
    with torch.no_grad():
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        own = torch.stack((x, y), -1).reshape(-1, 2)
        depth = torch.where((depth > 0) & depth.isfinite(), depth, 0.0).double()
        start, known = depth.reshape(-1), depth.reshape(-1) > 0
        points = unproject_depth(camera, depth[None, None]).reshape(1, -1, 3)
        count = torch.zeros(height * width, dtype=torch.int64)
        for other, other_camera in zip(other_depths, other_cameras, strict=True):
            seen_by = resize(other_camera.to(torch.float64), *other.shape)
            place, z, _ = (part[0, 0] for part in project(seen_by.at(None), points))
            found = _depth_at(other, place, z, known)
            # The point of the other map is on the same ray of the other camera, at another depth.
            factor, center = found / torch.where(z > 0, z, 1.0), centers(seen_by)
            back, distance, _ = (part[0, 0] for part in project(camera, center + factor[:, None] * (points - center)))
            agree = ((back - own).norm(dim=-1) <= pixels) & ((distance - start).abs() <= relative * start)
            count += known & (found > 0) & agree
        return count.reshape(height, width)


def _depth_at(depth: Tensor, pixels: Tensor, z: Tensor, known: Tensor) -> Tensor:
    """Depth (N,) of a map between its pixels, 0 where one of the four neighbours has none."""
    has = (depth > 0) & depth.isfinite()
    layers = torch.stack((torch.where(has, 1 / torch.where(has, depth, 1.0), 0.0), has.to(depth.dtype)))
    # Inverse depths are interpolated in float64, so that planes stay planes.
    sampled = functional.sample_views(
        layers.double()[None, None], pixels[None, None], z[None, None], (known & (z > 0))[None, None]
    ).volume[0, 0]
    whole = sampled[1] > 1 - 1e-9
    return torch.where(whole, 1 / torch.where(whole, sampled[0], 1.0), 0.0)
