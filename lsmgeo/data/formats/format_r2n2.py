"""The renderings of 3D-R2N2: 24 views of a ShapeNet object, and its voxels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lsmgeo.data.formats.format_binvox import read_binvox
from lsmgeo.data.formats.scene_assembly import SceneBuilder
from lsmgeo.data.formats.synsets import synset_category
from lsmgeo.data.images import image_size
from lsmgeo.data.posed_images import PosedImages
from lsmgeo.data.read_files import file_reader, parse_floats, path_inside, read_text
from lsmgeo.data.sample import MAX_VIEWS
from lsmgeo.errors import DataError

__all__ = ["METADATA", "is_r2n2", "read_r2n2"]

METADATA = "rendering_metadata.txt"
NAMES = "renderings.txt"
MAX_BYTES = 1 << 20
# A lens of 35 mm with a sensor of 32 mm; the fourth column is a fraction of the distance.
FOCAL_LENGTH_OF_WIDTH = 35 / 32
MAX_DISTANCE = 1.75


def is_r2n2(path: Path) -> bool:
    """Whether a path is the metadata of renderings, its folder, or the parent of its folder ``rendering``."""
    if path.is_file():
        return path.name == METADATA
    return any((folder / METADATA).is_file() for folder in (path, path / "rendering"))


@file_reader
def read_r2n2(path: str | Path) -> PosedImages:
    """Read the published renderings of one object of 3D-R2N2.

    ``ShapeNetRendering/SYNSET/MODEL/rendering`` has the images and, on one line for each view, azimuth, elevation,
    in-plane rotation (degrees), distance and field of view; ``ShapeNetVox32/SYNSET/MODEL/model.binvox`` the voxels,
    which may also be beside ``rendering``. (Choy, Xu, Gwak, Chen, Savarese, "3D-R2N2", ECCV 2016, and its renderer.)

    Equation: f = 35/32 W, c = W/2; C = d (cos e cos a, sin e, cos e sin a) with d = 1.75 distance; the camera looks at
    the origin, y up, and is rotated clockwise by the in-plane angle.

    Convention:
        Pixel centres are half-integer, so 0.5 is subtracted. The field of view is a constant that the renderer did not
        use; it is not read. The voxels are centred on the origin, see `read_binvox`.

    Args:
        path: the object's folder, its folder ``rendering``, or the metadata in it.

    Returns:
        The views in the order of the metadata, cut out, with voxels if there are any.

    Raises:
        DataError: a file is missing, damaged or too large, names a file outside, or has an invalid camera.
    """
    path = Path(path)
    folder = path.parent if path.is_file() else path if (path / METADATA).is_file() else path / "rendering"
    file = folder / METADATA
    lines = [line.split() for line in read_text(file, MAX_BYTES).splitlines() if line.strip()]
    if not 1 <= len(lines) <= MAX_VIEWS or any(len(line) != 5 for line in lines):
        raise DataError(file, f"must hold 1 to {MAX_VIEWS} lines of azimuth, elevation, in-plane, distance, fov")
    numbers = np.array([parse_floats(line, file, f"line {number}") for number, line in enumerate(lines, 1)])
    if np.abs(numbers[:, :3]).max() > 1e4 or not ((numbers[:, 3] > 1e-3) & (numbers[:, 3] < 1e3)).all():
        raise DataError(file, "holds an angle beyond 10000 degrees, or an invalid distance")
    builder = SceneBuilder("r2n2", file, pixel_center="half")
    for name, R, t in zip(_names(folder, len(lines)), *_poses(numbers), strict=True):
        path = path_inside(folder, name, folder / NAMES)
        height, width = image_size(path)
        focal_length = FOCAL_LENGTH_OF_WIDTH * width
        K = np.array([[focal_length, 0, width / 2], [0, focal_length, height / 2], [0, 0, 1]])
        builder.add(name, path, K, R, t, name)
    folder_of_object = folder.resolve().parent
    voxel_file = _voxel_file(folder_of_object)
    voxels = None if voxel_file is None else read_binvox(voxel_file, placement="centred")
    return builder.scene(voxels=voxels, cut_out=True, category=synset_category(folder_of_object.parent.name))


def _names(folder: Path, count: int) -> list[str]:
    if not (folder / NAMES).exists():
        return [f"{view:02d}.png" for view in range(count)]
    names = read_text(folder / NAMES, MAX_BYTES).split()
    if len(names) != count or len(set(names)) != count:
        raise DataError(folder / NAMES, f"must name {count} different images, one for each line of {METADATA}")
    return names


def _poses(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotations (V, 3, 3) and translations (V, 3)."""
    azimuth, elevation, roll = np.radians(numbers[:, :3]).T
    zero = np.zeros_like(azimuth)
    # In closed form, not by look_at: a camera straight above the origin also has a defined x axis.
    backward = [np.cos(elevation) * np.cos(azimuth), np.sin(elevation), np.cos(elevation) * np.sin(azimuth)]
    right = np.stack([np.sin(azimuth), zero, -np.cos(azimuth)], -1)
    forward = -np.stack(backward, -1)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll)[:, None], np.sin(roll)[:, None]
    R = np.stack([cos * right + sin * down, cos * down - sin * right, forward], 1)
    return R, np.stack([zero, zero, MAX_DISTANCE * numbers[:, 3]], -1)


def _voxel_file(folder_of_object: Path) -> Path | None:
    """The voxels of the object, beside its renderings or in the published tree of voxels."""
    beside = folder_of_object / "model.binvox"
    if beside.is_file():
        return path_inside(folder_of_object, beside.name, folder_of_object)
    if len(folder_of_object.parents) < 3:
        return None
    root = folder_of_object.parents[2]
    apart = root / "ShapeNetVox32" / folder_of_object.parent.name / folder_of_object.name / "model.binvox"
    return path_inside(root, str(apart.relative_to(root)), folder_of_object) if apart.is_file() else None
