"""Plane-sweep stereo of posed images: depth maps, coloured points and a mesh of one view or of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lsmgeo._checks import check_whole
from lsmgeo.cameras import CameraTensors, centers, stack, unproject_depth
from lsmgeo.classical.consistency import consistent_views
from lsmgeo.classical.depth_range import find_depth_range
from lsmgeo.classical.filtering import guided_filter
from lsmgeo.classical.gathering import gather
from lsmgeo.classical.plane_sweep import DepthMap, kept, run_sweep
from lsmgeo.classical.planes import sweep_planes
from lsmgeo.classical.sparse import SparseError, sparse_error
from lsmgeo.classical.sweep_options import SweepOptions
from lsmgeo.classical.views import default_depth_range, select_neighbours
from lsmgeo.data import PosedImages
from lsmgeo.drawing import as_pixels
from lsmgeo.errors import OptionError
from lsmgeo.grids import VoxelGrid

if TYPE_CHECKING:
    from lsmgeo.data.meshes import Mesh

__all__ = [
    "Reconstruction",
    "SceneReconstruction",
    "reconstruct_scene",
    "reconstruct_view",
    "reconstruct_views",
]

# The least confidence of a pixel to keep, as dark and uniform surfaces get some depth too; less if another view agrees.
LEAST_CONFIDENCE, LEAST_CONFIDENCE_AGREED = 0.35, 0.1
SPECK_FRACTION = 5e-4
# The default density of several views.
SCENE_DENSITY = 0.8
SPECK_FACES = 100
# Longer side in pixels of the sweep that finds a depth range.
COARSE_SIZE = 160
# The largest number of other depth maps that one is compared with: those of the nearest views.
MOST_CHECKED = 12


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The result of the sweep of one view.

    Attributes:
        view: index of the reference.
        neighbours: the views that it was matched with.
        depths: (P,) planes, ascending, world units.
        image: (3, h, w) the reference at the size of the depth map.
        camera: its camera at that size.
        depth_map: depth and confidence of every pixel; if other views were swept, a pixel on which more of them agree,
            up to two, has a higher confidence than all with fewer.
        mask: (h, w) bool, the pixels kept.
        points: (N, 3) float32 world positions of the kept pixels.
        colours: (N, 3) uint8.
        error: at the sparse points of the scene, if it has any, among the best pixels of the wanted density.
        support: (h, w) int64, the number of other swept views that agree; None if no others were swept.
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
    support: Tensor | None = None


@dataclass(frozen=True, eq=False)
class SceneReconstruction:
    """The result of the sweeps of several views.

    Attributes:
        views: one reconstruction per view, with the pixels kept on which other views agree.
        points: (N, 3) float32 world positions of all kept pixels.
        colours: (N, 3) uint8.
        mesh: their surface; None if it was not wanted, or no pixel was kept.
    """

    views: tuple[Reconstruction, ...]
    points: np.ndarray
    colours: np.ndarray
    mesh: Mesh | None


def reconstruct_view(scene: PosedImages, view: int, *, density: float = 0.4, **options: Any) -> Reconstruction:
    """Reconstruct one view by plane-sweep stereo with its best neighbours.

    Args:
        scene: posed images, see `lsmgeo.data.open`; two are enough.
        view: index of the reference.
        density: largest fraction of the pixels to keep.
        options: of the sweep, see `reconstruct_scene`.

    Returns:
        `Reconstruction`; its mask is empty if no pixel is confident, as in images without texture.

    Raises:
        OptionError: an option out of range, or no range or neighbours can be found.
        DataError: an image cannot be read.
    """
    return reconstruct_scene(scene, [view], mesh=False, density=density, **options).views[0]


def reconstruct_scene(
    scene: PosedImages,
    views: Sequence[int] | None = None,
    *,
    neighbours: int = 4,
    size: int = 640,
    planes: int = 300,
    spacing: str = "inverse",
    near: float | None = None,
    far: float | None = None,
    score: str = "zncc",
    window: int = 5,
    filtered: bool = True,
    density: float = SCENE_DENSITY,
    min_support: int | None = None,
    mesh: bool = True,
    resolution: int = 192,
    memory: int = 1 << 30,
    progress: bool = False,
) -> SceneReconstruction:
    """Reconstruct several views: depth maps that agree with each other, their points and their surface.

    Every view is swept; of its best pixels those are kept on which enough of the other views agree
    (`lsmgeo.classical.consistent_views`), and the depth maps are fused (`lsmgeo.classical.fuse_depth`).

    Args:
        scene: posed images, see `lsmgeo.data.open`; two are enough.
        views: the views to sweep; by default all. Each is matched with its best neighbours, swept or not.
        neighbours: the largest number of other views to match with.
        size: longer side of the depth maps in pixels; never larger than the images.
        planes: number of depth planes; see `lsmgeo.classical.sweep_planes`.
        spacing: "inverse", "depth" or "disparity" (which sets their number).
        near: nearest depth, world units; by default found for every view, see `lsmgeo.classical.find_depth_range`.
        far: farthest depth.
        score: "zncc", "sad" or "census", see `lsmgeo.classical.matching_costs`.
        window: side of the patches in pixels, odd.
        filtered: whether to filter the costs with `lsmgeo.classical.guided_filter`.
        density: largest fraction of the pixels to keep.
        min_support: least number of other swept views that must agree; by default 1 if others are swept.
        mesh: whether to make the surface.
        resolution: voxels along the longest side of the box in which the surface is made.
        memory: bound in bytes on what one sweep adds to the process; depth maps and images of all views are kept.
        progress: whether to show a progress bar, with one step per view, or per plane of a single view.

    Returns:
        `SceneReconstruction`.

    Raises:
        OptionError: an option out of range, or no range or neighbours can be found.
        DataError: an image cannot be read.
    """
    options = SweepOptions(
        neighbours=neighbours,
        size=size,
        planes=planes,
        spacing=spacing,
        near=near,
        far=far,
        score=score,
        window=window,
        filtered=filtered,
        density=density,
        memory=memory,
        who="reconstruct_scene",
    )
    return reconstruct_views(
        scene, views, options, min_support=min_support, mesh=mesh, resolution=resolution, progress=progress
    )


def reconstruct_views(
    scene: PosedImages,
    views: Sequence[int] | None,
    options: SweepOptions,
    *,
    min_support: int | None = None,
    mesh: bool = True,
    resolution: int = 192,
    progress: bool = False,
) -> SceneReconstruction:
    """`reconstruct_scene` with checked options."""
    chosen = list(range(len(scene))) if views is None else list(views)
    if not chosen or len(set(chosen)) != len(chosen):
        raise OptionError(f"views must name at least one view, none twice; got {views}")
    for view in chosen:
        if not 0 <= view < len(scene):
            raise OptionError(f"view must lie in 0..{len(scene) - 1}; got {view}")
    check_whole("reconstruct_scene", "resolution", resolution, 8)
    if min_support is None:
        min_support = min(1, len(chosen) - 1)
    min_support = check_whole("reconstruct_scene", "min_support", min_support, 0, len(chosen) - 1)
    is_one = len(chosen) == 1
    swept = [
        _sweep_view(scene, view, options, progress=progress and is_one)
        for view in tqdm(chosen, desc="sweep", unit="view", disable=None if progress and not is_one else True)
    ]
    density = SCENE_DENSITY if options.density is None else options.density
    kept_views = tuple(_keep(scene, one, swept, min_support, density) for one in swept)
    points = np.concatenate([one.points for one in kept_views])
    colours = np.concatenate([one.colours for one in kept_views])
    surface = surface_of(kept_views, points, resolution) if mesh and len(points) else None
    return SceneReconstruction(kept_views, points, colours, surface)


class _SweptView(NamedTuple):
    """The first fields of a `Reconstruction`, which do not depend on the results of other views."""

    view: int
    neighbours: tuple[int, ...]
    depths: Tensor
    image: Tensor
    camera: CameraTensors
    depth_map: DepthMap


def _sweep_view(scene: PosedImages, view: int, options: SweepOptions, *, progress: bool) -> _SweptView:
    near, far = _depth_range(scene, view, options)
    matched = select_neighbours(scene, view, options.neighbours, near=near, far=far)
    images, cameras = gather(scene, (view, *matched), options.size)
    depths = sweep_planes(cameras, near, far, options.planes, options.spacing)
    cost_filter = guided_filter(images[0]) if options.filtered else None
    depth_map = run_sweep(images, cameras, depths, options, cost_filter=cost_filter, progress=progress)
    return _SweptView(view, tuple(matched), depths, images[0].clone(), cameras.at(0), depth_map)


def _depth_range(scene: PosedImages, view: int, options: SweepOptions) -> tuple[float, float]:
    near, far = options.near, options.far
    if near is None or far is None:
        size = min(COARSE_SIZE, options.size)
        lower, upper = find_depth_range(scene, view, size=size, noise=options.noise, memory=options.memory)
        if (near or lower) >= (far or upper):
            lower, upper = default_depth_range(scene, view)
        near, far = near if near is not None else lower, far if far is not None else upper
    if not near < far:
        raise OptionError(f"near and far must be positive, finite and ascending; got {near} and {far}")
    return near, far


def _keep(
    scene: PosedImages, one: _SweptView, swept: Sequence[_SweptView], least: int, density: float
) -> Reconstruction:
    """The best pixels of one view on which at least ``least`` of the others agree."""
    depth_map, support = one.depth_map, None
    depth, allowed = depth_map.depth, depth_map.confidence > LEAST_CONFIDENCE
    away = (origins := centers(scene.cameras)) - origins[one.view]
    others = sorted((other for other in swept if other is not one), key=lambda other: float(away[other.view].norm()))
    if others := others[:MOST_CHECKED]:
        maps, cameras = [other.depth_map.depth for other in others], [other.camera for other in others]
        support = consistent_views(depth, one.camera, maps, cameras)
        allowed = (support >= least) & (depth_map.confidence > LEAST_CONFIDENCE_AGREED)
        # A pixel with more support has a higher confidence than all with less, up to two.
        most = min(len(others), 2)
        confidence = (support.clamp_max(most) + depth_map.confidence) / (most + 1)
        depth_map = depth_map._replace(confidence=torch.where(depth > 0, confidence, 0.0))
    specks = round(SPECK_FRACTION * depth.numel())
    mask = kept(depth_map._replace(depth=torch.where(allowed, depth, 0.0)), density, specks=specks)
    points = unproject_depth(one.camera.at(None), depth[None, None].double())[0, 0][mask].float().numpy()
    colours = as_pixels(one.image)[mask]
    error = sparse_error(scene, one.view, depth_map, kept(depth_map, density))
    return Reconstruction(*one[:-1], depth_map, mask, points, colours, error, support)


def surface_of(swept: Sequence[Reconstruction], points: np.ndarray, resolution: int) -> Mesh:
    """The surface of the kept pixels of several views, in a box around the middle 98 % of their points."""
    from lsmgeo.classical.surface import extract_mesh
    from lsmgeo.classical.tsdf import fuse_depth
    from lsmgeo.data.meshes import Mesh

    low, high = np.percentile(points.astype(np.float64), (1, 99), axis=0)
    margin = 0.1 * (high - low).max()
    if not margin > 0:  # points at one position have no surface
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    low, high = low - margin, high + margin
    voxel = (high - low).max() / resolution
    shape = np.maximum(np.ceil((high - low) / voxel).astype(int), 2)
    depth, height, width = (int(number) for number in shape[::-1])
    grid = VoxelGrid((depth, height, width), tuple(low.tolist()), tuple((low + voxel * shape).tolist()))
    depths = (torch.where(one.mask, one.depth_map.depth, 0.0) for one in swept)
    fused = fuse_depth(depths, stack([one.camera for one in swept]), grid, colours=(one.image for one in swept))
    return extract_mesh(fused, grid, specks=SPECK_FACES)
