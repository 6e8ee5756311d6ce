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
    """
    types = _types()
    views, channels = source.shape[1:3]
    planes, height, width = target.shape[3:]
    columns = _clamped(_power_of_two(channels), CHANNELS)
    block = _clamped(TILE // columns, SITES)
    # Small planes share a program. Where the third axis is the fastest in memory, a store along it is one transaction.
    run = max(1, block // _power_of_two(height * width))
    if 0 < target.stride(3) < max(target.stride(4), target.stride(5)):
        run = max(run, PLANES)
    run = min(run, _power_of_two(planes))
    block = max(run, block)
    tiles, slabs = max(1, -(-channels // columns)), -(-planes // run)
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
        channels=columns,
        width=_power_of_two(extras),
        corners=1 if options.mode == "nearest" else 8 if volume else 4,
        needs_source=needs[0],
        needs_geometry=needs[1],
    )
    cells = source.shape[3:]
    return Call(
        types.Lattice(*(None,) * 5) if lattice is None else types.Lattice(*lattice[:5]),
        types.Points(*points),
        types.Sizes(views, channels, planes, height, width, *cells, tiles, blocks, slabs),
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
    gradient: Tensor, source: Tensor, options: Options, sites: int, shared: bool, given: Tensor | None = None
) -> Accumulator:
    """Memory to add to: float32, or fixed-point numbers where results must not depend on the order of the sums.

    Args:
        gradient: the incoming gradient.
        source: (B, V, C, d, h, w).
        options: of the call.
        sites: how many sites may add to one cell.
        shared: whether the views add to the same cells.
        given: float32 memory to add to, (B, 1, C, d, h, w); zeros if None.
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
        largest = source.float().nan_to_num(0.0, 0.0, 0.0).abs().amax().double()
        bound = bound * (1.0 + 8.0 * largest)
    exponent = 62.0 - math.ceil(math.log2(max(1, sites))) - torch.log2(bound).ceil()
    scale = torch.where(bound.isfinite(), torch.exp2(exponent.clamp(-126.0, 126.0)), torch.nan)
    return Accumulator(array, scale.float().reshape(1))  # NaN if the gradient is not finite


def allocate_sums(call: Call, options: Options, needed: bool, like: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Memory for the sums of `lattice_gradients` that the kernel writes."""
    types = _types()
    n, index, extra = call.sizes, None, None
    if needed and options.mode != "nearest":
        index = like.new_empty((call.views, n.planes, n.blocks, n.tiles, types.INDEX_SUMS.value), dtype=torch.float32)
    if needed and call.config.extras:
        extra = like.new_empty((call.views, n.planes, n.blocks, types.EXTRA_SUMS.value), dtype=torch.float32)
    return index, extra
