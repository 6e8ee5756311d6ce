"""The members of one shape in a shard: `encode_sample` makes them, `decode_occupancy` reads one.

Members of a shape, by suffix and in this order::

    json             name, category, split, source, mesh, seed, views, size, depth_step, cameras, voxels
    00.png           8-bit RGBA; alpha is 255 on the object and 0 elsewhere, where the colour is 0 too
    00.depth.png     16-bit grey, depth = value * depth_step, 0 for background
    vox32.npy        uint8, np.packbits(occupancy, axis=-1)

A name is a key of eight digits, a dot and the suffix, as WebDataset expects.
"""

from __future__ import annotations

import io
import json
import re
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_number, check_whole, describe
from lsmgeo.cameras.camera_checks import check_cameras
from lsmgeo.data.images import encode_png
from lsmgeo.data.sample import MAX_VIEWS, Sample, check_sample
from lsmgeo.data.shards.shard_metadata import MAX_SIDE, MAX_VOXELS, is_text
from lsmgeo.errors import DataError, DTypeError, OptionError, ShapeError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from os import PathLike

__all__ = ["KEY", "SUFFIX", "decode_occupancy", "encode_sample", "format_key"]

KEY = re.compile(r"[0-9]{8}")
SUFFIX = re.compile(r"json|[0-9]{2,3}\.png|[0-9]{2,3}\.depth\.png|vox[1-9][0-9]{0,2}\.npy")


def format_key(key: int | str) -> str:
    """The key of a shape in a shard, eight digits; an OptionError for any other key.

    Example:
        >>> format_key(42)
        '00000042'
    """
    if isinstance(key, int) and not isinstance(key, bool) and 0 <= key < 10**8:
        return f"{key:08d}"
    if isinstance(key, str) and KEY.fullmatch(key):
        return key
    raise OptionError(f"key must be an integer from 0 to 99999999, or its eight digits; got {describe(key)}")


def encode_sample(
    sample: Sample,
    key: int | str,
    *,
    depth_step: float = 5e-5,
    more_occupancy: Sequence[Tensor] = (),
    source: str | None = None,
    seed: int | None = None,
    split: str | None = None,
) -> dict[str, bytes]:
    """Encode a shape as the members of a shard; equal samples give equal bytes.

    Colours become ``round(255 x)``. Depth is rounded to a multiple of ``depth_step``. Without a mask, the object is
    where depth is positive; without depth too, everywhere.

    Args:
        sample: the shape and its views, on the CPU, V <= 1000, sides of at most 4096 pixels.
        key: its index in the set.
        depth_step: world units of one step of 16-bit depth; 65535 steps must reach the farthest pixel.
        more_occupancy: further occupancy grids, (n, n, n) bool, of other resolutions than the sample's.
        source: of the shape.
        seed: of the set.
        split: such as "train".

    Returns:
        Suffix -> content, in the order in which a shard holds them.

    Raises:
        ShapeError: shapes do not match, a grid is not a cube, or there are too many views, pixels or voxels.
        DTypeError: wrong types.
        CameraError: an invalid camera.
        OptionError: an option or a value is out of range: colours not in [0, 1], depth that is negative, not finite or
            too far for `depth_step`, two grids of one resolution.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> cameras = orbit(torch.zeros(1), 10.0, 2.0, focal_length=90.0, height=48, width=48)
        >>> depth, grid = torch.full((1, 48, 48), 2.0), torch.ones(32, 32, 32, dtype=torch.bool)
        >>> sample = Sample(torch.rand(1, 3, 48, 48), cameras, depth, None, grid, None, "chair", "chair-0")
        >>> list(encode_sample(sample, 0))
        ['json', '00.png', '00.depth.png', 'vox32.npy']
    """
    who = f"encode_sample: sample {key}"
    key = format_key(key)
    cameras = check_sample(sample, who)
    check_cameras(who, cameras)
    views, _, height, width = sample.images.shape
    if views > MAX_VIEWS or max(height, width) > MAX_SIDE:
        raise ShapeError(
            f"{who}: at most {MAX_VIEWS} views of at most {MAX_SIDE} pixels a side; got {views} of {height} x {width}"
        )
    step = check_number("encode_sample", "depth_step", depth_step, "a positive number of world units")
    if step <= 0:
        raise OptionError(f"encode_sample: depth_step must be a positive number of world units; got {step}")
    grids = _grids(who, [*([] if sample.occupancy is None else [sample.occupancy]), *more_occupancy])
    mask = _mask(sample)
    rgba = _quantised_images(who, sample.images, mask)
    depths = None if sample.depth is None else _quantised_depth(who, sample.depth, step)
    metadata = {
        "key": key,
        **{field: _text(who, field, getattr(sample, field)) for field in ("name", "category")},
        "split": _text(who, "split", split),
        "source": _text(who, "source", source),
        "mesh": _text(who, "mesh", sample.mesh),
        "seed": seed,
        "views": views,
        "size": [height, width],
        "depth_step": None if depths is None else step,
        "cameras": {
            "intrinsics": cameras.intrinsics.double().tolist(),
            "cam_from_world": cameras.cam_from_world.double().tolist(),
        },
        "voxels": sorted(grids),
    }
    if seed is not None:
        seed = check_whole("encode_sample", "seed", seed, 0)
    members = {"json": json.dumps(metadata, separators=(",", ":"), allow_nan=False).encode()}
    for view in range(views):
        members[f"{view:02d}.png"] = encode_png(rgba[view])
        if depths is not None:
            members[f"{view:02d}.depth.png"] = encode_png(depths[view])
    for side in sorted(grids):
        members[f"vox{side}.npy"] = _npy(np.packbits(grids[side], axis=-1))
    return members


def _text(who: str, field: str, value: str | None) -> str | None:
    if value is not None and not is_text(value):
        raise OptionError(f"{who}: {field} must be 1 to 1024 printable characters, or None; got {describe(value)}")
    return value


def _grids(who: str, grids: Sequence[Tensor]) -> dict[int, np.ndarray]:
    found: dict[int, np.ndarray] = {}
    for grid in grids:
        if not isinstance(grid, Tensor) or grid.dtype != torch.bool:
            raise DTypeError(f"{who}: occupancy must be bool tensors (n, n, n); got {describe(grid)}")
        if grid.dim() != 3 or len(set(grid.shape)) != 1 or not 1 <= len(grid) <= MAX_VOXELS:
            raise ShapeError(f"{who}: occupancy must be (n, n, n), n <= {MAX_VOXELS}; got {tuple(grid.shape)}")
        if len(grid) in found:
            raise OptionError(f"{who}: two occupancy grids of {len(grid)} voxels a side")
        found[len(grid)] = grid.numpy(force=True)
    return found


def _mask(sample: Sample) -> Tensor:
    if sample.mask is not None:
        return sample.mask
    return torch.ones_like(sample.images[:, 0], dtype=torch.bool) if sample.depth is None else sample.depth > 0


def _quantised_images(who: str, images: Tensor, mask: Tensor) -> np.ndarray:
    """(V, H, W, 4) uint8."""
    low, high = (float(value) for value in images.aminmax())
    # Written so that NaN fails too; rounding may slightly exceed [0, 1].
    if not (low > -1e-3 and high < 1 + 1e-3):
        raise OptionError(f"{who}: images must be in [0, 1]; got [{low:.6g}, {high:.6g}]")
    result = np.zeros((len(images), *images.shape[2:], 4), np.uint8)
    for rgba, image, inside in zip(result, images, mask, strict=True):
        pixels = image.detach().mul(255).round_().clamp_(0, 255).mul_(inside).to(torch.uint8)
        rgba[..., :3] = pixels.permute(1, 2, 0).numpy(force=True)
        rgba[..., 3] = 255 * inside.numpy(force=True).astype(np.uint8)
    return result


def _quantised_depth(who: str, depth: Tensor, step: float) -> np.ndarray:
    """(V, H, W) uint16; positive depth never becomes 0, which is background."""
    low, high = (float(value) for value in depth.aminmax())
    if not (low >= 0 and high <= 65535 * step):
        raise OptionError(
            f"{who}: depth must be in [0, 65535 depth_step = {65535 * step:.6g}]; got [{low:.6g}, {high:.6g}]"
        )
    values = depth.numpy(force=True)
    steps = np.rint(values.astype(np.float64) / step)
    return np.where(values > 0, np.maximum(steps, 1), 0).astype(np.uint16)


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def decode_occupancy(content: bytes, side: int, path: str | PathLike[str], member: str) -> np.ndarray:
    """(n, n, n) bool of an occupancy member; a DataError if it is another array, or damaged."""
    shape = (side, side, (side + 7) // 8)
    stream = io.BytesIO(content)
    try:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("its version is not 1.0")
        header = np.lib.format.read_array_header_1_0(stream)
    # The header is a Python literal; parsing a damaged one raises many kinds of errors.
    except Exception as error:
        raise DataError(path, f"{member} is not an array file ({error})") from error
    if header != (shape, False, np.dtype(np.uint8)):
        raise DataError(path, f"{member} holds {describe(header)}; expected {shape} of uint8 in C order")
    if len(content) - stream.tell() != side * side * shape[2]:
        raise DataError(path, f"{member} holds {len(content) - stream.tell()} bytes of data; expected {shape}")
    packed = np.frombuffer(content, np.uint8, offset=stream.tell()).reshape(shape)
    return np.unpackbits(packed, axis=-1, count=side).view(np.bool_)
