"""What every reader of posed images needs: checks of the stated cameras, and `SceneBuilder`, which makes the scene."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo.cameras import from_opencv
from lsmgeo.data.images import has_alpha, image_size
from lsmgeo.data.posed_images import PosedImages
from lsmgeo.errors import DataError, LsmGeoError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.data.formats.depth_files import DepthFile
    from lsmgeo.data.formats.lenses import Lens
    from lsmgeo.data.posed_images import SparsePoints, Voxels

__all__ = [
    "SceneBuilder",
    "any_alpha",
    "assemble",
    "camera_errors_as_data_errors",
    "check_image_size",
    "check_intrinsics",
    "check_last_row",
    "check_rotation",
]

# The largest images have such sides; a larger number is damaged.
MAX_SIDE = 1 << 17
MAX_PARAMETER = 1e7


@contextlib.contextmanager
def camera_errors_as_data_errors(file: Path) -> Iterator[None]:
    """Turn errors of cameras into a DataError of the file that states them."""
    try:
        yield
    except DataError:
        raise
    except LsmGeoError as error:
        raise DataError(file, str(error)) from error


def check_intrinsics(intrinsics: np.ndarray, file: Path, where: str) -> None:
    """Raise a DataError unless K (3, 3) is upper triangular with positive focal lengths and last row 0 0 1."""
    lower = intrinsics[[1, 2, 2], [0, 0, 1]]
    if np.abs(lower).max() > 1e-9 or abs(intrinsics[2, 2] - 1) > 1e-9 or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise DataError(file, f"{where}: K must be upper triangular with positive focal lengths and last row 0 0 1")
    if np.abs(intrinsics).max() > MAX_PARAMETER:
        raise DataError(file, f"{where}: K holds a number beyond {MAX_PARAMETER:g} pixels")


def check_rotation(rotation: np.ndarray, file: Path, where: str) -> None:
    """Raise a DataError unless R (3, 3) is a rotation within rounding; the reason says if it is scaled or mirrored."""
    # Divided by its size, which is 1 for a rotation: numbers in a file may be large enough to overflow.
    size = float(np.abs(rotation).max())
    unit = rotation / size if size > 0 else rotation
    scale = size * float(np.sqrt((unit * unit).sum() / 3))
    unit = rotation / scale if scale > 0 else rotation
    rigid = scale > 0 and np.abs(unit.T @ unit - np.eye(3)).max() <= 1e-3
    if not rigid:
        raise DataError(file, f"{where}: not a rotation: its columns are not perpendicular and of one length")
    if np.linalg.det(unit) < 0:
        raise DataError(
            file, f"{where}: the rotation is mirrored (determinant -1): an axis is flipped or two exchanged"
        )
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3:
        raise DataError(file, f"{where}: the rotation is scaled by {scale:.6g}; divide it by that")


def check_last_row(pose: np.ndarray, file: Path, what: str) -> None:
    """Raise a DataError unless the last row of a pose (4, 4) is 0 0 0 1."""
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise DataError(file, f"{what} must have the last row 0 0 0 1")


def check_image_size(stated: tuple[float, float], found: tuple[int, int], image: Path, file: Path, where: str) -> None:
    """Raise a DataError unless the (height, width) of a camera is that of its image."""
    if stated != found:
        raise DataError(
            file,
            f"{where}: the camera has {stated[1]:g} x {stated[0]:g} pixels and {image.name!r} has "
            f"{found[1]} x {found[0]} (width x height): K of another resolution (lsmgeo.cameras.resize scales K)",
        )


def any_alpha(paths: Sequence[Path]) -> bool:
    """Whether any of the images has transparency, so that the scene is cut out."""
    return any(map(has_alpha, paths))


class SceneBuilder:
    """Collects the views of a scene, checks each, and makes the scene.

    Args:
        source: the name of the format.
        file: the file or folder that states the cameras, for errors.
        pixel_center: of K, "integer" or "half".
    """

    def __init__(self, source: str, file: Path, *, pixel_center: str = "integer") -> None:
        self.source, self.file, self.pixel_center = source, file, pixel_center
        self.names: list[str] = []
        self.paths: list[Path] = []
        self._cameras: list[tuple[object, ...]] = []  # K, R, t, height, width
        self._depths: list[DepthFile | None] = []

    def add(
        self,
        name: str,
        path: Path,
        intrinsics: np.ndarray,
        rotation: np.ndarray,
        translation: np.ndarray,
        where: str,
        *,
        size: tuple[float, float] | None = None,
        depth: DepthFile | None = None,
        file: Path | None = None,
    ) -> None:
        """Add a view.

        Args:
            name: the name of the image in the source.
            path: its file; the size of the image is that in its header.
            intrinsics: K (3, 3).
            rotation: world-to-camera R (3, 3).
            translation: t (3,).
            where: the view's place in the file, for errors.
            size: (height, width) as the source states it, if it does.
            depth: of the image.
            file: the file of this view's camera, if each has its own.

        Raises:
            DataError: the image cannot be read, or the camera is invalid or of another size.
        """
        file = self.file if file is None else file
        found = image_size(path)
        if size is not None:
            check_image_size(size, found, path, file, where)
        check_intrinsics(intrinsics, file, where)
        check_rotation(rotation, file, where)
        self.names.append(name)
        self.paths.append(path)
        self._cameras.append((intrinsics, rotation, translation, *found))
        self._depths.append(depth)

    def scene(self, *, cut_out: bool = False, voxels: Voxels | None = None, category: str | None = None) -> PosedImages:
        """The scene of the views, see `assemble`."""
        K, R, t, height, width = (torch.from_numpy(np.array(part)) for part in zip(*self._cameras, strict=True))
        with camera_errors_as_data_errors(self.file):
            cameras = from_opencv(K, R, t, height, width, pixel_center=self.pixel_center)
        return assemble(
            self.names,
            self.paths,
            cameras,
            self.source,
            file=self.file,
            depths=self._depths,
            cut_out=cut_out,
            voxels=voxels,
            category=category,
        )


def assemble(
    names: Sequence[str],
    paths: Sequence[Path],
    cameras: CameraTensors,
    source: str,
    *,
    file: Path,
    lenses: Sequence[Lens | None] = (),
    points: SparsePoints | None = None,
    depths: Sequence[DepthFile | None] = (),
    cut_out: bool = False,
    voxels: Voxels | None = None,
    category: str | None = None,
) -> PosedImages:
    """Make the scene of a reader, see `PosedImages`.

    Args:
        names: a different one for each image.
        paths: their files.
        cameras: leading shape (V,), with K of the images as stored; with a lens it becomes that of `Lens.pinhole`.
        source: the name of the format.
        file: the file that states the cameras, for errors.
        lenses: one for each image, or nothing.
        points: sparse points with their observations in undistorted pixels.
        depths: one for each image, or nothing.
        cut_out: whether alpha is a silhouette.
        voxels: the object.
        category: of the object.

    Raises:
        DataError: a name is used twice, or the distortion of a lens cannot be removed.
    """
    if len(set(names)) != len(names):
        raise DataError(file, "uses an image name twice")
    has_lens = any(lens is not None for lens in lenses)
    if has_lens:
        K = list(cameras.intrinsics)
        with camera_errors_as_data_errors(file):
            for view, lens in enumerate(lenses):
                K[view] = K[view] if lens is None else torch.from_numpy(lens.pinhole)
        cameras = cameras._replace(intrinsics=torch.stack(K))
    return PosedImages(
        tuple(names),
        tuple(paths),
        cameras,
        points,
        source,
        lenses=tuple(lenses) if has_lens else None,
        depths=tuple(depths) if any(depth is not None for depth in depths) else None,
        cut_out=cut_out,
        voxels=voxels,
        category=category,
    )
