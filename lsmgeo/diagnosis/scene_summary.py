"""What is there, told in lines, and what looks implausible before anything is measured."""

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
# Photographs whose features are counted to say why none match.
MOST_COUNTED = 8


def describe_scene(
    scene: PosedImages, views: np.ndarray, evidence: Sequence[Evidence], stated: Hypothesis, sizes: np.ndarray
) -> list[tuple[str, str]]:
    """Facts as (name, text)."""
    cameras = stated.photographs
    facts = [("format", scene.source), ("photographs", f"{len(scene)}, {_sizes(sizes)}")]
    if len(views) < len(scene):
        facts.append(("looked at", f"{len(views)} of them (at most {MAX_VIEWS}), in runs of successive ones"))
    angles = field_of_view(cameras, sizes)
    facts.append(("focal length", f"{_range(cameras.K[:, 0, 0])} x {_range(cameras.K[:, 1, 1])} px"))
    facts.append(("field of view", f"{_range(angles[:, 0])} x {_range(angles[:, 1])} degrees"))
    facts.append(("principal point", f"{_range(cameras.K[:, 0, 2])}, {_range(cameras.K[:, 1, 2])} px"))
    if scene.lenses is not None:
        facts.append(("lenses", f"{sum(lens is not None for lens in scene.lenses)} with distortion, straightened"))
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
        seen = len(np.unique(np.concatenate([matches.first, matches.second])))
        text = f"{len(matches.pair)} in {counted(len(matches.first), 'pairs')} of {seen} photographs"
        return [("matched features", text)]
    if isinstance(item, Silhouettes):
        return [("outlines", f"{len(item.outlines)} seen whole")]
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
    """Why nothing about photographs could be measured, and what would let it.

    Raises:
        DataError: a photograph is missing or damaged.
    """
    besides = "depth maps, sparse points, or cut-out photographs of a solid"
    if len(scene) == 1:
        remedy = "Add a photograph, with its camera, that sees the same from another place."
        return Gap("the one photograph has no partner to be compared with", remedy)
    views = choose_views(len(scene))
    looked = views[evenly(len(views), MOST_COUNTED)]
    counts = count_features(scene, looked)
    among = counted(len(scene), "photographs")
    if len(looked) < len(scene):
        among = f"the {len(looked)} of {among} that were looked at"
    if counts.max() == 0:
        reason, remedy = f"no features were found in {among}", f"They are blank or blurred: add {besides}."
    elif counts.max() < LEAST_VERIFIED:
        reason = f"hardly any features, at most {counts.max()}, were found in {among}"
        remedy = f"{LEAST_VERIFIED} that match are needed: take larger or sharper photographs, or add {besides}."
    else:
        among = counted(len(views), "photographs")
        reason = f"no two of {among} have matched features (each has some {np.median(counts):.0f})"
        remedy = (
            "Add photographs in between, so that neighbours see the same thing from directions less than 30 degrees "
            f"apart, or add {besides}."
        )
    return Gap(reason, remedy)


def implausibilities(cameras: Geometry, sizes: np.ndarray) -> list[str]:
    """Remarks on what cameras seldom are."""
    remarks = []
    far = principal_offsets(cameras, sizes).max(1) > LIMITS["centred"] / 100
    if far.any():
        remarks.append(f"the principal point is far from the middle of {_some(far)}: K of another size, or a crop?")
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
            remarks.append("all cameras are in one place: there is no baseline, and depth cannot be told")
    return remarks


def field_of_view(cameras: Geometry, sizes: np.ndarray) -> np.ndarray:
    """(V, 2) degrees across the width and the height."""
    focal = cameras.K[:, [0, 1], [0, 1]]
    before = cameras.K[:, :2, 2] + 0.5
    after = sizes[:, ::-1] - before
    return np.asarray(np.degrees(np.arctan2(before, focal) + np.arctan2(after, focal)))


def _some(chosen: np.ndarray) -> str:
    if len(chosen) == 1:
        return "the photograph"
    return "all photographs" if chosen.all() else f"{chosen.sum()} of {len(chosen)} photographs"


def _sizes(sizes: np.ndarray) -> str:
    kinds = np.unique(sizes, axis=0)
    if len(kinds) == 1:
        return f"{kinds[0, 1]} x {kinds[0, 0]}"
    low, high = kinds[np.prod(kinds, axis=1).argmin()], kinds[np.prod(kinds, axis=1).argmax()]
    return f"{len(kinds)} sizes from {low[1]} x {low[0]} to {high[1]} x {high[0]}"


def _range(values: np.ndarray) -> str:
    low, high = f"{values.min():.5g}", f"{values.max():.5g}"
    return low if low == high else f"{low} to {high}"
