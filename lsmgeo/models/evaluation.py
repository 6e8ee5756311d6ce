"""The old place of `lsmgeo.evaluation`, for this version."""

from typing import Any


def __getattr__(name: str) -> Any:
    import warnings

    from lsmgeo import evaluation

    if name.startswith("__"):
        raise AttributeError(name)
    warnings.warn("lsmgeo.models.evaluation is now lsmgeo.evaluation", DeprecationWarning, stacklevel=2)
    return getattr(evaluation, name)
