"""Checks that cameras, images, depth and voxels are consistent, and the likely cause if they are not."""

from lsmgeo.diagnosis.check_images import examine
from lsmgeo.diagnosis.findings import Cause, Check, Findings

__all__ = ["Cause", "Check", "Findings", "examine"]
