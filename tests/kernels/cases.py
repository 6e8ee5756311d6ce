"""A few fixed scenes for comparing a backend with the reference, small, and ugly in every way that has mattered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from lsmgeo import FrustumGrid, VoxelGrid, cameras
from lsmgeo.cameras import CameraTensors
from tests.kernels.comparison import (
    Call,
    compare,
    frustum_call,
    points_call,
    reduce_call,
    splat_call,
    sweep_call,
    unproject_call,
    views_call,
)

B, V, C = 2, 3, 5
_generator = torch.Generator().manual_seed(3)


def _random(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=_generator) - 0.5


def _ugly_cameras() -> CameraTensors:
    """Skewed, rolled, of unequal focal lengths; the last view of the second scene looks the other way."""
    azimuth = torch.tensor([[3.7, 58.1, 131.3], [11.9, 97.3, 251.7]])
    views = cameras.orbit(azimuth, 23.0, 1.7, focal_length=21.0, height=12, width=15)
    K, E = views.intrinsics.clone(), views.cam_from_world.clone()
    K[..., 0, 1] = 1.3
    K[..., 1, 1] *= 1.4
    K[..., :2, 2] += torch.tensor([0.37, -0.81])
    E[1, 2, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0])) @ E[1, 2, :3]
    E[0, 1, :3, 3] += torch.tensor([0.1, 0.2, -1.5])  # among the voxels
    return views._replace(intrinsics=K, cam_from_world=E)


VIEWS = _ugly_cameras()
POSE = torch.eye(4)
POSE[:3] = torch.tensor([[0.9, 0.2, -0.1, 0.07], [-0.3, 1.1, 0.2, -0.05], [0.15, -0.1, 0.8, 0.03]])
GRID = VoxelGrid((4, 3, 6), (-0.6, -0.5, -0.7), (0.5, 0.45, 0.65), POSE)
FEATURES = _random(B, V, C, 7, 10)
VOLUME = _random(B, C, *GRID.shape)
POINTS = 1.3 * _random(B, 11, 3)
PIXELS = torch.tensor([10.3, 7.4]) * (1.4 * _random(B, V, 11, 2) + 0.5) - 0.5
DISTANCE = _random(B, V, 11) + 0.3
VALID = _random(B, V, 11) > -0.3
DEPTHS = torch.tensor([0.62, 1.11, 1.43, 2.07, 2.9])
SIZE = (5, 6)
MASK = torch.tensor([[True, True, False], [True, False, True]])
WEIGHT, BIAS = _random(4, C * 5), _random(4)
CAMERA = VIEWS.at((slice(None), 0))
# Depths of each pixel, for each view of a sweep or shared by all, in no order; some pixels have the same ones twice.
PIXEL_DEPTHS = 1.7 + 2.4 * _random(B, V, 4, *SIZE)
PIXEL_DEPTHS[:, :, 1] = PIXEL_DEPTHS[:, :, 3]
FRUSTUM = (VIEWS, CAMERA, PIXEL_DEPTHS[:, 0])
REFERENCE, PLANE_REFERENCES = _random(B, 7 * C, 1, *SIZE), _random(B, 7 * C, 4, *SIZE)


def frustum(size: tuple[int, int] = SIZE) -> FrustumGrid:
    """Projective, with depths of their own for each scene."""
    return FrustumGrid(CAMERA, torch.stack((DEPTHS, 1.1 * DEPTHS)), size)


def _both(**options: Any) -> dict[str, Any]:
    return {"augment": ("depth", "direction"), **options}


def _case(make: Callable[..., Call], *given: Any, flat: int | None = None, **options: Any) -> Callable[[str], None]:
    reduced = options.get("reduce") is not None
    return lambda backend: compare(make(*given, **options), backend, reduced, flat)


_EVERY = ("max", "mean", "variance")
# More channels than a vector has lanes, and a rest.
WIDE, WIDE_VOLUME = (
    torch.cat([(0.3 + 0.07 * number) * source for number in range(7)], axis)
    for source, axis in ((FEATURES, 2), (VOLUME, 1))
)
BROAD = torch.cat([(1.0 - 0.09 * number) * WIDE for number in range(8)], -1)  # rows that are copied in segments
SWEEP = (VOLUME, VIEWS, GRID, DEPTHS, SIZE)
SPLAT = (VIEWS, GRID, DEPTHS)
MAPS, SHARES = _random(B, V, C, *SIZE), _random(B, V, 5, *SIZE)
WIDE_MAPS, PLANE_MAPS = _random(B, V, 4 * C, *SIZE), _random(B, V, 3 * C, 5, *SIZE)

CASES: dict[str, Callable[[str], None]] = {
    "bilinear": _case(unproject_call, FEATURES, VIEWS, GRID, **_both()),
    "bilinear, border": _case(unproject_call, WIDE, VIEWS, GRID, padding_mode="border"),
    "nearest": _case(unproject_call, FEATURES, VIEWS, GRID, mode="nearest", **_both(direction_frame="camera")),
    "nearest, border, masked": _case(
        unproject_call, FEATURES, VIEWS, GRID, mode="nearest", padding_mode="border", view_mask=MASK, **_both()
    ),
    "frustum, masked": _case(unproject_call, FEATURES, VIEWS, frustum(), view_mask=MASK, **_both()),
    # Vectors of sites, in rows longer than a tile and shorter.
    "one channel": _case(unproject_call, FEATURES[:, :, :1], VIEWS, frustum((2, 70))),
    "one channel, border": _case(unproject_call, FEATURES[:, :, :1], VIEWS, frustum((2, 70)), padding_mode="border"),
    "one channel, nearest": _case(unproject_call, FEATURES[:, :, :1], VIEWS, GRID, mode="nearest", view_mask=MASK),
    "no channel but the depth": _case(unproject_call, FEATURES[:, :, :0], VIEWS, GRID, augment=("depth",)),
    "near": _case(unproject_call, FEATURES, VIEWS, GRID, near=1.6, padding_mode="border"),
    "mean": _case(unproject_call, WIDE, VIEWS, GRID, reduce="mean"),
    "variance": _case(unproject_call, WIDE, VIEWS, GRID, reduce="variance", padding_mode="border"),
    "statistics": _case(unproject_call, FEATURES, VIEWS, GRID, reduce=_EVERY, view_mask=MASK, **_both()),
    "points": _case(points_call, FEATURES, VIEWS, POINTS, **_both()),
    "points, statistics": _case(points_call, FEATURES, VIEWS, POINTS, reduce=_EVERY, **_both()),
    "pixels": _case(views_call, WIDE, PIXELS, DISTANCE, VALID, augment="depth", padding_mode="border"),
    "pixels, mean": _case(views_call, FEATURES, PIXELS, DISTANCE, VALID, reduce="mean"),
    "trilinear": _case(sweep_call, *SWEEP, flatten=False, **_both()),
    "trilinear, border, stacked": _case(
        sweep_call, WIDE_VOLUME, *SWEEP[1:], flat=5, padding_mode="border", view_mask=MASK, **_both()
    ),
    "nearest sweep": _case(sweep_call, *SWEEP, flatten=False, mode="nearest", **_both(direction_frame="camera")),
    "nearest sweep, stacked, near": _case(sweep_call, *SWEEP, flat=5, mode="nearest", near=1.2),
    "reduced sweep": _case(reduce_call, *SWEEP, WEIGHT, BIAS),
    "depths of pixels": _case(frustum_call, WIDE, *FRUSTUM, view_mask=MASK, **_both()),
    "depths of pixels, float64": _case(frustum_call, FEATURES, VIEWS, CAMERA, PIXEL_DEPTHS[:, 0].double(), near=1.1),
    "depths of pixels, nearest": _case(frustum_call, FEATURES, *FRUSTUM, mode="nearest", **_both()),
    "depths of pixels, variance": _case(frustum_call, WIDE, *FRUSTUM, reduce="variance", padding_mode="border"),
    "depths of pixels, statistics": _case(
        frustum_call, FEATURES, *FRUSTUM, reduce=_EVERY, **_both(direction_frame="camera")
    ),
    "sweep of pixels' depths": _case(
        sweep_call, *SWEEP[:3], PIXEL_DEPTHS, SIZE, flatten=False, view_mask=MASK, **_both()
    ),
    "sweep of pixels' depths, zeros": _case(sweep_call, *SWEEP[:3], PIXEL_DEPTHS, SIZE, flatten=False),
    "sweep of pixels' depths, stacked": _case(
        sweep_call, WIDE_VOLUME, *SWEEP[1:3], PIXEL_DEPTHS, SIZE, flat=4, padding_mode="border"
    ),
    "correlation": _case(frustum_call, WIDE, VIEWS, CAMERA, DEPTHS, REFERENCE, SIZE, view_mask=MASK, **_both()),
    "correlation, groups": _case(frustum_call, WIDE, *FRUSTUM, PLANE_REFERENCES, groups=7, padding_mode="border"),
    "correlation, each channel": _case(frustum_call, WIDE, *FRUSTUM, REFERENCE, groups=7 * C, mode="nearest"),
    "correlation, mean": _case(frustum_call, WIDE, VIEWS, CAMERA, DEPTHS[:4], PLANE_REFERENCES, SIZE, reduce="mean"),
    "correlation, mean of groups": _case(frustum_call, WIDE, *FRUSTUM, REFERENCE, groups=5, reduce="mean"),
    "correlation, statistics": _case(
        frustum_call, WIDE, *FRUSTUM, REFERENCE, groups=7, reduce=_EVERY, view_mask=MASK, **_both()
    ),
    "splat": _case(splat_call, WIDE_MAPS, *SPLAT, SHARES, view_mask=MASK),
    "splat, border": _case(splat_call, WIDE_MAPS, *SPLAT, SHARES, padding_mode="border", near=1.2),
    "splat, nearest": _case(splat_call, MAPS, *SPLAT, SHARES, mode="nearest", near=1.2),
    "splat, nearest, border": _case(
        splat_call, MAPS, *SPLAT[:2], PIXEL_DEPTHS, SHARES[:, :, :4], mode="nearest", padding_mode="border"
    ),
    "splat of pixels' depths": _case(splat_call, WIDE_MAPS, *SPLAT[:2], PIXEL_DEPTHS, SHARES[:, :, :4]),
    "splat, planes adjacent": _case(splat_call, WIDE_MAPS, *SPLAT, SHARES.movedim(2, -1).contiguous().movedim(-1, 2)),
    "splat without weights": _case(splat_call, PLANE_MAPS, *SPLAT, view_mask=MASK),
    "splat without weights, nearest": _case(
        splat_call, PLANE_MAPS.movedim(3, -1).contiguous().movedim(-1, 3), *SPLAT, mode="nearest", padding_mode="border"
    ),
    "splat without weights, pixels' depths": _case(splat_call, PLANE_MAPS[:, :, :, :4], *SPLAT[:2], PIXEL_DEPTHS),
    "broad": _case(unproject_call, BROAD, VIEWS, GRID),
    "broad, columns adjacent": _case(
        unproject_call, BROAD.mT.contiguous().mT, VIEWS, GRID, reduce="variance", padding_mode="border"
    ),
    "contiguous": _case(
        unproject_call, WIDE, VIEWS, GRID, reduce=("mean", "variance"), memory_format=torch.contiguous_format
    ),
}
HALF: dict[str, Callable[[str], None]] = {
    f"{name}, {dtype}".replace("torch.", ""): case
    for dtype in (torch.bfloat16, torch.float16)
    for name, case in {
        "bilinear": _case(unproject_call, WIDE.to(dtype), VIEWS, GRID, **_both()),
        "statistics": _case(unproject_call, WIDE.to(dtype), VIEWS, GRID, reduce=("mean", "variance")),
        "mean": _case(unproject_call, BROAD.to(dtype), VIEWS, GRID, reduce="mean"),
        "contiguous": _case(unproject_call, WIDE.to(dtype), VIEWS, GRID, memory_format=torch.contiguous_format),
        "trilinear": _case(sweep_call, WIDE_VOLUME.to(dtype), *SWEEP[1:], flat=5, padding_mode="border", **_both()),
        "pixels": _case(views_call, WIDE.to(dtype), PIXELS, DISTANCE, VALID),
        "one channel": _case(unproject_call, FEATURES[:, :, :1].to(dtype), VIEWS, GRID, padding_mode="border"),
        "depths of pixels": _case(frustum_call, WIDE.to(dtype), *FRUSTUM, **_both()),
        "correlation": _case(frustum_call, WIDE.to(dtype), *FRUSTUM, REFERENCE.to(dtype), groups=7),
        "correlation, mean": _case(
            frustum_call, WIDE.to(dtype), *FRUSTUM, PLANE_REFERENCES.to(dtype), groups=5, reduce="mean"
        ),
        "splat": _case(splat_call, WIDE_MAPS.to(dtype), *SPLAT, SHARES.to(dtype)),
        "splat without weights": _case(splat_call, PLANE_MAPS.to(dtype), *SPLAT, mode="nearest"),
        "small numbers": _case(unproject_call, (1e-5 * WIDE).to(dtype), VIEWS, GRID, padding_mode="border"),
    }.items()
}


# In a world of another unit variances, depths and sums go beyond what float16 holds, beside others that do not.
UNIT = 5e4
FAR_VIEWS = VIEWS._replace(
    cam_from_world=torch.cat((VIEWS.cam_from_world[..., :3], UNIT * VIEWS.cam_from_world[..., 3:]), -1)
)
FAR_VIEWS.cam_from_world[..., 3, 3] = 1.0
FAR_GRID = VoxelGrid(GRID.shape, GRID.lower, GRID.upper, torch.diag(torch.tensor([UNIT, UNIT, UNIT, 1.0])) @ POSE)
LARGE = (1020.0 * torch.rand(WIDE.shape, generator=_generator)).half()
HALF |= {
    "variance that saturates": _case(unproject_call, LARGE, VIEWS, GRID, reduce="variance"),
    "statistics that saturate": _case(unproject_call, LARGE, FAR_VIEWS, FAR_GRID, reduce=_EVERY, **_both()),
    "correlation that saturates": _case(frustum_call, LARGE, *FRUSTUM, (400.0 * REFERENCE).half(), groups=7),
    "correlation that saturates, mean": _case(
        frustum_call, LARGE, *FRUSTUM, (400.0 * REFERENCE).half(), groups=7, reduce="mean"
    ),
    "splat that saturates": _case(splat_call, (4e4 * WIDE_MAPS).half(), *SPLAT, SHARES.half(), padding_mode="border"),
    "depth that saturates": _case(unproject_call, FEATURES.half(), FAR_VIEWS, FAR_GRID, **_both()),
    "swept depth that saturates": _case(
        sweep_call, VOLUME.half(), FAR_VIEWS, FAR_GRID, UNIT * DEPTHS, SIZE, flatten=False, **_both()
    ),
    "given depth that saturates": _case(views_call, FEATURES.half(), PIXELS, 1e5 * DISTANCE, VALID, augment="depth"),
    "points' statistics that saturate": _case(points_call, LARGE, VIEWS, POINTS, reduce=_EVERY),
    "reduced sweep that saturates": _case(
        reduce_call, 1e3 * VOLUME.half(), *SWEEP[1:], 100.0 * WEIGHT, 2e4 * BIAS, padding_mode="border"
    ),
}

# What no gradient to the geometry comes from, but through the channels that are named.
NEAREST = {
    f"{operator}, {augment or 'nothing'}, {reduce}": make(
        *given,
        mode="nearest",
        **({"augment": augment} if augment else {}),
        **({"reduce": reduce} if reduce else {}),
    )
    for operator, make, given in (
        ("unproject", unproject_call, (FEATURES, VIEWS, GRID)),
        ("points", points_call, (FEATURES, VIEWS, POINTS)),
        ("pixels", views_call, (FEATURES, PIXELS, DISTANCE, VALID)),
        ("sweep", sweep_call, SWEEP),
        ("reduced sweep", reduce_call, (*SWEEP, WEIGHT, None)),
        ("splat", splat_call, (MAPS, *SPLAT, SHARES)),
    )
    for augment in ("", "depth", "direction")
    for reduce in (None, "mean")
    if not (reduce and "sweep" in operator)
    and not ((reduce or augment) and operator == "splat")
    and not (augment == "direction" and operator == "pixels")
    and not (augment and operator == "reduced sweep")
}
