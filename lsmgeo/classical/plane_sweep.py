"""Plane-sweep stereo: a cost for every plane of the frustum of a view, and the winner along every ray."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad
from tqdm import tqdm

from lsmgeo._checks import check_float, check_number, check_whole
from lsmgeo.cameras import resize
from lsmgeo.cameras.tensors import Cameras
from lsmgeo.classical.matching import INVALID_COST, aggregated_costs
from lsmgeo.classical.planes import longest_path
from lsmgeo.classical.sweep_options import SweepOptions
from lsmgeo.classical.winner_take_all import WinnerTakeAll
from lsmgeo.errors import OptionError

__all__ = ["DepthMap", "kept", "run_sweep", "slab_planes", "sweep"]

# Minima that are closer are one: a cost varies no faster than the image.
SAME_PIXELS = 2.0
# More planes at once are not faster.
MOST_PLANES = 8
# The largest number of arrays of each kind in memory at one time (measured), and the memory of the libraries.
LIVE_COSTS = 8
LIVE_IMAGES = 24
OVERHEAD = 48 << 20


class DepthMap(NamedTuple):
    """Depth of every pixel of a view, and its confidence."""

    depth: Tensor  # (h, w) camera z, world units, 0 where no plane wins
    confidence: Tensor  # (h, w) in [0, 1]
    cost: Tensor  # (h, w), the winner's matching cost: 0 is perfect, 1 unrelated
    planes: Tensor  # (h, w) fractional index of the winning plane, -1 where none


def slab_planes(neighbours: int, channels: int, size: tuple[int, int], memory: int) -> int:
    """The number of planes of a slab within a memory bound in bytes; `OptionError` if not even one plane fits.

    A neighbour has ``channels`` numbers of 4 bytes per pixel of maps of ``size`` (h, w).
    """
    image = 4 * size[0] * size[1]
    buffers = torch.get_num_threads() * (neighbours + 4)
    fixed = OVERHEAD + ((neighbours + 1) * (channels + 1) + buffers + LIVE_IMAGES) * image
    plane = (3 * channels + LIVE_COSTS) * neighbours * image
    if memory < fixed + plane:
        need = -(-(fixed + plane) // 2**20)
        raise OptionError(
            f"memory must be at least {need} MiB for {neighbours + 1} views of {size[1]} x {size[0]}; "
            f"got {memory >> 20} MiB"
        )
    return int(min((memory - fixed) // plane, MOST_PLANES))


def sweep(
    images: Tensor,
    cameras: Cameras,
    depths: Tensor,
    *,
    score: str = "zncc",
    window: int = 5,
    best: int | None = None,
    min_views: int = 1,
    cost_filter: Callable[[Tensor], Tensor] | None = None,
    noise: float = 2 / 255,
    memory: int = 1 << 30,
    progress: bool = False,
) -> DepthMap:
    """Depth of the first view by sweeping planes through its frustum.

    At every site the costs of the `best` neighbours that see it are averaged (see `lsmgeo.classical.matching_costs`
    and `lsmgeo.classical.aggregate_views`). Along a ray the lowest local minimum wins, and a parabola through it and
    its neighbours in inverse depth places it between planes. Planes are processed in slabs, and only the running
    winners are kept. (Collins, "A space-sweep approach to true multi-image matching", CVPR 1996.)

    Convention:
        Depth is camera z of the first view. Integer pixel centres.

    Args:
        images: (V, C, h, w), the reference first, V at least 2: RGB or grey in [0, 1], or features.
        cameras: leading shape (V,), of images of any sizes; they are resized to (h, w).
        depths: (P,) ascending, P >= 3; see `lsmgeo.classical.sweep_planes`.
        score: "zncc", "sad", "census" or "cosine".
        window: side of the patches, odd.
        best: neighbours averaged at a site, by default half of them, rounded up.
        min_views: least number of neighbours that must see a site, the reference not included.
        cost_filter: maps costs (d, h, w) float32 of some planes to filtered ones, plane by plane.
        noise: standard deviation of the images below which texture has little weight.
        memory: bound in bytes on the memory that the sweep adds to the process; it sets the size of a slab.
        progress: whether to show a progress bar (on a terminal).

    Returns:
        `DepthMap` at (h, w). The confidence is ``max(0, 1 - cost)`` times the square root of the uniqueness (by how
        much the second-lowest minimum at another depth is above the lowest) times the fraction of nearby pixels at the
        same depth, within two pixels in the neighbour in which samples move most.

    Raises:
        OptionError: too few planes or views, or a memory bound too small for one plane.
        ShapeError, CameraError, GridError: as `lsmgeo.functional.unproject`.
    """
    options = SweepOptions(score=score, window=window, best=best, min_views=min_views, noise=noise, memory=memory)
    check_float("sweep", "images", images, "(V, C, h, w)", rank=4)
    check_float("sweep", "depths", depths, "(P,)", rank=1)
    if depths.shape[0] < 3:
        raise OptionError(f"sweep: depths must hold at least 3 planes; got {depths.shape[0]}")
    return run_sweep(images, cameras, depths, options, cost_filter=cost_filter, progress=progress)


def run_sweep(
    images: Tensor,
    cameras: Cameras,
    depths: Tensor,
    options: SweepOptions,
    *,
    cost_filter: Callable[[Tensor], Tensor] | None = None,
    progress: bool = False,
) -> DepthMap:
    """`sweep` with checked options."""
    views, channels, height, width = images.shape
    warped = (channels if options.score in ("sad", "cosine") else 1) * max(1, images.element_size() // 4)
    slab = slab_planes(max(views - 1, 1), warped, (height, width), options.memory)
    with torch.no_grad():
        winners = WinnerTakeAll(depths, (height, width), INVALID_COST, _planes_apart(cameras, depths, (height, width)))
        with tqdm(total=len(depths), desc="sweep", unit="plane", disable=None if progress else True) as bar:
            for cost, seen in aggregated_costs(images, cameras, depths, slab, options):
                if cost_filter is not None:
                    cost = cost_filter(cost)
                winners.push(cost, seen)
                bar.update(len(cost))
        cost, place = torch.from_numpy(winners.best), torch.from_numpy(winners.place)
        confidence = (1 - cost).clamp(0, 1) * winners.uniqueness().sqrt() * _agreement(place, winners.apart)
        confidence = torch.where(place >= 0, confidence, 0.0)
        return DepthMap(*(values.to(images.device) for values in (winners.depth(), confidence, cost, place)))


def _planes_apart(cameras: Cameras, depths: Tensor, size: tuple[int, int]) -> float:
    """The planes over which a sample moves `SAME_PIXELS` on average, in the neighbour where it moves most."""
    path = longest_path(resize(cameras, *size), float(depths[0]), float(depths[-1]))
    return SAME_PIXELS * (len(depths) - 1) / max(path, 1e-6)


def kept(depth_map: DepthMap, density: float, least: float = 0.0, specks: int = 0) -> Tensor:
    """The best pixels of a depth map.

    Args:
        depth_map: from `sweep`.
        density: largest fraction of all pixels to keep, in (0, 1]; of equal pixels the first, row by row, are kept.
        least: confidence below which a pixel is never kept.
        specks: connected patches of kept pixels, without a jump in depth, with fewer pixels than this are dropped.

    Returns:
        (h, w) bool.

    Raises:
        OptionError: a density outside (0, 1], or specks that are not a whole number.

    Example:
        >>> import torch
        >>> from lsmgeo.classical.plane_sweep import DepthMap, kept
        >>> ones = torch.ones(2, 2)
        >>> kept(DepthMap(ones, torch.tensor([[0.9, 0.1], [0.5, 0.7]]), ones, ones), density=0.5)
        tensor([[ True, False],
                [False,  True]])
    """
    if not 0 < check_number("kept", "density", density, "a number in (0, 1]") <= 1:
        raise OptionError(f"kept: density must lie in (0, 1]; got {density}")
    check_number("kept", "least", least, "a number")
    check_whole("kept", "specks", specks, 0, 2**31 - 1)
    confidence = torch.where(depth_map.depth > 0, depth_map.confidence, 0.0)
    # The margin is for products that are whole but for rounding: 0.29 * 100 is 28.999999999999996.
    number = math.floor(density * confidence.numel() + 1e-6)
    # A stable order, unlike that of topk, is the same on every machine if confidences are equal.
    best = confidence.flatten().sort(descending=True, stable=True).indices[:number]
    mask = torch.zeros_like(confidence, dtype=torch.bool)
    mask.view(-1)[best] = True
    mask &= confidence > least
    return _without_specks(mask, depth_map.planes, specks) if specks > 1 else mask


def _without_specks(mask: Tensor, planes: Tensor, least: int) -> Tensor:
    """A mask without its connected patches of fewer than `least` pixels; a jump of two planes separates patches."""
    import cv2

    steps = 8  # filterSpeckles needs 16-bit integers: eighths of a plane
    labels = torch.where(mask, (planes.clamp(0, 4000) + 1) * steps, 0.0).to(torch.int16).numpy()
    cv2.filterSpeckles(labels, 0, least - 1, 2 * steps)
    return mask & torch.from_numpy(labels > 0)


def _agreement(place: Tensor, apart: float, radius: int = 2) -> Tensor:
    """The fraction of the pixels around each whose winner is at most ``apart`` planes from its own, (h, w)."""
    height, width = place.shape
    side = 2 * radius + 1
    around = pad(place[None], (radius,) * 4, value=-1e6)[0]
    count = torch.zeros(place.shape, dtype=torch.uint8)
    for y in range(side):
        for x in range(side):
            count += (around[y : y + height, x : x + width] - place).abs_() <= apart
    return (count.float() - 1) / (side * side - 1)
