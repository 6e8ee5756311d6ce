"""Whether cameras, photographs, depth and voxels belong together, and which mistake explains it where they do not."""

from lsmgeo.diagnosis.check_images import examine
from lsmgeo.diagnosis.findings import Cause, Check, Findings

__all__ = ["Cause", "Check", "Findings", "examine"]
