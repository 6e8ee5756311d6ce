"""A backend against the reference: values, visibility, and vector-Jacobian products with random cotangents.

The measure of a backend is the reference in float64. Its error may be a few times that of the reference in float32,
whose own errors the property suite bounds by analysis. Sites next to a kink (a cell's border, the image's border, the
near plane, the largest number of a half-precision answer) are left out of cotangents and of the comparison: there both
answers are right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lsmgeo import FrustumGrid, functional, rays
from lsmgeo._dtypes import saturation_limit
from lsmgeo.cameras import CameraTensors
from lsmgeo.kernels import OPERATORS, reference
from tests import tolerances

GUARD = 2e-3  # in cells, to the next multiple of a half
TIMES = 8.0  # of the error of the reference in float32
FLOOR = 2.0**-20  # relative to the largest magnitude: what a few float32 sums of a handful of terms may lose

Run = Callable[..., tuple[Tensor, Tensor]]


class Call(NamedTuple):
    """An operator on leaves, the tensors that a gradient is asked for; `run(*leaves, backend=...)` gives its answer.

    Of leaf `at_sites` the gradient is not compared where `close`: these sites are next to a kink, and add nothing.
    """

    name: str
    run: Run
    leaves: tuple[Tensor, ...]
    at_sites: int = -1
    close: Tensor | None = None


def unproject_call(features: Tensor, cameras: CameraTensors, grid: Any, **options: Any) -> Call:
    def run(features: Tensor, K: Tensor, E: Tensor, **backend: Any) -> Any:
        moved = cameras._replace(intrinsics=K, cam_from_world=E)
        return functional.unproject(features, moved, grid, **options, **backend)

    return Call("unproject", run, (features, cameras.intrinsics, cameras.cam_from_world))


def frustum_call(
    features: Tensor,
    cameras: CameraTensors,
    camera: CameraTensors,
    depths: Tensor,
    reference: Tensor | None = None,
    size: tuple[int, int] | None = None,
    **options: Any,
) -> Call:
    def run(features: Tensor, K: Tensor, E: Tensor, depths: Tensor, *reference: Tensor, **backend: Any) -> Any:
        moved = cameras._replace(intrinsics=K, cam_from_world=E)
        grid = FrustumGrid(camera, depths, size)
        other = reference[0] if reference else None
        return functional.unproject(features, moved, grid, reference=other, **options, **backend)

    leaves = (features, cameras.intrinsics, cameras.cam_from_world, depths)
    return Call("unproject", run, leaves if reference is None else (*leaves, reference))


def points_call(features: Tensor, cameras: CameraTensors, points: Tensor, **options: Any) -> Call:
    def run(features: Tensor, K: Tensor, E: Tensor, points: Tensor, **backend: Any) -> Any:
        moved = cameras._replace(intrinsics=K, cam_from_world=E)
        return functional.unproject_points(features, moved, points, **options, **backend)

    return Call("unproject_points", run, (features, cameras.intrinsics, cameras.cam_from_world, points))


def views_call(features: Tensor, pixels: Tensor, depth: Tensor, valid: Tensor, **options: Any) -> Call:
    def run(features: Tensor, pixels: Tensor, depth: Tensor, **backend: Any) -> Any:
        return functional.sample_views(features, pixels, depth, valid, **options, **backend)

    return Call("sample_views", run, (features, pixels, depth))


def sweep_call(
    volume: Tensor, cameras: CameraTensors, grid: Any, depths: Tensor, size: tuple[int, int], **options: Any
) -> Call:
    def run(volume: Tensor, K: Tensor, E: Tensor, depths: Tensor, **backend: Any) -> Any:
        moved = cameras._replace(intrinsics=K, cam_from_world=E)
        return functional.plane_sweep_project(volume, moved, grid, depths, size, **options, **backend)

    return Call("plane_sweep_project", run, (volume, cameras.intrinsics, cameras.cam_from_world, depths))


def reduce_call(
    volume: Tensor,
    cameras: CameraTensors,
    grid: Any,
    depths: Tensor,
    size: tuple[int, int],
    weight: Tensor,
    bias: Tensor | None,
    **options: Any,
) -> Call:
    def run(volume: Tensor, K: Tensor, E: Tensor, depths: Tensor, weight: Tensor, *bias: Tensor, **backend: Any) -> Any:
        moved = cameras._replace(intrinsics=K, cam_from_world=E)
        offset = bias[0] if bias else None
        return rays.project_reduce(volume, moved, grid, depths, weight, offset, size, **options, **backend)

    leaves = (volume, cameras.intrinsics, cameras.cam_from_world, depths, weight)
    return Call("project_reduce", run, leaves if bias is None else (*leaves, bias))


def splat_call(
    features: Tensor,
    cameras: CameraTensors,
    grid: Any,
    depths: Tensor,
    weights: Tensor | None = None,
    **options: Any,
) -> Call:
    def run(features: Tensor, K: Tensor, E: Tensor, depths: Tensor, *weights: Tensor, **backend: Any) -> Any:
        moved = cameras._replace(intrinsics=K, cam_from_world=E)
        other = weights[0] if weights else None
        volume = functional.splat(features, moved, grid, depths, weights=other, **options, **backend)
        return volume, volume.new_empty(0, dtype=torch.bool)

    size = tuple(features.shape[-2:])
    with _Kinks() as kinks:
        volume = torch.zeros(features.shape[0], 1, *grid.shape, dtype=torch.float64)
        functional.plane_sweep_project(volume, cameras, grid, depths, size, backend="reference", **options)
    close = kinks.close[0]
    leaves = (features, cameras.intrinsics, cameras.cam_from_world, depths)
    if weights is None:
        close = close[:, :, None].expand(features.shape)
        return Call("splat", run, (features.masked_fill(close, 0.0), *leaves[1:]), 0, close)
    return Call("splat", run, (*leaves, weights.masked_fill(close, 0.0)), 4, close)


class _Kinks:
    """Notes, while the reference runs, which samples (B, V, *sites) lie next to a kink."""

    def __init__(self) -> None:
        self.close: list[Tensor] = []

    def __enter__(self) -> _Kinks:
        self.inner = reference.sample_cells

        def watching(source: Tensor, index: Sequence[Tensor], front: Tensor, options: Any) -> Any:
            close = torch.zeros_like(index[0], dtype=torch.bool)
            for axis in index:
                known = 2.0 * axis.detach()
                close |= (known - known.round()).abs() < 2.0 * GUARD
            # Sites not in front are sent to an integer; what is close to them is the near plane, which scenes avoid.
            self.close.append(close & front.expand(close.shape))
            return self.inner(source, index, front, options)

        reference.sample_cells = watching
        return self

    def __exit__(self, *_: object) -> None:
        reference.sample_cells = self.inner


def _answer(
    call: Call, leaves: Sequence[Tensor], cotangent: Tensor | None, backend: str, limit: float = torch.inf
) -> list[Tensor]:
    leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
    values, visible = call.run(*leaves, backend=backend)
    values = values.clamp(-limit, limit) if limit < torch.inf else values
    if cotangent is None:
        return [values.detach(), visible]
    gradients = torch.autograd.grad(values, leaves, cotangent.to(values.dtype), allow_unused=True)
    return [torch.zeros_like(leaf) if part is None else part for part, leaf in zip(gradients, leaves, strict=True)]


def _double(leaves: Sequence[Tensor]) -> list[Tensor]:
    return [leaf.double() for leaf in leaves]


def _spread(close: Tensor, values: Tensor, reduced: bool, flat: int | None) -> Tensor:
    """Kinks (B, V, *sites) to the shape of the values."""
    if reduced:
        close = close.any(1, keepdim=True)
    if flat is not None:  # channels times planes
        return close.repeat(1, 1, values.shape[2] // flat, 1, 1)
    close = close[:, 0][:, None] if reduced else close[:, :, None]
    return close.expand(values.shape)


def compare(call: Call, backend: str, reduced: bool = False, flat: int | None = None) -> None:
    """Raise where a backend and the reference differ.

    Args:
        call: what to run, on float32 or half-precision leaves.
        backend: its name.
        reduced: whether views are reduced.
        flat: the number of planes, where they are stacked with the channels.
    """
    assert call.name in OPERATORS
    half = call.leaves[0].dtype not in (torch.float32, torch.float64)
    with _Kinks() as kinks:
        exact, seen = _answer(call, _double(call.leaves), None, "reference")
    single = [leaf.float() for leaf in call.leaves]
    # What the answer's dtype cannot hold saturates.
    limit = saturation_limit(call.leaves[0].dtype) if half else torch.inf
    saturates = (exact.abs() / limit - 1.0).abs() < GUARD
    exact = exact.clamp(-limit, limit)
    rough, _ = _answer(call, single, None, "reference", limit)
    values, visible = _answer(call, call.leaves, None, backend)
    assert values.dtype == call.leaves[0].dtype
    close = torch.cat(kinks.close, 2) if kinks.close else seen
    if call.name == "splat":
        ignored = torch.zeros_like(exact, dtype=torch.bool)
    elif call.name == "project_reduce":
        ignored = close.any(2, keepdim=True).expand(exact.shape)
    else:
        ignored = _spread(close, exact, reduced, flat)
    if bool((visible != seen)[~close].any()):
        raise AssertionError(f"{call.name}: visibility differs at {int((visible != seen)[~close].sum())} samples")
    ignored = ignored | saturates
    assert_as_exact("values", values, rough, exact, ~ignored, half=half)
    cotangent = torch.rand(exact.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9)) - 0.5
    cotangent = torch.where(ignored, 0.0, cotangent)
    if half:
        cotangent = cotangent.to(values.dtype).double()
    wanted = _answer(call, _double(call.leaves), cotangent, "reference", limit)
    rough_gradients = _answer(call, single, cotangent, "reference", limit)
    found = _answer(call, call.leaves, cotangent, backend)
    for number, (part, near, expected) in enumerate(zip(found, rough_gradients, wanted, strict=True)):
        assert part.dtype == call.leaves[number].dtype
        compared = ~call.close if number == call.at_sites else None
        assert_as_exact(f"gradient {number}", part, near, expected, compared, half=half)


def assert_as_exact(
    what: str,
    found: Tensor,
    rough: Tensor,
    expected: Tensor,
    compared: Tensor | None = None,
    *,
    half: bool,
    rounding: float = 1.01,
) -> None:
    """Within a few times the error of the reference in float32, ``rough``, by the largest norm.

    Values in half precision may also be off by a ``rounding`` in units of theirs.
    """
    assert found.shape == expected.shape, (what, found.shape, expected.shape)
    if compared is None:
        compared = torch.ones_like(expected, dtype=torch.bool)
    if not compared.any():
        return
    assert bool(found.isfinite().all()), f"{what} not finite"
    expected, found = expected[compared].double(), found[compared]
    largest = float(expected.abs().max())
    allowed = TIMES * float((rough.double()[compared] - expected).abs().max()) + FLOOR * largest
    error = (found.double() - expected).abs()
    if half and found.dtype in tolerances.UNIT_ROUNDOFF:
        # Values are rounded once, and so are the gradients that come in and go out.
        times = rounding if what == "values" else 4.0
        magnitude = expected.abs() if what == "values" else largest
        error = error - times * tolerances.UNIT_ROUNDOFF[found.dtype] * magnitude
        error = error - torch.finfo(found.dtype).smallest_normal * tolerances.UNIT_ROUNDOFF[found.dtype]
    error = float(error.max())
    assert error <= allowed, f"{what} off by {error:.3g}, allowed {allowed:.3g}"
