"""The old place of `lsmgeo.training`, for this version."""

from lsmgeo._old_names import moved_to as _moved_to

__getattr__ = _moved_to("lsmgeo.training", __name__)
