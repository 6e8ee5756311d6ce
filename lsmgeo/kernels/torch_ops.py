"""The fused kernels as PyTorch operators: schemas, shapes for tracing, derivatives, and one matrix product.

`images` and `pixels` sample images, `volume` samples volumes, `project_reduce` is `volume` and a linear map of its
channels, tile by tile. Which kernels run them, C++ or Triton, is an argument. Derivatives of derivatives are those of
the reference.

They are defined through `torch.library.Library`: `torch.library.custom_op` imports dynamo at its first call, which
takes seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from lsmgeo._dtypes import saturating_cast, saturation_limit
from lsmgeo.kernels import reference
from lsmgeo.kernels.native import library
from lsmgeo.kernels.points import pixels_in_front, project_points, sample_pixels
from lsmgeo.kernels.request import Options, Sites
from lsmgeo.kernels.triton import operators as triton_operators

__all__ = ["KERNELS", "operators", "why_not"]

# Modules of one protocol: why_not, images, images_backward, pixels, pixels_backward, volume, volume_backward.
KERNELS: dict[str, Any] = {"cpu": library, "triton": triton_operators}

# PyTorch 2.6 cannot tell export from compile: both take the reference there.
_is_exporting = getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)

LARGEST_TILE = {"cpu": 16 << 20, "triton": 256 << 20}  # bytes
LEAST_TILES = 32


def why_not(name: str, operator: str, source: Tensor, options: Options) -> str | None:
    """Why the kernels of this name cannot run a call, or None."""
    if _is_exporting():
        return "torch.export takes the reference, whose operations every runtime knows"
    if not torch.compiler.is_compiling() and _is_transformed():
        return "torch.func, forward-mode derivatives and torch.jit take the reference"
    return KERNELS[name].why_not(operator, source, options)


def _is_transformed() -> bool:
    """Whether something other than autograd's backward or torch.compile looks into the operations."""
    transforms: bool = torch._C._are_functorch_transforms_active()
    return transforms or forward_ad._current_level >= 0 or torch._C._get_tracing_state() is not None


# Schemas

_OPTIONS = "str mode, str padding_mode, bool depth, str direction_frame, str[] reduce, float near, bool stacked"
_SITES = "Tensor matrix, Tensor? direction, Tensor x, Tensor y, Tensor z, bool projective, Tensor? view_mask"
_ARGUMENTS = {
    "images": f"Tensor source, {_SITES}, {_OPTIONS}, str kernels",
    "pixels": f"Tensor source, Tensor pixels, Tensor front, Tensor? extra, {_OPTIONS}, str kernels",
    "volume": f"Tensor source, {_SITES}, {_OPTIONS}, str kernels",
    "project_reduce": f"Tensor source, {_SITES}, Tensor weight, Tensor? bias, {_OPTIONS}, str kernels",
}
# By which arguments each can be differentiated.
_DIFFERENTIABLE = {
    "images": ("source", "matrix", "direction", "z"),
    "pixels": ("source", "pixels", "extra"),
    "volume": ("source", "matrix", "direction", "z"),
    "project_reduce": ("source", "matrix", "direction", "z", "weight", "bias"),
}
_NAMES = {name: [part.split()[-1] for part in text.split(", ")] for name, text in _ARGUMENTS.items()}
_library = torch.library.Library("lsmgeo", "DEF")


def _sites(given: dict[str, Any]) -> Sites:
    return Sites(*(given[name] for name in Sites._fields))


def _options(given: dict[str, Any]) -> Options:
    return Options(*(given[part.split()[-1]] for part in _OPTIONS.split(", ")))


def _empty(like: Tensor, shape: Sequence[int], order: Sequence[int], dtype: torch.dtype) -> Tensor:
    tensor = like.new_empty([shape[axis] for axis in order], dtype=dtype)
    return tensor.permute([order.index(axis) for axis in range(len(shape))])


def _channels_last(like: Tensor, shape: Sequence[int], axis: int, dtype: torch.dtype) -> Tensor:
    return _empty(like, shape, [*(other for other in range(len(shape)) if other != axis), axis], dtype)


# What each operator runs: the kernels, the shapes of its answer, and the reference. All take the arguments by name.


def _forward(name: str, given: dict[str, Any]) -> tuple[Tensor, Tensor]:
    kernels, options = KERNELS[given["kernels"]], _options(given)
    if name == "pixels":
        return kernels.pixels(given["source"], given["pixels"], given["front"], given["extra"], options)
    if name == "project_reduce":
        return _project_reduce(kernels, given, options)
    return getattr(kernels, name)(given["source"], _sites(given), options)


def _shapes(name: str, given: dict[str, Any]) -> tuple[Tensor, Tensor]:
    source, options = given["source"], _options(given)
    if name == "pixels":
        B, V, N = given["front"].shape
        extra = given["extra"]
        channels, counts = source.shape[2] + (0 if extra is None else extra.shape[2]), [N]
    else:
        B, V = given["matrix"].shape[:2]
        channels = source.shape[2 if name == "images" else 1] + options.depth + 3 * bool(options.direction)
        counts = [given["z"].shape[-1], given["y"].shape[0], given["x"].shape[0]]
    visible = source.new_empty((B, V, *counts), dtype=torch.bool)
    if name == "project_reduce":
        return _channels_last(source, (B, V, given["weight"].shape[0], *counts[1:]), 2, source.dtype), visible
    if options.reduce:
        return _channels_last(source, (B, channels * len(options.reduce), *counts), 1, source.dtype), visible
    if options.stacked:
        return _empty(source, (B, V, channels, *counts), (0, 1, 4, 5, 2, 3), source.dtype), visible
    return _channels_last(source, (B, V, channels, *counts), 2, source.dtype), visible


def _reference(name: str, given: dict[str, Any]) -> tuple[Tensor, Tensor]:
    source, options = given["source"], _options(given)
    if name == "pixels":
        return sample_pixels(source, given["pixels"], given["front"], given["extra"], options)
    if name == "project_reduce":
        return reference.project_reduce(source, _sites(given), given["weight"], given["bias"], options)
    operator = reference.unproject if name == "images" else reference.plane_sweep_project
    return operator(source, _sites(given), options)


# Backward. An operator cannot answer None: an empty tensor stands for a gradient that was not asked for.


def _backward(name: str, gradient: Tensor, given: dict[str, Any], needs: Sequence[bool]) -> list[Tensor]:
    kernels, options = KERNELS[given["kernels"]], _options(given)
    if name == "pixels":
        found = kernels.pixels_backward(
            gradient, given["source"], given["pixels"], given["front"], given["extra"], options, needs
        )
        found = (found[0], *(None if part is None else part.contiguous() for part in found[1:]))
    elif name == "project_reduce":
        found = _project_reduce_backward(kernels, gradient, given, options, needs)
    else:
        backward = getattr(kernels, f"{name}_backward")
        found = backward(gradient, given["source"], _sites(given), options, needs)
    pairs = zip(found, needs, strict=True)
    return [gradient.new_empty(0) if part is None or not need else part for part, need in pairs]


def _backward_shapes(name: str, gradient: Tensor, given: dict[str, Any], needs: Sequence[bool]) -> list[Tensor]:
    def made(part: str) -> Tensor:
        like = given["matrix" if part in ("direction", "z") else part]
        if part == "source":
            return _channels_last(like, like.shape, 2 if name in ("images", "pixels") else 1, like.dtype)
        return like.new_empty((*like.shape[:2], given["z"].shape[-1]) if part == "z" else like.shape)

    parts = zip(_DIFFERENTIABLE[name], needs, strict=True)
    return [made(part) if need and given[part] is not None else gradient.new_empty(0) for part, need in parts]


def _keep(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    """Keep the arguments for backward: nothing of the size of the answer, which is made again there."""
    tensors = [value if isinstance(value, Tensor) else None for value in inputs]
    ctx.save_for_backward(*tensors)
    ctx.others = [None if isinstance(value, Tensor) else value for value in inputs]


def _differentiate(name: str, ctx: Any, gradient: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
    pairs = zip(ctx.saved_tensors, ctx.others, strict=True)
    inputs = [other if tensor is None else tensor for tensor, other in pairs]
    given = dict(zip(_NAMES[name], inputs, strict=True))
    wanted = dict(zip(_NAMES[name], ctx.needs_input_grad, strict=True))
    needs = [wanted[part] for part in _DIFFERENTIABLE[name]]
    if gradient is None or not any(needs):
        return (None,) * len(inputs)
    if torch.is_grad_enabled() and not torch.compiler.is_compiling():  # derivatives of derivatives are asked for
        values, _ = _reference(name, given)
        asked = [part for part, need in zip(_DIFFERENTIABLE[name], needs, strict=True) if need]
        answers: Sequence[Tensor | None] = [None] * len(asked)
        if values.requires_grad:
            known = [given[part] for part in asked]
            answers = torch.autograd.grad(values, known, gradient, create_graph=True, allow_unused=True)
        found = dict(zip(asked, answers, strict=True))
        return tuple(found.get(part) for part in _NAMES[name])
    backward = getattr(torch.ops.lsmgeo, f"{name}_backward")
    parts = backward(gradient, *inputs, needs)
    found = {
        part: value if need else None for part, value, need in zip(_DIFFERENTIABLE[name], parts, needs, strict=True)
    }
    if found.get("z") is not None:
        found["z"] = _shared(found["z"], given["z"])  # type: ignore[arg-type]
    return tuple(found.get(part) for part in _NAMES[name])


def _shared(gradient: Tensor, z: Tensor) -> Tensor:
    """From (B, V, D) to the shape of z: (D,), (B, D) or (B, V, D)."""
    return gradient.sum((0, 1)) if z.dim() == 1 else gradient.sum(1) if z.dim() == 2 else gradient


def _register(name: str) -> None:
    names, count = _NAMES[name], len(_DIFFERENTIABLE[name])

    def forward(*inputs: Any) -> tuple[Tensor, Tensor]:
        return _forward(name, dict(zip(names, inputs, strict=True)))

    def shapes(*inputs: Any) -> tuple[Tensor, Tensor]:
        return _shapes(name, dict(zip(names, inputs, strict=True)))

    def backward(gradient: Tensor, *rest: Any) -> tuple[Tensor, ...]:
        return tuple(_backward(name, gradient, dict(zip(names, rest[:-1], strict=True)), rest[-1]))

    def backward_shapes(gradient: Tensor, *rest: Any) -> tuple[Tensor, ...]:
        return tuple(_backward_shapes(name, gradient, dict(zip(names, rest[:-1], strict=True)), rest[-1]))

    answer = ", ".join(["Tensor"] * count)
    _library.define(f"{name}({_ARGUMENTS[name]}) -> (Tensor, Tensor)")
    _library.define(f"{name}_backward(Tensor gradient, {_ARGUMENTS[name]}, bool[{count}] needs) -> ({answer})")
    _library.impl(name, forward, "CompositeExplicitAutograd")
    _library.impl(f"{name}_backward", backward, "CompositeExplicitAutograd")
    torch.library.register_fake(f"lsmgeo::{name}", shapes, lib=_library)
    torch.library.register_fake(f"lsmgeo::{name}_backward", backward_shapes, lib=_library)
    torch.library.register_autograd(f"lsmgeo::{name}", partial(_differentiate, name), setup_context=_keep, lib=_library)
    for device in ("CPU", "CUDA"):  # arithmetic is in float32 whatever autocast says; answers have the features' dtype
        for operator in (name, f"{name}_backward"):
            _library.impl(operator, torch.library.fallthrough_kernel, f"Autocast{device}")


for _name in _ARGUMENTS:
    _register(_name)


# project_reduce: a tile of the sweep at a time, and a matrix product


def _neighbours(source: Tensor) -> Tensor:
    """The volume with neighbouring channels, so that no tile copies it again."""
    return source if source.stride(1) == 1 else source.movedim(1, -1).contiguous().movedim(-1, 1)


def _tiles(given: dict[str, Any], kernels: str) -> list[tuple[int, int, slice]]:
    """Scenes, views and rows of the maps whose stacked channels are in memory at one time."""
    (B, V), (_, channels, planes) = given["matrix"].shape[:2], given["weight"].shape
    height, width = given["y"].shape[0], given["x"].shape[0]
    row = max(1, 4 * channels * planes * width)
    most = min(LARGEST_TILE[kernels], B * V * height * row // LEAST_TILES)
    step = min(max(1, most // row), max(1, height))
    cuts = [slice(start, min(start + step, height)) for start in range(0, height, step)]
    return [(b, v, cut) for b in range(B) for v in range(V) for cut in cuts]


def _part(sites: Sites, b: int, v: int, rows: slice) -> Sites:
    z = sites.z if sites.z.dim() == 1 else sites.z[b] if sites.z.dim() == 2 else sites.z[b, v]
    one = (slice(b, b + 1), slice(v, v + 1))
    direction = None if sites.direction is None else sites.direction.expand_as(sites.matrix)[one]
    mask = None if sites.view_mask is None else sites.view_mask[one]
    return Sites(sites.matrix[one], direction, sites.x, sites.y[rows], z, sites.projective, mask)


def _unstacked(tile: Tensor, planes: int, channels: int, width: int) -> Tensor:
    """A tile (rows * width, planes * channels) as (1, 1, C', P, rows, width), without a copy."""
    rows = tile.shape[0] // max(1, width)
    return tile.view(rows, width, planes, channels).permute(3, 2, 0, 1)[None, None]


def _linear(weight: Tensor, bias: Tensor | None) -> tuple[Tensor, Tensor]:
    """Weights (P C', O) and bias (O,) in float32."""
    outputs, channels, planes = weight.shape
    offset = weight.new_zeros(outputs, dtype=torch.float32) if bias is None else bias.float()
    return weight.permute(2, 1, 0).reshape(planes * channels, outputs).float(), offset


def _can_saturate(
    dtype: torch.dtype, source: Tensor, sites: Sites, kernel: Tensor, offset: Tensor, options: Options
) -> bool:
    """Whether a map may be beyond its dtype, which takes making it again to know."""
    if dtype == torch.float32 or not offset.numel():
        return False
    if source.device.type != "cpu":  # to look at numbers would make it wait; bfloat16 holds what float32 does
        return dtype == torch.float16
    channels = [source.new_ones(1)]  # a direction's
    if source.numel():
        channels.append(source.abs().amax()[None])
    if options.depth:
        channels.append((1.0 / sites.z).amax()[None])
    largest = float(torch.cat([channel.float() for channel in channels]).amax())
    return not largest * float(kernel.abs().sum(0).amax()) + float(offset.abs().amax()) <= saturation_limit(dtype)


def _project_reduce(kernels: Any, given: dict[str, Any], options: Options) -> tuple[Tensor, Tensor]:
    source, sites, weight, bias = _neighbours(given["source"]), _sites(given), given["weight"], given["bias"]
    maps, visible = _shapes("project_reduce", given)
    if kernels is library:
        maps = library.fresh(maps.shape, source.dtype, (0, 1, 3, 4, 2))
    outputs, channels, planes = weight.shape
    width = maps.shape[4]
    kernel, offset = _linear(weight, bias)
    memory = None
    options = options._replace(stacked=False)
    with torch.autocast(source.device.type, enabled=False):
        for b, v, rows in _tiles(given, given["kernels"]):
            pixels = (rows.stop - rows.start) * width
            if memory is None:
                memory = source.new_empty((pixels, planes * channels), dtype=torch.float32)
            tile = memory[:pixels]
            swept = _unstacked(tile, planes, channels, width)
            _, visible[b : b + 1, v : v + 1, :, rows] = kernels.volume(
                source[b : b + 1], _part(sites, b, v, rows), options, swept
            )
            target = maps[b, v, :, rows].permute(1, 2, 0).view(pixels, outputs)
            if target.dtype == torch.float32:
                torch.addmm(offset, tile, kernel, out=target)
            else:
                target.copy_(saturating_cast(torch.addmm(offset, tile, kernel), target.dtype))
    return maps, visible


def _project_reduce_backward(
    kernels: Any, gradient: Tensor, given: dict[str, Any], options: Options, needs: Sequence[bool]
) -> tuple[Tensor | None, ...]:
    original, sites, weight = given["source"], _sites(given), given["weight"]
    source = _neighbours(original)
    outputs, channels, planes = weight.shape
    (B, V), width, D = sites.matrix.shape[:2], sites.x.shape[0], sites.z.shape[-1]
    kernel, offset = _linear(weight, given["bias"])
    saturates = _can_saturate(gradient.dtype, source, sites, kernel, offset, options)
    options = options._replace(stacked=False)
    places, needs_weight, needs_bias = needs[:4], needs[4], needs[5]
    to_source = _channels_last(source, source.shape, 1, torch.float32).zero_() if needs[0] else None
    parts = [sites.matrix.new_zeros(shape) for shape in ((B, V, 3, 4), (B, V, 3, 4), (B, V, D))]
    to_kernel = torch.zeros_like(kernel) if needs_weight else None
    to_bias = torch.zeros_like(offset) if needs_bias else None
    memory = None
    with torch.autocast(source.device.type, enabled=False):
        for b, v, rows in _tiles(given, given["kernels"]):
            pixels, part = (rows.stop - rows.start) * width, _part(sites, b, v, rows)
            if memory is None:
                memory = source.new_empty((pixels, planes * channels), dtype=torch.float32)
            tile = memory[:pixels]
            volume = source[b : b + 1]
            incoming = gradient[b, v, :, rows].permute(1, 2, 0).reshape(pixels, outputs).float()
            if to_kernel is not None or saturates:
                kernels.volume(volume, part, options, _unstacked(tile, planes, channels, width))
            if saturates:
                kept = torch.addmm(offset, tile, kernel).abs() <= saturation_limit(gradient.dtype)
                incoming = torch.where(kept, incoming, 0.0)
            if to_kernel is not None:
                to_kernel.addmm_(tile.t(), incoming)
            if to_bias is not None:
                to_bias += incoming.sum(0)
            if any(places):
                torch.mm(incoming, kernel.t(), out=tile)
                swept = _unstacked(tile, planes, channels, width)
                into = None if to_source is None else to_source[b : b + 1]
                _, *found = kernels.volume_backward(swept, volume, part, options, places, into)
                for total, share in zip(parts, found, strict=True):
                    if share is not None:
                        total[b, v] += share[0, 0]
    to_weight = None
    if to_kernel is not None:
        to_weight = to_kernel.view(planes, channels, outputs).permute(2, 1, 0).contiguous().to(weight.dtype)
    to_bias = None if to_bias is None else to_bias.to(given["bias"].dtype)
    to_source = None if to_source is None else saturating_cast(to_source, original.dtype)
    return to_source, *parts, to_weight, to_bias


# The operators of a backend, as `lsmgeo.kernels` calls them


def _on_sites(name: str, kernels: str, source: Tensor, sites: Sites, *arguments: Any) -> tuple[Tensor, Tensor]:
    return getattr(torch.ops.lsmgeo, name)(source, *sites, *arguments[:-1], *arguments[-1], kernels)


def _on_pixels(project: Callable[..., Any], kernels: str, source: Tensor, *arguments: Any) -> tuple[Tensor, Tensor]:
    return torch.ops.lsmgeo.pixels(source, *project(*arguments), *arguments[-1], kernels)


def operators(kernels: str) -> dict[str, Callable[..., Any]]:
    """The operators run by the kernels of this name."""
    return {
        "unproject": partial(_on_sites, "images", kernels),
        "unproject_points": partial(_on_pixels, project_points, kernels),
        "sample_views": partial(_on_pixels, pixels_in_front, kernels),
        "plane_sweep_project": partial(_on_sites, "volume", kernels),
        "project_reduce": partial(_on_sites, "project_reduce", kernels),
    }
