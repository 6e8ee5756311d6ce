"""The errors that the library raises: one base class, each also a Python built-in."""

from __future__ import annotations

from os import PathLike

__all__ = [
    "BackendError",
    "CameraError",
    "CheckpointError",
    "DTypeError",
    "DataError",
    "DeviceError",
    "GridError",
    "LsmGeoError",
    "OptionError",
    "ShapeError",
    "TrainingError",
]


class LsmGeoError(Exception):
    """Base class of every error that the library raises on purpose."""


class ShapeError(LsmGeoError, ValueError):
    """A tensor has the wrong rank or size."""


class DTypeError(LsmGeoError, TypeError):
    """An argument is not of the expected type, or a tensor not of the expected dtype."""


class DeviceError(LsmGeoError, ValueError):
    """Tensors of one call are on different devices."""


class CameraError(LsmGeoError, ValueError):
    """A camera is not a rigid pinhole camera: for example a singular calibration matrix or a mirrored rotation."""


class GridError(LsmGeoError, ValueError):
    """A grid is invalid: no voxels, crossed bounds, depths out of order."""


class OptionError(LsmGeoError, ValueError):
    """An option has an invalid value."""


class BackendError(LsmGeoError, ValueError):
    """A backend requested by name cannot run this call."""


class _FileError(LsmGeoError):
    def __init__(self, path: str | PathLike[str], reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path = path
        self.reason = reason

    def __reduce__(self) -> tuple[type[_FileError], tuple[str | PathLike[str], str]]:
        # By default pickle rebuilds an error from its message only, which breaks a pool of processes.
        return type(self), (self.path, self.reason)


class DataError(_FileError, OSError):
    """An input file cannot be used.

    Args:
        path: the file or folder.
        reason: what is wrong with it.
    """


class CheckpointError(_FileError, RuntimeError):
    """A checkpoint or a file of weights cannot be written, read, or used for this model or run.

    Args:
        path: the file or folder.
        reason: what is wrong with it.
    """


class TrainingError(LsmGeoError, RuntimeError):
    """Training cannot continue: values are not finite, or its processes do not agree."""
