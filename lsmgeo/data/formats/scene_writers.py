"""Writing posed images as a COLMAP model, ``transforms.json`` or plain JSON, and point clouds as PLY."""

from __future__ import annotations

import json
import math
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lsmgeo.cameras import to_colmap, to_opengl
from lsmgeo.cameras.matrices import is_unskewed
from lsmgeo.data.atomic_files import atomic_folder, write_atomic
from lsmgeo.data.formats.format_cameras_json import NAME, camera_entry, encode_cameras
from lsmgeo.data.formats.scene_assembly import check_image_size
from lsmgeo.data.images import MAX_IMAGE_BYTES, SUFFIXES, encode_png, image_size, read_cut_out, read_image
from lsmgeo.data.read_files import path_inside, read_bytes
from lsmgeo.errors import CameraError, DataError, OptionError

if TYPE_CHECKING:
    from os import PathLike

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.data.posed_images import PosedImages

__all__ = ["write_cameras_json", "write_colmap", "write_point_cloud", "write_transforms"]

IMAGES = "images"


def write_colmap(images: PosedImages, folder: str | PathLike[str]) -> Path:
    """Write posed images as a COLMAP model in text form: ``sparse/0`` and ``images``.

    Convention:
        COLMAP's: world-to-camera quaternions, half-integer pixel centres (0.5 is added to principal points and
        observations). All cameras are PINHOLE: images with distortion are undistorted and written as PNG, all others
        are copied. A rounded rotation is written as the nearest rotation with the same camera centre. Spaces in names
        become underscores, since COLMAP's text form cannot have them. Depth and voxels are not written.

    Args:
        images: the images, with their sparse points and observations.
        folder: the folder to make, atomically; it must be new or empty.

    Returns:
        The folder.

    Raises:
        CameraError: a camera has skew, or its image is flipped or rolled, which COLMAP does not support.
        DataError: the folder exists or cannot be written, or an image cannot be read.
    """
    _require_upright("write_colmap", "COLMAP", images)
    names = _file_names(images, blank="_")
    K, quaternions, translations = (part.numpy() for part in to_colmap(_as_rigid(images.cameras)))
    models: dict[str, int] = {}
    lines = []
    for view in range(len(images)):
        height, width = images.size(view)
        matrix = K[view]
        numbers = _joined(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        camera = models.setdefault(f"PINHOLE {width} {height} {numbers}", len(models) + 1)
        pose = _joined(*quaternions[view], *translations[view])
        lines += [f"{view + 1} {pose} {camera} {names[view]}", _observed(images, view)]
    cameras = [f"{camera} {model}" for model, camera in models.items()]
    points = _points(images)
    with atomic_folder(folder) as made:
        _write_images(images, names, made / IMAGES)
        for name, rows in (("cameras", cameras), ("images", lines), ("points3D", points)):
            write_atomic(made / "sparse" / "0" / f"{name}.txt", "".join(f"{row}\n" for row in rows).encode())
    return Path(folder)


def write_transforms(images: PosedImages, folder: str | PathLike[str]) -> Path:
    """Write posed images as ``transforms.json`` and ``images``, for instant-ngp and nerfstudio.

    Convention:
        Camera-to-world, OpenGL axes, half-integer pixel centres (0.5 is added to principal points). Images with
        distortion are undistorted and written as PNG, all others are copied. A rounded rotation is written as the
        nearest rotation with the same camera centre. Points, depth and voxels are not written.

    Args:
        images: the images.
        folder: the folder to make, atomically; it must be new or empty.

    Returns:
        The folder.

    Raises:
        CameraError: a camera has skew, or its image is flipped or rolled, which the format does not support.
        DataError: the folder exists or cannot be written, or an image cannot be read.
    """
    _require_upright("write_transforms", "transforms.json", images)
    names = _file_names(images)
    K, poses = (part.numpy() for part in to_opengl(_as_rigid(images.cameras)))
    stated, frames = [], []
    for view, name in enumerate(names):
        height, width = images.size(view)
        (fx, _, cx), (_, fy, cy) = K[view, :2].tolist()
        angles = (2 * math.atan(0.5 * side / focal) for side, focal in ((width, fx), (height, fy)))
        keys = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
        stated.append(dict(zip(keys, (width, height, fx, fy, cx, cy, *angles), strict=True)))
        frames.append({"file_path": f"{IMAGES}/{name}", "transform_matrix": poses[view].tolist()})
    values: dict[str, Any] = {"camera_model": "PINHOLE"}
    if all(camera == stated[0] for camera in stated):
        values |= stated[0]
    else:
        frames = [camera | frame for camera, frame in zip(stated, frames, strict=True)]
    values["frames"] = frames
    with atomic_folder(folder) as made:
        _write_images(images, names, made / IMAGES)
        write_atomic(made / "transforms.json", json.dumps(values, indent=1, allow_nan=False).encode())
    return Path(folder)


def write_cameras_json(images: PosedImages, path: str | PathLike[str]) -> Path:
    """Write posed images as a plain JSON file of cameras, see `read_cameras_json`.

    Convention:
        World-to-camera, OpenCV axes, integer pixel centres, K with skew. Nothing is rounded. Points, depth and voxels
        are not written.

    Args:
        images: the images.
        path: a folder to make, which must not exist or be empty, for ``cameras.json`` and ``images``; or a ``.json``
            file for only the cameras, in a folder with all the images in or below it; it may exist.

    Returns:
        The path.

    Raises:
        CameraError: an image is flipped or rolled, which the reader does not accept.
        OptionError: only cameras are written, and an image is elsewhere or has distortion.
        DataError: the folder exists, a file cannot be written, or an image cannot be read.
    """
    _require_upright("write_cameras_json", NAME, images, skew=True)
    path = Path(path)
    only_cameras = path.suffix.lower() == ".json"
    names = _below(images, path.parent) if only_cameras else [f"{IMAGES}/{name}" for name in _file_names(images)]
    cameras = [{"file": name} | camera_entry(images.camera(view)) for view, name in enumerate(names)]
    if only_cameras:
        return write_atomic(path, encode_cameras(cameras))
    with atomic_folder(path) as made:
        _write_images(images, names, made)
        write_atomic(made / NAME, encode_cameras(cameras))
    return path


def _below(images: PosedImages, folder: Path) -> list[str]:
    """The images' paths relative to the folder."""
    if images.lenses is not None:
        raise OptionError(
            "write_cameras_json: path must be a folder if images have distortion, as they are written undistorted; "
            "got a file"
        )
    names = []
    for path in images.paths:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise OptionError(f"write_cameras_json: images must be below the folder of the file; got {path}")
        names.append(path.resolve().relative_to(folder.resolve()).as_posix())
    return names


def _file_names(images: PosedImages, *, blank: str = " ") -> list[str]:
    """The names of the images below ``images``: those of their source, with the suffixes of their files."""
    names = []
    for view, name in enumerate(images.names):
        parts = [part for part in PurePosixPath(name).parts if part not in ("..", "/")]
        # Names of scenes that lsmgeo has written begin with images/.
        plain = PurePosixPath(*(parts[1:] if len(parts) > 1 and parts[0] == IMAGES else parts))
        suffix = images.paths[view].suffix
        has_lens = images.lenses is not None and images.lenses[view] is not None
        if plain.suffix.lower() not in SUFFIXES:
            plain = plain.with_name(plain.name + (".png" if has_lens else suffix))
        names.append(str(plain.with_suffix(".png") if has_lens else plain).replace(" ", blank))
    twice = next((name for name in names if names.count(name) > 1), None) if len(set(names)) < len(names) else None
    if twice is not None:
        raise DataError(images.paths[names.index(twice)], f"is one of two images that would be named {twice!r}")
    return names


def _write_images(images: PosedImages, names: list[str], folder: Path) -> None:
    for view, name in enumerate(names):
        source, size = images.paths[view], images.size(view)
        check_image_size(size, image_size(source), source, source, name)
        lens = None if images.lenses is None else images.lenses[view]
        if lens is None:
            content = read_bytes(source, MAX_IMAGE_BYTES)
        else:
            pixels = read_cut_out(source, size) if images.cut_out else read_image(source, size)
            content = encode_png(lens.straighten(pixels))
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path_inside(folder, name, source), content)


def _require_upright(who: str, what: str, images: PosedImages, skew: bool = False) -> None:
    """Raise a CameraError for images that are flipped, rolled or, unless `skew`, skewed: `what` cannot hold them."""
    K = images.cameras.intrinsics.clone()
    if skew:
        K[:, 0, 1] = 0.0
    good = is_unskewed(K) & (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0)
    for view in (~good).nonzero()[:1, 0].tolist():
        raise CameraError(
            f"{who}: cameras must have positive focal lengths and no {'rolled image' if skew else 'skew'}: {what} "
            f"cannot hold {images.names[view]!r} with K[:2, :2] = {images.cameras.intrinsics[view, :2, :2].tolist()}"
        )


def _as_rigid(cameras: CameraTensors) -> CameraTensors:
    """The nearest rotations with the same camera centres: quaternions and inverses of rounded ones would differ."""
    E = cameras.cam_from_world.double()
    U, _, V = torch.linalg.svd(E[:, :3, :3])
    near = U @ V
    rigid = E.clone()
    rigid[:, :3, :3] = near
    rigid[:, :3, 3] = (near @ torch.linalg.solve(E[:, :3, :3], E[:, :3, 3:]))[..., 0]
    # Exact rotations are unchanged, to the last digit.
    exact = ((near - E[:, :3, :3]).abs() < 1e-12).all(-1).all(-1)
    return cameras._replace(cam_from_world=torch.where(exact[:, None, None], E, rigid))


def _joined(*values: float) -> str:
    # repr() of a double is exact.
    return " ".join(repr(float(value)) for value in values)


def _observed(images: PosedImages, view: int) -> str:
    if images.points is None:
        return ""
    points, pixels = images.points.observations[view]
    return " ".join(
        f"{_joined(*pixel)} {point + 1}" for point, pixel in zip(points.tolist(), pixels + 0.5, strict=True)
    )


def _points(images: PosedImages) -> list[str]:
    if images.points is None:
        return []
    tracks: list[list[str]] = [[] for _ in images.points.positions]
    for view, observed in enumerate(images.points.observations):
        for index, point in enumerate(observed.points.tolist()):
            tracks[point].append(f"{view + 1} {index}")
    rows = zip(images.points.positions, images.points.colours.tolist(), tracks, strict=True)
    # -1 is COLMAP's value for an unknown reprojection error.
    return [
        " ".join([str(index), _joined(*position), *map(str, colour), "-1", *track])
        for index, (position, colour, track) in enumerate(rows, 1)
    ]


def write_point_cloud(path: str | PathLike[str], positions: np.ndarray, colours: np.ndarray) -> Path:
    """Write coloured points as a binary PLY file, atomically.

    Args:
        path: the file to write.
        positions: (N, 3) world coordinates, N >= 1.
        colours: (N, 3) uint8 RGB.

    Returns:
        The path written.

    Raises:
        DataError: there is no point, shapes do not match, a position is not finite, or the file cannot be written.
    """
    positions = np.asarray(positions)
    colours = np.asarray(colours)
    if positions.ndim != 2 or positions.shape[1:] != (3,) or len(positions) == 0:
        raise DataError(path, f"positions must be (N, 3) with N >= 1; got {positions.shape}")
    if colours.shape != positions.shape or colours.dtype != np.uint8:
        raise DataError(path, f"colours must be {positions.shape} uint8; got {colours.shape} {colours.dtype}")
    if not np.isfinite(positions).all():
        raise DataError(path, "positions must be finite")
    import trimesh

    content = trimesh.PointCloud(positions, colors=colours).export(file_type="ply")
    return write_atomic(path, content)
