"""The depth range of a sweep if none is given or measured: a coarse sweep finds it."""

from __future__ import annotations

import numpy as np

from lsmgeo.classical.filtering import guided_filter
from lsmgeo.classical.gathering import gather
from lsmgeo.classical.plane_sweep import kept, run_sweep
from lsmgeo.classical.planes import sweep_planes
from lsmgeo.classical.sweep_options import SweepOptions
from lsmgeo.classical.views import default_depth_range, measured_depth_range, select_neighbours
from lsmgeo.data import PosedImages

__all__ = ["find_depth_range"]

# Planes and neighbours of the coarse sweep, and its range in units of the depth that the cameras imply.
PLANES, NEIGHBOURS = 160, 4
NEARER, FARTHER = 0.3, 4.0
# The density and the confidence of the pixels that are used, and the least fraction of the pixels that must remain.
DENSITY, CONFIDENCE, LEAST = 0.8, 0.3, 0.02
MARGIN = 0.15


def find_depth_range(
    scene: PosedImages,
    view: int,
    *,
    size: int = 160,
    noise: float = 2 / 255,
    memory: int = 1 << 30,
) -> tuple[float, float]:
    """Nearest and farthest depth of what a view shows.

    From sparse points or measured depth if the scene has them (`lsmgeo.classical.default_depth_range`). If not, from a
    sweep of the reduced image in a range far wider than the one that the cameras imply: the 1st and 99th percentile of
    the inverse depth of its most confident pixels, widened. If too few pixels are confident, from the cameras, as in
    that function.

    Args:
        scene: posed images.
        view: index of the view.
        size: longer side of the reduced image in pixels.
        noise: standard deviation of luminance that counts as no texture.
        memory: bound in bytes on what the sweep adds to the process.

    Returns:
        Camera z, world units.

    Raises:
        OptionError: the depth cannot be inferred, or the view has no neighbours.
        DataError: an image cannot be read.
    """
    measured = measured_depth_range(scene, view)
    if measured is not None:
        return measured
    near, far = default_depth_range(scene, view)
    chosen = select_neighbours(scene, view, NEIGHBOURS, near=near, far=far)
    images, cameras = gather(scene, (view, *chosen), size)
    middle = float(np.sqrt(near * far))
    depths = sweep_planes(cameras, min(near, NEARER * middle), max(far, FARTHER * middle), PLANES)
    options = SweepOptions(min_views=min(2, len(chosen)), noise=noise, memory=memory, who="find_depth_range")
    depth_map = run_sweep(images, cameras, depths, options, cost_filter=guided_filter(images[0]))
    mask = kept(depth_map, DENSITY, CONFIDENCE)
    if float(mask.float().mean()) < LEAST:
        return near, far
    low, high = np.percentile(1 / depth_map.depth[mask].double().numpy(), (1, 99))
    margin = MARGIN * (high - low) + 0.02 * high
    return float(1 / (high + margin)), float(1 / max(low - margin, 0.5 * low))
