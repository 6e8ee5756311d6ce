"""Kernels: resampling between a lattice and an array through a matrix. They know neither cameras nor grids.

This module is the one place where a backend is chosen. A backend has a predicate that says why it cannot run a call;
"auto" takes the first of `BACKENDS` that can; a backend requested by name runs, or raises with its reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from lsmgeo._checks import check_choice, check_float
from lsmgeo.errors import BackendError
from lsmgeo.kernels import reference, torch_ops
from lsmgeo.kernels.request import OPERATORS, Options, Sites

__all__ = [
    "BACKENDS",
    "OPERATORS",
    "Backend",
    "Options",
    "Sites",
    "check_backend",
    "check_options",
    "explain",
    "run",
    "select",
]


@dataclass(frozen=True)
class Backend:
    """A set of kernels.

    Args:
        name: as in the argument `backend`.
        why_not: from (operator, source, options) to the reason why this backend cannot run it, or None.
        operators: the kernels by operator name.
    """

    name: str
    why_not: Callable[[str, Tensor, Options], str | None]
    operators: Mapping[str, Callable[..., Any]]


# In the order in which "auto" tries them.
BACKENDS: tuple[Backend, ...] = (
    *(Backend(name, partial(torch_ops.why_not, name), torch_ops.operators(name)) for name in torch_ops.KERNELS),
    Backend("reference", reference.why_not, reference.OPERATORS),
)


def check_backend(who: str, name: object) -> str:
    """Require "auto" or the name of a backend."""
    return check_choice(who, "backend", name, ("auto", *(backend.name for backend in BACKENDS)))


def check_options(who: str, smooth: str, backend: object, *choices: Any, **more: Any) -> Options:
    """`Options.checked`, with the name of a backend."""
    return Options.checked(who, smooth, *choices, **more).on(check_backend(who, backend))


def select(operator: str, source: Tensor, options: Options) -> Backend:
    """The backend that runs this call."""
    reasons = []
    for candidate in BACKENDS:
        if options.backend in ("auto", candidate.name):
            reason = candidate.why_not(operator, source, options)
            if reason is None:
                return candidate
            reasons.append(f"{candidate.name}: {reason}")
    raise BackendError(f"{operator}: backend {options.backend!r} cannot run this call ({'; '.join(reasons)})")


def run(operator: str, source: Tensor, *arguments: Any, options: Options) -> Any:
    """Run an operator on the backend that `select` names."""
    backend = select(operator, source, options)
    return backend.operators[operator](source, *_differentiable(operator, arguments, options), options)


def _differentiable(operator: str, arguments: tuple[Any, ...], options: Options) -> tuple[Any, ...]:
    """The arguments, detached where there is no derivative: nearest sampling has none to the geometry."""
    nearest, appended = options.mode == "nearest", options.appended() > 0
    if operator == "sample_views":
        pixels, depth, valid = arguments
        return pixels.detach() if nearest else pixels, depth if options.depth else depth.detach(), valid
    if not nearest:
        return arguments
    if operator == "unproject_points":
        matrix, direction, points, view_mask = arguments
        matrix, points = matrix if options.depth else matrix.detach(), points if appended else points.detach()
        return matrix, direction, points, view_mask
    sites, *others = arguments
    # The depth of an image's site comes from its matrix, that of a plane from the table of depths.
    matrix = sites.matrix if options.depth and operator == "unproject" else sites.matrix.detach()
    return sites.with_geometry(matrix, sites.direction, sites.z if appended else sites.z.detach()), *others


def explain(operator: str, source: Tensor, **options: Any) -> str:
    """Print and return, for each backend, whether "auto" would take it for a call, or why not.

    Args:
        operator: "unproject", "unproject_points", "sample_views", "plane_sweep_project", "project_reduce" or "splat".
        source: the features or volume of the call.
        **options: options of the call: mode, padding_mode, augment, direction_frame, reduce, near, groups,
            memory_format.

    Returns:
        A line for the call, then one for each backend.

    Raises:
        OptionError: an unknown operator or an invalid option.

    Example:
        >>> import torch
        >>> from lsmgeo import kernels
        >>> _ = kernels.explain("unproject", torch.zeros(1, 2, 8, 16, 16, dtype=torch.float64))
        unproject of (1, 2, 8, 16, 16) float64 on cpu
          cpu: float64 stays on the reference path
          triton: float64 stays on the reference path
          reference: taken
    """
    check_choice("explain", "operator", operator, OPERATORS)
    check_float("explain", "source", source, "(B, V, C, h, w) or (B, C, D, H, W)", None if operator == "splat" else 5)
    smooth = "trilinear" if operator in ("plane_sweep_project", "project_reduce", "splat") else "bilinear"
    call = Options.checked("explain", smooth, **options)
    lines = [f"{operator} of {tuple(source.shape)} {str(source.dtype).removeprefix('torch.')} on {source.device.type}"]
    taken = False
    for backend in BACKENDS:
        reason = backend.why_not(operator, source, call)
        verdict = reason if reason is not None else "can run, not needed" if taken else "taken"
        taken = taken or reason is None
        lines.append(f"  {backend.name}: {verdict}")
    text = "\n".join(lines)
    print(text)
    return text
