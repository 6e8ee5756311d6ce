"""The release of Learnt Stereo Machines: renderings, depth, cameras and voxels of ShapeNet objects."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo._checks import check_choice
from lsmgeo.data.formats.depth_files import DepthPng
from lsmgeo.data.formats.mat_files import parse_mat
from lsmgeo.data.formats.scene_assembly import SceneBuilder, check_last_row
from lsmgeo.data.formats.synsets import synset_category
from lsmgeo.data.isolated import parse_isolated
from lsmgeo.data.posed_images import PosedImages, Voxels
from lsmgeo.data.read_files import file_reader, path_inside
from lsmgeo.data.sample import MAX_VIEWS
from lsmgeo.errors import DataError, OptionError
from lsmgeo.grids import VoxelGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["is_lsm", "read_lsm", "read_lsm_object", "read_mat_files"]

RENDER = re.compile(r"render_(0|[1-9][0-9]{0,4})\.png")
RESOLUTIONS = (32, 64)
# A step of depth in world units; the largest value means no depth.
DEPTH_STEP = 10 / 65535
NO_DEPTH = 65535
# 128^3 bytes uncompressed fit.
MAX_MAT_BYTES = 1 << 22
# Address space, 200 MiB of it for the libraries.
MEMORY = 1 << 29
SECONDS = 60.0

Arrays = dict[str, np.ndarray]


def is_lsm(path: Path) -> bool:
    """Whether a folder has the renderings of one object."""
    renders, cameras = (any(True for _ in path.glob(pattern)) for pattern in ("render_*.png", "camera_*.mat"))
    return renders and cameras


@file_reader
def read_lsm(path: str | Path, *, voxels: int = 32) -> PosedImages:
    """Read one object of the LSM release: ``renders/SYNSET/MODEL``, with its voxels beside ``renders``.

    A view is ``render_i.png``, ``depth_i.png`` and ``camera_i.mat``; voxels are in
    ``voxels/modelVoxels32/SYNSET/MODEL.mat``, or 64. (Kar, Haene, Malik, "Learning a multi-view stereo machine",
    NeurIPS 2017, and the loaders of its code.)

    Convention:
        The source's ``extrinsic`` is world-to-camera with OpenCV axes. Its pixel centres are half-integer, so 0.5 is
        subtracted. Depth is camera z in steps of 10/65535, the largest value for no depth. Voxels fill
        [-0.5, 0.5]^3 and are stored as ``Volume[x, z, n - 1 - y]``.

    Args:
        path: the object's folder.
        voxels: the resolution to read, 32 or 64.

    Returns:
        The views in the order of their numbers, cut out, with depth and voxels if there are any.

    Raises:
        DataError: a file is missing or damaged, or crashes its parser, which runs in an isolated process.
        OptionError: another resolution, or SciPy is missing.
    """
    check_choice("read_lsm", "voxels", str(voxels), tuple(map(str, RESOLUTIONS)))
    scene, grids = read_lsm_object(Path(path), (voxels,))
    return scene if not grids else replace(scene, voxels=Voxels(grids[0], VoxelGrid(len(grids[0]))))


def read_lsm_object(folder: Path, resolutions: Sequence[int]) -> tuple[PosedImages, tuple[torch.Tensor, ...]]:
    """Read one object without voxels, and its occupancy (n, n, n) of the given resolutions that exist."""
    try:
        views = sorted(int(match[1]) for file in folder.iterdir() if (match := RENDER.fullmatch(file.name)))
        root = folder.resolve().parents[2]
        synset, model = folder.resolve().parts[-2:]
        files = [(side, root / "voxels" / f"modelVoxels{side}" / synset / f"{model}.mat") for side in resolutions]
        volumes = [
            (side, path_inside(root, str(file.relative_to(root)), folder)) for side, file in files if file.exists()
        ]
    except (OSError, RuntimeError, IndexError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(folder, f"cannot be read ({error})") from error
    if not 1 <= len(views) <= MAX_VIEWS:
        raise DataError(folder, f"must hold render_0.png and so on, at most {MAX_VIEWS} views; found {len(views)}")
    cameras = [path_inside(folder, f"camera_{view}.mat", folder) for view in views]
    arrays = []
    for found in read_mat_files([*cameras, *(file for _, file in volumes)]):
        if isinstance(found, DataError):
            raise found
        arrays.append(found)
    grids = tuple(
        _occupancy(found, side, file) for (side, file), found in zip(volumes, arrays[len(views) :], strict=True)
    )
    return _scene(folder, views, list(zip(cameras, arrays[: len(views)], strict=True))), grids


def read_mat_files(paths: Sequence[Path]) -> list[Arrays | DataError]:
    """K, extrinsic and Volume of each MATLAB file (up to version 7.2), if it has them; or the error of the file."""
    if find_spec("scipy") is None:
        raise OptionError("read_lsm: MATLAB files need SciPy; install scipy")
    results = parse_isolated(parse_mat, paths, limit=MAX_MAT_BYTES, memory=MEMORY, seconds=SECONDS)
    for number, (path, found) in enumerate(zip(paths, results, strict=True)):
        if isinstance(found, dict):
            for name, array in found.items():
                if array.dtype not in (np.float64, np.bool_) or not np.isfinite(array).all():
                    results[number] = DataError(path, f"{name} must hold finite numbers")
    return results


def _scene(folder: Path, views: Sequence[int], cameras: Sequence[tuple[Path, Arrays]]) -> PosedImages:
    builder = SceneBuilder("lsm", folder, pixel_center="half")
    for view, (file, arrays) in zip(views, cameras, strict=True):
        for name, shape in (("K", (3, 3)), ("extrinsic", (4, 4))):
            if name not in arrays or arrays[name].shape != shape:
                has = arrays[name].shape if name in arrays else "none"
                raise DataError(file, f"must hold {name}, {shape[0]} x {shape[1]}; found {has}")
        E = arrays["extrinsic"]
        image, depth = (path_inside(folder, f"{kind}_{view}.png", folder) for kind in ("render", "depth"))
        builder.add(
            image.name,
            image,
            arrays["K"],
            E[:3, :3],
            E[:3, 3],
            "camera",
            depth=DepthPng(depth, DEPTH_STEP, (NO_DEPTH,)) if depth.exists() else None,
            file=file,
        )
        check_last_row(E, file, "extrinsic")
    return builder.scene(cut_out=True, category=synset_category(folder.resolve().parent.name))


def _occupancy(arrays: Arrays, side: int, file: Path) -> torch.Tensor:
    """(D, H, W), so z, y, x, of ``Volume[x, z, n - 1 - y]``."""
    volume = arrays.get("Volume")
    if volume is None or volume.shape != (side,) * 3 or volume.dtype != np.bool_:
        has = "none" if volume is None else volume.shape
        raise DataError(file, f"must hold Volume, {side} x {side} x {side} zeros and ones; found {has}")
    return torch.from_numpy(np.ascontiguousarray(volume[:, :, ::-1].transpose(1, 2, 0)))
