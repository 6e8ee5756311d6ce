"""Drawing primitives: figures as PNG, rows of images, and voxels, depth and points drawn with NumPy."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lsmgeo._checks import check_whole, describe
from lsmgeo._old_names import old_names
from lsmgeo.cameras import CameraTensors, as_tensors, orbit, resize, unproject_depth
from lsmgeo.errors import DTypeError, ShapeError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__getattr__ = old_names(__name__, {"Picture": "Pixels"})

__all__ = ["Pixels", "as_pixels", "as_png", "draw_depth", "draw_points", "draw_voxels", "new_figure", "tile"]

COLOUR = (0.42, 0.60, 0.84)
# The direction to the light in the viewer's axes (x right, y down, z forward): left, above and behind; of length 1.
LIGHT = np.array([-0.3, -0.7, -0.648])
AMBIENT = 0.4
# Supersampling along each side of a pixel.
FINER = 2
# Half the side of the visible square, world units, for the unit cube.
REACH = 0.56
# The largest number of dots along the side of a quad.
MOST_DOTS = 1 << 10
# Neighbouring pixels whose points are farther apart than this many pixel widths are not connected.
STEEPEST = 10.0

Floats = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]


def new_figure(width: float, height: float, title: str = "", *, dpi: int = 100, layout: str = "constrained") -> Figure:
    """A matplotlib figure, sizes in inches, without a window."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)  # type: ignore[arg-type]
    if title:
        figure.suptitle(title)
    return figure


def as_png(figure: Figure) -> bytes:
    """A figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def as_pixels(image: Tensor, side: int | None = None) -> Pixels:
    """An image (3, h, w) in [0, 1] as (h, w, 3) uint8, or resized to a square."""
    image = image.detach().float().cpu()
    if side is not None:
        image = torch.nn.functional.interpolate(image[None], (side, side), mode="bilinear", antialias=True)[0]
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()


def tile(images: Sequence[Sequence[Pixels | None]], gap: int = 4) -> Pixels:
    """Rows of images of one size as one image, with white gaps and white for None.

    Args:
        images: rows, which may differ in length.
        gap: between two images, in pixels.

    Returns:
        (h, w, 3) uint8.
    """
    height, width, _ = next(image for row in images for image in row if image is not None).shape
    columns = max(len(row) for row in images)
    sheet = np.full((len(images) * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for y, row in enumerate(images):
        for x, image in enumerate(row):
            if image is not None:
                top, left = y * (height + gap), x * (width + gap)
                sheet[top : top + height, left : left + width] = image
    return sheet


def draw_voxels(
    occupancy: Tensor | np.ndarray,
    azimuth: float = 35.0,
    elevation: float = 25.0,
    size: int = 128,
    *,
    colour: Sequence[float] = COLOUR,
    reach: float = REACH,
) -> Pixels:
    """Draw the faces of occupied voxels in orthographic projection.

    They are shaded by a light from the viewer's left, and darker where other voxels surround them.

    Convention:
        The grid fills [-0.5, 0.5]^3 of the world, y up; azimuth and elevation as in `lsmgeo.cameras.orbit`.

    Args:
        occupancy: (D, H, W) bool.
        azimuth: of the viewer, degrees.
        elevation: degrees in (-90, 90).
        size: height and width of the image in pixels.
        colour: of the voxels, RGB in [0, 1].
        reach: half the side of the visible square, world units.

    Returns:
        (size, size, 3) uint8 RGB on white.

    Raises:
        ShapeError: the grid is not (D, H, W).
        DTypeError: it is not bool.

    Example:
        >>> import torch
        >>> from lsmgeo.drawing import draw_voxels
        >>> cube = draw_voxels(torch.ones(4, 4, 4, dtype=torch.bool), 0.0, 0.0, 24, reach=1.0)
        >>> cube.shape, int((cube < 255).all(-1).sum())  # half the side of 24
        ((24, 24, 3), 144)
    """
    grid = np.asarray(occupancy)
    if grid.dtype != np.bool_:
        raise DTypeError(f"draw_voxels: occupancy must be bool (D, H, W); got {describe(occupancy)}")
    if grid.ndim != 3 or 0 in grid.shape:
        raise ShapeError(f"draw_voxels: occupancy must be (D, H, W); got {grid.shape}")
    view = _viewer(azimuth, elevation)
    quads, shades = _visible_faces(grid.transpose(2, 1, 0), view)
    return _splat(quads, shades[:, None] * np.asarray(colour, np.float64), view, size, reach)


def draw_depth(
    depth: Tensor,
    camera: CameraTensors,
    *,
    turn: float = 25.0,
    lift: float = 12.0,
    size: int = 192,
    reach: float = REACH,
) -> Pixels:
    """Draw a depth map as a shaded surface, from a viewpoint beside its camera's.

    The surface is cut at depth discontinuities. Shading shows errors that colours by depth hide (Kar et al. 2017,
    figure 4: "visualized with shading from a shifted viewpoint").

    Args:
        depth: (h, w) camera z, 0 for no depth.
        camera: one camera, of any image size.
        turn: azimuth of the viewer about the world's origin relative to the camera, degrees, positive to its right.
        lift: elevation relative to the camera, degrees.
        size: height and width of the image in pixels.
        reach: half the side of the visible square about the world's origin, world units.

    Returns:
        (size, size, 3) uint8 RGB on white.

    Raises:
        ShapeError, DTypeError: the depth is not a floating tensor (h, w).
    """
    from scipy.spatial.transform import Rotation

    if not isinstance(depth, Tensor) or not depth.is_floating_point():
        raise DTypeError(f"draw_depth: depth must be a floating tensor (h, w); got {describe(depth)}")
    if depth.dim() != 2 or min(depth.shape) < 2:
        raise ShapeError(f"draw_depth: depth must be (h, w), each at least 2; got {tuple(depth.shape)}")
    camera = as_tensors(camera, "draw_depth")
    z = depth.detach().double().cpu().numpy()
    known = np.isfinite(z) & (z > 0)
    filled = torch.from_numpy(np.where(known, z, 1.0)).to(camera.device)  # depth 1 for no depth
    points = unproject_depth(camera.at(None), filled[None, None])[0, 0].cpu().numpy()
    focal = float(torch.linalg.vector_norm(resize(camera, *depth.shape).intrinsics[0, :2]))
    pixel = float(np.median(z[known]) if known.any() else 1.0) / focal
    ends = [(rows, columns) for rows in (slice(-1), slice(1, None)) for columns in (slice(-1), slice(1, None))]
    corners = np.stack([points[end] for end in ends], 2)
    is_whole = np.logical_and.reduce([known[end] for end in ends])
    is_whole &= np.linalg.norm(corners - np.roll(corners, 1, 2), axis=-1).max(-1) < STEEPEST * pixel
    quads = corners[is_whole]  # (Q, 4, 3)
    R = camera.cam_from_world[:3, :3].double().cpu().numpy()
    view = Rotation.from_euler("yx", (turn, lift), degrees=True).as_matrix() @ R
    normals = np.cross(quads[:, 3] - quads[:, 0], quads[:, 1] - quads[:, 2])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    normals *= -np.sign(normals @ view[2])[:, None]  # towards the viewer
    shades = AMBIENT + (1 - AMBIENT) * np.clip(normals @ view.T @ LIGHT, 0, 1)
    return _splat(quads, shades[:, None] * np.asarray(COLOUR), view, size, reach)


def draw_points(
    points: np.ndarray,
    colours: np.ndarray,
    azimuth: float = 35.0,
    elevation: float = 25.0,
    size: int = 192,
    *,
    dot: float = 1.5,
    reach: float = REACH,
) -> Pixels:
    """Draw coloured points as small squares, near ones over far ones, in orthographic projection.

    Args:
        points: (N, 3).
        colours: (N, 3) uint8.
        azimuth: degrees, see `draw_voxels`.
        elevation: degrees in (-90, 90).
        size: height and width of the image in pixels.
        dot: side of a point in pixels.
        reach: half the side of the visible square, world units.

    Returns:
        (size, size, 3) uint8 RGB on white.
    """
    view = _viewer(azimuth, elevation)
    half = dot * reach / size
    corners = np.array([(-half, -half), (half, -half), (-half, half), (half, half)]) @ view[:2]
    quads = np.asarray(points, np.float64).reshape(-1, 1, 3) + corners
    return _splat(quads, np.asarray(colours) / 255.0, view, size, reach)


def _viewer(azimuth: float, elevation: float) -> Floats:
    """The world-to-camera rotation of a viewer on a sphere about the origin."""
    around = torch.tensor(azimuth, dtype=torch.float64)
    return np.asarray(orbit(around, elevation, 2.0, focal_length=1.0, height=1, width=1).cam_from_world[:3, :3])


def _visible_faces(grid: np.ndarray, view: Floats) -> tuple[Floats, Floats]:
    """The faces (Q, 4, 3) of occupied voxels, indexed x, y, z, towards the viewer, and the brightness (Q,) of each."""
    padded = np.pad(grid, 3)
    crowded = padded.astype(np.float64)  # the occupied fraction of 5 x 5 x 5 voxels
    for axis in range(3):
        crowded = np.mean([np.roll(crowded, step, axis) for step in range(-2, 3)], axis=0)
    quads, shades = [], []
    for axis in range(3):
        if abs(view[2, axis]) < 1e-9:
            continue  # edge-on
        side = -1 if view[2, axis] > 0 else 1
        others = [other for other in range(3) if other != axis]
        voxel = np.argwhere(grid & ~np.roll(padded, -side, axis)[3:-3, 3:-3, 3:-3])
        corners = np.repeat(voxel[:, None].astype(np.float64), 4, 1)
        corners[:, :, axis] += side > 0
        corners[:, :, others] += np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        quads.append(corners / grid.shape - 0.5)
        before = voxel + 3
        before[:, axis] += 2 * side
        lit = AMBIENT + (1 - AMBIENT) * max(0.0, float(side * view[:, axis] @ LIGHT))
        shades.append(lit * (1.12 - 0.9 * crowded[tuple(before.T)]))
    return np.concatenate(quads), np.concatenate(shades)


def _splat(quads: Floats, colours: Floats, view: Floats, size: int, reach: float) -> Pixels:
    """Draw quads (Q, 4, 3) of one colour each, near over far, in orthographic projection."""
    fine = check_whole("draw", "size", size, 1, 4096) * FINER
    image = np.ones((fine * fine, 3))
    if len(quads):
        scale = fine / (2 * reach)
        dots, owner = _dots(quads, scale)
        seen = dots @ view.T
        column, row = (np.floor(seen[:, axis] * scale + fine / 2).astype(np.int64) for axis in (0, 1))
        inside = (column >= 0) & (column < fine) & (row >= 0) & (row < fine)
        order = np.flatnonzero(inside)[np.argsort(-seen[inside, 2], kind="stable")]
        image[row[order] * fine + column[order]] = colours[owner[order]]
    image = image.reshape(size, FINER, size, FINER, 3).mean((1, 3))
    return np.asarray((image.clip(0, 1) * 255).round(), np.uint8)


def _dots(quads: Floats, scale: float) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Dots (N, 3) that cover quads without gaps at ``scale`` pixels a unit, and the quad (N,) of each."""
    widest = np.linalg.norm(quads - np.roll(quads, 1, 1), axis=-1).max(-1)
    levels = np.ceil(np.clip(1.2 * scale * widest, 2, MOST_DOTS)).astype(np.int64)
    dots, owner = [], []
    for level in np.unique(levels):
        some = np.flatnonzero(levels == level)
        middles = (np.arange(level) + 0.5) / level
        s, t = (axis.reshape(-1) for axis in np.meshgrid(middles, middles))
        weights = np.stack(((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t), 1)
        dots.append((weights @ quads[some]).reshape(-1, 3))
        owner.append(np.repeat(some, len(weights)))
    return np.concatenate(dots), np.concatenate(owner)
