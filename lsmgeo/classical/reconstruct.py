"""From posed photographs to the depth map and the coloured points of one view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lsmgeo.cameras import CameraTensors, rays, resize, stack
from lsmgeo.classical.plane_sweep import DepthMap, kept, sweep
from lsmgeo.classical.views import default_depth_range, number_of_planes, select_neighbours
from lsmgeo.data import PosedImages
from lsmgeo.errors import OptionError
from lsmgeo.grids import depth_planes

__all__ = ["Reconstruction", "SparseError", "points_of", "reconstruct_view", "sparse_error"]

# Confidence below which a pixel is never shown, however few there are: a winner without agreement around it.
LEAST_CONFIDENCE = 0.1
SPECK_FRACTION = 5e-4
# As many as depth_planes makes.
MOST_PLANES = 1 << 20


@dataclass(frozen=True)
class SparseError:
    """Relative depth error at a scene's own sparse points."""

    median: float
    points: int
    observed: int


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What one view's sweep gives.

    Attributes:
        view: index of the reference.
        neighbours: the views it was matched with.
        depths: (P,) planes, ascending, world units.
        image: (3, h, w) the reference at the depth map's size.
        camera: its camera at that size.
        depth_map: depth and confidence of every pixel.
        mask: (h, w) bool, the pixels kept.
        points: (N, 3) float32 world positions of the kept pixels.
        colours: (N, 3) uint8.
        error: against the scene's sparse points, where it has any, among the best pixels of the wanted density.
    """

    view: int
    neighbours: tuple[int, ...]
    depths: Tensor
    image: Tensor
    camera: CameraTensors
    depth_map: DepthMap
    mask: Tensor
    points: np.ndarray
    colours: np.ndarray
    error: SparseError | None


def reconstruct_view(
    scene: PosedImages,
    view: int,
    *,
    neighbours: int = 4,
    size: int = 400,
    planes: int | None = None,
    near: float | None = None,
    far: float | None = None,
    density: float = 0.4,
    min_views: int = 3,
    memory: int = 1 << 30,
    progress: bool = False,
) -> Reconstruction:
    """Reconstruct what one photograph sees, by plane-sweep stereo with its best neighbours.

    Args:
        scene: posed photographs, see `lsmgeo.data.open`.
        view: index of the reference.
        neighbours: how many other views to match with, at least 2.
        size: longer side of the depth map in pixels; never larger than the photograph.
        planes: number of depth planes, evenly spaced in inverse depth; by default a step is about a pixel.
        near: nearest depth, world units; by default told from the scene.
        far: farthest depth.
        density: largest fraction of the pixels to keep.
        min_views: least number of views that must see a point.
        memory: bound in bytes on what the sweep adds to the process.
        progress: whether to show a progress bar.

    Returns:
        `Reconstruction`.

    Raises:
        OptionError: an option out of range, or no range or neighbours can be told.
        DataError: a photograph cannot be read.
    """
    for name, number, least in (("neighbours", neighbours, 2), ("size", size, 16), ("planes", planes, 3)):
        if number is not None and number < least:
            raise OptionError(f"{name} must be at least {least}; got {number}")
    if planes is not None and planes > MOST_PLANES:
        raise OptionError(f"planes must be at most {MOST_PLANES}; got {planes}")
    if not 0 <= view < len(scene):
        raise OptionError(f"view must lie in 0..{len(scene) - 1}; got {view}")
    if not 0 < density <= 1:
        raise OptionError(f"density must lie in (0, 1]; got {density}")
    chosen = select_neighbours(scene, view, neighbours)
    if near is None or far is None:
        lower, upper = default_depth_range(scene, view, chosen)
        near, far = near if near is not None else lower, far if far is not None else upper
    if not 0 < near < far < float("inf"):
        raise OptionError(f"near and far must be positive, finite and ascending; got {near} and {far}")

    shape = _working_size(scene, view, size)
    # All photographs take the reference's size; the cameras' resize rule keeps them exact, even where aspects differ.
    images = torch.stack([_resized(scene.load(index), shape) for index in (view, *chosen)])
    cameras = stack([resize(scene.camera(index), *shape) for index in (view, *chosen)])
    number = planes if planes is not None else number_of_planes(cameras, near, far)
    depths = depth_planes(near, far, number, spacing="inverse")
    depth_map = sweep(images, cameras, depths, min_views=min_views - 1, memory=memory, progress=progress)

    specks = round(SPECK_FRACTION * depth_map.depth.numel())
    mask = kept(depth_map, density, LEAST_CONFIDENCE, specks)
    camera = CameraTensors(*(torch.as_tensor(value)[0] for value in cameras))
    points = points_of(depth_map.depth, camera)[mask].float().numpy()
    colours = (images[0].permute(1, 2, 0)[mask] * 255).round().to(torch.uint8).numpy()
    error = sparse_error(scene, view, depth_map, kept(depth_map, density))
    return Reconstruction(view, tuple(chosen), depths, images[0], camera, depth_map, mask, points, colours, error)


def points_of(depth: Tensor, camera: CameraTensors) -> Tensor:
    """World positions of a depth map's pixels.

    Args:
        depth: (h, w) camera z.
        camera: leading shape (), of images of that size.

    Returns:
        (h, w, 3) float64.
    """
    origin, directions = rays(camera, (depth.shape[0], depth.shape[1]))
    forward = camera.cam_from_world[2, :3]
    return origin + directions * (depth.double() / (directions * forward).sum(-1))[..., None]


def sparse_error(scene: PosedImages, view: int, depth_map: DepthMap, mask: Tensor) -> SparseError | None:
    """Median relative depth error at the sparse points that a view observes, among the pixels of a mask.

    Args:
        scene: with or without sparse points.
        view: the view of the depth map.
        depth_map: its depths, of any size.
        mask: (h, w) bool, the pixels that count.

    Returns:
        The median of ``|depth - true| / true``, and how many points count of how many observed; None without points.
    """
    if scene.points is None:
        return None
    observed = scene.points.observations[view]
    E = scene.cameras.cam_from_world[view].double().numpy()
    expected = scene.points.positions[observed.points] @ E[2, :3] + E[2, 3]
    height, width = depth_map.depth.shape
    full = scene.size(view)
    scale = np.array([width / full[1], height / full[0]])
    cells = np.floor((observed.pixels + 0.5) * scale).astype(np.int64)
    inside = ((cells >= 0) & (cells < (width, height))).all(1) & (expected > 0)
    x, y = cells[inside].T
    use = mask.numpy()[y, x]
    errors = np.abs(depth_map.depth.numpy()[y, x] - expected[inside])[use] / expected[inside][use]
    return SparseError(float(np.median(errors)) if len(errors) else float("nan"), len(errors), len(expected))


def _working_size(scene: PosedImages, view: int, size: int) -> tuple[int, int]:
    height, width = scene.size(view)
    scale = min(1.0, size / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def _resized(image: Tensor, shape: tuple[int, int]) -> Tensor:
    if tuple(image.shape[1:]) == shape:
        return image
    return interpolate(image[None], shape, mode="bilinear", antialias=True)[0].clamp(0, 1)
