"""Images paired with the cameras of other images: which permutation of the cameras fits."""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.diagnosis.camera_errors import Candidate
from lsmgeo.diagnosis.evidence import Features, Points, Silhouettes, VoxelModel, is_rectified
from lsmgeo.diagnosis.findings import counted
from lsmgeo.diagnosis.residuals import pair_distances, view_costs
from lsmgeo.diagnosis.silhouette_consistency import draw_cells, intersection_over_union

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.diagnosis.evidence import Evidence
    from lsmgeo.diagnosis.two_view_geometry import Geometry, Hypothesis

__all__ = ["assign_cameras", "named_permutations", "permutation_candidates", "search_permutation"]

# Costs are clamped at this multiple of the limit: a wrong pair of cameras is wrong, by ten pixels or by a hundred.
WORST = 4.0
SEEDS_PER_PAIR, SEEDED_PAIRS, ROUNDS, LEAST_GAIN = 40, 4, 4, 1e-12
MATCHES_TRIED = 40
# Silhouettes are compared pair by pair, for every pair of cameras: too slow for more views.
MOST_SILHOUETTES = 16
LISTED = 4


def permutation_candidates(
    stated: Hypothesis, names: Sequence[str], evidence: Sequence[Evidence], views: np.ndarray
) -> list[Candidate]:
    """Candidates in which images have other cameras: common permutations, and those that fit the evidence."""
    count = len(names)
    fitted = _fitted_permutations(stated, evidence, views)
    found, tried = [], {tuple(range(count))}
    for order, words in [*named_permutations(names), *((order, "") for order in fitted)]:
        if tuple(order) in tried:
            continue
        tried.add(tuple(order))
        name, remedy = "frames shuffled", _remedy(order, names, words)
        if is_rectified(stated.cameras):
            name, remedy = "left and right exchanged", "The two images are exchanged: the first is the right one."
        correction = f"with {words}" if words else "with the images at the cameras that fit them"
        cameras = stated.cameras.select(order)
        images_only = stated._replace(cameras=cameras)
        # Depth and points may be in the order of the images, or of the cameras.
        changed = [images_only._replace(depth_cameras=stated.depth_cameras.select(order)), images_only]
        if np.ptp(stated.cameras.K, axis=0).any():
            # Or only the poses are in another order, and every image has its own K.
            changed.append(stated._replace(cameras=cameras._replace(K=stated.cameras.K)))
        found += [Candidate(name, correction, remedy, hypothesis) for hypothesis in changed]
    return found


def named_permutations(names: Sequence[str]) -> list[tuple[np.ndarray, str]]:
    """Common permutations: (V,) the camera of each image, and the permutation in words.

    Example:
        >>> from lsmgeo.diagnosis.permutations import named_permutations
        >>> order, words = named_permutations(["frame_0", "frame_1", "frame_10", "frame_2"])[0]
        >>> order.tolist(), words
        ([0, 1, 3, 2], 'the names ordered by their numbers, not as text')
    """
    rows = np.arange(len(names))
    text = np.array(sorted(range(len(names)), key=lambda row: names[row]), int)
    number = np.array(sorted(range(len(names)), key=lambda row: _natural(names[row])), int)
    # Row i of one order is paired with row i of the other.
    found = [
        (text[np.argsort(number)], "the names ordered by their numbers, not as text"),
        (number[np.argsort(text)], "the names ordered as text, not by numbers"),
        (rows[::-1].copy(), "the order reversed"),
    ]
    for shift in sorted(range(1, len(names)), key=lambda shift: min(shift, len(names) - shift)):
        signed = shift if 2 * shift <= len(names) else shift - len(names)
        places = f"{counted(abs(signed), 'places')} {'later' if signed > 0 else 'earlier'}"
        found.append((np.roll(rows, -shift), f"every image at the camera {places}"))
    return [(order, words) for order, words in found if not np.array_equal(order, rows)]


def _natural(name: str) -> list[tuple[int, str]]:
    # A number of any length is compared by its length and digits, without conversion.
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(len(part.lstrip("0")) + 1, part.lstrip("0")) if part[0] in "0123456789" else (0, part) for part in parts]


def _remedy(order: np.ndarray, names: Sequence[str], words: str) -> str:
    if words:
        return f"Images are paired with the cameras of other images; the correct order is {words}."
    moved = np.flatnonzero(order != np.arange(len(order)))
    pairs = ", ".join(f"{names[view]} to the camera of {names[order[view]]}" for view in moved[:LISTED])
    more = f" and {len(moved) - LISTED} more" if len(moved) > LISTED else ""
    return f"Images are paired with the cameras of other images: {pairs}{more}."


def _fitted_permutations(stated: Hypothesis, evidence: Sequence[Evidence], views: np.ndarray) -> list[np.ndarray]:
    """Permutations of all views that fit points, projected voxels, or pairs of views."""
    found = []
    count = len(stated.cameras.K)
    pairs: list[tuple[int, int, np.ndarray]] = []
    for item in evidence:
        if isinstance(item, Points):
            found.append(assign_cameras(np.minimum(view_costs(item.points, stated.depth_cameras) / item.limit, 1e3)))
        elif isinstance(item, VoxelModel) and item.masks is not None:
            order = np.arange(count)
            kept = np.array(item.masks.views)
            order[kept] = kept[assign_cameras(-_overlaps(item, stated.cameras))]
            found.append(order)
        elif isinstance(item, Features):
            pairs += _feature_costs(item, stated.cameras, views)
        elif isinstance(item, Silhouettes) and len(item.contours) <= MOST_SILHOUETTES:
            pairs += _silhouette_costs(item, stated.cameras, views)
    if pairs and len(views) > 1:
        first = np.searchsorted(views, [first for first, _, _ in pairs])
        second = np.searchsorted(views, [second for _, second, _ in pairs])
        order = np.arange(count)
        order[views] = views[search_permutation(first, second, np.stack([costs for _, _, costs in pairs]))]
        found.append(order)
    return found


def assign_cameras(costs: np.ndarray) -> np.ndarray:
    """The camera (V,) of each view that minimises the sum of costs (V, V); without costs a view keeps its own if free.

    Example:
        >>> import numpy as np
        >>> from lsmgeo.diagnosis.permutations import assign_cameras
        >>> assign_cameras(np.array([[5.0, 0.1, 5.0], [0.2, 5.0, 5.0], [np.nan, np.nan, np.nan]])).tolist()
        [1, 0, 2]
    """
    from scipy.optimize import linear_sum_assignment

    known = np.isfinite(costs).any(1)
    filled = np.where(known[:, None], np.nan_to_num(costs, nan=1e6), 1.0 - np.eye(len(costs)))
    return np.asarray(linear_sum_assignment(filled)[1], int)


def _overlaps(model: VoxelModel, cameras: Geometry) -> np.ndarray:
    """Intersection over union of each view's silhouette and the voxels in each camera, (N, N)."""
    assert model.masks is not None
    views, masks, steps = model.masks
    table = np.zeros((len(views), len(views)))
    for column, camera in enumerate(views):
        drawn: dict[tuple[tuple[int, int], int], np.ndarray] = {}
        for row, (mask, step) in enumerate(zip(masks, steps, strict=True)):
            key = (mask.shape, step)
            if key not in drawn:
                drawn[key] = draw_cells(model.cells, cameras, camera, *key)
            table[row, column] = intersection_over_union(drawn[key], mask)
    return table


def _feature_costs(features: Features, cameras: Geometry, views: np.ndarray) -> list[tuple[int, int, np.ndarray]]:
    """For each pair of matched views the cost of every pair of cameras, (N, N) in 0..1."""
    tried = features.matches.thinned(MATCHES_TRIED)
    rows, columns = (grid.ravel() for grid in np.meshgrid(views, views, indexing="ij"))
    apart = rows != columns
    found = []
    for pair, (first, second) in enumerate(zip(tried.first.tolist(), tried.second.tolist(), strict=True)):
        costs = np.ones(len(rows))
        distances = pair_distances(tried.pixels[tried.pair == pair], cameras, rows[apart], columns[apart])
        costs[apart] = np.minimum(distances / features.limit, WORST) / WORST
        found.append((first, second, costs.reshape(len(views), len(views))))
    return found


def _silhouette_costs(item: Silhouettes, cameras: Geometry, views: np.ndarray) -> list[tuple[int, int, np.ndarray]]:
    found = []
    for first, second in item.pairs:
        costs = np.ones((len(views), len(views)))
        for i, j in itertools.permutations(range(len(views)), 2):
            tangents = item.distance(cameras, first, second, int(views[i]), int(views[j]))
            # Without a distance, the pair is neutral.
            costs[i, j] = np.nanmin([np.mean(tangents) / item.limit, WORST]) / WORST if tangents[0] >= 0 else 0.5
        found.append((first, second, costs))
    return found


def search_permutation(first: np.ndarray, second: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Which camera each of N views has, from costs of pairs: grown from distinctive pairs, then improved by swaps.

    Args:
        first: (P,) views, 0..N-1.
        second: (P,) views.
        costs: (P, N, N) in 0..1, of the pair's views having cameras i and j.

    Returns:
        (N,) cameras; views without any pair keep their own where it is free.
    """
    count = costs.shape[1]
    links: list[list[tuple[int, np.ndarray]]] = [[] for _ in range(count)]
    for pair, (a, b) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        links[a].append((b, costs[pair].T))  # row: camera of b, column: camera of a
        links[b].append((a, costs[pair]))

    # Distinctive pairs first: those whose cheapest cameras differ most from the next.
    cheap = np.partition(costs.reshape(len(costs), -1), min(count, costs[0].size - 1), axis=1)[:, : count + 1]
    distinctive = np.argsort(-(cheap.mean(1) - cheap.min(1)), kind="stable")
    cameras: dict[int, int] = {}
    for views in _connected(first, second):
        within = np.array([pair for pair in distinctive.tolist() if first[pair] in views])
        best: dict[int, int] = {}
        lowest = np.inf
        for pair in within[:SEEDED_PAIRS].tolist():
            for place in np.argsort(costs[pair].ravel(), kind="stable")[:SEEDS_PER_PAIR].tolist():
                i, j = divmod(place, count)
                if i == j or {i, j} & set(cameras.values()):
                    continue
                grown = _grown({int(first[pair]): i, int(second[pair]): j}, links, views, set(cameras.values()))
                places = [(grown[int(first[other])], grown[int(second[other])]) for other in within]
                cost = sum(float(costs[other][place]) for other, place in zip(within, places, strict=True))
                if cost < lowest:
                    best, lowest = grown, cost
        cameras |= best
    return _improved(_completed(cameras, count), first, second, costs)


def _connected(first: np.ndarray, second: np.ndarray) -> list[set[int]]:
    """Groups of views that pairs connect, largest first."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    views = np.union1d(first, second)
    ends = np.searchsorted(views, first), np.searchsorted(views, second)
    count, labels = connected_components(coo_array((np.ones(len(first)), ends), (len(views),) * 2), directed=False)
    return sorted((set(views[labels == label].tolist()) for label in range(count)), key=len, reverse=True)


def _grown(
    cameras: dict[int, int], links: list[list[tuple[int, np.ndarray]]], views: set[int], taken: set[int]
) -> dict[int, int]:
    """Add the views of a group one by one, each at the free camera with the lowest cost to its linked views."""
    free = np.ones(len(links), bool)
    free[[*taken, *cameras.values()]] = False
    while len(cameras) < len(views):
        tied = {view: [link for link in links[view] if link[0] in cameras] for view in sorted(views - cameras.keys())}
        view = max(tied, key=lambda view: len(tied[view]))
        cost = np.sum([table[cameras[other]] for other, table in tied[view]], axis=0)
        cost[~free] = np.inf
        cameras[view] = int(cost.argmin())
        free[cameras[view]] = False
    return cameras


def _completed(cameras: dict[int, int], count: int) -> np.ndarray:
    """Views without a pair keep their camera where it is free."""
    order = np.full(count, -1)
    order[list(cameras)] = list(cameras.values())
    kept = np.setdiff1d(np.flatnonzero(order < 0), order)
    order[kept] = kept
    order[order < 0] = np.setdiff1d(np.arange(count), order)
    return order


def _improved(order: np.ndarray, first: np.ndarray, second: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Swap the cameras of two views as long as that lowers the cost."""

    def total(order: np.ndarray) -> float:
        return float(costs[np.arange(len(first)), order[first], order[second]].sum())

    lowest = total(order)
    for _ in range(ROUNDS):
        before = lowest
        for a, b in itertools.combinations(range(len(order)), 2):
            other = order.copy()
            other[[a, b]] = order[[b, a]]
            if (cost := total(other)) < lowest - LEAST_GAIN:
                order, lowest = other, cost
        if lowest == before:
            break
    return order
