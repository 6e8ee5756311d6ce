"""Parsers of mesh files: bytes in, arrays out.

They use numpy and the standard library and nothing of this package, so that `lsmgeo.data.mesh_files.alone` can run
them in a process of its own whose memory and time are limited. Nothing is allocated for a count that a file merely
announces.
"""

from .common import Parsed, Unreadable
from .parse import KINDS, parse

__all__ = ["KINDS", "Parsed", "Unreadable", "parse"]
