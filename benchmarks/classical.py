"""Errors of classical reconstruction on photos with known geometry; all its sections are run from here.

Each figure is compared with its goal, or with the figure of a competitor, which runs here too with the settings in
`benchmarks.classical_rivals`. Densities are fractions of all pixels of a view, in the order of the method's own
confidence; an error at a density is over those of them whose true value is known. "Bad-2" is the fraction with a
disparity error above two pixels.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks import classical_exact, classical_rivals
from benchmarks.classical_rivals import Found, bad_at, luminance, matchers, median_at, plain_sweep, row, winners
from benchmarks.known_sets import BASELINE, FOCAL_LENGTH, OFFSET, write_motorcycle
from benchmarks.measuring import Settings
from benchmarks.triangulated import Depths, find_features, triangulate
from lsmgeo import VoxelGrid, data, functional
from lsmgeo.cameras import CameraTensors, project, resize, stack
from lsmgeo.classical import Reconstruction, hull_box, reconstruct_scene, silhouettes, visual_hull
from lsmgeo.classical.tsdf import voxel_side

Section = dict[str, Any]  # rows of the table, and the numbers of the curves


def found_in(one: Reconstruction) -> Found:
    """The depth of a view, and its confidence."""
    depth = one.depth_map.depth.double().numpy()
    return Found(np.where(depth > 0, depth, np.nan), one.depth_map.confidence.numpy())


# The search range of all methods, in whole disparities for those that require it.
FIRST, LAST = 4, 64
THRESHOLD = 2.0
DENSITIES = tuple(tenth / 10 for tenth in range(1, 11))


def depth_of(disparity: Any) -> Any:
    """Z = f B / (d + doffs), millimetres."""
    return FOCAL_LENGTH * BASELINE / (disparity + OFFSET)


def disparity_of(depth: np.ndarray) -> np.ndarray:
    """Disparity, NaN without depth."""
    with np.errstate(divide="ignore"):
        return np.where(depth > 0, FOCAL_LENGTH * BASELINE / depth - OFFSET, np.nan)


def motorcycle(root: Path, planes: int = 300, *, unfiltered: bool = True) -> tuple[dict[str, Found], np.ndarray, float]:
    """Disparities of all methods, the true ones, and the fraction of our pixels that both directions agree on.

    OpenCV's matchers have no confidence, only valid pixels: their curves have a single point.
    """
    with tempfile.TemporaryDirectory() as scratch:
        scene = data.open(write_motorcycle(root, Path(scratch)))
        images = [scene.load(view) for view in (0, 1)]
        true = disparity_of(np.asarray(scene.load_depth(0), np.float64))
        options = {"near": depth_of(LAST), "far": depth_of(FIRST), "size": max(true.shape), "planes": planes}
        ours = {
            f"ours, {name}": reconstruct_scene(
                scene, density=1.0, mesh=False, filtered=name == "filtered", **options
            ).views[0]
            for name in ("filtered", "unfiltered")[: 1 + unfiltered]
        }
        plain = plain_sweep([luminance(image) for image in images], scene.cameras, depth_of(np.arange(FIRST, LAST + 1)))
    depths = {name: found_in(one) for name, one in ours.items()} | {"plain ZNCC": plain}
    methods = {name: found._replace(value=disparity_of(found.value)) for name, found in depths.items()}
    methods |= matchers(*((image.permute(1, 2, 0) * 255).round().byte().numpy() for image in images))
    agreed = ours["ours, filtered"].support
    return methods, true, float((agreed > 0).float().mean()) if agreed is not None else 0.0


def curve(method: Found, true: np.ndarray) -> tuple[list[float], list[float]]:
    """Densities, of all pixels, and the fraction of wrong pixels at each; one density if the confidence is binary."""
    most = float(np.isfinite(method.value).mean())
    levels = [density for density in DENSITIES if density < most] + [most]
    levels = [most] if len(np.unique(method.confidence)) <= 2 else levels
    return levels, [bad_at(method, true, density, THRESHOLD) for density in levels]


def stereo(root: Path) -> Section:
    """Middlebury's motorcycle: our sweep of a rectified pair against OpenCV's two matchers and a plain sweep."""
    methods, true, agreed = motorcycle(root)
    curves = {name: dict(zip(("density", "bad"), curve(method, true), strict=True)) for name, method in methods.items()}
    rows = [
        row("motorcycle", f"bad-2 at {100 * density:.0f} % density, {name}", f"{100 * bad:.1f} %")
        for name, drawn in curves.items()
        for density, bad in zip(drawn["density"], drawn["bad"], strict=True)
        if density in (0.4, 0.7, drawn["density"][-1])
    ]
    ours, plain, rival = (methods[name] for name in ("ours, filtered", "plain ZNCC", "StereoSGBM"))
    # Our valid pixels are those where both directions agree.
    density = min(agreed, float(np.isfinite(ours.value).mean()))
    both = winners(ours, density) & np.isfinite(rival.value) & np.isfinite(true)
    mine, theirs = (100 * float((np.abs(method.value - true)[both] > THRESHOLD).mean()) for method in (ours, rival))
    what = f"bad-2 on pixels valid in both, ours at {100 * density:.0f} % density, over StereoSGBM's"
    measured, reached = f"{mine:.2f} % : {theirs:.2f} % = {mine / theirs:.2f}", density >= 0.7 and mine <= 1.5 * theirs
    rows.append(row("motorcycle", what, measured, "at most 1.5 at 70 % or more", reached))
    fewer = sum(bad_at(ours, true, level, THRESHOLD) < bad_at(plain, true, level, THRESHOLD) for level in DENSITIES)
    what = "densities of 10 at which ours has fewer bad pixels than plain ZNCC"
    rows.append(row("motorcycle", what, str(fewer), "all 10", fewer == 10))
    return {"rows": rows, "bad_pixel_curves": curves, "threshold_px": THRESHOLD}


WALK_DENSITIES = (0.1, 0.2, 0.4)


def walk(root: Path, views: list[int] | None = None) -> dict[str, np.ndarray]:
    """The median relative depth error of every frame (rows) at every density (columns), of both methods."""
    scene = data.open(root / "hololens_rgbd")
    options: Any = {"near": 0.7, "far": 8.0, "planes": 128, "size": 540, "density": 1.0, "mesh": False}
    table: dict[str, list[list[float]]] = {"ours": [], "plain ZNCC": []}
    for one in reconstruct_scene(scene, views, progress=True, **options).views:
        depth = scene.load_depth(one.view)
        assert depth is not None
        height, width = one.mask.shape
        y, x = (
            np.round((np.arange(n) + 0.5) * m / n - 0.5).astype(int)
            for n, m in zip((height, width), depth.shape, strict=True)
        )
        measured = depth.double().numpy()[np.ix_(y, x)]
        true = np.where(measured > 0, measured, np.nan)
        seen = (one.view, *one.neighbours)
        loaded = (luminance(scene.load(view)) for view in seen)
        images = [cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in loaded]
        cameras = stack([resize(scene.camera(view), height, width) for view in seen])
        plain = plain_sweep(images, cameras, one.depths.numpy())
        for name, method in (("ours", found_in(one)), ("plain ZNCC", plain)):
            table[name].append([median_at(method, true, density) for density in WALK_DENSITIES])
    return {name: np.array(values) for name, values in table.items()}


def rgbd(root: Path) -> Section:
    """Frames of a walk through a room with measured depth: our sweep against a plain one, frame by frame."""
    found = walk(root)
    frames, (middle, middle_plain) = len(found["ours"]), (np.median(found[name], axis=0) for name in found)
    rows = []
    for density, ours, plain in zip(WALK_DENSITIES, middle, middle_plain, strict=True):
        what = f"median depth error at {100 * density:.0f} % density over plain ZNCC's, middle of {frames} frames"
        measured = f"{100 * ours:.1f} % : {100 * plain:.1f} % = {ours / plain:.2f}"
        rows.append(row("HoloLens", what, measured, "at most 0.5" if density == 0.4 else "", ours <= 0.5 * plain))
    ratios = found["ours"][:, -1] / found["plain ZNCC"][:, -1]
    what = f"frames of {frames} whose error at 40 % density is at most half of plain ZNCC's"
    measured = f"{int((ratios <= 0.5).sum())}, largest ratio {ratios.max():.2f}"
    rows.append(row("HoloLens", what, measured, "all", (ratios <= 0.5).all()))
    return {"rows": rows}


POSED = {"fountain": "strecha_fountain_quarter", "temple": "middlebury_temple", "COLMAP scene": "colmap_scene"}
# This many neighbouring views are swept and checked for agreement; features are matched among more.
VIEWS, VIEWS_MATCHED = 3, 8


def triangulated_of(scene: data.PosedImages, views: list[int], among: list[int]) -> list[Depths]:
    """The depths of views' features, in pixels of the photos, from matches among some views."""
    loaded = (np.rint(255 * luminance(scene.load(view))).astype(np.uint8) for view in among)
    features = [find_features(image) for image in loaded]
    K, E = (value[among].double().numpy() for value in scene.cameras[:2])
    return [triangulate(features, K, E, among.index(view)) for view in views]


def sparse_of(scene: data.PosedImages, view: int) -> Depths:
    """The depths of the set's sparse points that a view observes."""
    assert scene.points is not None
    seen = scene.points.observations[view]
    positions = torch.from_numpy(scene.points.positions[seen.points])
    return Depths(seen.pixels, project(scene.camera(view).at(None), positions[None]).depth[0, 0].numpy())


def errors_at(one: Reconstruction, truth: Depths, full: tuple[int, int], density: float) -> np.ndarray:
    """Relative depth errors at the features that are among the pixels of highest confidence."""
    found = found_in(one)
    height, width = found.value.shape
    x, y = np.floor((truth.pixels + 0.5) * (width / full[1], height / full[0])).astype(int).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y, true = x[inside], y[inside], truth.depth[inside]
    return (np.abs(found.value[y, x] - true) / true)[winners(found, density)[y, x]]


def posed(root: Path) -> Section:
    """Photos with known cameras and no depth, against triangulated features and sparse points."""
    rows = []
    for name, folder in POSED.items():
        scene = data.open(root / folder)
        views, among = (list(range(min(count, len(scene)))) for count in (VIEWS, VIEWS_MATCHED))
        judged = reconstruct_scene(scene, views, size=480, mesh=False, density=1.0, progress=True).views
        truths = {"triangulated features": triangulated_of(scene, views, among)}
        if scene.points is not None:
            truths["the set's sparse points"] = [sparse_of(scene, view) for view in views]
        for kind, depths in truths.items():
            pairs = zip(judged, depths, strict=True)
            pooled = np.concatenate([errors_at(one, truth, scene.size(one.view), 0.4) for one, truth in pairs])
            median, tenth = 100 * float(np.median(pooled)), 100 * float(np.quantile(pooled, 0.9))
            what = f"median depth error at 40 % density against {len(pooled)} {kind} in {len(views)} views"
            rows.append(row(name, what, f"{median:.2f} %, 90 % below {tenth:.1f} %", "at most 0.5 %", median <= 0.5))
    return {"rows": rows}


# The box of the temple as the publisher states it, metres.
PUBLISHED = np.array([(-0.073568, 0.021728, -0.012445), (0.028855, 0.181892, 0.062736)])


def project_back(occupancy: torch.Tensor, grid: VoxelGrid, camera: CameraTensors, size: tuple[int, int]) -> Any:
    """The silhouette of voxels, (h, w) bool: the nearest voxels at depths a voxel apart, the largest along each ray."""
    T, views = grid.world_from_lattice, camera.at(None)
    ends = (torch.tensor([-0.5, count - 0.5], dtype=torch.float64) for count in reversed(grid.shape))
    depth = project(views, (torch.cartesian_prod(*ends) @ T[:3, :3].T + T[:3, 3])[None]).depth  # of the box's corners
    step = voxel_side(grid)
    planes = torch.arange(float(depth.min()), float(depth.max()) + step, step)
    return torch.stack(
        [
            functional.plane_sweep_project(occupancy[None, None].float(), views, grid, some, size, mode="nearest")[0]
            .amax((0, 1, 2))
            .gt(0.5)
            for some in planes.split(64)
        ]
    ).any(0)


def temple(root: Path) -> Section:
    """The hull of a temple, in a box inferred from its silhouettes; its projection and its box are measured."""
    scene = data.open_scene(root / "middlebury_temple")
    masks = silhouettes(scene)
    grid, views = VoxelGrid(192, *hull_box(masks, scene.cameras)), range(len(scene))
    rows, title = [], "Visual hull, temple, 192^3"
    for rule, name in (("all", "strict intersection"), ("mean", "mean above 0.75")):
        occupancy = visual_hull(torch.stack(masks), scene.cameras, grid, rule=rule).occupancy
        drawn = [project_back(occupancy, grid, scene.camera(view), scene.size(view)) for view in views]
        scores = [float((a & b).sum() / (a | b).sum()) for a, b in zip(drawn, masks, strict=True)]
        sites, half = grid.centers()[occupancy], grid.world_from_lattice.diagonal()[:3] / 2
        away = 1000 * (torch.stack((sites.amin(0) - half, sites.amax(0) + half)).numpy() - PUBLISHED)
        lower, upper = (", ".join(f"{item:+.1f}" for item in end) for end in away)
        what = f"{name}: IoU of its silhouettes with those given, mean of {len(scene)} views"
        measured, goals = f"{np.mean(scores):.4f} (least {min(scores):.4f})", (">= 0.88", "<= 20 mm")
        goals = goals if rule == "all" else ("", "")
        rows.append(row(title, what, measured, goals[0], np.mean(scores) >= 0.88))
        what, far = f"{name}: its box from the published one, six faces", np.abs(away).max()
        rows.append(row(title, what, f"most {far:.1f} mm (lower {lower}; upper {upper})", goals[1], far <= 20))
    return {"rows": rows}


# Sections that need the folder of sets, and sections that do not.
ON_PHOTOS: dict[str, Callable[[Path], Section]] = {"stereo": stereo, "rgbd": rgbd, "posed": posed, "hull": temple}
EXACT = {
    "analytic": classical_exact.analytic,
    "hull": classical_exact.hull,
    "tsdf": classical_exact.tsdf,
    "speed": classical_rivals.speed,
}


def measure(settings: Settings) -> list[dict[str, Any]]:
    """A case of rows for each section."""
    cases = []
    for name in ("analytic", "stereo", "rgbd", "posed", "hull", "tsdf", "speed"):
        if settings.only in name:
            start = time.perf_counter()
            is_here = name in ON_PHOTOS and settings.data is not None
            case = {"section": name, **(ON_PHOTOS[name](settings.data) if is_here else {"rows": []})}
            case["rows"] += EXACT[name]() if name in EXACT else []
            cases.append({**case, "seconds": time.perf_counter() - start})
    return cases
