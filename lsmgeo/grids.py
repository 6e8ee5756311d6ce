"""Lattices of sites in the world: voxel grids, camera frustums, depth planes.

A lattice is a regular array of sites with homogeneous index ``q = (x[i], y[j], z[k], 1)`` and homogeneous world
position ``X ~ T q``. `VoxelGrid` counts x, y, z = 0, 1, 2, ... with T affine; `FrustumGrid` has ``z[k] = 1 / depth[k]``
and T projective. They differ in nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import (
    check_choice,
    check_devices,
    check_geometry,
    check_number,
    check_size,
    describe,
    is_whole,
    moved,
)
from lsmgeo._linalg import affine_inverse, basis_row, homogeneous_row, inverse_3x3, multiply
from lsmgeo._torch_compat import is_exporting
from lsmgeo.cameras.camera_checks import check_cameras, image_size
from lsmgeo.cameras.matrices import camera_matrices
from lsmgeo.cameras.tensors import Cameras, CameraTensors, as_tensors, leading_shape
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import DTypeError, GridError, ShapeError

__all__ = ["FrustumGrid", "Lattice", "VoxelGrid", "depth_planes"]


# Far below the largest float32.
LARGEST_BOUND = 1e37
LARGEST_NUMBER_OF_PLANES = 2**20


class Lattice(NamedTuple):
    """A lattice in float64: T (4, 4) or (B, 4, 4); x (W,), y (H,), z (D,) or (B, D); whether T is projective.

    Where depths differ from pixel to pixel, z (B, 1, D, H, W) holds them, in their dtype.
    """

    world_from_lattice: Tensor
    x: Tensor
    y: Tensor
    z: Tensor
    projective: bool

    def centers(self) -> Tensor:
        """World positions of the sites, (D, H, W, 3) or (B, D, H, W, 3)."""
        T, x, y, z, projective = self
        plane = T[..., :3, 0, None, None] * x + (T[..., :3, 1, None, None] * y[:, None] + T[..., :3, 3, None, None])
        if z.dim() == 5:
            return (plane[..., None, :, :] * z + T[..., :3, 2, None, None, None]).movedim(-4, -1)
        line = T[..., :3, 2, None] * z[..., None, :]  # (B?, 3, D)
        points = plane[..., None, :, :] + line[..., None, None]
        if projective:
            points = points / z[..., None, :, None, None]
        return points.movedim(-4, -1)  # (B?, D, H, W, 3)


@dataclass(frozen=True, eq=False, repr=False)
class VoxelGrid:
    """A box of voxels: an immutable value, not a module; it follows the features' device and is never cast.

    Convention:
        Arrays over the grid are (..., D, H, W) with D along z, H along y, W along x. Voxel i of n between lower and
        upper is centred at ``lower + (i + 0.5) (upper - lower) / n``.

    Args:
        shape: (D, H, W), or one int for all three.
        lower: lower bounds of the box in world units, a number or (x, y, z).
        upper: upper bounds of the box.
        world_from_grid: affine (4, 4), or (B, 4, 4) for one per scene, float32 or float64, applied to the metric box:
            any pose, also with scale or shear. Gradients flow to it.

    Raises:
        GridError: no voxels, more than 2^31 - 1, crossed or non-finite bounds, a singular or projective matrix.

    Example:
        >>> from lsmgeo import VoxelGrid
        >>> VoxelGrid(2).centers()[0, 0]
        tensor([[-0.2500, -0.2500, -0.2500],
                [ 0.2500, -0.2500, -0.2500]])
        >>> VoxelGrid((4, 3, 2), lower=(0, 0, 0), upper=(2, 3, 4))
        VoxelGrid((4, 3, 2), lower=(0.0, 0.0, 0.0), upper=(2.0, 3.0, 4.0))
    """

    shape: int | tuple[int, int, int]
    lower: float | Sequence[float] = -0.5
    upper: float | Sequence[float] = 0.5
    world_from_grid: Tensor | None = None

    def __post_init__(self) -> None:
        """Check and normalise the fields."""
        object.__setattr__(
            self, "shape", check_size("VoxelGrid", "shape", self.shape, 3, "an int or (D, H, W)", GridError)
        )
        for name in ("lower", "upper"):
            object.__setattr__(self, name, _bounds(name, getattr(self, name)))
        for axis, low, high in zip("xyz", self.lower, self.upper, strict=True):  # type: ignore[arg-type]
            if not low < high:
                raise GridError(f"VoxelGrid: lower must be below upper on every axis; got {low} and {high} in {axis}")
        matrix = self.world_from_grid
        if matrix is None:
            return
        check_geometry("VoxelGrid", "world_from_grid", matrix, "(4, 4) or (B, 4, 4)")
        if matrix.dim() not in (2, 3) or tuple(matrix.shape[-2:]) != (4, 4):
            raise ShapeError(f"VoxelGrid: world_from_grid must be (4, 4) or (B, 4, 4); got {tuple(matrix.shape)}")
        if can_inspect(matrix):
            with torch.no_grad():
                double = matrix.double()
                if not bool(double.isfinite().all()):
                    raise GridError("VoxelGrid: world_from_grid must be finite; got a NaN or an infinity")
                off = (double[..., 3, :] - double.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().amax(-1)
                if not bool((off <= 1e-3).all()):
                    raise GridError(
                        "VoxelGrid: world_from_grid must be affine, its last row (0, 0, 0, 1); "
                        f"got one that differs by {off.max().item():.6g}"
                    )
                if not bool(inverse_3x3(double[..., :3, :3]).isfinite().all()):
                    raise GridError("VoxelGrid: world_from_grid must be invertible; got a singular matrix")

    def __repr__(self) -> str:
        """The call that creates this grid, with the shape in place of a matrix."""
        text = f"VoxelGrid({self.shape}, lower={self.lower}, upper={self.upper}"
        if self.world_from_grid is not None:
            text += f", world_from_grid=<{tuple(self.world_from_grid.shape)} {self.world_from_grid.dtype}>"
        return text + ")"

    @property
    def world_from_lattice(self) -> Tensor:
        """World from voxel index, (4, 4) or (B, 4, 4), float64: ``X = A (i_x, i_y, i_z, 1)``."""
        return self._world_from_lattice(None)

    def _world_from_lattice(self, device: torch.device | None) -> Tensor:
        matrix = self.world_from_grid
        if matrix is not None:
            device = matrix.device if device is None else device
            matrix = moved("VoxelGrid", "world_from_grid", matrix, device)
        lower, upper = self.lower, self.upper
        counts = tuple(reversed(self.shape))  # type: ignore[arg-type]
        steps = [(high - low) / n for low, high, n in zip(lower, upper, counts, strict=True)]  # type: ignore[arg-type]
        firsts = [low + 0.5 * step for low, step in zip(lower, steps, strict=True)]  # type: ignore[arg-type]
        # Filled on the device: a copy from the host would make a GPU wait.
        scale, shift = (
            torch.stack([torch.full((), item, dtype=torch.float64, device=device) for item in items])
            for items in (steps, firsts)
        )
        box = homogeneous_row(torch.cat((torch.diag(scale), shift[:, None]), -1))
        return box if matrix is None else multiply(homogeneous_row(matrix[..., :3, :].double()), box)

    @property
    def lattice_from_world(self) -> Tensor:
        """Voxel index from world, (4, 4) or (B, 4, 4), float64."""
        return affine_inverse(self.world_from_lattice)

    def lattice(self, device: torch.device | None = None) -> Lattice:
        """The lattice that the operators take, on a device or on the grid's own."""
        T = self._world_from_lattice(device)
        depth, height, width = self.shape  # type: ignore[misc]
        x, y, z = (torch.arange(n, dtype=T.dtype, device=T.device) for n in (width, height, depth))
        return Lattice(T, x, y, z, False)

    def centers(self) -> Tensor:
        """Voxel centres in the world, (D, H, W, 3) or (B, D, H, W, 3) as x, y, z, of `world_from_grid`'s dtype."""
        dtype = torch.get_default_dtype() if self.world_from_grid is None else self.world_from_grid.dtype
        return self.lattice().centers().to(dtype)


def _bounds(name: str, value: object) -> tuple[float, float, float]:
    if isinstance(value, Tensor):
        raise DTypeError(f"VoxelGrid: {name} must be numbers (gradients go to world_from_grid); got {describe(value)}")
    if isinstance(value, np.ndarray):
        value = value.tolist()
    values = tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else (value,) * 3
    if len(values) != 3:
        raise GridError(f"VoxelGrid: {name} must be a number or (x, y, z); got {describe(value)}")
    expected = "a finite number or (x, y, z)"
    x, y, z = (check_number("VoxelGrid", name, item, expected, error=GridError) for item in values)
    if not max(abs(x), abs(y), abs(z)) <= LARGEST_BOUND:
        raise GridError(f"VoxelGrid: {name} must be at most {LARGEST_BOUND:g}; got {(x, y, z)}")
    return x, y, z


DEPTHS = {1: "(P,)", 2: "(B, P)", 3: "(B, V, P)", 4: "(B, P, h, w)", 5: "(B, V, P, h, w)"}  # by number of axes


def planes_of(depths: Tensor) -> int:
    """P of depths as in `DEPTHS`."""
    return depths.shape[-1 if depths.dim() < 4 else -3]


def check_depths(who: str, depths: Tensor, axes: Sequence[int], view_mask: Tensor | None = None) -> None:
    """Require float32 or float64 depths with one of these numbers of axes, at least one plane.

    Rows shared by all pixels must be positive, finite and strictly ascending, where values may be read. For depths of
    each pixel see `check_pixel_depths`.
    """
    *others, last = (DEPTHS[number] for number in axes)
    expected = f"{', '.join(others)} or {last}{', the same for all pixels,' if max(axes) < 4 else ''}"
    check_geometry(who, "depths", depths, expected)
    if depths.dim() not in axes or planes_of(depths) < 1:
        raise ShapeError(f"{who}: depths must be {expected} with P at least 1; got {tuple(depths.shape)}")
    if depths.dim() > 3 or not can_inspect(depths):
        return
    with torch.no_grad():
        good = (depths > 0).all(-1) & depths.isfinite().all(-1) & (depths.diff(dim=-1) > 0).all(-1)
        if view_mask is not None and depths.dim() == 3:
            good = good | ~view_mask
        if not bool(good.all()):
            row = depths[tuple((~good).nonzero()[0].tolist())]
            raise GridError(
                f"{who}: depths must be positive, finite and strictly ascending; got "
                f"{[float(f'{item:.6g}') for item in row[:6].tolist()]}{'...' if row.numel() > 6 else ''}"
            )


def check_pixel_depths(who: str, depths: Tensor) -> None:
    """Require positive and finite depths, where values may be read; others of no pixel pass."""
    if depths.dim() < 4 or not can_inspect(depths) or not depths.numel():
        return
    with torch.no_grad():
        least, largest = depths.aminmax()  # NaN if there is one, and a tenth of the time of a comparison of each
        if bool((least > 0) & (largest < torch.inf)):
            return
        index = tuple((~((depths > 0) & (depths < torch.inf))).nonzero()[0].tolist())
        raise GridError(f"{who}: depths must be positive and finite; got {depths[index].item():.6g} at {list(index)}")


def map_size(who: str, cameras: CameraTensors, depths: Tensor, size: tuple[int, int] | None) -> tuple[int, int]:
    """The (h, w) of maps: `size`, where depths are those of each pixel theirs, or the size of all cameras' images."""
    if depths.dim() < 4:
        return image_size(who, cameras, size)
    check_map_size(who, depths, size)
    height, width = depths.shape[-2:]
    return height, width


def check_map_size(who: str, depths: Tensor | None, size: tuple[int, int] | None) -> None:
    """Require None or a size (h, w), that of depths of each pixel, if any."""
    if size is None:
        return
    size = check_size(who, "size", size, 2, "(h, w)")  # type: ignore[assignment]
    if depths is not None and depths.dim() > 3 and size != tuple(depths.shape[-2:]):
        raise ShapeError(
            f"{who}: size must be that of the depths of each pixel, {tuple(depths.shape[-2:])}; got {size}"
        )


def check_constant_depths(who: str, depths: Tensor, axes: Sequence[int] = (1, 2, 3)) -> None:
    """Require depths that a module may store: not a parameter, which would become part of its state."""
    if isinstance(depths, torch.nn.Parameter):
        raise DTypeError(f"{who}: depths must be a plain tensor; got a Parameter (pass learned depths to the function)")
    check_depths(who, depths, axes)
    check_pixel_depths(who, depths)


@dataclass(frozen=True, eq=False, repr=False)
class FrustumGrid:
    """The frustum of one camera per scene, cut into fronto-parallel planes: the sites of a plane-sweep volume.

    Equation: site (k, j, i) is at the depth[k] point of the ray of pixel (i, j): ``X ~ T (i, j, 1/depth[k], 1)``,
    ``T = [[R^T K^-1[:, :2], -R^T t, R^T K^-1[:, 2:]], [0, 0, 1, 0]]``.

    Args:
        camera: one camera per scene, leading shape () or (B,): a kornia ``PinholeCamera`` or `CameraTensors`.
        depths: (P,) or (B, P) camera z in world units, positive, strictly ascending; see `depth_planes`. Or, for each
            pixel, (B, P, h, w), positive and finite, in any order: checked by the operator that reads them.
        size: (h, w) of the planes, for which K is resized; by default the camera's image size, or that of depths of
            each pixel.

    Gradients flow to the camera and to the depths.

    Raises:
        GridError: depths out of order, too many sites.
        ShapeError: more than one camera per scene.
        CameraError: an invalid camera.

    Example:
        >>> from lsmgeo import FrustumGrid, depth_planes
        >>> from lsmgeo.cameras import orbit
        >>> camera = orbit(0.0, 0.0, 2.0, focal_length=10.0, height=3, width=3)
        >>> FrustumGrid(camera, depth_planes(1.0, 3.0, 2)).centers()[:, 1, 1]
        tensor([[ 1.,  0.,  0.],
                [-1.,  0.,  0.]])
    """

    camera: Cameras
    depths: Tensor
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        """Check and normalise the fields."""
        who = "FrustumGrid"
        camera = as_tensors(self.camera, who)
        leading = leading_shape(camera)
        if len(leading) > 1:
            raise ShapeError(
                f"{who}: camera must have leading shape () or (B,), one per scene, see cameras.select; got {leading}"
            )
        check_cameras(who, camera)
        depths = self.depths
        check_depths(who, depths, (1, 2, 4))
        if leading and depths.dim() > 1 and depths.shape[0] != leading[0]:
            raise ShapeError(
                f"{who}: depths must be {DEPTHS[depths.dim()]} with B = {leading[0]} cameras; got {tuple(depths.shape)}"
            )
        check_devices(who, camera=camera.intrinsics, depths=depths)
        size = map_size(who, camera, depths, self.size)
        check_size(who, "shape", (planes_of(depths), *size), 3, "(P, h, w)", GridError)
        object.__setattr__(self, "camera", camera)
        object.__setattr__(self, "size", size)

    def __repr__(self) -> str:
        """Shape and number of scenes."""
        scenes = tuple(self.world_from_lattice.shape[:-2])
        return f"FrustumGrid(shape={self.shape}, scenes={scenes[0] if scenes else 'shared'})"

    @property
    def shape(self) -> tuple[int, int, int]:
        """(P, h, w)."""
        assert self.size is not None
        return (planes_of(self.depths), *self.size)

    @property
    def world_from_lattice(self) -> Tensor:
        """Homogeneous world from (u, v, 1/depth, 1), (4, 4) or (B, 4, 4), float64."""
        return camera_matrices(as_tensors(self.camera), self.size).world_from_frustum()

    @property
    def lattice_from_world(self) -> Tensor:
        """(u, v, 1/depth, 1) up to a factor from homogeneous world, (4, 4) or (B, 4, 4), float64."""
        matrices = camera_matrices(as_tensors(self.camera), self.size)
        P = matrices.projection()
        return torch.cat((P[..., :2, :], basis_row(P, 4, 3), P[..., 2:, :]), -2)

    def lattice(self, device: torch.device | None = None) -> Lattice:
        """The lattice that the operators take, on a device or on the grid's own."""
        T = self.world_from_lattice
        T = T if device is None else moved("FrustumGrid", "camera", T, device)
        _, height, width = self.shape
        x, y = (torch.arange(n, dtype=T.dtype, device=T.device) for n in (width, height))
        depths = moved("FrustumGrid", "depths", self.depths, T.device)
        return Lattice(T, x, y, depths[:, None] if depths.dim() == 4 else 1.0 / depths.double(), True)

    def centers(self) -> Tensor:
        """Site positions in the world, (P, h, w, 3) or (B, P, h, w, 3) as x, y, z, of the depths' dtype."""
        check_pixel_depths("FrustumGrid", self.depths)
        return self.lattice().centers().to(self.depths.dtype)


def depth_planes(near: float | Tensor, far: float | Tensor, num: int, spacing: str = "depth") -> Tensor:
    """Depths of sweep planes from near to far, both ends included.

    Equation: with a in [0, 1] evenly spaced, "depth": near + a (far - near); "inverse":
    1 / (1/near + a (1/far - 1/near)); "log": near (far / near)^a. "inverse" gives even steps in another view's image.

    Args:
        near: first depth, positive, world units; a number, or (B,) for one per scene.
        far: last depth, larger than near; a number or (B,).
        num: number of planes, at least 1; 1 gives near.
        spacing: "depth", "inverse" or "log".

    Returns:
        (num,) or (B, num), strictly ascending, differentiable in near and far.

    Raises:
        GridError: no planes; near and far not positive and ascending, or too close for `num` different numbers of
            their dtype.
        OptionError: an unknown spacing.

    Example:
        >>> from lsmgeo import depth_planes
        >>> depth_planes(1.0, 4.0, 4)
        tensor([1., 2., 3., 4.])
        >>> depth_planes(1.0, 4.0, 3, spacing="log")
        tensor([1., 2., 4.])
        >>> depth_planes(1.0, 4.0, 3, spacing="inverse")
        tensor([1.0000, 1.6000, 4.0000])
    """
    who = "depth_planes"
    check_choice(who, "spacing", spacing, ("depth", "inverse", "log"))
    if not is_whole(num) or not 1 <= num <= LARGEST_NUMBER_OF_PLANES:
        raise GridError(f"{who}: num must be an integer from 1 to {LARGEST_NUMBER_OF_PLANES}; got {describe(num)}")
    given = [value for value in (near, far) if isinstance(value, Tensor)]
    like = given[0] if given else torch.zeros(())
    ends = []
    for name, value in (("near", near), ("far", far)):
        if isinstance(value, Tensor):
            check_geometry(who, name, value, "a number or (B,)")
            if value.dim() > 1:
                raise ShapeError(f"{who}: {name} must be a number or (B,); got {tuple(value.shape)}")
        else:
            value = like.new_tensor(check_number(who, name, value, "a finite number", error=GridError))
        ends.append(value)
    check_devices(who, near=ends[0], far=ends[1])
    if ends[0].dtype != ends[1].dtype:
        raise DTypeError(f"{who}: near and far must be of one dtype; got {ends[0].dtype} and {ends[1].dtype}")
    if ends[0].dim() and ends[1].dim() and ends[0].shape != ends[1].shape:
        raise ShapeError(f"{who}: near and far must agree; got {tuple(ends[0].shape)} and {tuple(ends[1].shape)}")
    first, last = torch.broadcast_tensors(*ends)
    if can_inspect(first) and not bool(((first > 0) & (first < last) & last.isfinite()).all()):
        raise GridError(f"{who}: near and far must be positive, finite and ascending; got {near} and {far}")
    dtype, ends = first.dtype, [first[..., None], last[..., None]]
    if num == 1:
        return ends[0].clone()
    first, last = (end.double() for end in ends)
    a = torch.linspace(0.0, 1.0, num, dtype=torch.float64, device=first.device)
    if spacing == "depth":
        planes = first * (1.0 - a) + last * a
    elif spacing == "inverse":
        planes = 1.0 / ((1.0 - a) / first + a / last)
    else:
        planes = torch.exp((1.0 - a) * torch.log(first) + a * torch.log(last))
    planes = torch.cat((ends[0], planes[..., 1:-1].to(dtype), ends[1]), -1)  # the ends exactly
    # Exported programs, for example ONNX, cannot reinterpret bits.
    if torch.jit.is_tracing() or is_exporting():  # type: ignore[attr-defined]
        return planes
    # Rounding may make neighbours equal. Positive floats are ordered as the integers of the same bits.
    integers = {2: torch.int16, 4: torch.int32, 8: torch.int64}[planes.element_size()]
    count = torch.arange(num, device=planes.device)
    excess = planes.detach().view(integers).long() - count
    if can_inspect(planes) and not bool((excess[..., 0] <= excess[..., -1]).all()):
        raise GridError(f"{who}: near and far must be {num} different numbers of {dtype} apart; got {near} and {far}")
    ascending = torch.minimum(excess.cummax(-1).values, excess[..., -1:]) + count
    return planes + (ascending.to(integers).view(dtype) - planes.detach())
