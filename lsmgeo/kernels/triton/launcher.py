"""How the Triton kernels are launched: tiles, strides, and where they write. Triton is imported at the first launch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lsmgeo._dtypes import saturation_limit
from lsmgeo.kernels.request import Options
from lsmgeo.kernels.triton.launch_tables import Tables

TILE = 2048  # elements: 16 for each thread of four warps
SITES = (16, 256)  # of a tile
CHANNELS = (4, 64)
PLANES = 32  # 128 bytes of float32


def kernels() -> Mapping[str, Any]:
    """The kernels by name."""
    from lsmgeo.kernels.triton import backward, forward

    return {"resample": forward.resample, "resample_backward": backward.resample_backward}


def _types() -> ModuleType:
    from lsmgeo.kernels.triton import types

    return types


class Call(NamedTuple):
    """The arguments of both kernels."""

    lattice: Any
    points: Any
    sizes: Any
    config: Any
    near: float
    programs: int
    views: int  # B V


def plan(
    source: Tensor,
    target: Tensor,
    options: Options,
    extras: int,
    lattice: Tables | None = None,
    points: Sequence[Tensor | None] = (None, None, None),
    volume: bool = False,
    needs: tuple[bool, bool] = (False, False),
    reference: Tensor | None = None,
    needs_reference: bool = False,
    averages: bool = True,
) -> Call:
    """Choose the tiles of a launch.

    Args:
        source: (B, V, C, d, h, w).
        target: values or their gradient: (B, V, C', D, H, W), or (B, 1, C'', D, H, W).
        options: of the call.
        extras: number of geometric channels.
        lattice: tables of the sites, None for given pixels.
        points: pixels, front and geometric channels of given pixels.
        volume: whether the source is a volume.
        needs: whether the gradients to the source and to the geometry are needed.
        reference: (B, V or 1, C, D or 1, H, W), to correlate the samples with.
        needs_reference: whether the gradient to it is needed.
        averages: whether a correlation is a mean over its channels, not their sum.
    """
    types = _types()
    views, channels = source.shape[1:3]
    planes, height, width = target.shape[3:]
    chunk = _clamped(_power_of_two(channels), CHANNELS)
    features = channels if reference is None else options.groups
    columns = chunk if reference is None else _power_of_two(features)
    block = _clamped(TILE // max(chunk, columns), SITES)
    # Small planes share a program. Where the third axis is the fastest in memory, a store along it is one transaction.
    run = max(1, block // _power_of_two(height * width))
    if 0 < target.stride(3) < max(target.stride(4), target.stride(5)):
        run = max(run, PLANES)
    run = min(run, _power_of_two(planes))
    block = max(run, block)
    chunks, slabs = max(1, -(-channels // chunk)), -(-planes // run)
    tiles = chunks if reference is None else 1
    blocks = -(-height * width // (block // run))
    order = {name: place for place, name in enumerate(options.reduce)}
    kind = types.PIXELS if lattice is None else types.VOLUME if volume else types.IMAGES
    config = types.Config(
        kind=kind.value,
        nearest=options.mode == "nearest",
        border=options.padding_mode == "border",
        projective=lattice is not None and lattice.projective,
        depth=options.depth,
        direction=bool(options.direction),
        extras=extras,
        reduce=bool(options.reduce),
        mean=order.get("mean", -1),
        variance=order.get("variance", -1),
        maximum=order.get("max", -1),
        largest=min(saturation_limit(target.dtype), torch.finfo(torch.float32).max),
        sites=block,
        planes=run,
        channels=chunk,
        columns=columns,
        width=_power_of_two(extras),
        corners=1 if options.mode == "nearest" else 8 if volume else 4,
        needs_source=needs[0],
        needs_geometry=needs[1],
        needs_reference=needs_reference,
        per_site=lattice is not None and lattice.depths is not None,
        correlates=reference is not None,
        averages=averages,
    )
    cells = source.shape[3:]
    depths = None if lattice is None or lattice.depths is None else strided(lattice.depths)
    other = None if reference is None else strided_reference(reference)
    return Call(
        types.Lattice(*(None,) * 7) if lattice is None else types.Lattice(*lattice[:5], depths, other),
        types.Points(*points),
        types.Sizes(views, channels, features, planes, height, width, *cells, tiles, chunks, blocks, slabs),
        config,
        min(float(options.near), torch.finfo(torch.float32).max),
        tiles * blocks * slabs * source.shape[0] * (1 if options.reduce else views),
        source.shape[0] * views,
    )


def launch(name: str, call: Call, *arrays: Any) -> None:
    """Run a kernel on the arrays' device; does nothing where there are no sites."""
    if call.programs:
        with torch.cuda.device_of(arrays[0].pointer):
            warps = 8 if call.config.reduce else 4  # statistics need more registers
            # Fused multiply-adds are Triton's default, which is to change.
            kernels()[name][(call.programs,)](
                *arrays,
                call.lattice,
                call.points,
                call.sizes,
                call.near,
                call.config,
                num_warps=warps,
                enable_fp_fusion=True,
            )


def strided(array: Tensor) -> Any:
    """A (B, V, C, z, y, x) array for a kernel."""
    return _types().Strided(array, *array.stride())


def strided_reference(reference: Tensor) -> Any:
    """A (B, V or 1, C, D or 1, H, W) array for a kernel, the same for all views or planes where it has one."""
    b, v, c, z, y, x = reference.stride()
    shared = reference.shape[1] == 1, reference.shape[3] == 1
    return _types().Strided(reference, b, 0 if shared[0] else v, c, 0 if shared[1] else z, y, x)


def into_of(source: Tensor, scale: Tensor | None, reference: Accumulator | None) -> Any:
    """The `types.Into` of a backward."""
    other = (None, None) if reference is None else (strided_reference(reference.array), reference.scale)
    return _types().Into(strided(source), scale, *other)


def sums_of(*sums: Tensor | None) -> Any:
    """The `types.Sums` of a backward."""
    return _types().Sums(*sums)


def _power_of_two(count: int) -> int:
    """The power of two at or above."""
    return 1 << max(0, count - 1).bit_length()


def _clamped(value: int, bounds: tuple[int, int]) -> int:
    return min(max(value, bounds[0]), bounds[1])


def channels_last(source: Tensor, reads: int) -> Tensor:
    """The (B, V, C, d, h, w) source with adjacent channels, as the kernels read them.

    A copy, axes of stride 0 only once, unless few of its cells are read.
    """
    cells = math.prod(source.shape[3:])
    if source.shape[2] == 1 or source.stride(2) == 1 or reads < cells or source.numel() == 0:
        return source
    once = source[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in source.stride())]
    return once.movedim(2, -1).contiguous().movedim(-1, 2).expand_as(source)


def empty_channels_last(B: int, V: int, C: int, *sites: int, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """An uninitialised (B, V, C, D, H, W) array, channels last in memory."""
    return torch.empty((B, V, *sites, C), dtype=dtype or like.dtype, device=like.device).movedim(-1, 2)


# Gradients to the source


class Accumulator(NamedTuple):
    """Where the kernel adds the source's gradient."""

    array: Tensor  # (B, V or 1, C, d, h, w)
    scale: Tensor | None = None  # (1,) float32, of fixed-point numbers

    def total(self) -> Tensor:
        """The sum, float32."""
        return self.array if self.scale is None else (self.array.double() / self.scale.double()).float()


def accumulator(
    gradient: Tensor,
    source: Tensor,
    options: Options,
    sites: int,
    shared: bool,
    given: Tensor | None = None,
    factor: Tensor | None = None,
) -> Accumulator:
    """Memory to add to: float32, or fixed-point numbers where results must not depend on the order of the sums.

    Args:
        gradient: the incoming gradient.
        source: (B, V, C, d, h, w).
        options: of the call.
        sites: how many sites may add to one cell.
        shared: whether the views add to the same cells.
        given: float32 memory to add to, (B, 1, C, d, h, w); zeros if None.
        factor: what the source is correlated with.
    """
    fixed = torch.are_deterministic_algorithms_enabled() and gradient.numel() > 0
    if given is not None and not fixed:
        return Accumulator(given)
    B, V, C, *cells = source.shape
    dtype = torch.int64 if fixed else torch.float32
    array = empty_channels_last(B, 1 if shared else V, C, *cells, like=source, dtype=dtype).zero_()
    if not fixed:
        return Accumulator(array)
    bound = torch.linalg.vector_norm(gradient, math.inf, dtype=torch.float32).double() * max(1, len(options.reduce))
    if "variance" in options.reduce and source.numel():
        largest = _largest(source) * (1.0 if factor is None else _largest(factor))
        bound = bound * (1.0 + 8.0 * largest)
    if factor is not None:
        bound = bound * _largest(factor)
    exponent = 62.0 - math.ceil(math.log2(max(1, sites))) - torch.log2(bound).ceil()
    scale = torch.where(bound.isfinite(), torch.exp2(exponent.clamp(-126.0, 126.0)), torch.nan)
    return Accumulator(array, scale.float().reshape(1))  # NaN where an infinity leaves no bound


def _largest(tensor: Tensor) -> Tensor:
    """The largest magnitude, float64; a NaN, which hidden sites may have, is 0."""
    if not tensor.numel():
        return tensor.new_zeros((), dtype=torch.float64)
    return tensor.float().nan_to_num(0.0, math.inf, -math.inf).abs().amax().double()


def allocate_sums(
    call: Call, options: Options, needed: bool, like: Tensor
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Memory for what the kernel writes for the gradients to the geometry, see `types.Sums`."""
    types = _types()
    n, index, extra, depths = call.sizes, None, None, None
    rows = 3 * (types.ROW_PER_SITE if call.config.per_site else types.ROW).value
    if needed and options.mode != "nearest":
        index = like.new_empty((call.views, n.planes, n.blocks, n.tiles, rows), dtype=torch.float32)
    if needed and call.config.extras:
        sums = types.DEPTH_SUMS.value + rows
        extra = like.new_empty((call.views, n.planes, n.blocks, sums), dtype=torch.float32)
    if needed and call.config.per_site:
        parts = n.tiles + (call.config.extras > 0)
        depths = like.new_zeros((call.views, parts, n.planes, n.height, n.width), dtype=torch.float32)
    return index, extra, depths
