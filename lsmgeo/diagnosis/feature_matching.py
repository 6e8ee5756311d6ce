"""Features that photographs share, found without believing their cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages

__all__ = ["MAX_VIEWS", "Matches", "choose_views", "count_features", "grey_image", "match_features", "shrunk"]

# Views that are looked at, at most; beyond, runs of neighbours are taken so that some of them overlap.
MAX_VIEWS = 40
RUN = 4
# Longer side of the pictures in which features are sought: fewer views can be looked at more closely.
LONGEST_SIDE, LONGEST_SIDE_OF_MANY, MANY = 1600, 1200, 16
MAX_FEATURES, FEATURES_AT_FIRST = 4000, 700
RATIO, RATIO_AT_FIRST = 0.7, 0.8
PARTNERS = 4
# Matches count where they fit one fundamental matrix, whichever: chance agrees on few of them.
LEAST_AT_FIRST, LEAST_VERIFIED, LEAST_FRACTION = 10, 24, 0.5
TOLERANCE = 1.5  # px of the picture that is matched


class Matches(NamedTuple):
    """M pixels of P pairs of photographs that show the same thing.

    Attributes:
        first: (P,) int, the pairs' first views.
        second: (P,) int.
        pair: (M,) int, which pair a match belongs to, ascending.
        pixels: (M, 2, 2) x, y of the first and of the second photograph, at their own sizes.
    """

    first: np.ndarray
    second: np.ndarray
    pair: np.ndarray
    pixels: np.ndarray

    def thinned(self, most: int) -> Matches:
        """At most so many matches of each pair, evenly chosen."""
        rank = np.arange(len(self.pair)) - np.searchsorted(self.pair, self.pair)
        count = np.bincount(self.pair, minlength=len(self.first))[self.pair]
        step = np.maximum(count / most, 1.0)
        kept = np.floor((rank + 1) / step) > np.floor(rank / step)
        return self._replace(pair=self.pair[kept], pixels=self.pixels[kept])


def choose_views(count: int) -> np.ndarray:
    """Which of ``count`` views are looked at: all, or runs of successive ones at even distances.

    Example:
        >>> from lsmgeo.diagnosis.feature_matching import choose_views
        >>> [int(view) for view in choose_views(100)[:9]]
        [0, 1, 2, 3, 10, 11, 12, 13, 21]
    """
    if count <= MAX_VIEWS:
        return np.arange(count)
    starts = np.linspace(0, count - RUN, MAX_VIEWS // RUN).astype(int)
    return np.unique(starts[:, None] + np.arange(RUN))


def grey_image(scene: PosedImages, view: int, longest: int) -> tuple[np.ndarray, np.ndarray]:
    """One photograph in grey, shrunk where its longer side is beyond ``longest``.

    Returns:
        (h, w) uint8, and (2,) the photograph's pixels per pixel of it, x and y.
    """
    whole = (scene.load(view) * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0).mul_(255).numpy()
    grey = shrunk(whole, longest)
    return np.round(grey).clip(0, 255).astype(np.uint8), np.divide(whole.shape, grey.shape)[::-1]


def shrunk(picture: np.ndarray, longest: int) -> np.ndarray:
    """A picture (h, w) or (h, w, 3), smaller where its longer side is beyond ``longest``."""
    import cv2

    height, width = picture.shape[:2]
    shrink = min(1.0, longest / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if size != (width, height) else picture)


def match_features(scene: PosedImages, views: np.ndarray) -> Matches:
    """Match SIFT features between the pairs of views that share most, and keep what fits one fundamental matrix.

    Pairs are told from the features alone: the strongest of every view are compared with those of every other.
    (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004; Barath et al., "MAGSAC++", CVPR
    2020.)

    Args:
        scene: the photographs; each is read once.
        views: which are looked at.

    Raises:
        DataError: a photograph is missing, damaged or not of its camera's size.
    """
    found = {}
    longest = LONGEST_SIDE if len(views) <= MANY else LONGEST_SIDE_OF_MANY
    for view in tqdm(views.tolist(), desc="features", unit="photograph", disable=None, leave=False):
        found[view] = _features(*grey_image(scene, view, longest))
    pairs = []
    for first, second in tqdm(_promising_pairs(found), desc="matches", unit="pair", disable=None, leave=False):
        pixels = _verified(found[first], found[second])
        if pixels is not None:
            pairs.append((first, second, pixels))
    first, second = np.array([pair[:2] for pair in pairs], int).reshape(-1, 2).T
    return Matches(
        first,
        second,
        np.repeat(np.arange(len(pairs)), [len(pixels) for _, _, pixels in pairs]),
        np.concatenate([np.zeros((0, 2, 2)), *(pixels for _, _, pixels in pairs)]),
    )


def count_features(scene: PosedImages, views: np.ndarray) -> np.ndarray:
    """How many features each of some views has, (N,) int.

    Raises:
        DataError: a photograph is missing, damaged or not of its camera's size.
    """
    return np.array([len(_features(*grey_image(scene, view, LONGEST_SIDE)).pixels) for view in views.tolist()], int)


class _Features(NamedTuple):
    pixels: np.ndarray  # (N, 2), of the photograph
    words: torch.Tensor  # (N, 128) float32, strongest first
    zoom: np.ndarray  # (2,) pixels of the photograph per pixel matched


def _features(grey: np.ndarray, zoom: np.ndarray) -> _Features:
    import cv2

    # Without the precise upscaling OpenCV's features lie a quarter of a pixel aside.
    create: Any = cv2.SIFT_create  # type: ignore[attr-defined]
    sift = create(MAX_FEATURES, enable_precise_upscale=True)
    keys, words = sift.detectAndCompute(grey, None)
    if words is None:
        return _Features(np.zeros((0, 2)), torch.zeros(0, 128), zoom)
    pixels = np.array([key.pt for key in keys], np.float64)
    # One place may have several directions: strength and place order them, so that the result is the same every time.
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -np.array([key.response for key in keys])))[:MAX_FEATURES]
    return _Features((pixels[order] + 0.5) * zoom - 0.5, torch.from_numpy(words[order]), zoom)


def _mutual_matches(first: torch.Tensor, second: torch.Tensor, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of two sets of words that are each other's nearest, clearly nearer than the next: (M,) and (M,)."""
    if min(len(first), len(second)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    from kornia.feature import match_snn

    distances = torch.cdist(first, second)
    rows, columns = match_snn(first, second, ratio, distances)[1].unbind(1)
    kept = distances.min(0).indices[columns] == rows
    return rows[kept].numpy(), columns[kept].numpy()


def _promising_pairs(found: dict[int, _Features]) -> list[tuple[int, int]]:
    """For every view the partners with which it shares most of its strongest features."""
    views = sorted(found)
    strong = {view: found[view].words[:FEATURES_AT_FIRST] for view in views}
    shared = np.zeros((len(views), len(views)), int)
    for i, first in enumerate(tqdm(views, desc="pairs", unit="photograph", disable=None, leave=False)):
        for j, second in enumerate(views[:i]):
            shared[i, j] = shared[j, i] = len(_mutual_matches(strong[first], strong[second], RATIO_AT_FIRST)[0])
    pairs = set()
    for i, row in enumerate(shared):
        for j in np.argsort(-row, kind="stable")[:PARTNERS]:
            if row[j] >= LEAST_AT_FIRST:
                pairs.add((views[min(i, j)], views[max(i, j)]))
    return sorted(pairs)


def _verified(first: _Features, second: _Features) -> np.ndarray | None:
    """(M, 2, 2) pixels of the matches that fit one fundamental matrix; None where too few do."""
    import cv2

    rows, columns = _mutual_matches(first.words, second.words, RATIO)
    if len(rows) < LEAST_VERIFIED:
        return None
    pixels = np.stack([first.pixels[rows], second.pixels[columns]], 1)
    pixels = pixels[np.sort(np.unique(pixels.reshape(-1, 4), axis=0, return_index=True)[1])]
    small = pixels / np.stack([first.zoom, second.zoom])
    try:
        _, fits = cv2.findFundamentalMat(small[:, 0], small[:, 1], cv2.USAC_MAGSAC, TOLERANCE, 0.999, 10000)
    except cv2.error:
        return None
    if fits is None:
        return None
    kept = fits.ravel().astype(bool)
    return pixels[kept] if kept.sum() >= max(LEAST_VERIFIED, LEAST_FRACTION * len(pixels)) else None
