"""The numbers of the paper: Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017.

They are for its own renderings and split of ShapeNet, and are not comparable with numbers for other data.
"""

from __future__ import annotations

from collections.abc import Sequence

from lsmgeo.evaluation.report import Cell, Row

__all__ = ["CATEGORIES", "DEPTH", "IOU", "IOU_OF_CATEGORIES", "paper_row"]

CATEGORIES = (
    "airplane", "bench", "cabinet", "car", "chair", "display", "lamp", "speaker", "rifle", "sofa", "table",
    "telephone", "vessel",
)  # fmt: skip

IOU = {
    "3D-R2N2": (55.6, 59.6, 61.3, 62.0),
    "visual hull": (18.0, 36.9, 47.0, 52.4),
    "3D-R2N2 w/pose": (55.1, 59.4, 61.2, 62.1),
    "V-LSM": (61.5, 72.1, 76.2, 78.2),
    "V-LSM w/bg": (60.5, 69.8, 73.7, 75.6),
}
"""Table 1: mean voxel IoU in per cent with 1, 2, 3, 4 views."""

IOU_OF_CATEGORIES = {
    "V-LSM": (
        (61.1, 50.8, 65.9, 79.3, 57.8, 53.9, 48.1, 63.9, 69.7, 67.0, 55.6, 67.7, 58.3, 61.5),
        (71.1, 64.0, 75.4, 82.6, 69.1, 69.0, 62.7, 72.8, 79.2, 75.9, 67.5, 79.1, 68.4, 72.1),
        (75.6, 69.5, 78.0, 83.9, 73.8, 73.5, 67.9, 76.4, 82.9, 79.5, 72.6, 84.1, 72.6, 76.2),
        (78.1, 72.2, 79.3, 84.7, 76.5, 75.6, 70.6, 77.8, 84.5, 81.3, 75.2, 86.2, 74.1, 78.2),
    ),
    "3D-R2N2 w/pose": (
        (56.7, 43.2, 61.8, 77.6, 50.9, 44.0, 40.0, 56.7, 56.5, 58.9, 51.6, 65.6, 53.1, 55.1),
        (59.9, 49.7, 67.0, 79.5, 55.0, 49.8, 43.1, 61.6, 59.9, 63.9, 56.0, 70.4, 57.0, 59.4),
        (61.3, 51.9, 69.0, 80.2, 56.8, 53.3, 44.2, 62.9, 61.0, 65.3, 58.0, 73.4, 58.9, 61.2),
        (62.0, 53.0, 69.7, 80.6, 57.7, 55.1, 44.5, 63.5, 61.6, 66.3, 58.8, 74.3, 59.5, 62.1),
    ),
}
"""Tables 3 and 4: the same by category and, last, their mean, with 1, 2, 3, 4 views."""

DEPTH = {
    "plane sweep": (0.029, 0.047, 0.074, 0.043, 0.054, 0.079, 0.043, 0.068, 0.023, 0.066, 0.054, 0.041, 0.043, 0.051),
    "D-LSM": (0.024, 0.030, 0.022, 0.016, 0.023, 0.028, 0.027, 0.029, 0.023, 0.021, 0.025, 0.021, 0.027, 0.024),
}
"""Table 5: median depth error by category and, last, their mean, 10 views, world units (the caption says mean L1)."""


def paper_row(name: str, numbers: Sequence[float], length: int) -> Row:
    """A row with the paper's numbers, padded to a length."""
    cells: list[Cell | None] = [Cell(number) for number in numbers[:length]]
    return Row(f"paper, {name}", [*cells, *[None] * (length - len(cells))], True)


def paper_categories(name: str, numbers: Sequence[float], categories: Sequence[str]) -> Row:
    """A row with the paper's numbers for some categories and, last, for all."""
    known = dict(zip(CATEGORIES, numbers, strict=False))
    cells = [Cell(known[category]) if category in known else None for category in categories]
    return Row(f"paper, {name}", [*cells, Cell(numbers[-1])], True)
