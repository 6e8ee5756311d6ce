"""COLMAP reconstructions, text or binary: cameras, poses, and sparse points with who observes them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo.cameras import from_colmap
from lsmgeo.data.assembling import as_data_error, assemble
from lsmgeo.data.colmap_model import read_model
from lsmgeo.data.files import child, refuse_unreadable
from lsmgeo.data.posed import Observations, PosedImages, SparsePoints
from lsmgeo.errors import DataError

if TYPE_CHECKING:
    from lsmgeo.data.colmap_model import ColmapImage, ColmapModel
    from lsmgeo.data.lenses import Lens

__all__ = ["model_folder", "read_colmap"]


def model_folder(path: Path) -> tuple[Path, str] | None:
    """Where a COLMAP model lies in or below ``path``, and its form ("bin" or "txt"); None where there is none."""
    for folder in (path, path / "sparse", path / "sparse" / "0", path / "0"):
        for form in ("bin", "txt"):
            if (folder / f"cameras.{form}").is_file() and (folder / f"images.{form}").is_file():
                return folder, form
    return None


@refuse_unreadable
def read_colmap(path: str | Path, images: str | Path | None = None) -> PosedImages:
    """Read a COLMAP model; photographs with distortion are straightened.

    The model (``cameras``, ``images`` and, where it exists, ``points3D``, binary or text) is looked for in the folder,
    in ``sparse``, ``sparse/0`` and ``0``; the photographs in ``images`` in it or in up to three folders above, else in
    the folder itself. Photographs are ordered by name. Its files of rigs and frames repeat the photographs' poses and
    are not read.

    Convention:
        COLMAP's poses are world-to-camera with OpenCV axes, as ours. Its pixel centres are half-integer: principal
        points and observations lose 0.5. The models that OpenCV has become a `Lens`, and observations move to where
        the straightened photograph shows them; one that it cannot show is left out.

    Args:
        path: the scene's folder or the model's.
        images: folder of the photographs, where it is elsewhere.

    Returns:
        The photographs with cameras and sparse points.

    Raises:
        DataError: no model, a damaged or inconsistent one, a camera model that OpenCV lacks, or a name that leads
            outside the folder of photographs.
    """
    path = Path(path)
    found = model_folder(path)
    if found is None:
        raise DataError(path, "holds no COLMAP model (cameras and images, .bin or .txt)")
    folder, form = found
    model = read_model(folder, form)
    file = folder / f"images.{form}"
    if not model.images:
        raise DataError(file, "holds no photograph")
    entries = sorted(model.images, key=lambda entry: entry.name)
    root = Path(images) if images is not None else _image_folder(path, folder)

    lenses = {camera_id: camera.lens() for camera_id, camera in model.cameras.items()}
    paths, used = [], []
    for entry in entries:
        camera = model.cameras.get(entry.camera_id)
        if camera is None:
            raise DataError(file, f"{entry.name[:80]!r} refers to camera {entry.camera_id}, which does not exist")
        paths.append(child(root, entry.name, file))
        used.append(camera)
    with as_data_error(file):
        cameras = from_colmap(
            torch.from_numpy(np.stack([camera.intrinsics() for camera in used])),
            torch.from_numpy(np.stack([entry.quaternion for entry in entries])),
            torch.from_numpy(np.stack([entry.translation for entry in entries])),
            torch.tensor([camera.height for camera in used]),
            torch.tensor([camera.width for camera in used]),
        )
        points = _sparse_points(model, entries, lenses, file)
    return assemble(
        [entry.name for entry in entries],
        paths,
        cameras,
        "colmap",
        file=file,
        lenses=[lenses[entry.camera_id] for entry in entries],
        points=points,
    )


def _image_folder(path: Path, model: Path) -> Path:
    # The third is where nerfstudio keeps them, whose models are in colmap/sparse/0.
    for folder in (path, model, *model.absolute().parents[:3]):
        if (folder / "images").is_dir():
            return folder / "images"
    return path


def _sparse_points(
    model: ColmapModel, entries: list[ColmapImage], lenses: dict[int, Lens | None], file: Path
) -> SparsePoints | None:
    if model.points is None:
        return None
    ranks = np.argsort(model.points["id"], kind="stable")
    ordered = model.points["id"][ranks]
    observations = []
    for entry in entries:
        known = entry.point_ids != -1
        slots = np.searchsorted(ordered, entry.point_ids[known])
        if len(ordered) == 0 and known.any():
            raise DataError(file, f"{entry.name!r} observes points, but the model holds none")
        slots = np.minimum(slots, max(len(ordered) - 1, 0))
        if (ordered[slots] != entry.point_ids[known]).any():
            raise DataError(file, f"{entry.name!r} observes a point that does not exist")
        pixels = entry.pixels[known] - 0.5
        lens = lenses[entry.camera_id]
        if lens is not None:
            pixels = lens.straighten_pixels(pixels)
        shown = np.isfinite(pixels).all(1)
        observations.append(Observations(ranks[slots][shown], pixels[shown]))
    return SparsePoints(model.points["position"].copy(), model.points["colour"].copy(), tuple(observations))
