"""A scene in lines of facts, implausible cameras, and why nothing could be measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.diagnosis.depth_consistency import relative_errors
from lsmgeo.diagnosis.evidence import DepthMaps, Features, Silhouettes, StereoPair, principal_offsets
from lsmgeo.diagnosis.feature_matching import LEAST_VERIFIED, MAX_VIEWS, choose_views, count_features
from lsmgeo.diagnosis.findings import LIMITS, Gap, counted
from lsmgeo.diagnosis.two_view_geometry import evenly

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.data import PosedImages
    from lsmgeo.diagnosis.evidence import Evidence
    from lsmgeo.diagnosis.two_view_geometry import Geometry, Hypothesis

__all__ = ["describe_scene", "find_gap", "implausibilities"]

NARROWEST, WIDEST = 5.0, 170.0  # degrees
MOST_ANISOTROPIC = 1.2
# Images whose features are counted to explain why none match.
MOST_COUNTED = 8


def describe_scene(
    scene: PosedImages, views: np.ndarray, evidence: Sequence[Evidence], stated: Hypothesis, sizes: np.ndarray
) -> list[tuple[str, str]]:
    """Facts as (name, text)."""
    cameras = stated.cameras
    facts = [("format", scene.source), ("images", f"{len(scene)}, {_sizes(sizes)}")]
    if len(views) < len(scene):
        facts.append(("measured", f"{len(views)} of them (at most {MAX_VIEWS}), in runs of successive ones"))
    angles = field_of_view(cameras, sizes)
    facts.append(("focal length", f"{_range(cameras.K[:, 0, 0])} x {_range(cameras.K[:, 1, 1])} px"))
    facts.append(("field of view", f"{_range(angles[:, 0])} x {_range(angles[:, 1])} degrees"))
    facts.append(("principal point", f"{_range(cameras.K[:, 0, 2])}, {_range(cameras.K[:, 1, 2])} px"))
    if scene.lenses is not None:
        facts.append(("lenses", f"{sum(lens is not None for lens in scene.lenses)} with distortion, undistorted"))
    if len(scene) > 1:
        apart = np.linalg.norm(cameras.centers[:, None] - cameras.centers, axis=2)
        near = np.sort(apart, axis=1)[:, 1]
        facts.append(("baselines", f"{np.median(near):.4g} to the nearest (median), {apart.max():.4g} at most"))
    for item in evidence:
        facts += _facts_of(item, stated)
    if scene.points is not None:
        observed = sum(len(observation.points) for observation in scene.points.observations)
        facts.append(("sparse points", f"{len(scene.points.positions)}, {counted(observed, 'observations')}"))
    if scene.voxels is not None:
        occupancy = scene.voxels.occupancy
        text = f"{' x '.join(map(str, occupancy.shape))}, {100 * float(occupancy.float().mean()):.2g} % occupied"
        facts.append(("voxels", text))
    return facts


def _facts_of(item: Evidence, stated: Hypothesis) -> list[tuple[str, str]]:
    if isinstance(item, Features):
        matches = item.matches
        matched = len(np.unique(np.concatenate([matches.first, matches.second])))
        text = f"{len(matches.pair)} in {counted(len(matches.first), 'pairs')} of {matched} images"
        return [("matched features", text)]
    if isinstance(item, Silhouettes):
        return [("silhouettes", f"{len(item.contours)} inside their images")]
    if isinstance(item, (DepthMaps, StereoPair)):
        depths = np.concatenate(item.surfaces.depths)
        low, high = np.percentile(depths, (2, 98))
        text = f"{low:.4g} to {high:.4g} (2nd to 98th percentile)"
        if isinstance(item, DepthMaps):
            errors = relative_errors(item.surfaces, stated)
            if len(errors):
                text += f"; {100 * float(np.mean(np.abs(errors) < 0.02)):.3g} % within 2 % of another view's"
        return [("depth", text)]
    return []


def find_gap(scene: PosedImages) -> Gap:
    """Why nothing could be measured about images, and what to add.

    Raises:
        DataError: an image is missing or damaged.
    """
    others = "depth maps, sparse points, or cut-out images with voxels"
    if len(scene) == 1:
        return Gap("there is only one image", "Add an image of the same object from another place, with its camera.")
    views = choose_views(len(scene))
    chosen = views[evenly(len(views), MOST_COUNTED)]
    counts = count_features(scene, chosen)
    among = counted(len(scene), "images")
    if len(chosen) < len(scene):
        among = f"the {len(chosen)} of {among} that were measured"
    if counts.max() == 0:
        reason, remedy = f"no features were found in {among}", f"They are blank or blurred: add {others}."
    elif counts.max() < LEAST_VERIFIED:
        reason = f"hardly any features, at most {counts.max()}, were found in {among}"
        remedy = f"{LEAST_VERIFIED} matches are needed: use larger or sharper images, or add {others}."
    else:
        among = counted(len(views), "images")
        reason = f"no two of {among} have matched features (each has about {np.median(counts):.0f} features)"
        remedy = (
            "Add images in between, so that neighbours see the same object from directions less than 30 degrees apart, "
            f"or add {others}."
        )
    return Gap(reason, remedy)


def implausibilities(cameras: Geometry, sizes: np.ndarray) -> list[str]:
    """Remarks on unusual cameras."""
    remarks = []
    far = principal_offsets(cameras, sizes).max(1) > LIMITS["centred"] / 100
    if far.any():
        remarks.append(f"the principal point is far from the centre of {_some(far)}: K of another size, or a crop?")
    angles = field_of_view(cameras, sizes)
    odd = (angles.min(1) < NARROWEST) | (angles.max(1) > WIDEST)
    if odd.any():
        remarks.append(f"the field of view is below {NARROWEST:.0f} or above {WIDEST:.0f} degrees in {_some(odd)}")
    ratio = cameras.K[:, 0, 0] / cameras.K[:, 1, 1]
    uneven = np.abs(np.log(np.abs(ratio))) > np.log(MOST_ANISOTROPIC)
    if uneven.any():
        remarks.append(f"fx and fy differ by more than {100 * (MOST_ANISOTROPIC - 1):.0f} % in {_some(uneven)}")
    centers = cameras.centers
    if len(centers) > 1:
        spread = np.linalg.norm(centers - centers.mean(0), axis=1).max()
        if spread <= 1e-9 * max(np.abs(centers).max(), 1e-300):
            remarks.append("all cameras are in one place: there is no baseline, so no depth can be computed")
    return remarks


def field_of_view(cameras: Geometry, sizes: np.ndarray) -> np.ndarray:
    """(V, 2) degrees across the width and the height."""
    focal = cameras.K[:, [0, 1], [0, 1]]
    before = cameras.K[:, :2, 2] + 0.5
    after = sizes[:, ::-1] - before
    return np.asarray(np.degrees(np.arctan2(before, focal) + np.arctan2(after, focal)))


def _some(chosen: np.ndarray) -> str:
    if len(chosen) == 1:
        return "the image"
    return "all images" if chosen.all() else f"{chosen.sum()} of {len(chosen)} images"


def _sizes(sizes: np.ndarray) -> str:
    kinds = np.unique(sizes, axis=0)
    if len(kinds) == 1:
        return f"{kinds[0, 1]} x {kinds[0, 0]}"
    low, high = kinds[np.prod(kinds, axis=1).argmin()], kinds[np.prod(kinds, axis=1).argmax()]
    return f"{len(kinds)} sizes from {low[1]} x {low[0]} to {high[1]} x {high[0]}"


def _range(values: np.ndarray) -> str:
    low, high = f"{values.min():.5g}", f"{values.max():.5g}"
    return low if low == high else f"{low} to {high}"
