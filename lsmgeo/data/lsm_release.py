"""The data that came with Learnt Stereo Machines: renderings, depth, cameras and voxels of ShapeNet's objects."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from lsmgeo._checks import check_choice
from lsmgeo.data.depth_files import DepthPng
from lsmgeo.data.files import child, refuse_unreadable
from lsmgeo.data.images import image_size
from lsmgeo.data.isolated import isolated
from lsmgeo.data.mat_files import parse_mat
from lsmgeo.data.metadata import MAX_VIEWS
from lsmgeo.data.posed import PosedImages, Voxels, assemble, check_camera, check_last_row, make_cameras
from lsmgeo.errors import DataError, OptionError
from lsmgeo.grids import VoxelGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["LsmObject", "find_lsm", "is_lsm", "read_lsm", "read_lsm_objects", "read_mats", "spell_synset"]

RENDER = re.compile(r"render_(0|[1-9][0-9]{0,4})\.png")
RESOLUTIONS = (32, 64)
# A step of depth in world units; the largest value means that nothing is there.
DEPTH_STEP = 10 / 65535
NO_DEPTH = 65535
# 128^3 bytes uncompressed fit.
MAX_MAT_BYTES = 1 << 22
# Of address space; the libraries take 200 MiB of it.
MEMORY = 1 << 29
SECONDS = 60.0

Arrays = dict[str, np.ndarray]


class LsmObject(NamedTuple):
    """The files of one object.

    Attributes:
        folder: where its renderings lie.
        views: their numbers, ascending.
        cameras: the MATLAB file of each view's camera.
        volumes: resolution and MATLAB file of the voxels that are there.
    """

    folder: Path
    views: tuple[int, ...]
    cameras: tuple[Path, ...]
    volumes: tuple[tuple[int, Path], ...]


def is_lsm(path: Path) -> bool:
    """Whether a folder holds the renderings of one object."""
    renders, cameras = (any(True for _ in path.glob(pattern)) for pattern in ("render_*.png", "camera_*.mat"))
    return renders and cameras


@refuse_unreadable
def read_lsm(path: str | Path, *, voxels: int = 32) -> PosedImages:
    """Read one object of the LSM release: ``renders/SYNSET/MODEL``, its voxels beside ``renders``.

    A view is ``render_i.png``, ``depth_i.png`` and ``camera_i.mat``; voxels are in
    ``voxels/modelVoxels32/SYNSET/MODEL.mat``, or 64. (Kar, Haene, Malik, "Learning a multi-view stereo machine",
    NeurIPS 2017, and the loaders of its code.)

    Convention:
        The source's ``extrinsic`` is world-to-camera with OpenCV axes; its pixel centres are half-integers, so half a
        pixel is taken off. Depth is camera z in steps of 10/65535, the largest of them empty. Voxels fill
        [-0.5, 0.5]^3 and are stored as ``Volume[x, z, n - 1 - y]``.

    Args:
        path: the object's folder.
        voxels: the resolution to read, 32 or 64.

    Returns:
        The views in the order of their numbers, cut out; with depth and voxels where they are there.

    Raises:
        DataError: a file is missing, damaged, or crashes its parser, which runs in a process of its own.
        OptionError: another resolution, or SciPy is missing.
    """
    check_choice("read_lsm", "voxels", str(voxels), tuple(map(str, RESOLUTIONS)))
    (found,) = read_lsm_objects([find_lsm(Path(path), (voxels,))])
    if isinstance(found, DataError):
        raise found
    scene, grids = found
    return scene if not grids else replace(scene, voxels=Voxels(grids[0], VoxelGrid(len(grids[0]))))


def find_lsm(folder: Path, resolutions: Sequence[int]) -> LsmObject:
    """Find the files of one object.

    Raises:
        DataError: no view, a view without camera, or too many.
    """
    try:
        numbers = [int(match[1]) for file in folder.iterdir() if (match := RENDER.fullmatch(file.name))]
        root = folder.resolve().parents[2]
        synset, model = folder.resolve().parts[-2:]
        files = [(side, root / "voxels" / f"modelVoxels{side}" / synset / f"{model}.mat") for side in resolutions]
        volumes = tuple(
            (side, child(root, str(file.relative_to(root)), folder)) for side, file in files if file.exists()
        )
    except (OSError, RuntimeError, IndexError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(folder, f"cannot be read ({error})") from error
    if not 1 <= len(numbers) <= MAX_VIEWS:
        raise DataError(folder, f"must hold render_0.png and so on, {MAX_VIEWS} views at most; found {len(numbers)}")
    views = tuple(sorted(numbers))
    return LsmObject(folder, views, tuple(child(folder, f"camera_{i}.mat", folder) for i in views), volumes)


def read_lsm_objects(objects: Sequence[LsmObject]) -> list[tuple[PosedImages, tuple[torch.Tensor, ...]] | DataError]:
    """Read objects together, their MATLAB files in one process.

    Returns:
        For each its scene without voxels, and its occupancy (n, n, n) of each resolution; or why it cannot be used.
    """
    paths = [path for found in objects for path in (*found.cameras, *(file for _, file in found.volumes))]
    mats = dict(zip(paths, read_mats(paths), strict=True))
    results: list[tuple[PosedImages, tuple[torch.Tensor, ...]] | DataError] = []
    for found in objects:
        try:
            grids = tuple(_occupancy(_arrays(mats[file]), side, file) for side, file in found.volumes)
            results.append((_scene(found, [_arrays(mats[file]) for file in found.cameras]), grids))
        except DataError as error:
            results.append(error)
    return results


def read_mats(paths: Sequence[Path]) -> list[Arrays | DataError]:
    """Read K, extrinsic and Volume from MATLAB files up to version 7.2, as far as each holds them.

    Returns:
        For each file its arrays, float64 or, beyond 64 elements, bool; or the error of one that cannot be used.

    Raises:
        OptionError: SciPy is missing.
    """
    if find_spec("scipy") is None:
        raise OptionError("read_mats: MATLAB files need SciPy; install lsmgeo[data]")
    results = isolated(parse_mat, paths, limit=MAX_MAT_BYTES, memory=MEMORY, seconds=SECONDS)
    for number, (path, found) in enumerate(zip(paths, results, strict=True)):
        if isinstance(found, dict):
            for name, array in found.items():
                if array.dtype not in (np.float64, np.bool_) or not np.isfinite(array).all():
                    results[number] = DataError(path, f"{name} must hold finite numbers")
    return results


def _arrays(found: Arrays | DataError) -> Arrays:
    if isinstance(found, DataError):
        raise found
    return found


def _scene(found: LsmObject, cameras: list[Arrays]) -> PosedImages:
    K, E, sizes, depths = [], [], [], []
    paths = [child(found.folder, f"render_{view}.png", found.folder) for view in found.views]
    for view, picture, file, arrays in zip(found.views, paths, found.cameras, cameras, strict=True):
        for name, shape in (("K", (3, 3)), ("extrinsic", (4, 4))):
            if name not in arrays or arrays[name].shape != shape:
                has = arrays[name].shape if name in arrays else "none"
                raise DataError(file, f"must hold {name}, {shape[0]} x {shape[1]}; found {has}")
        intrinsics, extrinsic = arrays["K"], arrays["extrinsic"]
        check_camera(intrinsics, extrinsic[:3, :3], file, "camera")
        check_last_row(extrinsic, file, "extrinsic")
        K.append(intrinsics)
        E.append(extrinsic)
        sizes.append(image_size(picture))
        depth = child(found.folder, f"depth_{view}.png", found.folder)
        depths.append(DepthPng(depth, DEPTH_STEP, (NO_DEPTH,)) if depth.exists() else None)
    poses = np.array(E)
    return assemble(
        [path.name for path in paths],
        paths,
        make_cameras(K, poses[:, :3, :3], poses[:, :3, 3], sizes, found.folder, pixel_center="half"),
        "lsm",
        file=found.folder,
        depths=depths,
        cut_out=True,
        category=spell_synset(found.folder.resolve().parent.name),
    )


def _occupancy(arrays: Arrays, side: int, file: Path) -> torch.Tensor:
    """(D, H, W), so z, y, x, of ``Volume[x, z, n - 1 - y]``."""
    volume = arrays.get("Volume")
    if volume is None or volume.shape != (side,) * 3 or volume.dtype != np.bool_:
        has = "none" if volume is None else volume.shape
        raise DataError(file, f"must hold Volume, {side} x {side} x {side} zeros and ones; found {has}")
    return torch.from_numpy(np.ascontiguousarray(volume[:, :, ::-1].transpose(1, 2, 0)))


def spell_synset(synset: str) -> str | None:
    """The name of a ShapeNet category, or None.

    Example:
        >>> spell_synset("03001627")
        'chair'
    """
    from lsmgeo.scenes.synthetic13 import CATEGORIES

    return {number: name for name, number in CATEGORIES.items()}.get(synset)
