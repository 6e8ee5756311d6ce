"""COLMAP reconstructions, text or binary: cameras, poses, and sparse points with who observes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lsmgeo.cameras import from_colmap
from lsmgeo.data import colmap_binary, colmap_text
from lsmgeo.data.colmap_model import ColmapModel
from lsmgeo.data.files import child
from lsmgeo.data.posed import Observations, PosedImages, SparsePoints
from lsmgeo.errors import DataError, LsmGeoError

__all__ = ["model_folder", "read_colmap"]


def model_folder(path: Path) -> tuple[Path, str] | None:
    """Where a COLMAP model lies in or below ``path``, and its form ("bin" or "txt"); None where there is none."""
    for folder in (path, path / "sparse", path / "sparse" / "0"):
        for form in ("bin", "txt"):
            if (folder / f"cameras.{form}").is_file() and (folder / f"images.{form}").is_file():
                return folder, form
    return None


def read_colmap(path: str | Path, images: str | Path | None = None) -> PosedImages:
    """Read a COLMAP model of undistorted photographs.

    The model (``cameras``, ``images`` and, where it exists, ``points3D``, binary or text) is looked for in the folder,
    in ``sparse`` and in ``sparse/0``; the photographs in ``images`` beside it, else in the folder itself. Photographs
    are ordered by name.

    Convention:
        COLMAP's poses are world-to-camera with OpenCV axes, as ours. Its pixel centres are half-integer: principal
        points and observations lose 0.5.

    Args:
        path: the scene's folder or the model's.
        images: folder of the photographs, where it is elsewhere.

    Returns:
        The photographs with cameras and sparse points.

    Raises:
        DataError: no model, a damaged or inconsistent one, a camera model with distortion, or a name that leads
            outside the folder of photographs.
    """
    path = Path(path)
    found = model_folder(path)
    if found is None:
        raise DataError(path, "holds no COLMAP model (cameras and images, .bin or .txt)")
    folder, form = found
    model = colmap_binary.read_model(folder) if form == "bin" else colmap_text.read_model(folder)
    file = folder / f"images.{form}"
    if not model.images:
        raise DataError(file, "holds no photograph")
    entries = sorted(model.images, key=lambda entry: entry.name)
    root = Path(images) if images is not None else _image_folder(path, folder)

    paths, used = [], []
    for entry in entries:
        camera = model.cameras.get(entry.camera_id)
        if camera is None:
            raise DataError(file, f"{entry.name!r} refers to camera {entry.camera_id}, which does not exist")
        paths.append(child(root, entry.name, file))
        used.append(camera)
    if len({entry.name for entry in entries}) != len(entries):
        raise DataError(file, "names a photograph twice")
    try:
        cameras = from_colmap(
            torch.from_numpy(np.stack([camera.intrinsics() for camera in used])),
            torch.from_numpy(np.stack([entry.quaternion for entry in entries])),
            torch.from_numpy(np.stack([entry.translation for entry in entries])),
            torch.tensor([camera.height for camera in used]),
            torch.tensor([camera.width for camera in used]),
        )
    except LsmGeoError as error:
        raise DataError(file, str(error)) from error
    points = _sparse_points(model, [entry.image_id for entry in entries], file)
    return PosedImages(tuple(entry.name for entry in entries), tuple(paths), cameras, points, "colmap")


def _image_folder(path: Path, model: Path) -> Path:
    for folder in (path / "images", model / "images", model.parent / "images", model.parent.parent / "images"):
        if folder.is_dir():
            return folder
    return path


def _sparse_points(model: ColmapModel, order: list[int], file: Path) -> SparsePoints | None:
    if model.points is None:
        return None
    identifiers, positions, colours = model.points
    by_id = {entry.image_id: entry for entry in model.images}
    ranks = np.argsort(identifiers, kind="stable")
    ordered = identifiers[ranks]
    observations = []
    for image_id in order:
        entry = by_id[image_id]
        known = entry.point_ids != -1
        slots = np.searchsorted(ordered, entry.point_ids[known])
        if len(ordered) == 0 and known.any():
            raise DataError(file, f"{entry.name!r} observes points, but the model holds none")
        slots = np.minimum(slots, max(len(ordered) - 1, 0))
        if (ordered[slots] != entry.point_ids[known]).any():
            raise DataError(file, f"{entry.name!r} observes a point that does not exist")
        observations.append(Observations(ranks[slots], entry.pixels[known] - 0.5))
    return SparsePoints(positions, colours, tuple(observations))
