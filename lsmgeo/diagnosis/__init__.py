"""Whether cameras, photographs, depth and voxels belong together, and which mistake explains it where they do not."""

from lsmgeo.diagnosis.findings import Cause, Check, Findings
from lsmgeo.diagnosis.photographs import examine

__all__ = ["Cause", "Check", "Findings", "examine"]
