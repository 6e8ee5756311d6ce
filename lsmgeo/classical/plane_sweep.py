"""Plane-sweep stereo: a cost for every plane of a view's frustum, and the winner along every ray."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad, unfold
from tqdm import tqdm

from lsmgeo import functional
from lsmgeo.cameras import CameraTensors, resize
from lsmgeo.classical.patches import patch_features, patch_frames
from lsmgeo.errors import OptionError
from lsmgeo.grids import FrustumGrid

__all__ = ["DepthMap", "kept", "slab_planes", "sweep"]

UNRELATED = 1.0
# A second minimum counts against the first only where it is another place, not the noise around the same one.
SAME_PLANES = 2.5
# How many arrays of each kind are alive at once at the worst moment (measured), and what the libraries take besides.
LIVE_SLABS = 8
LIVE_FEATURES = 4
LIVE_IMAGES = 16
OVERHEAD = 128 << 20


class DepthMap(NamedTuple):
    """Depth of every pixel of a view and how far it can be trusted."""

    depth: Tensor  # (h, w) camera z, world units, 0 where no plane wins
    confidence: Tensor  # (h, w) in [0, 1]
    cost: Tensor  # (h, w), 1 - mean correlation between the views: 0 is perfect, 1 unrelated
    planes: Tensor  # (h, w) fractional index of the winning plane, -1 where none


def slab_planes(views: int, channels: int, size: tuple[int, int], memory: int) -> int:
    """Planes that a slab may have within a memory bound.

    Args:
        views: V.
        channels: C of the features.
        size: (h, w) of the maps.
        memory: bytes that the sweep may add to the process.

    Raises:
        OptionError: not even one plane fits.
    """
    image = 4 * size[0] * size[1]
    fixed = OVERHEAD + (LIVE_FEATURES * views * channels + LIVE_IMAGES) * image
    plane = LIVE_SLABS * channels * image
    if memory < fixed + plane:
        need = -(-(fixed + plane) // 2**20)
        raise OptionError(
            f"memory must be at least {need} MiB for {views} views of {size[1]} x {size[0]}; got {memory >> 20} MiB"
        )
    return int((memory - fixed) // plane)


def sweep(
    images: Tensor,
    cameras: CameraTensors,
    depths: Tensor,
    *,
    window: int = 3,
    aggregate: int = 5,
    min_views: int = 3,
    noise: float = 2 / 255,
    memory: int = 1 << 30,
    progress: bool = False,
) -> DepthMap:
    """Depth of the first view by sweeping planes through its frustum.

    Every site of the frustum takes the patch features of all views; their variance is a matching cost (see
    `lsmgeo.classical.patches.patch_features`), averaged over ``aggregate`` x ``aggregate`` pixels. Along a ray the
    lowest local minimum wins, among sites that at least ``min_views`` views see, and a parabola through it and its
    neighbours places it between planes. Planes pass in slabs and only the running winners are kept. (Collins, "A
    space-sweep approach to true multi-image matching", CVPR 1996.)

    Convention:
        Depth is camera z of the first view. Integer pixel centres.

    Args:
        images: (V, 3, h, w) RGB in [0, 1], the reference first.
        cameras: leading shape (V,), of images resized to (h, w) or of the originals, which may differ in size.
        depths: (P,) ascending, P >= 3.
        window: side of the patches.
        aggregate: side of the square over which costs are averaged, odd.
        min_views: least number of views that must see a site, the reference included.
        noise: standard deviation of luminance that counts as no texture.
        memory: bound in bytes on what the sweep adds to the process, from which the size of a slab follows.
        progress: whether to show a progress bar (on a terminal).

    Returns:
        `DepthMap` at (h, w).

    Raises:
        OptionError: too few planes or views, or a memory bound too small for one plane.
        ShapeError, CameraError, GridError: as `lsmgeo.functional.unproject`.
    """
    views, _, height, width = images.shape
    if depths.shape[-1] < 3:
        raise OptionError(f"sweep: depths must hold at least 3 planes; got {depths.shape[-1]}")
    if not 2 <= min_views <= views:
        raise OptionError(f"sweep: min_views must lie in 2..{views}, the number of views; got {min_views}")
    # Patches take their steps in pixels of the images at hand, and every view may have been resized by its own factors.
    cameras = resize(cameras, height, width)
    reference = CameraTensors(*(torch.as_tensor(value)[0] for value in cameras))
    grid = FrustumGrid(reference, depths, (height, width))
    middle = float((depths[0] * depths[-1]).sqrt())
    slab = slab_planes(views, window * window + views, (height, width), memory)
    with torch.no_grad():
        features = patch_features(images, patch_frames(cameras, middle), window=window, noise=noise)
        winners = _Winners(height, width)
        slabs = functional.unproject_slabs(
            features[None], cameras, grid, slab, reduce="variance", padding_mode="border"
        )
        with tqdm(total=depths.shape[-1], desc="sweep", unit="plane", disable=None if progress else True) as bar:
            for _, variance, visible in slabs:
                count = visible[0].sum(0)  # (d, h, w)
                cost = variance[0].sum(0) * (count / (count - 1).clamp_min(1))
                cost = torch.where(count >= min_views, cost, UNRELATED)
                cost = _box(cost, aggregate)
                for plane_cost, plane_count in zip(cost, count, strict=True):
                    winners.push(plane_cost, plane_count >= min_views)
                bar.update(len(cost))
        return winners.finish(depths)


def kept(depth_map: DepthMap, density: float, least: float = 0.0, specks: int = 0) -> Tensor:
    """The best pixels of a depth map.

    Args:
        depth_map: from `sweep`.
        density: largest fraction of all pixels to keep, in (0, 1]; among equals the first, row by row, are kept.
        least: confidence below which a pixel is never kept.
        specks: drop connected patches of kept pixels, without a jump in depth, that have fewer pixels than this.

    Returns:
        (h, w) bool.

    Raises:
        OptionError: a density outside (0, 1].

    Example:
        >>> import torch
        >>> from lsmgeo.classical.plane_sweep import DepthMap, kept
        >>> ones = torch.ones(2, 2)
        >>> kept(DepthMap(ones, torch.tensor([[0.9, 0.1], [0.5, 0.7]]), ones, ones), density=0.5)
        tensor([[ True, False],
                [False,  True]])
    """
    if not 0 < density <= 1:
        raise OptionError(f"kept: density must lie in (0, 1]; got {density}")
    confidence = torch.where(depth_map.depth > 0, depth_map.confidence, 0.0)
    # The margin keeps a product that is whole but for rounding: 0.29 * 100 is 28.999999999999996.
    number = math.floor(density * confidence.numel() + 1e-6)
    # A stable order, unlike topk's, is the same on every machine where confidences are equal.
    best = confidence.flatten().sort(descending=True, stable=True).indices[:number]
    mask = torch.zeros_like(confidence, dtype=torch.bool)
    mask.view(-1)[best] = True
    mask &= confidence > least
    return _without_specks(mask, depth_map.planes, specks) if specks > 1 else mask


def _without_specks(mask: Tensor, planes: Tensor, least: int) -> Tensor:
    """A mask without its connected patches of fewer than `least` pixels; a jump of two planes separates patches."""
    import cv2

    steps = 8  # filterSpeckles wants 16-bit integers: eighths of a plane
    labels = torch.where(mask, (planes.clamp(0, 4000) + 1) * steps, 0.0).to(torch.int16).numpy()
    cv2.filterSpeckles(labels, 0, least - 1, 2 * steps)
    return mask & torch.from_numpy(labels > 0)


class _Winners:
    """The lowest and second-lowest local minimum of a cost along every ray, from planes that come one by one."""

    def __init__(self, height: int, width: int):
        self.before: list[tuple[Tensor, Tensor]] = []
        self.count = 0
        self.best = torch.full((height, width), 2 * UNRELATED)
        self.second = torch.full((height, width), UNRELATED)
        self.place = torch.full((height, width), -1.0)

    def push(self, cost: Tensor, seen: Tensor) -> None:
        """Take the next plane's cost (h, w) and where enough views see it."""
        self.before.append((cost.clone(), seen))
        self.count += 1
        if len(self.before) < 3:
            return
        (previous, _), (middle, usable), (following, _) = self.before
        self.before.pop(0)
        is_minimum = usable & (middle <= previous) & (middle < following)
        curvature = (previous - 2 * middle + following).clamp_min(1e-9)
        place = self.count - 2 + (0.5 * (previous - following) / curvature).clamp(-0.5, 0.5)
        elsewhere = (place - self.place > SAME_PLANES) | (self.place < 0)
        better = is_minimum & (middle < self.best)
        loser = torch.where(better, self.best, torch.where(is_minimum, middle, UNRELATED)).clamp_max(UNRELATED)
        # A better minimum beside the old one replaces it; elsewhere it demotes the old one.
        self.second = torch.where(
            better,
            torch.where(elsewhere, loser, self.second),
            torch.where(elsewhere, torch.minimum(loser, self.second), self.second),
        )
        self.best = torch.where(better, middle, self.best)
        self.place = torch.where(better, place, self.place)

    def finish(self, depths: Tensor) -> DepthMap:
        """Depth and confidence of the winners."""
        found = self.place >= 0
        inverse = 1 / depths.double()
        lower = self.place.clamp(0, len(depths) - 2).floor().long()
        depth = 1 / torch.lerp(inverse[lower], inverse[lower + 1], (self.place - lower).double())
        depth = torch.where(found, depth, 0.0).float()
        correlation = (1 - self.best).clamp(0, 1)
        unique = ((self.second - self.best) / self.second.clamp_min(1e-3)).clamp(0, 1)
        confidence = torch.where(found, correlation * unique.sqrt() * _agreement(self.place), 0.0)
        return DepthMap(depth, confidence, self.best.clamp_max(UNRELATED), self.place)


def _box(cost: Tensor, side: int) -> Tensor:
    """Average (d, h, w) over side x side pixels; at the border over those that exist."""
    return avg_pool2d(cost, side, 1, side // 2, count_include_pad=False) if side > 1 else cost


def _agreement(place: Tensor, radius: int = 2) -> Tensor:
    """The fraction of the pixels around each whose winner lies within two planes of its own, (h, w)."""
    height, width = place.shape
    side = 2 * radius + 1
    around = unfold(pad(place[None, None], (radius,) * 4, value=-1e6), side)[0].reshape(side * side, height, width)
    return (((around - place).abs() <= 2).float().sum(0) - 1) / (side * side - 1)
