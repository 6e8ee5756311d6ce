"""SIFT features matched between images, without their cameras: a fundamental matrix verifies each pair."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages

__all__ = ["MAX_VIEWS", "Matches", "choose_views", "count_features", "downsized", "grey_image", "match_features"]

# Most views that are measured; of more, runs of successive ones, so that some of them overlap.
MAX_VIEWS = 40
RUN = 4
# Longer side of the images in which features are detected: larger for few views.
LONGEST_SIDE, LONGEST_SIDE_OF_MANY, MANY = 1600, 1200, 16
MAX_FEATURES, FEATURES_AT_FIRST = 4000, 700
RATIO, RATIO_AT_FIRST = 0.7, 0.8
PARTNERS = 4
# A pair counts if this many, and this fraction, of its matches fit one fundamental matrix.
LEAST_AT_FIRST, LEAST_VERIFIED, LEAST_FRACTION = 10, 24, 0.5
TOLERANCE = 1.5  # px of the resized image


class Matches(NamedTuple):
    """M matches of P pairs of images."""

    first: np.ndarray  # (P,) int, the pairs' first views
    second: np.ndarray  # (P,) int
    pair: np.ndarray  # (M,) int, the pair of each match, ascending
    pixels: np.ndarray  # (M, 2, 2) x, y in the first and in the second image, at their original sizes

    def thinned(self, most: int) -> Matches:
        """At most ``most`` matches of each pair, evenly chosen."""
        rank = np.arange(len(self.pair)) - np.searchsorted(self.pair, self.pair)
        count = np.bincount(self.pair, minlength=len(self.first))[self.pair]
        step = np.maximum(count / most, 1.0)
        kept = np.floor((rank + 1) / step) > np.floor(rank / step)
        return self._replace(pair=self.pair[kept], pixels=self.pixels[kept])


def choose_views(count: int) -> np.ndarray:
    """Which of ``count`` views are measured: all, or runs of successive ones at even distances.

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
    """One image in grey, resized where its longer side is above ``longest``.

    Returns:
        (h, w) uint8, and (2,) original pixels per pixel, x and y.
    """
    whole = (scene.load(view) * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0).mul_(255).numpy()
    grey = downsized(whole, longest)
    return np.round(grey).clip(0, 255).astype(np.uint8), np.divide(whole.shape, grey.shape)[::-1]


def downsized(image: np.ndarray, longest: int) -> np.ndarray:
    """An image (h, w) or (h, w, 3), resized where its longer side is above ``longest``."""
    import cv2

    height, width = image.shape[:2]
    scale = min(1.0, longest / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA) if size != (width, height) else image)


def match_features(scene: PosedImages, views: np.ndarray) -> Matches:
    """Match SIFT features between the pairs of views that share most, and keep those that fit one fundamental matrix.

    Pairs are chosen by the features only: the strongest of every view are compared with those of every other.
    (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004; Barath et al., "MAGSAC++", CVPR
    2020.)

    Raises:
        DataError: an image is missing, damaged or not of its camera's size.
    """
    found = {}
    longest = LONGEST_SIDE if len(views) <= MANY else LONGEST_SIDE_OF_MANY
    for view in tqdm(views.tolist(), desc="features", unit="image", disable=None, leave=False):
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
    """The number of features of each view, (N,) int.

    Raises:
        DataError: an image is missing, damaged or not of its camera's size.
    """
    return np.array([len(_features(*grey_image(scene, view, LONGEST_SIDE)).pixels) for view in views.tolist()], int)


class _Features(NamedTuple):
    pixels: np.ndarray  # (N, 2), of the original image
    descriptors: torch.Tensor  # (N, 128) float32, strongest first
    scale: np.ndarray  # (2,) original pixels per pixel of the resized image


def _features(grey: np.ndarray, scale: np.ndarray) -> _Features:
    import cv2

    # Without the precise upscaling OpenCV's features are a quarter of a pixel off.
    create: Any = cv2.SIFT_create  # type: ignore[attr-defined]
    sift = create(MAX_FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return _Features(np.zeros((0, 2)), torch.zeros(0, 128), scale)
    pixels = np.array([key.pt for key in keypoints], np.float64)
    # A place may have several orientations: sorted by strength and place, the result is always the same.
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -np.array([key.response for key in keypoints])))[:MAX_FEATURES]
    return _Features((pixels[order] + 0.5) * scale - 0.5, torch.from_numpy(descriptors[order]), scale)


def _mutual_matches(first: torch.Tensor, second: torch.Tensor, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices (M,) and (M,) of descriptors that are mutual nearest neighbours and pass the ratio test."""
    if min(len(first), len(second)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    from kornia.feature import match_snn

    distances = torch.cdist(first, second)
    rows, columns = match_snn(first, second, ratio, distances)[1].unbind(1)
    kept = distances.min(0).indices[columns] == rows
    return rows[kept].numpy(), columns[kept].numpy()


def _promising_pairs(found: dict[int, _Features]) -> list[tuple[int, int]]:
    """Pairs of every view with those that share most of its strongest features."""
    views = sorted(found)
    strong = {view: found[view].descriptors[:FEATURES_AT_FIRST] for view in views}
    shared = np.zeros((len(views), len(views)), int)
    for i, first in enumerate(tqdm(views, desc="pairs", unit="image", disable=None, leave=False)):
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

    rows, columns = _mutual_matches(first.descriptors, second.descriptors, RATIO)
    if len(rows) < LEAST_VERIFIED:
        return None
    pixels = np.stack([first.pixels[rows], second.pixels[columns]], 1)
    pixels = pixels[np.sort(np.unique(pixels.reshape(-1, 4), axis=0, return_index=True)[1])]
    resized = pixels / np.stack([first.scale, second.scale])
    try:
        _, fits = cv2.findFundamentalMat(resized[:, 0], resized[:, 1], cv2.USAC_MAGSAC, TOLERANCE, 0.999, 10000)
    except cv2.error:
        return None
    if fits is None:
        return None
    kept = fits.ravel().astype(bool)
    return pixels[kept] if kept.sum() >= max(LEAST_VERIFIED, LEAST_FRACTION * len(pixels)) else None
