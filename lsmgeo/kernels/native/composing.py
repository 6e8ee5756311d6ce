"""Cameras checked, and the matrices of `Sites` composed, by one C function in float64 (native/geometry.h).

For tensors whose values may be read and that have no derivative; `lsmgeo._sites` alone calls it, and takes PyTorch's
operations, which raise the errors, where the answer is None.
"""

from __future__ import annotations

from struct import Struct

import torch
from torch import Tensor

from lsmgeo._torch_compat import has_dispatch_modes, has_forward_derivatives, is_jit_traced
from lsmgeo.debugging import can_inspect
from lsmgeo.kernels.native.loading import composer

__all__ = ["CHECKS", "FRUSTUMS", "IMAGES", "LATTICE", "compose"]

CHECKS, IMAGES, FRUSTUMS, LATTICE = range(4)  # `Composed`
ROWS = (0, 3, 3, 4)  # of a matrix
FRAMES = {"": 0, "world": 1, "camera": 2}
FIELDS = Struct("4q2P8q3P2dP2q2P")  # `Geometry`


def can_compose(*tensors: Tensor | None) -> bool:
    """Whether these are CPU tensors, and there are values to read and no derivatives to pass on."""
    given = [tensor for tensor in tensors if tensor is not None]
    if not can_inspect(*given) or has_dispatch_modes() or has_forward_derivatives() or is_jit_traced():
        return False
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given):
        return False
    # A negated view holds the values before the sign; a tensor without memory holds none.
    return all(tensor.is_cpu and not tensor.is_neg() and tensor.data_ptr() for tensor in given)


def compose(
    composed: int,
    intrinsics: Tensor,
    cam_from_world: Tensor,
    height: Tensor,
    width: Tensor,
    view_mask: Tensor | None = None,
    grid: Tensor | None = None,
    size: tuple[int, int] | None = None,
    frame: str = "",
) -> tuple[Tensor, Tensor | None] | None:
    """The matrices of valid cameras; None where one is invalid, or the library or a derivative stands in the way.

    Args:
        composed: CHECKS for none; IMAGES: the pixel, FRUSTUMS: the voxel from the lattice; LATTICE: the world from a
            frustum's lattice, of cameras that are not checked again.
        intrinsics: (B, V, 3, 3).
        cam_from_world: (B, V, 4, 4).
        height: (B, V).
        width: (B, V).
        view_mask: (B, V) bool.
        grid: world from lattice, affine for FRUSTUMS, (4, 4) or (B, 4, 4), float64.
        size: (h, w) for which K is resized.
        frame: of the directions.

    Returns:
        M, (B, V, 3, 4), (B, V, 4, 4) for LATTICE, or empty for CHECKS, and G, (B, V, 3, 4), as `Sites` has them.
    """
    if not can_compose(intrinsics, cam_from_world, height, width, view_mask, grid):
        return None
    function = composer(FIELDS.size)
    if function is None:
        return None
    B, V = cam_from_world.shape[:2]
    height, width = height.double().contiguous(), width.double().contiguous()
    mask = None if view_mask is None else view_mask.contiguous()
    stride = 0
    if grid is not None:
        grid, stride = grid.contiguous(), 0 if grid.dim() == 2 else 16
    matrix = torch.empty(B, V, ROWS[composed], 4, dtype=torch.float64, device="cpu")
    direction = torch.empty(B, V, 3, 4, dtype=torch.float64, device="cpu") if frame else None
    fields = FIELDS.pack(
        *(composed, B, V, intrinsics.dtype == torch.float64),
        *(intrinsics.data_ptr(), cam_from_world.data_ptr()),
        *intrinsics.stride(),
        *cam_from_world.stride(),
        *(_address(height), _address(width), _address(mask)),
        *((0.0, 0.0) if size is None else size),
        *(_address(grid), stride, FRAMES[frame]),
        *(_address(matrix), _address(direction)),
    )
    return None if function(fields) else (matrix, direction)


def _address(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.data_ptr()
