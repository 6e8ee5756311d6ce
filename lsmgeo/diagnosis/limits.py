"""How far each measurement may go before it counts as failed, in one place."""

from __future__ import annotations

import numpy as np

from lsmgeo.diagnosis.findings import Check

__all__ = ["CENTRED", "LIMITS", "SIDES", "badness", "pixel_limit"]

# Good sets stay at a quarter of these or below; the mistakes that people make go beyond by ten times and more.
LIMITS = {
    "pixels": 0.001,  # of the picture's diagonal: 1 px where that is 1000 px; never below the next
    "fewest pixels": 0.75,  # features and outlines are not located better in small pictures
    "pairs": 90.0,  # % of the pairs of photographs within three times the limit of pixels
    "in front": 90.0,  # % of the matched features with enough parallax
    "depth": 2.0,  # %, median relative difference of depth
    "warp": 0.5,  # of the difference in grey levels with no warp
    "inside": 97.0,  # % of the cells that reach into the outlines
    "overlap": 60.0,  # %, intersection over union of solid and outline
    "near a cell": 95.0,  # % of depth points at most one cell away from an occupied one
    "centred": 20.0,  # % of the width or height between principal point and middle, where nothing else tells of K
    "view": 3.0,  # times the limit of pixels, by which one view stands out
}

LEAST_BADNESS, MOST_BADNESS = 0.02, 1e6
# A principal point in the very middle is no better than one that lies well.
CENTRED = "principal point off the middle"
SIDES = "matched features in front of both cameras"


def pixel_limit(sizes: np.ndarray) -> float:
    """The limit of distances in photographs of sizes (V, 2), px."""
    diagonal = float(np.median(np.hypot(*np.asarray(sizes, float).T)))
    return max(LIMITS["pixels"] * diagonal, LIMITS["fewest pixels"])


def badness(check: Check) -> float:
    """How far a measurement goes, as a multiple of what it may: 1 is the limit."""
    part = (100 - check.value) / (100 - check.limit) if check.at_least else check.value / check.limit
    least = 1.0 if check.name == CENTRED else LEAST_BADNESS
    return float(np.clip(part, least, MOST_BADNESS)) if np.isfinite(part) else MOST_BADNESS
