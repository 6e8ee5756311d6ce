"""Voxels in Patrick Min's binvox format: a short text header and runs of equal voxels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from lsmgeo._checks import check_choice
from lsmgeo.data.posed_images import Voxels
from lsmgeo.data.read_files import file_reader, one_file, parse_floats, parse_ints, plain_files, read_bytes
from lsmgeo.errors import DataError, LsmGeoError
from lsmgeo.grids import VoxelGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["PATTERN", "PLACEMENTS", "is_binvox", "read_binvox"]

PATTERN = "*.binvox"
PLACEMENTS = ("header", "centred")
SIGNATURE = b"#binvox 1"
# The lines of a header, and the number of values of each.
LENGTHS = {"dim": 3, "translate": 3, "scale": 1}
MAX_HEADER_BYTES = 1024
MAX_SIDE = 1024
MAX_VOXELS = 1 << 28
# A run takes two bytes, and has at least one voxel.
MAX_BYTES = MAX_HEADER_BYTES + 2 * MAX_VOXELS


def is_binvox(path: Path) -> bool:
    """Whether a file has the signature of binvox, or a folder has ``*.binvox`` files."""
    if path.is_dir():
        return bool(plain_files(path, PATTERN))
    with path.open("rb") as stream:
        return stream.read(len(SIGNATURE)) == SIGNATURE


@file_reader
def read_binvox(path: str | Path, *, placement: str = "header") -> Voxels:
    """Read a binvox file.

    (Patrick Min, "BINVOX voxel file format specification".) The header must agree with the runs: 1 to 1024 voxels a
    side, at most 2^28, exactly as many as the runs have.

    Convention:
        Voxel i of n is centred at ``translate + scale (i + 0.5) / n`` with "header", the format's definition, and at
        ``((i + 0.5) / n - 0.5) scale`` with "centred": the grids of the 3D-R2N2 renderings are centred on the
        origin, whatever their translate. The file has y fastest, then z, then x; the result is
        (D, H, W) with D along z, H along y, W along x.

    Args:
        path: the file, or a folder with one such file.
        placement: "header" or "centred".

    Returns:
        The occupancy, and its grid in the world.

    Raises:
        DataError: the file is missing, damaged or too large, or its sides differ (writers disagree on their order).
        OptionError: another placement.
    """
    check_choice("read_binvox", "placement", placement, PLACEMENTS)
    path = one_file(Path(path), PATTERN)
    content = read_bytes(path, MAX_BYTES)
    side, translate, scale, begin = _read_header(content, path)
    runs = np.frombuffer(content, np.uint8, offset=begin)
    if len(runs) % 2:
        raise DataError(path, "ends inside a run of voxels")
    values, lengths = runs[0::2], runs[1::2]
    if not (values <= 1).all() or not (lengths > 0).all():
        raise DataError(path, "holds an empty run, or a value other than 0 and 1")
    count = int(lengths.sum(dtype=np.int64))
    if count != side**3:
        raise DataError(path, f"holds runs of {count} voxels; its header says {side} x {side} x {side}")
    stored = np.repeat(values.astype(np.bool_), lengths).reshape(side, side, side)  # (x, z, y)
    lower = tuple(translate) if placement == "header" else (-0.5 * scale,) * 3
    try:
        grid = VoxelGrid(side, lower, tuple(low + scale for low in lower))
    except LsmGeoError as error:
        raise DataError(path, f"has a scale too small for its translate ({error})") from error
    return Voxels(torch.from_numpy(np.ascontiguousarray(stored.transpose(1, 2, 0))), grid)


def _read_header(content: bytes, path: Path) -> tuple[int, list[float], float, int]:
    """Voxels a side, translate, scale, and the offset of the runs."""
    found: dict[str, Sequence[float]] = {}
    begin = 0
    for number, line in enumerate(content[:MAX_HEADER_BYTES].split(b"\n")[:-1]):
        begin += len(line) + 1
        if number == 0 and line.split() != SIGNATURE.split():
            raise DataError(path, "is not a binvox file: its first line is not '#binvox 1'")
        try:
            name, *tokens = line.decode("ascii").partition("#")[0].split() or [""]
        except UnicodeDecodeError as error:
            raise DataError(path, "has a header that is not ASCII text") from error
        if name == "data" and not tokens:
            break
        if name:
            if name in found or len(tokens) != LENGTHS.get(name):
                reason = f"has an invalid or repeated header line: {name[:40]!r} with {len(tokens)} values"
                raise DataError(path, reason)
            found[name] = (parse_ints if name == "dim" else parse_floats)(tokens, path, name)
    else:
        raise DataError(path, f"has no binvox header in its first {MAX_HEADER_BYTES} bytes")
    missing = [name for name in LENGTHS if name not in found]
    if missing:
        raise DataError(path, f"has a header without {' and '.join(missing)}")
    sides, (scale,) = [int(side) for side in found["dim"]], found["scale"]
    if not all(1 <= side <= MAX_SIDE for side in sides) or sides[0] * sides[1] * sides[2] > MAX_VOXELS:
        raise DataError(path, f"has {sides[0]} x {sides[1]} x {sides[2]} voxels; expected 1 to 645 a side")
    if len(set(sides)) != 1:
        raise DataError(path, f"has {sides[0]} x {sides[1]} x {sides[2]} voxels; writers disagree on their order")
    if not 0 < scale <= 1e12 or max(map(abs, found["translate"])) > 1e12:
        raise DataError(path, f"has scale {scale:g}, translate {found['translate']}: not a valid cube")
    return sides[0], list(found["translate"]), scale, begin
