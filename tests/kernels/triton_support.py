"""Ugly little scenes for the Triton kernels, and the comparison of a call and its gradients with the reference.

Judged by the reference in float64: the kernels may be a few times as far from it as the reference in float32 is.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lsmgeo._dtypes import computing_dtype, saturating_cast
from lsmgeo.kernels import reference
from lsmgeo.kernels.lattice_geometry import per_view
from lsmgeo.kernels.request import Options, Sites
from lsmgeo.kernels.triton import operators
from lsmgeo.kernels.view_statistics import view_statistics
from tests.kernels.comparison import assert_as_exact

B, V = 1, 3  # scenes and views where a case says nothing else
SHAPE = (2, 3, 4)  # D, H, W
IMAGE = (5, 7)
CELLS = (4, 5, 6)


@contextlib.contextmanager
def deterministic() -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def rotations(random: torch.Generator, *leading: int) -> Tensor:
    q, r = torch.linalg.qr(torch.randn(*leading, 3, 3, generator=random, dtype=torch.float64))
    q = q * r.diagonal(dim1=-2, dim2=-1).sign()[..., None, :]
    return q * torch.linalg.det(q)[..., None, None]


def _sites(
    random: torch.Generator, matrix: Tensor, direction: Tensor, shape: Sequence[int], z: Tensor, per: str, mask: bool
) -> Sites:
    """Sites of these depths, which are other ones in each scene or view where they are per it."""
    x, y = (torch.arange(size, dtype=torch.float64) for size in shape[:0:-1])
    leading = matrix.shape[: ("all", "scene", "view").index(per)]
    if leading:
        z = z * (1.0 + 0.2 * torch.rand(*leading, 1, generator=random, dtype=torch.float64))
    view_mask = None
    if mask:
        view_mask = torch.ones(matrix.shape[:2], dtype=torch.bool)
        view_mask[0, 0] = view_mask[-1, -1] = False
    return Sites(matrix, direction, x, y, z, False, view_mask)


def image_sites(
    seed: int = 0,
    *,
    batch: int = B,
    views: int = V,
    shape: tuple[int, int, int] = SHAPE,
    projective: bool = False,
    per: str = "all",
    mask: bool = False,
) -> Sites:
    """A turned lattice before skewed cameras, a part of it behind them and a part beside their images."""
    random = generator(seed)
    K = torch.tensor([[5.0, 0.9, 3.1], [0.0, 4.0, 1.8], [0.0, 0.0, 1.0]], dtype=torch.float64)
    E = torch.cat((rotations(random, batch, views), torch.zeros(batch, views, 3, 1, dtype=torch.float64)), -1)
    E[..., 2, 3] = 0.9 + torch.rand(batch, views, generator=random, dtype=torch.float64)
    D, H, W = shape
    axes = rotations(random, batch, 1) * torch.tensor([1.9 / W, 1.7 / H, 1.5 / D], dtype=torch.float64)
    origin = -axes @ torch.tensor([(W - 1) / 2, (H - 1) / 2, (D - 1) / 2], dtype=torch.float64)
    T = torch.zeros(batch, 1, 4, 4, dtype=torch.float64)
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = axes, origin, 1.0
    z = torch.arange(D, dtype=torch.float64)
    if projective:  # X = origin + depth (x a + y b + c), of which 1 / depth is the third coordinate
        T = torch.cat((T[..., :2], T[..., 3:], T[..., 2:3]), -1)
        T[..., 3, :] = torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
        z = 1.0 / torch.linspace(0.3, 1.4, D, dtype=torch.float64)
    M = K @ (E @ T)
    center = -(E[..., :3].mT @ E[..., 3:])
    G = T[..., :3, :] - center * T[..., 3:, :]
    return _sites(random, M, G, shape, z, per, mask)._replace(projective=projective)


def sweep_sites(
    seed: int = 0,
    *,
    batch: int = B,
    views: int = 2,
    shape: tuple[int, int, int] = SHAPE,
    cells: tuple[int, int, int] = CELLS,
    per: str = "all",
    mask: bool = False,
) -> Sites:
    """Frustums that cross a volume, and leave it."""
    random = generator(seed)
    P, h, w = shape
    turned = rotations(random, batch, views) * (torch.tensor(cells[::-1], dtype=torch.float64)[:, None] * 0.5)
    M = torch.zeros(batch, views, 3, 4, dtype=torch.float64)
    M[..., 0], M[..., 1] = turned[..., 0] / w, turned[..., 1] / h
    M[..., 3] = turned[..., 2] - 0.5 * turned[..., 0] - 0.5 * turned[..., 1]
    M[..., 2] = 0.45 * torch.tensor(cells[::-1], dtype=torch.float64) - 1.1 * turned[..., 2]
    z = 1.0 / torch.linspace(0.5, 1.9, P, dtype=torch.float64)
    G = torch.randn(batch, views, 3, 4, generator=random, dtype=torch.float64)
    return _sites(random, M, G, shape, z, per, mask)._replace(projective=True)


def features(channels: int = 3, seed: int = 7, batch: int = B, views: int = V, dtype: Any = torch.float32) -> Tensor:
    return torch.randn(batch, views, channels, *IMAGE, generator=generator(seed)).to(dtype)


def volumes(channels: int = 3, seed: int = 7, batch: int = B, dtype: Any = torch.float32) -> Tensor:
    return torch.randn(batch, channels, *CELLS, generator=generator(seed)).to(dtype)


class Points(NamedTuple):
    pixels: Tensor
    front: Tensor
    extra: Tensor | None


def points(seed: int = 3, extras: int = 2, count: int = 11) -> Points:
    """Pixels within and beside the images, some of sites not in front."""
    random = generator(seed)
    pixels = torch.rand(B, V, count, 2, generator=random) * torch.tensor([9.0, 7.0]) - 1.5
    front = torch.rand(B, V, count, generator=random) > 0.2
    extra = torch.randn(B, V, extras, count, generator=random) if extras else None
    return Points(pixels, front, extra)


# Both sides of the comparison as functions of the source and what else has gradients


def sample_pixels(source: Tensor, given: Points, options: Options) -> tuple[Tensor, Tensor]:
    """What `operators.sample_views` means, by the reference's parts."""
    dtype, output = computing_dtype(source), source.dtype
    index = [torch.where(given.front, axis, -2.0) for axis in given.pixels.to(dtype).unbind(-1)]
    values, visible = reference.sample_cells(source.to(dtype), index, given.front, options)
    blocks = [values] if given.extra is None else [values, given.extra.to(dtype)]
    if options.reduce:
        return saturating_cast(view_statistics(torch.cat(blocks, 2), visible, options.reduce), output), visible
    return torch.cat([saturating_cast(block, output) for block in blocks], 2), visible


def unproject_reference(source: Tensor, sites: Sites, options: Options) -> tuple[Tensor, Tensor]:
    return reference.unproject(source, sites, None, options)


def unproject(source: Tensor, sites: Sites, options: Options) -> tuple[Tensor, Tensor]:
    return operators.unproject(source, sites, None, options)


def unproject_backward(
    gradient: Tensor, source: Tensor, sites: Sites, options: Options, needs: tuple[bool, ...]
) -> tuple[Tensor | None, ...]:
    return operators.unproject_backward(gradient, source, sites, None, options, (*needs, False))[:-1]


Answer = tuple[Tensor, Tensor, list[Tensor | None]]  # values, visible, gradients


def by_reference(
    operator: Callable[..., tuple[Tensor, Tensor]], source: Tensor, place: Any, options: Options, cotangent: Tensor
) -> Answer:
    source = source.detach().clone().requires_grad_()
    if isinstance(place, Sites):
        M, G = place.matrix.clone().requires_grad_(), place.direction
        G = None if G is None else G.clone().requires_grad_()
        z = per_view(place.z, place.matrix).clone().requires_grad_()
        leaves, place = (M, G, z), place._replace(matrix=M, direction=G, z=z)
    else:
        leaves = tuple(leaf if leaf is None else leaf.clone().requires_grad_() for leaf in (place.pixels, place.extra))
        place = Points(leaves[0], place.front, leaves[1])
    values, visible = operator(source, place, options)
    wanted = [leaf for leaf in (source, *leaves) if leaf is not None]
    found = iter(torch.autograd.grad(values, wanted, cotangent.to(values.dtype), allow_unused=True))
    gradients = [None if leaf is None else next(found) for leaf in (source, *leaves)]
    return values.detach(), visible, gradients


def by_kernels(
    source: Tensor,
    place: Any,
    options: Options,
    cotangent: Tensor | None = None,
    *,
    volume: bool = False,
    out: Tensor | None = None,
) -> Answer:
    """The kernels' answer and gradients; the cotangent is the answer itself if None."""
    needs = (True,) * 4
    if not isinstance(place, Sites):
        values, visible = operators.sample_views(source, *place, options)
        back = operators.sample_views_backward(
            values if cotangent is None else cotangent, source, *place, options, needs[:3]
        )
        return values, visible, list(back)
    values, visible = (
        operators.plane_sweep_project(source, place, options, out) if volume else unproject(source, place, options)
    )
    backward = operators.plane_sweep_project_backward if volume else unproject_backward
    return values, visible, list(backward(values if cotangent is None else cotangent, source, place, options, needs))


def compare(
    source: Tensor,
    place: Any,
    options: Options,
    *,
    cotangent: Tensor | None = None,
    volume: bool = False,
    seen: bool = True,
    out: Tensor | None = None,
) -> Answer:
    """Require values, visibility and every gradient to be the reference's; returns what the kernels gave.

    Args:
        source: of the call.
        place: `Sites`, or `Points`.
        options: of the call.
        cotangent: the incoming gradient; random if None.
        volume: whether the sites are frustums.
        seen: require that some sites are visible and some are not.
        out: where the kernels write a volume's values.
    """
    operator: Any = reference.plane_sweep_project if volume else unproject_reference
    if not isinstance(place, Sites):
        operator = sample_pixels
    plain = options._replace(flatten=False)
    with torch.no_grad():
        shape = operator(source, place, plain)[0].shape
    if cotangent is None:
        cotangent = torch.randn(shape, generator=generator(5)).to(source.dtype)
    values, visible, gradients = by_reference(operator, source.float(), place, plain, cotangent.float())
    exact, _, derivatives = by_reference(operator, source.double(), place, plain, cotangent.double())
    found = by_kernels(source, place, options, cotangent, volume=volume, out=out)
    half = source.dtype != torch.float32
    if seen and (bool(visible.all()) or not bool(visible.any())):
        raise ValueError("a scene of which everything is visible, or nothing, tells little")
    torch.testing.assert_close(found[1], visible, rtol=0, atol=0)
    # The interpreter cuts off what bfloat16 does not hold.
    assert_as_exact("values", found[0], values, exact, half=half, rounding=2.0)
    assert len(found[2]) == len(derivatives)
    assert found[2][0] is not None
    assert found[2][0].dtype == source.dtype
    for place_of, (gradient, expected, single) in enumerate(zip(found[2], derivatives, gradients, strict=True)):
        if expected is None or single is None:  # does not depend on it
            assert gradient is None or not bool(gradient.any())
        else:
            assert gradient is not None
            assert_as_exact(f"gradient {place_of}", gradient, single, expected, half=half)
    return found


compare_sweep = functools.partial(compare, volume=True)
