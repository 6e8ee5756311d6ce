"""The C++ kernels: calls on tensors without derivatives.

Without a compiler the package is built without the library; `why_not` then says so. The library does not depend on
Python or PyTorch: tensors are passed as addresses and strides, and the threads are those of PyTorch's own pool.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from lsmgeo._dtypes import saturating_cast
from lsmgeo.kernels.lattice_geometry import per_view
from lsmgeo.kernels.native.loading import Call, empty, missing, run
from lsmgeo.kernels.request import Options, Sites

UNPROJECT, SAMPLE_VIEWS, PLANE_SWEEP_PROJECT = range(3)
TYPES = {torch.float32: 0, torch.bfloat16: 1, torch.float16: 2, torch.float64: 3}
SOURCE_TYPES = (torch.float32, torch.bfloat16, torch.float16)
STATISTICS = {"mean": 0, "variance": 1, "max": 2}
LEAST_CHUNK = 8  # channels of a task


def why_not(operator: str, source: Tensor, options: Options) -> str | None:
    """Why the C++ kernels cannot run a call, or None."""
    if source.dtype not in SOURCE_TYPES:
        return "float64 stays on the reference path"
    if source.device.type != "cpu":
        return f"its kernels are for CPU tensors, these are on {source.device.type}"
    return missing()


# Calls: `_set_*` fill in a part of the arguments; tensors must stay alive until the kernel is done.


def channels_last(source: Tensor, axis: int) -> Tensor:
    """The source with adjacent channels; a copy only where they are not."""
    if source.shape[axis] < 2 or source.stride(axis) == 1:
        return source
    return source.movedim(axis, -1).contiguous().movedim(-1, axis)


def _new_call(kind: int, source: Tensor, options: Options, sites: Sequence[int]) -> Call:
    call = Call()
    call.kind, call.threads = kind, torch.get_num_threads()
    if kind == PLANE_SWEEP_PROJECT:
        call.scenes, call.channels, *sizes = source.shape
    else:
        call.scenes, call.views, call.channels, *sizes = source.shape
    call.size[:] = (*reversed(sizes), 1)[:3]
    call.sites[:] = sites
    call.nearest = options.mode == "nearest"
    call.border = options.padding_mode == "border"
    call.statistics = len(options.reduce)
    for number, name in enumerate(options.reduce):
        call.statistic[number] = STATISTICS[name]
    call.near = options.near
    call.source, call.source_type = source.data_ptr(), TYPES[source.dtype]
    call.source_stride[:] = _source_strides(source, _channel_axis(kind))
    return call


def _source_strides(source: Tensor, axis: int) -> tuple[int, ...]:
    """Those of scene, view, z, y and x; 0 for the view of a volume and the z of an image."""
    scene, *views = source.stride()[:axis]
    depth, *sides = source.stride()[axis + 1 :] if axis == 1 else (0, *source.stride()[axis + 1 :])
    return scene, *(views or [0]), depth, *sides


def _set_original(call: Call, source: Tensor, axis: int) -> None:
    """Have the kernels copy what they read of a source whose channels are not adjacent."""
    if source.shape[axis] > 1 and source.stride(axis) != 1:
        scene, view, *sides = call.source_stride
        call.original, call.original_stride[:] = source.data_ptr(), (scene, view, source.stride(axis), *sides)


def _set_sites(call: Call, sites: Sites, options: Options) -> tuple[Tensor | None, ...]:
    """Set the geometry; the result must live as long as the call."""
    B, V = call.scenes, call.views = sites.matrix.shape[:2]
    matrix, x, y = sites.matrix.contiguous(), sites.x.contiguous(), sites.y.contiguous()
    direction = sites.direction.expand(B, V, 3, 4).contiguous() if options.direction else None  # type: ignore[union-attr]
    if sites.per_site():
        z = sites.z.expand(B, V, *sites.z.shape[2:])
        call.depths, call.depths_type, call.depths_stride[:] = z.data_ptr(), TYPES[z.dtype], z.stride()
    else:
        z = per_view(sites.z, sites.matrix)
        call.z, call.z_stride[:] = z.data_ptr(), z.stride()
    mask = None if sites.view_mask is None else sites.view_mask.contiguous()
    call.projective, call.depth, call.direction = sites.projective, options.depth, bool(options.direction)
    call.matrix, call.x, call.y = matrix.data_ptr(), x.data_ptr(), y.data_ptr()
    call.direction_matrix = None if direction is None else direction.data_ptr()
    call.view_mask = None if mask is None else mask.data_ptr()
    return matrix, direction, x, y, z, mask


def _set_gradient(call: Call, gradient: Tensor, options: Options) -> None:
    """Set the incoming gradient; split the channels where there are fewer scenes and views than threads."""
    call.gradient, call.gradient_type = gradient.data_ptr(), TYPES[gradient.dtype]
    call.gradient_stride[:] = _value_strides(gradient, options)
    units = max(1, call.scenes * (1 if call.whole_scenes or call.statistics else call.views))
    chunks = min(call.channels // (2 * LEAST_CHUNK), -(-2 * call.threads // units))
    if chunks * units < call.threads:
        chunks = min(call.channels // LEAST_CHUNK, -(-call.threads // units))
    call.chunks = max(1, chunks)


def _set_source_gradient(call: Call, source: Tensor, axis: int, into: Tensor | None) -> Tensor:
    """Set the memory of the source's gradient: `into`, float32, to add to, or new memory that the kernel fills."""
    if into is None:
        order = [other for other in range(source.dim()) if other != axis]
        gradient = empty(source.shape, source.dtype, [*order, axis])
        if 0 in call.sites[:]:  # then no task runs that would fill it
            gradient.zero_()
    elif into.shape[axis] > 1 and into.stride(axis) != 1:
        raise ValueError("the channels of a gradient to add to must be adjacent")
    else:
        gradient = into
    call.accumulate, call.source_gradient = into is not None, gradient.data_ptr()
    call.source_gradient_type = TYPES[gradient.dtype]
    call.source_gradient_stride[:] = _source_strides(gradient, axis)
    return gradient


def _set_geometry_gradients(call: Call, sites: Sites, needs: Sequence[bool]) -> list[Tensor | None]:
    """Set the memory of the gradients to matrix, direction and z, a part for each chunk of channels."""
    views, chunks = (call.scenes, call.views), call.chunks
    matrix, direction = (
        torch.zeros(*views, chunks, 3, 4, dtype=torch.float64, device="cpu") if need else None for need in needs[:2]
    )
    call.matrix_gradient, call.direction_gradient = (
        None if part is None else part.data_ptr() for part in (matrix, direction)
    )
    z = None
    if needs[2] and sites.per_site():
        z = torch.zeros(chunks, *sites.z.shape, dtype=torch.float32, device="cpu")
        chunk, scene, view, *_ = z.stride()
        call.depths_gradient = z.data_ptr()
        call.depths_gradient_stride[:] = (chunk, scene, view if sites.z.shape[1] > 1 else 0)
        z = z.movedim(0, 2)
    elif needs[2]:
        z = torch.zeros(*views, chunks, call.sites[2], dtype=torch.float64, device="cpu")
        call.z_gradient = z.data_ptr()
    return [matrix, direction, z]


def _set_reference(call: Call, reference: Tensor, groups: int, share: float | None = None) -> None:
    """Set what samples are multiplied with: (B, C, D or 1, H, W), or (B, V, C, D or 1, H, W)."""
    # An empty tensor is at address 0, which nothing is read from, but which arithmetic must not start from.
    call.groups, call.reference = groups, reference.data_ptr() or ctypes.addressof(call)
    call.share = groups / max(1, call.channels) if share is None else share
    call.reference_stride[:] = _reference_strides(reference)


def _reference_strides(reference: Tensor) -> tuple[int, ...]:
    """Those of scene, view, channel, z, y and x; 0 for what a reference is shared by."""
    scene, *views, channel, z, y, x = reference.stride()
    return scene, *(views or [0]), channel, z if reference.shape[-3] > 1 else 0, y, x


def _set_reference_gradient(call: Call, reference: Tensor) -> Tensor:
    """Where the gradient to the reference goes, in float32."""
    *views, C, D, H, W = reference.shape
    gradient = torch.zeros((*views, D, H, W, C), dtype=torch.float32, device="cpu").movedim(-1, -4)
    call.reference_gradient = gradient.data_ptr()
    scene, view, _, *sites = _reference_strides(gradient)
    call.reference_gradient_stride[:] = (scene, view, *sites)
    return gradient


def _lattice_call(
    kind: int, source: Tensor, sites: Sites, options: Options, reads_source: bool = True
) -> tuple[Call, tuple[Tensor | None, ...]]:
    """A call on the sites of a lattice, and what must live as long as it."""
    call = _new_call(kind, source, options, sites.counts()[::-1])
    if reads_source:
        _set_original(call, source, _channel_axis(kind))
    return call, _set_sites(call, sites, options)


def _is_linear(options: Options, appended: bool) -> bool:
    """Whether the values' gradient to the source can be found without reading it."""
    return not options.reduce or (tuple(options.reduce) == ("mean",) and not appended)


def _channel_axis(kind: int) -> int:
    return 1 if kind == PLANE_SWEEP_PROJECT else 2


def _lattice_backward(
    kind: int,
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    options: Options,
    needs: Sequence[bool],
    reference: Tensor | None = None,
    into: Tensor | None = None,
    share: float | None = None,
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """Gradients to source, matrix, direction, z and reference."""
    of_source, of_matrix, of_direction, of_z, of_reference = needs
    can_saturate = reference is not None and gradient.dtype != torch.float32
    is_linear = _is_linear(options, bool(options.depth or options.direction)) and not can_saturate
    reads = of_matrix or of_z or of_reference or not is_linear
    call, alive = _lattice_call(kind, source, sites, options, reads)
    # One task has all views of a scene where their gradients are added to one array.
    shares_depths = of_z and sites.per_site() and sites.z.shape[1] < call.views
    call.whole_scenes = kind == PLANE_SWEEP_PROJECT or of_reference or shares_depths
    to_reference = None
    if reference is not None:
        _set_reference(call, reference, options.groups, share)
        to_reference = _set_reference_gradient(call, reference) if of_reference else None
    _set_gradient(call, gradient, options)
    to_source = _set_source_gradient(call, source, _channel_axis(kind), into) if of_source else None
    parts = _set_geometry_gradients(call, sites, (of_matrix, of_direction and bool(options.direction), of_z))
    run(call, backward=True)
    del alive
    if to_reference is not None:
        to_reference = saturating_cast(to_reference, reference.dtype)  # type: ignore[union-attr]
    return to_source, *(None if part is None else part.sum(2) for part in parts), to_reference  # type: ignore[return-value]


def _forward(
    call: Call, alive: Sequence[Tensor | None], dtype: torch.dtype, options: Options, out: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Run a call forward; `alive` must live as long as it. `out` is memory of the values' shape to write to."""
    counts, reduced = call.sites[::-1], bool(options.reduce)
    features = call.groups or call.channels
    channels = (features + call.depth + 3 * call.direction + call.extra) * max(1, len(options.reduce))
    views = () if reduced else (call.views,)
    if out is None:
        order = [0, 2, 3, 4, 1] if reduced else [0, 1, 4, 5, 2, 3] if options.flatten else [0, 1, 3, 4, 5, 2]
        order = sorted(order) if options.contiguous else order
        out = empty((call.scenes, *views, channels, *counts), dtype, order)
    visible = torch.empty((call.scenes, call.views, *counts), dtype=torch.bool, device="cpu")
    call.values, call.values_type, call.visible = out.data_ptr(), TYPES[out.dtype], visible.data_ptr()
    call.values_stride[:] = _value_strides(out, options)
    run(call, backward=False)
    del alive
    return out, visible


def _value_strides(values: Tensor, options: Options) -> tuple[int, ...]:
    """The strides of values (B, V, C', D, H, W), or of (B, C'', D, H, W) where views are reduced, with 0 for those."""
    strides = values.stride()
    return (strides[0], 0, *strides[1:]) if options.reduce else strides


def unproject(
    source: Tensor, sites: Sites, reference: Tensor | None, options: Options, out: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """As `reference.unproject`; `out` is memory of the values' shape to write to."""
    call, alive = _lattice_call(UNPROJECT, source, sites, options)
    if reference is not None:
        _set_reference(call, reference, options.groups)
    return _forward(call, (*alive, reference), source.dtype, options, out)


def unproject_backward(
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    reference: Tensor | None,
    options: Options,
    needs: Sequence[bool],
    into: Tensor | None = None,
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """Vector-Jacobian product of `unproject` to source, matrix, direction, z and reference, None where not in `needs`.

    The gradient may have any strides. Those to source and reference have their dtype; those to matrices (B, V, 3, 4)
    and z (B, V, D) are float64; that to the depths of each site is float32, of their shape.
    `into` is float32 memory of the source's shape, channels adjacent, to add its gradient to.
    """
    return _lattice_backward(UNPROJECT, gradient, source, sites, options, needs, reference, into)


def sample_views(
    source: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, options: Options
) -> tuple[Tensor, Tensor]:
    """Sample images (B, V, C, h, w) at pixels (B, V, N, 2) where `front` (B, V, N), append `extra` (B, V, E, N)."""
    values, visible = _forward(*_pixels_call(source, pixels, front, extra, options), source.dtype, options)
    return values[..., 0, 0, :], visible[:, :, 0, 0]


def _pixels_call(
    source: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, options: Options, reads_source: bool = True
) -> tuple[Call, tuple[Tensor | None, ...]]:
    call = _new_call(SAMPLE_VIEWS, source, options, (front.shape[-1], 1, 1))
    if reads_source:
        _set_original(call, source, 2)
    pixels, front = pixels.float().contiguous(), front.contiguous()
    extras = None if extra is None else extra.float().movedim(2, 3).contiguous()
    call.pixels, call.front = pixels.data_ptr(), front.data_ptr()
    call.extra = 0 if extras is None else extras.shape[3]
    call.extras = None if extras is None else extras.data_ptr()
    return call, (pixels, front, extras)


def sample_views_backward(
    gradient: Tensor,
    source: Tensor,
    pixels: Tensor,
    front: Tensor,
    extra: Tensor | None,
    options: Options,
    needs: Sequence[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Vector-Jacobian product of `sample_views` to source, pixels and extra, each in its dtype."""
    reads = needs[1] or not _is_linear(options, extra is not None)
    call, alive = _pixels_call(source, pixels, front, extra, options, reads)
    _set_gradient(call, gradient[..., None, None, :], options)
    to_source = _set_source_gradient(call, source, 2, None) if needs[0] else None
    to_pixels = torch.zeros((call.chunks, *pixels.shape), dtype=torch.float32, device="cpu") if needs[1] else None
    call.pixels_gradient = None if to_pixels is None else to_pixels.data_ptr()
    to_extra = None
    if needs[2] and extra is not None:
        to_extra = torch.zeros((*front.shape, call.extra), dtype=torch.float32, device="cpu")
        call.extras_gradient = to_extra.data_ptr()
    run(call, backward=True)
    del alive
    return (
        to_source,
        None if to_pixels is None else to_pixels.sum(0).to(pixels.dtype),
        None if to_extra is None else to_extra.movedim(3, 2).to(extra.dtype),  # type: ignore[union-attr]
    )


def plane_sweep_project(
    source: Tensor, sites: Sites, options: Options, out: Tensor | None = None, factor: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """As `reference.plane_sweep_project`; `out` is memory of the values' shape, any strides, to write to.

    With a `factor` (B, V, C, 1, h, w) the one channel is the sum of its products with the samples.
    """
    call, alive = _lattice_call(PLANE_SWEEP_PROJECT, source, sites, options)
    if factor is not None:
        _set_reference(call, factor, 1, share=1.0)
    return _forward(call, (*alive, factor), source.dtype, options, out)


def plane_sweep_project_backward(
    gradient: Tensor,
    source: Tensor,
    sites: Sites,
    options: Options,
    needs: Sequence[bool],
    into: Tensor | None = None,
    factor: Tensor | None = None,
) -> tuple[Tensor | None, ...]:
    """Vector-Jacobian product of `plane_sweep_project` to source, matrix, direction, z, and factor if in `needs`.

    See `unproject_backward`. `into` is float32 memory of the source's shape, channels adjacent, to add its gradient to.
    """
    every = (*needs, False)[:5]
    share = None if factor is None else 1.0
    found = _lattice_backward(PLANE_SWEEP_PROJECT, gradient, source, sites, options, every, factor, into, share)
    return found[: len(needs)]
