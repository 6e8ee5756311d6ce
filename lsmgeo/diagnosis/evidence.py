"""The kinds of evidence about posed images: each is gathered once, and measured again for every hypothesis."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from lsmgeo.diagnosis.depth_consistency import (
    Surfaces,
    load_surfaces,
    relative_errors,
    surface_points,
    thinned,
    warp_errors,
)
from lsmgeo.diagnosis.feature_matching import Matches, grey_image, match_features
from lsmgeo.diagnosis.findings import CENTRED, LIMITS, SIDES, Check, pixel_limit, share
from lsmgeo.diagnosis.residuals import in_front, reprojection_errors, sampson_distances
from lsmgeo.diagnosis.silhouette_consistency import (
    epipolar_tangency,
    load_masks,
    near_cells,
    occupied_cells,
    silhouette_hull,
    silhouette_overlap,
    within_a_cell,
)
from lsmgeo.diagnosis.two_view_geometry import evenly

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages
    from lsmgeo.diagnosis.two_view_geometry import Geometry, Hypothesis

__all__ = [
    "DepthMaps", "Evidence", "Features", "Points", "PrincipalPoints", "Silhouettes", "StereoPair", "VoxelModel",
    "gather_evidence", "is_rectified", "pair_medians", "principal_offsets",
]  # fmt: skip

LEAST_WITH_PARALLAX = 30
LEAST_OBSERVATIONS = 20
LEAST_SILHOUETTE_PAIRS = 3
LEAST_PAIRS = 3
# Subsets on which hypotheses are compared: matches of a pair, pairs of silhouettes, pixels and views.
MATCHES_TRIED = 100
SILHOUETTE_PAIRS, SILHOUETTE_PAIRS_TRIED = 300, 60
PIXELS_TRIED, VIEWS_TRIED = 400, 12


class Evidence:
    """Something that can be measured again with other cameras.

    Attributes:
        slow: whether it is measured only for hypotheses that are likely by other evidence.
        measurable: whether there is enough to measure.
        everything: the data of the reported checks; None without a subset.
        tried: the subset on which hypotheses are compared.
    """

    slow = False
    measurable = True
    everything: Any = None
    tried: Any = None

    def measure(self, hypothesis: Hypothesis) -> list[Check]:
        """The checks of a hypothesis on the subset; always the same checks."""
        return self._measured(hypothesis, self.tried)

    def measure_all(self, hypothesis: Hypothesis) -> list[Check]:
        """The checks of a hypothesis on everything, to be reported."""
        return self._measured(hypothesis, self.everything)

    def _measured(self, hypothesis: Hypothesis, data: Any) -> list[Check]:
        raise NotImplementedError


class Features(Evidence):
    """Matched features: their distance from epipolar lines, and cheirality."""

    def __init__(self, scene: PosedImages, views: np.ndarray, sizes: np.ndarray, cameras: Geometry) -> None:
        self.matches = self.everything = match_features(scene, views)
        self.limit = pixel_limit(sizes)
        self.tried = self.matches.thinned(MATCHES_TRIED)
        # Decided once, so that hypotheses are compared on the same checks.
        known = np.isfinite(in_front(self.matches, cameras)).sum()
        self.judges_cheirality = bool(known >= LEAST_WITH_PARALLAX)
        self.measurable = len(self.matches.pair) > 0

    def _measured(self, hypothesis: Hypothesis, matches: Matches) -> list[Check]:
        distances = np.abs(sampson_distances(matches, hypothesis.cameras))
        name = "epipolar error of matched features"
        checks = [Check(name, float(np.median(distances)), "px", self.limit, len(distances), "matches")]
        if len(matches.first) >= LEAST_PAIRS:
            # The median tolerates a few images with wrong cameras; this check does not.
            agree = np.mean(pair_medians(distances, matches) <= LIMITS["view"] * self.limit)
            checks.append(share("pairs of images that agree", agree, "pairs", len(matches.first), "pairs"))
        if self.judges_cheirality:
            front = in_front(matches, hypothesis.cameras)
            front = front[np.isfinite(front)]
            # Without a baseline there is no parallax, and nothing to contradict the cameras.
            checks.append(share(SIDES, front.mean() if len(front) else 1.0, "in front", len(front), "matches"))
        return checks


def pair_medians(distances: np.ndarray, matches: Matches) -> np.ndarray:
    """Median distance of each pair of views, (P,) px."""
    from scipy.ndimage import median

    return np.asarray(median(distances, matches.pair, np.arange(len(matches.first))))


class Points(Evidence):
    """Sparse points and their observations."""

    def __init__(self, scene: PosedImages, sizes: np.ndarray) -> None:
        assert scene.points is not None
        self.points = scene.points
        self.limit = pixel_limit(sizes)
        self.measurable = sum(len(view.points) for view in self.points.observations) >= LEAST_OBSERVATIONS

    def _measured(self, hypothesis: Hypothesis, _: Any) -> list[Check]:
        """Median reprojection error, and the share of observations with their point in front of the camera."""
        errors, depths, _ = reprojection_errors(self.points, hypothesis.depth_cameras)
        count, of, error = len(errors), "observations", float(np.median(errors))
        return [
            Check("reprojection error of sparse points", error, "px", self.limit, count, of),
            share("sparse points in front of their cameras", np.mean(depths > 0), "in front", count, of),
        ]


class DepthMaps(Evidence):
    """Depth maps of several views."""

    slow = True

    def __init__(self, scene: PosedImages, views: np.ndarray) -> None:
        self.surfaces = self.everything = load_surfaces(scene, views)
        self.tried = thinned(self.surfaces, PIXELS_TRIED, VIEWS_TRIED)
        self.measurable = len(self.surfaces.views) >= 2

    def _measured(self, hypothesis: Hypothesis, surfaces: Surfaces) -> list[Check]:
        errors = relative_errors(surfaces, hypothesis)
        value = 100 * float(np.median(np.abs(errors))) if len(errors) else float("inf")
        return [Check("depth of one view in another", value, "%", LIMITS["depth"], len(errors), "pixels")]


class StereoPair(Evidence):
    """A rectified pair with depth: one image warped by depth equals the other one."""

    def __init__(self, scene: PosedImages) -> None:
        self.surfaces = load_surfaces(scene, np.arange(2))
        self.images = tuple(grey_image(scene, view, max(scene.size(view)))[0] for view in range(2))
        self.measurable = len(self.surfaces.views) > 0

    def _measured(self, hypothesis: Hypothesis, _: Any) -> list[Check]:
        """Median difference in grey levels, against that without a warp."""
        moved, unmoved = warp_errors(self.surfaces, hypothesis, self.images)
        if len(moved) == 0:
            return [Check("image warped by depth", float("inf"), "grey levels", 1.0, 0, "pixels")]
        limit = LIMITS["warp"] * float(np.median(unmoved))
        value = float(np.median(moved))
        return [Check("image warped by depth", value, "grey levels", max(limit, 1.0), len(moved), "pixels")]


class Silhouettes(Evidence):
    """Silhouettes of cut-out images: epipolar tangents touch them in both views."""

    def __init__(self, scene: PosedImages, views: np.ndarray, sizes: np.ndarray) -> None:
        masks = ((view, scene.load_mask(view)) for view in views.tolist())
        contours = ((view, None if mask is None else silhouette_hull(mask.numpy())) for view, mask in masks)
        self.contours = {view: contour for view, contour in contours if contour is not None}
        pairs = list(itertools.combinations(sorted(self.contours), 2))
        self.pairs = self.everything = [pairs[index] for index in evenly(len(pairs), SILHOUETTE_PAIRS)]
        self.tried = [self.pairs[index] for index in evenly(len(self.pairs), SILHOUETTE_PAIRS_TRIED)]
        self.limit = pixel_limit(sizes)
        # The two tangents of a single pair agree too often by chance.
        self.measurable = len(self.pairs) >= LEAST_SILHOUETTE_PAIRS

    def _measured(self, hypothesis: Hypothesis, pairs: list[tuple[int, int]]) -> list[Check]:
        distances = self.distances(hypothesis.cameras, pairs)
        known = distances[np.isfinite(distances)]
        value = float(np.median(known)) if len(known) else float("inf")
        return [Check("epipolar tangency of the silhouettes", value, "px", self.limit, len(known), "tangents")]

    def distances(self, cameras: Geometry, pairs: list[tuple[int, int]]) -> np.ndarray:
        """(P, 2) px for each pair of views, NaN where there is no distance."""
        return np.array([self.distance(cameras, first, second, first, second) for first, second in pairs])

    def distance(self, cameras: Geometry, first: int, second: int, camera1: int, camera2: int) -> np.ndarray:
        """(2,) px for the silhouettes of two views in two cameras."""
        both = cameras.select(np.array([camera1, camera2]))
        return epipolar_tangency(self.contours[first], self.contours[second], both)


class VoxelModel(Evidence):
    """The voxels of the object: they project into the silhouettes, and depth points lie on them."""

    slow = True

    def __init__(self, scene: PosedImages, views: np.ndarray) -> None:
        assert scene.voxels is not None
        self.near, self.world_from_lattice = near_cells(scene.voxels)
        self.cells = occupied_cells(scene.voxels)
        self.masks = load_masks(scene, views) if scene.cut_out else None
        surfaces = load_surfaces(scene, views) if scene.depths is not None else None
        self.surfaces = surfaces if surfaces is not None and surfaces.views else None
        self.measurable = len(self.cells.centers) > 0 and (self.masks or self.surfaces) is not None

    def _measured(self, hypothesis: Hypothesis, _: Any) -> list[Check]:
        """Cells inside the silhouettes, overlap with them, and depth points near occupied cells."""
        checks = []
        if self.masks is not None:
            recalls, unions = silhouette_overlap(self.masks, self.cells, hypothesis.cameras)
            cells = len(self.cells.centers) * len(recalls)
            checks.append(share("voxels inside the silhouettes", recalls.mean(), "inside", cells, "voxels"))
            name = "overlap of voxels and silhouettes"
            checks.append(share(name, unions.mean(), "overlap", len(unions), "views"))
        if self.surfaces is not None:
            points = np.concatenate([surface_points(self.surfaces, hypothesis, view) for view in self.surfaces.views])
            near = within_a_cell(points, self.near, self.world_from_lattice)
            checks.append(share("depth points within a cell of the voxels", near, "near a cell", len(points), "points"))
        return checks


class PrincipalPoints(Evidence):
    """Principal points: near the image centre, where nothing else reveals a K of another resolution."""

    def __init__(self, sizes: np.ndarray) -> None:
        self.sizes = sizes

    def _measured(self, hypothesis: Hypothesis, _: Any) -> list[Check]:
        """Largest distance of a principal point from the image centre."""
        value = 100 * float(principal_offsets(hypothesis.cameras, self.sizes).max())
        return [Check(CENTRED, value, "%", LIMITS["centred"], len(self.sizes), "images")]


def principal_offsets(cameras: Geometry, sizes: np.ndarray) -> np.ndarray:
    """Distance of the principal points from the image centre, (V, 2), as a fraction of width and height."""
    center = (sizes[:, ::-1] - 1) / 2
    return np.asarray(np.abs(cameras.K[:, :2, 2] - center) / sizes[:, ::-1])


def is_rectified(cameras: Geometry) -> bool:
    """Whether these are two cameras side by side with the same orientation."""
    if len(cameras.K) != 2:
        return False
    across = cameras.t[1] - cameras.t[0]
    return bool(
        np.allclose(cameras.R[0], cameras.R[1], atol=1e-6)
        and np.linalg.norm(across) > 0
        and np.abs(across[1:]).max() <= 1e-6 * np.linalg.norm(across)
    )


def gather_evidence(scene: PosedImages, views: np.ndarray, sizes: np.ndarray, stated: Hypothesis) -> list[Evidence]:
    """Everything that can be measured about a scene.

    Raises:
        DataError: an image, a mask or a depth map that is needed is missing or damaged.
    """
    candidates: list[Evidence] = []
    if len(scene) >= 2:
        candidates.append(Features(scene, views, sizes, stated.cameras))
    if scene.points is not None:
        candidates.append(Points(scene, sizes))
    if scene.cut_out and len(scene) >= 2:
        candidates.append(Silhouettes(scene, views, sizes))
    if scene.depths is not None:
        if is_rectified(stated.cameras):
            candidates.append(StereoPair(scene))
        else:
            candidates.append(DepthMaps(scene, views))
    if scene.voxels is not None:
        candidates.append(VoxelModel(scene, views))
    found = [evidence for evidence in candidates if evidence.measurable]
    # The rows of a rectified pair correspond whatever K is, so nothing else depends on K.
    return [*found, PrincipalPoints(sizes)] if found and is_rectified(stated.cameras) else found
