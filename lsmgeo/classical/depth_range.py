"""Between which depths a view is swept, where nobody says and nothing was measured: a coarse sweep looks for them."""

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

# Planes of the coarse sweep, views it matches at most, and how much nearer and farther it looks than the cameras tell.
PLANES, NEIGHBOURS = 160, 4
NEARER, FARTHER = 0.3, 4.0
# The best pixels that are believed, how certain they must be, and the least fraction that says anything.
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

    From sparse points or measured depth where there are any (`lsmgeo.classical.default_depth_range`). Else a sweep of
    the reduced photograph, from far nearer to far farther than the place that the cameras look at; the range is
    that of its most certain pixels (their 1st and 99th percentile in inverse depth, widened). Where too few are
    certain, the place where the optical axes meet decides, as there.

    Args:
        scene: the posed photographs.
        view: index of the view.
        size: longer side of the reduced photograph in pixels.
        noise: standard deviation of luminance that counts as no texture.
        memory: bound in bytes on what the sweep adds to the process.

    Returns:
        Camera z, world units.

    Raises:
        OptionError: the depth cannot be told, or the view has no neighbours.
        DataError: a photograph cannot be read.
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
