"""The fused kernels as PyTorch operators: schemas, shapes for tracing, derivatives.

`unproject` and `sample_views` sample images, `plane_sweep_project` and `project_reduce` sample volumes. In the schemas
`Sites` and `Options` are flat, field by field; ``options.backend`` names the kernels. Second derivatives are those of
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

from lsmgeo._dtypes import saturating_cast
from lsmgeo._torch_compat import has_forward_derivatives, has_function_transforms, is_exporting, is_jit_traced
from lsmgeo.kernels import reference
from lsmgeo.kernels.lattice_geometry import pixels_in_front, project_points
from lsmgeo.kernels.native import library
from lsmgeo.kernels.project_reduce import project_reduce, project_reduce_backward
from lsmgeo.kernels.request import Options, Sites
from lsmgeo.kernels.splat import splat, splat_backward
from lsmgeo.kernels.triton import operators as triton_operators

__all__ = ["KERNELS", "operators", "why_not"]

# Modules of one protocol: why_not and unproject, sample_views, plane_sweep_project, each with its _backward.
KERNELS: dict[str, Any] = {"cpu": library, "triton": triton_operators}


def why_not(name: str, operator: str, source: Tensor, options: Options) -> str | None:
    """Why the kernels of this name cannot run a call, or None."""
    if is_exporting():
        return "torch.export takes the reference, whose operations every runtime knows"
    if not torch.compiler.is_compiling() and (
        has_function_transforms() or has_forward_derivatives() or is_jit_traced()
    ):
        return "torch.func, forward-mode derivatives and torch.jit take the reference"
    return KERNELS[name].why_not(operator, source, options)


# Schemas

_SITES = "Tensor matrix, Tensor? direction, Tensor x, Tensor y, Tensor z, bool projective, Tensor? view_mask"
_OPTIONS = (
    "str mode, str padding_mode, bool depth, str direction_frame, str[] reduce, float near, bool flatten, int groups, "
    "bool contiguous, str backend"
)
_NO_OPTIONS = (None,) * len(Options._fields)  # their gradients

_library = torch.library.Library("lsmgeo", "DEF")


def _sites(flat: Sequence[Any]) -> Sites:
    return Sites(*flat[: len(Sites._fields)])


def _options(flat: Sequence[Any]) -> Options:
    return Options(*flat[-len(Options._fields) :])


def _empty(like: Tensor, shape: Sequence[int], order: Sequence[int], dtype: torch.dtype) -> Tensor:
    """An empty tensor; `order` names its axes from the slowest to the fastest in memory."""
    tensor = like.new_empty([shape[axis] for axis in order], dtype=dtype)
    return tensor.permute([order.index(axis) for axis in range(len(shape))])


def _channels_last(like: Tensor, shape: Sequence[int], axis: int) -> Tensor:
    return _empty(like, shape, [*(other for other in range(len(shape)) if other != axis), axis], like.dtype)


def _tensors(gradient: Tensor, found: Sequence[Tensor | None], needs: Sequence[bool]) -> tuple[Tensor, ...]:
    """The gradients, with an empty tensor for each that is not needed: an operator cannot return None."""
    pairs = zip(found, needs, strict=True)
    return tuple(gradient.new_empty(0) if part is None or not need else part for part, need in pairs)


def _empty_at_sites(
    source: Tensor, views: Sequence[int], channels: int, counts: Sequence[int], options: Options
) -> tuple[Tensor, Tensor]:
    """Empty values and visibility of views (B, V) at sites (D, H, W) or (N,), with the strides of the kernels'."""
    shape, visible = (*views, channels, *counts), source.new_empty((*views, *counts), dtype=torch.bool)
    if options.contiguous:
        shape = (views[0], channels * len(options.reduce), *counts) if options.reduce else shape
        return source.new_empty(shape), visible
    if options.reduce:
        return _channels_last(source, (views[0], channels * len(options.reduce), *counts), 1), visible
    if options.flatten:
        return _empty(source, shape, (0, 1, 4, 5, 2, 3), source.dtype), visible
    return _channels_last(source, shape, 2), visible


# Autograd


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    """Save the arguments; backward recomputes the rest, so that nothing of the output's size is kept."""
    ctx.save_for_backward(*(value if isinstance(value, Tensor) else None for value in inputs))
    ctx.others = [None if isinstance(value, Tensor) else value for value in inputs]


def _saved(ctx: Any) -> list[Any]:
    """The arguments, in the order of the schema."""
    pairs = zip(ctx.saved_tensors, ctx.others, strict=True)
    return [other if tensor is None else tensor for tensor, other in pairs]


def _gradients(
    gradient: Tensor | None,
    inputs: Sequence[Tensor | None],
    needs: Sequence[bool],
    backward: Callable[[list[bool]], Sequence[Tensor]],
    forward: Callable[[], tuple[Tensor, ...]],
) -> list[Tensor | None]:
    """The gradients to `inputs`, None where not needed.

    Args:
        gradient: of the values, or None.
        inputs: the arguments that have derivatives.
        needs: which of their gradients are needed.
        backward: the fused kernels' backward, of the needs.
        forward: the reference, for second derivatives.
    """
    if gradient is None or not any(needs):
        return [None] * len(inputs)
    if torch.is_grad_enabled() and not torch.compiler.is_compiling():  # second derivatives may follow
        values = forward()[0]
        if not values.requires_grad:
            return [None] * len(inputs)
        wanted = [part for part, need in zip(inputs, needs, strict=True) if part is not None and need]
        found = iter(torch.autograd.grad(values, wanted, gradient, create_graph=True, allow_unused=True))
        return [next(found) if need else None for need in needs]
    return [part if need else None for part, need in zip(backward(list(needs)), needs, strict=True)]


def _shared(gradient: Tensor | None, z: Tensor) -> Tensor | None:
    """The gradient to z, (D,), (B, D) or (B, V, D), from that to the z of every view, (B, V, D); others as they are."""
    if gradient is None or gradient.dim() == z.dim():
        return gradient
    return gradient.sum((0, 1)) if z.dim() == 1 else gradient.sum(1)


# Operators: forward and backward of the kernels, fake versions of both for tracing, and the autograd rule


class _PlaneSweepProject:
    """Volumes (B, C, D, H, W) at the sites of the views' frustums."""

    name, channel_axis, derivatives = "plane_sweep_project", 1, 4
    schema = f"Tensor volume, {_SITES}, {_OPTIONS}"

    def forward(self, volume: Tensor, *flat: Any) -> tuple[Tensor, Tensor]:
        options = _options(flat)
        return KERNELS[options.backend].plane_sweep_project(volume, _sites(flat), options)

    def forward_fake(self, source: Tensor, *flat: Any) -> tuple[Tensor, Tensor]:
        sites, options = _sites(flat), _options(flat)
        channels = source.shape[self.channel_axis] + options.appended()
        return _empty_at_sites(source, sites.matrix.shape[:2], channels, sites.counts(), options)

    def backward(self, gradient: Tensor, volume: Tensor, *rest: Any) -> tuple[Tensor, ...]:
        *flat, needs = rest
        options = _options(flat)
        backward = KERNELS[options.backend].plane_sweep_project_backward
        return _tensors(gradient, backward(gradient, volume, _sites(flat), options, needs), needs)

    def backward_fake(self, gradient: Tensor, source: Tensor, *flat: Any) -> tuple[Tensor, ...]:
        sites, needs = _sites(flat), flat[-1]
        matrix, direction, z = sites.matrix, sites.direction, sites.z
        to_direction = None if direction is None else direction.new_empty(direction.shape)
        if sites.per_site():
            to_z = z.new_empty(z.shape, dtype=torch.float32)
        else:
            to_z = matrix.new_empty((*matrix.shape[:2], z.shape[-1]))
        to_source = _channels_last(source, source.shape, self.channel_axis)
        return _tensors(gradient, (to_source, matrix.new_empty(matrix.shape), to_direction, to_z), needs)

    def autograd(self, ctx: Any, gradient: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
        volume, *flat = _saved(ctx)
        sites = _sites(flat)
        of_volume, of_matrix, of_direction, _, _, of_z, *_ = ctx.needs_input_grad
        to_volume, to_matrix, to_direction, to_z = _gradients(
            gradient,
            (volume, sites.matrix, sites.direction, sites.z),
            (of_volume, of_matrix, of_direction, of_z),
            lambda needs: torch.ops.lsmgeo.plane_sweep_project_backward(gradient, volume, *flat, needs),
            lambda: reference.plane_sweep_project(volume, sites, _options(flat)),
        )
        return to_volume, to_matrix, to_direction, None, None, _shared(to_z, sites.z), None, None, *_NO_OPTIONS


class _Unproject(_PlaneSweepProject):
    """Images (B, V, C, h, w) at the sites of a lattice, or their correlation with a reference (B, C, D or 1, H, W)."""

    name, channel_axis, derivatives = "unproject", 2, 5
    schema = f"Tensor features, Tensor? reference, {_SITES}, {_OPTIONS}"

    def forward(self, features: Tensor, other: Tensor | None, *flat: Any) -> tuple[Tensor, Tensor]:
        options = _options(flat)
        return KERNELS[options.backend].unproject(features, _sites(flat), other, options)

    def forward_fake(self, features: Tensor, other: Tensor | None, *flat: Any) -> tuple[Tensor, Tensor]:
        sites, options = _sites(flat), _options(flat)
        channels = (features.shape[2] if other is None else options.groups) + options.appended()
        return _empty_at_sites(features, sites.matrix.shape[:2], channels, sites.counts(), options)

    def backward(self, gradient: Tensor, features: Tensor, other: Tensor | None, *rest: Any) -> tuple[Tensor, ...]:
        *flat, needs = rest
        options = _options(flat)
        backward = KERNELS[options.backend].unproject_backward
        return _tensors(gradient, backward(gradient, features, _sites(flat), other, options, needs), needs)

    def backward_fake(self, gradient: Tensor, features: Tensor, other: Tensor | None, *flat: Any) -> tuple[Tensor, ...]:
        to_others = super().backward_fake(gradient, features, *flat[:-1], [True] * 4)
        to_reference = None if other is None else _channels_last(other, other.shape, 1)
        return _tensors(gradient, (*to_others, to_reference), flat[-1])

    def autograd(self, ctx: Any, gradient: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
        features, other, *flat = _saved(ctx)
        sites = _sites(flat)
        of_features, of_reference, of_matrix, of_direction, _, _, of_z, *_ = ctx.needs_input_grad
        to_features, to_matrix, to_direction, to_z, to_reference = _gradients(
            gradient,
            (features, sites.matrix, sites.direction, sites.z, other),
            (of_features, of_matrix, of_direction, of_z, of_reference),
            lambda needs: torch.ops.lsmgeo.unproject_backward(gradient, features, other, *flat, needs),
            lambda: reference.unproject(features, sites, other, _options(flat)),
        )
        to_sites = to_matrix, to_direction, None, None, _shared(to_z, sites.z), None, None
        return to_features, to_reference, *to_sites, *_NO_OPTIONS


class _SampleViews:
    """Images at given pixels (B, V, N, 2), where `front`; channels `extra` (B, V, E, N) are appended."""

    name, derivatives = "sample_views", 3
    schema = f"Tensor features, Tensor pixels, Tensor front, Tensor? extra, {_OPTIONS}"

    def forward(
        self, features: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, *flat: Any
    ) -> tuple[Tensor, Tensor]:
        options = _options(flat)
        return KERNELS[options.backend].sample_views(features, pixels, front, extra, options)

    def forward_fake(
        self, features: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, *flat: Any
    ) -> tuple[Tensor, Tensor]:
        channels = features.shape[2] + (0 if extra is None else extra.shape[2])
        return _empty_at_sites(features, front.shape[:2], channels, front.shape[2:], _options(flat))

    def backward(
        self, gradient: Tensor, features: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, *rest: Any
    ) -> tuple[Tensor, ...]:
        *flat, needs = rest
        options = _options(flat)
        backward = KERNELS[options.backend].sample_views_backward
        to_features, *others = backward(gradient, features, pixels, front, extra, options, needs)
        others = [None if part is None else part.contiguous() for part in others]
        return _tensors(gradient, (to_features, *others), needs)

    def backward_fake(
        self, gradient: Tensor, features: Tensor, pixels: Tensor, front: Tensor, extra: Tensor | None, *flat: Any
    ) -> tuple[Tensor, ...]:
        to_extra = None if extra is None else extra.new_empty(extra.shape)
        to_features = _channels_last(features, features.shape, 2)
        return _tensors(gradient, (to_features, pixels.new_empty(pixels.shape), to_extra), flat[-1])

    def autograd(self, ctx: Any, gradient: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
        features, pixels, front, extra, *flat = arguments = _saved(ctx)
        of_features, of_pixels, _, of_extra, *_ = ctx.needs_input_grad
        to_features, to_pixels, to_extra = _gradients(
            gradient,
            (features, pixels, extra),
            (of_features, of_pixels, of_extra),
            lambda needs: torch.ops.lsmgeo.sample_views_backward(gradient, *arguments, needs),
            lambda: reference.sample_pixels(features, pixels, front, extra, _options(flat)),
        )
        return to_features, to_pixels, None, to_extra, *_NO_OPTIONS


class _ProjectReduce(_PlaneSweepProject):
    """A plane sweep and a linear map of its stacked channels; `weight` and `bias` come before the sites."""

    name, derivatives = "project_reduce", 6
    schema = f"Tensor volume, Tensor weight, Tensor? bias, {_SITES}, {_OPTIONS}"

    def forward(self, volume: Tensor, weight: Tensor, bias: Tensor | None, *flat: Any) -> tuple[Tensor, Tensor]:
        options = _options(flat)
        return project_reduce(KERNELS[options.backend], volume, weight, bias, _sites(flat), options)

    def forward_fake(self, volume: Tensor, weight: Tensor, bias: Tensor | None, *flat: Any) -> tuple[Tensor, Tensor]:
        (B, V), counts = flat[0].shape[:2], _sites(flat).counts()
        maps = _channels_last(volume, (B, V, weight.shape[0], *counts[1:]), 2)
        return maps, volume.new_empty((B, V, *counts), dtype=torch.bool)

    def backward(
        self, gradient: Tensor, volume: Tensor, weight: Tensor, bias: Tensor | None, *rest: Any
    ) -> tuple[Tensor, ...]:
        *flat, needs = rest
        sites, options = _sites(flat), _options(flat)
        kernels = KERNELS[options.backend]
        found = project_reduce_backward(kernels, gradient, volume, weight, bias, sites, options, needs)
        return _tensors(gradient, found, needs)

    def backward_fake(
        self, gradient: Tensor, volume: Tensor, weight: Tensor, bias: Tensor | None, *flat: Any
    ) -> tuple[Tensor, ...]:
        of_weights = weight.new_empty(weight.shape), None if bias is None else bias.new_empty(bias.shape)
        to_volume, *of_sites = super().backward_fake(gradient, volume, *flat[:-1], [True] * 4)
        return _tensors(gradient, (to_volume, *of_weights, *of_sites), flat[-1])

    def autograd(self, ctx: Any, gradient: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
        volume, weight, bias, *flat = arguments = _saved(ctx)
        sites = _sites(flat)
        of_volume, of_weight, of_bias, of_matrix, of_direction, _, _, of_z, *_ = ctx.needs_input_grad
        *to_tensors, to_matrix, to_direction, to_z = _gradients(
            gradient,
            (volume, weight, bias, sites.matrix, sites.direction, sites.z),
            (of_volume, of_weight, of_bias, of_matrix, of_direction, of_z),
            lambda needs: torch.ops.lsmgeo.project_reduce_backward(gradient, *arguments, needs),
            lambda: reference.project_reduce(volume, sites, weight, bias, _options(flat)),
        )
        return *to_tensors, to_matrix, to_direction, None, None, _shared(to_z, sites.z), None, None, *_NO_OPTIONS


class _Splat(_PlaneSweepProject):
    """The transpose of a plane sweep; `weights` (B, V, P, h, w) and the volume's (D, H, W) come before the sites."""

    name, derivatives, answers = "splat", 4, "Tensor"
    schema = f"Tensor features, Tensor? weights, int[] shape, {_SITES}, {_OPTIONS}"

    def forward(  # type: ignore[override]
        self, features: Tensor, weights: Tensor | None, shape: Sequence[int], *flat: Any
    ) -> Tensor:
        options = _options(flat)
        return splat(KERNELS[options.backend], features, _sites(flat), weights, shape, options)

    def forward_fake(  # type: ignore[override]
        self, features: Tensor, weights: Tensor | None, shape: Sequence[int], *flat: Any
    ) -> Tensor:
        B, _, C = features.shape[:3]
        return _empty(features, (B, C, *shape), (0, 2, 3, 4, 1), torch.float32)

    def backward(
        self, gradient: Tensor, features: Tensor, weights: Tensor | None, shape: Sequence[int], *rest: Any
    ) -> tuple[Tensor, ...]:
        *flat, needs = rest
        options = _options(flat)
        sites, kernels = _sites(flat), KERNELS[options.backend]
        to_features, to_weights, *to_sites = splat_backward(kernels, gradient, features, sites, weights, options, needs)
        to_features = None if to_features is None else saturating_cast(to_features, features.dtype)
        to_weights = None if to_weights is None else saturating_cast(to_weights, features.dtype)
        return _tensors(gradient, (to_features, to_weights, *to_sites), needs)

    def backward_fake(
        self, gradient: Tensor, features: Tensor, weights: Tensor | None, shape: Sequence[int], *flat: Any
    ) -> tuple[Tensor, ...]:
        _, to_matrix, _, to_z = super().backward_fake(gradient, gradient, *flat[:-1], [True] * 4)
        to_weights = None if weights is None else weights.new_empty(weights.shape)
        return _tensors(gradient, (_channels_last(features, features.shape, 2), to_weights, to_matrix, to_z), flat[-1])

    def autograd(self, ctx: Any, gradient: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
        features, weights, shape, *flat = arguments = _saved(ctx)
        sites = _sites(flat)
        of_features, of_weights, _, of_matrix, _, _, _, of_z, *_ = ctx.needs_input_grad
        to_features, to_weights, to_matrix, to_z = _gradients(
            gradient,
            (features, weights, sites.matrix, sites.z),
            (of_features, of_weights, of_matrix, of_z),
            lambda needs: torch.ops.lsmgeo.splat_backward(gradient, *arguments, needs),
            lambda: (reference.splat(features, sites, weights, shape, _options(flat)),),
        )
        to_sites = to_matrix, None, None, None, _shared(to_z, sites.z), None, None
        return to_features, to_weights, None, *to_sites, *_NO_OPTIONS


for _operator in (_Unproject(), _SampleViews(), _PlaneSweepProject(), _ProjectReduce(), _Splat()):
    _name, _answers = _operator.name, ", ".join(["Tensor"] * _operator.derivatives)
    _library.define(f"{_name}({_operator.schema}) -> {getattr(_operator, 'answers', '(Tensor, Tensor)')}")
    _needs = f"bool[{_operator.derivatives}] needs"
    _library.define(f"{_name}_backward(Tensor gradient, {_operator.schema}, {_needs}) -> ({_answers})")
    for _full_name, _run, _fake in (
        (_name, _operator.forward, _operator.forward_fake),
        (f"{_name}_backward", _operator.backward, _operator.backward_fake),
    ):
        _library.impl(_full_name, _run, "CompositeExplicitAutograd")
        torch.library.register_fake(f"lsmgeo::{_full_name}", _fake, lib=_library)
        for _device in ("CPU", "CUDA"):  # arithmetic is in float32 under autocast too
            _library.impl(_full_name, torch.library.fallthrough_kernel, f"Autocast{_device}")
    torch.library.register_autograd(f"lsmgeo::{_name}", _operator.autograd, setup_context=_save, lib=_library)


# The operators of a backend, as `lsmgeo.kernels` calls them


def _at_sites(operator: Callable[..., Any], backend: str, source: Tensor, sites: Sites, *rest: Any) -> Any:
    *tensors, options = rest
    return operator(source, *tensors, *sites, *options.on(backend))


def _at_pixels(project: Callable[..., Any], backend: str, features: Tensor, *arguments: Any) -> Any:
    return torch.ops.lsmgeo.sample_views(features, *project(*arguments), *arguments[-1].on(backend))


def operators(backend: str) -> dict[str, Callable[..., Any]]:
    """The operators run by the kernels of this name."""
    return {
        "unproject": partial(_at_sites, torch.ops.lsmgeo.unproject, backend),
        "unproject_points": partial(_at_pixels, project_points, backend),
        "sample_views": partial(_at_pixels, pixels_in_front, backend),
        "plane_sweep_project": partial(_at_sites, torch.ops.lsmgeo.plane_sweep_project, backend),
        "project_reduce": partial(_at_sites, torch.ops.lsmgeo.project_reduce, backend),
        "splat": partial(_at_sites, torch.ops.lsmgeo.splat, backend),
    }
