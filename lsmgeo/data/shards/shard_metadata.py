"""The json of a shape in a shard: its name, category and source, its cameras and sizes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import torch

from lsmgeo._checks import check_whole, describe
from lsmgeo.cameras import CameraTensors
from lsmgeo.cameras.camera_checks import check_cameras
from lsmgeo.data.json_files import read_array
from lsmgeo.data.sample import MAX_VIEWS
from lsmgeo.errors import DataError, LsmGeoError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

__all__ = ["MAX_SIDE", "MAX_VOXELS", "Metadata", "decode_metadata", "decode_texts", "is_text"]

MAX_VOXELS = 256
MAX_SIDE = 4096
MAX_BYTES = 1 << 22

Checked = TypeVar("Checked")


class Metadata(NamedTuple):
    """The checked content of a shape's json.

    Attributes:
        name, category, mesh: as in `Sample`.
        split, source: as in `encode_sample`.
        seed: of the set, or None.
        size: (height, width) of its images.
        depth_step: world units of one step of the depth images, or None if there are none.
        intrinsics: (V, 3, 3) float64.
        cam_from_world: (V, 4, 4) float64.
        voxels: the resolutions of its occupancy grids.
    """

    name: str
    category: str | None
    split: str | None
    source: str | None
    mesh: str | None
    seed: int | None
    size: tuple[int, int]
    depth_step: float | None
    intrinsics: np.ndarray
    cam_from_world: np.ndarray
    voxels: tuple[int, ...]

    def cameras(self, views: Sequence[int]) -> CameraTensors:
        """The cameras of these views, float32, leading shape (len(views),), sizes as tensors."""
        chosen = list(views)
        K, E = (torch.from_numpy(m[chosen].astype(np.float32)) for m in (self.intrinsics, self.cam_from_world))
        return CameraTensors(K, E, *(torch.full((len(chosen),), side) for side in self.size))


def is_text(value: Any) -> bool:
    """Whether a value is one line of 1 to 1024 printable characters."""
    return isinstance(value, str) and value.isprintable() and 0 < len(value) <= 1024


def decode_metadata(content: bytes, key: str, path: Path) -> Metadata:
    """Read and check the untrusted json of the shape of a key; a DataError of the shard's path if it is invalid."""
    return _decode(content, key, path, _metadata)


def decode_texts(content: bytes, key: str, path: Path) -> dict[str, str | None]:
    """Only name, category, split, source and mesh of the json of a shape, checked; see `decode_metadata`."""
    return _decode(content, key, path, _texts)


def _decode(content: bytes, key: str, path: Path, check: Callable[[dict[str, Any], Path, str], Checked]) -> Checked:
    where = f"{key}.json"
    if len(content) > MAX_BYTES:
        raise DataError(path, f"{where} is larger than the limit of {MAX_BYTES} bytes")
    try:
        # Python itself refuses int() of a long text; deep nesting raises a RecursionError.
        values = json.loads(content.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"{where} is not JSON ({error})") from error
    try:
        if not isinstance(values, dict):
            raise ValueError("expected an object")
        if values["key"] != key:
            raise ValueError(f"belongs to key {describe(values['key'])}")
        return check(values, path, where)
    except DataError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, LsmGeoError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(path, f"{where}: {reason}") from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"holds {name}")


def _texts(values: dict[str, Any], path: Path, where: str) -> dict[str, str | None]:
    texts = {field: values[field] for field in ("name", "category", "split", "source", "mesh")}
    for field, text in texts.items():
        if text is not None and not is_text(text):
            raise ValueError(f"{field} must be 1 to 1024 printable characters or null; got {describe(text)}")
    if texts["name"] is None:
        raise ValueError("name must be a string; got null")
    return texts


def _metadata(values: dict[str, Any], path: Path, where: str) -> Metadata:
    seed, step, size = values["seed"], values["depth_step"], values["size"]
    if seed is not None:
        seed = check_whole("metadata", "seed", seed, 0)
    if step is not None:
        if not isinstance(step, (int, float)) or isinstance(step, bool) or not 0 < step < 1e6:
            raise ValueError(f"depth_step must be a positive number below 1e6 or null; got {describe(step)}")
        step = float(step)
    if not isinstance(size, list) or len(size) != 2:
        raise ValueError(f"size must be [height, width]; got {describe(size)}")
    height, width = (check_whole("size", "a side", side, 1, MAX_SIDE) for side in size)
    views = check_whole("metadata", "views", values["views"], 1, MAX_VIEWS)
    voxels = values["voxels"]
    if not isinstance(voxels, list) or len(voxels) > MAX_VOXELS:
        raise ValueError(f"voxels must be a list of resolutions; got {describe(voxels)}")
    cameras = values["cameras"]
    if not isinstance(cameras, dict):
        raise ValueError(f"cameras must be an object; got {describe(cameras)}")
    K, E = (
        read_array(cameras, field, (views, side, side), path, where)
        for field, side in (("intrinsics", 3), ("cam_from_world", 4))
    )
    sizes = (torch.full((views,), side) for side in (height, width))
    check_cameras("cameras", CameraTensors(torch.from_numpy(K), torch.from_numpy(E), *sizes))
    resolutions = tuple(check_whole("voxels", "a resolution", side, 1, MAX_VOXELS) for side in voxels)
    return Metadata(
        **_texts(values, path, where),  # type: ignore[arg-type]
        seed=seed,
        size=(height, width),
        depth_step=step,
        intrinsics=K,
        cam_from_world=E,
        voxels=resolutions,
    )
