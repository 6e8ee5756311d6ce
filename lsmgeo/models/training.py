"""The old place of `lsmgeo.training`, for this version."""

from typing import Any


def __getattr__(name: str) -> Any:
    import warnings

    from lsmgeo import training

    if name.startswith("__"):
        raise AttributeError(name)
    warnings.warn("lsmgeo.models.training is now lsmgeo.training", DeprecationWarning, stacklevel=2)
    return getattr(training, name)
