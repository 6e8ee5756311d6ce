"""The ShapeNet synsets of the 13 categories."""

from __future__ import annotations

from lsmgeo.scenes import synthetic13

__all__ = ["synset_category"]


def synset_category(synset: str) -> str | None:
    """The name of a ShapeNet category, or None.

    Example:
        >>> synset_category("03001627")
        'chair'
    """
    return {number: name for name, number in synthetic13.CATEGORIES.items()}.get(synset)
