"""Run-time replacement of the library's internals, undone on exit."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from lsmgeo import kernels
from lsmgeo.cameras import matrices
from lsmgeo.kernels import reference


def reference_alone() -> contextlib.AbstractContextManager[Any]:
    """Take the reference in every call: the faults here are in it. Those of other kernels have tables of their own."""
    return mock.patch.object(kernels, "BACKENDS", tuple(b for b in kernels.BACKENDS if b.name == "reference"))


Patch = Callable[[], contextlib.AbstractContextManager[Any]]


@contextlib.contextmanager
def replaced(original: Any, make: Callable[[Any], Any]) -> Iterator[None]:
    """Put ``make(original)`` wherever a module of the library, or of its laws, holds ``original``."""
    substitute = functools.wraps(original)(make(original))
    holders: list[tuple[Any, str]] = []
    for name, module in list(sys.modules.items()):
        if name == "lsmgeo" or name.startswith(("lsmgeo.", "tests.property.")):
            holders += [(module, key) for key, value in vars(module).items() if value is original]
    assert holders, f"{original} is nowhere to be found"
    tables = [key for key, value in reference.OPERATORS.items() if value is original]
    for module, key in holders:
        setattr(module, key, substitute)
    for key in tables:
        reference.OPERATORS[key] = substitute
    try:
        yield
    finally:
        for module, key in holders:
            setattr(module, key, original)
        for key in tables:
            reference.OPERATORS[key] = original


def attribute(owner: Any, name: str, make: Callable[[Any], Any]) -> contextlib.AbstractContextManager[Any]:
    """Replace an attribute of a class by ``make(original)``; properties too."""
    original = vars(owner)[name]
    made = property(make(original.fget)) if isinstance(original, property) else make(original)
    return mock.patch.object(owner, name, made)


def around(original: Any, wrapper: Callable[..., Any]) -> Patch:
    """Call ``wrapper(original, *args, **kwargs)`` instead of ``original``."""
    return lambda: replaced(original, lambda inner: functools.partial(wrapper, inner))


def around_method(owner: Any, name: str, wrapper: Callable[..., Any]) -> Patch:
    def make(inner: Any) -> Any:
        return lambda self, *args, **kwargs: wrapper(inner, self, *args, **kwargs)

    return lambda: attribute(owner, name, make)


def cameras(change: Callable[[Any], Any]) -> Patch:
    """Change the float64 camera matrices that every operator and grid is made from."""
    return around(matrices.camera_matrices, lambda inner, *args, **kwargs: change(inner(*args, **kwargs)))


IMAGE_OPERATORS = ("unproject", "unproject_points")
SWEEPS = ("plane_sweep_project", "project_reduce")


@contextlib.contextmanager
def _operators(names: tuple[str, ...], wrapper: Callable[..., Any]) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for name in names:
            stack.enter_context(around(reference.OPERATORS[name], wrapper)())
        yield


def image_matrix(change: Callable[[Tensor, Tensor], Tensor]) -> Patch:
    """Change M of unprojection: ``change(matrix, features)``."""

    def wrapper(inner: Any, source: Tensor, target: Any, *args: Any) -> Any:
        if isinstance(target, Tensor):
            return inner(source, change(target, source), *args)
        return inner(source, target._replace(matrix=change(target.matrix, source)), *args)

    return lambda: _operators(IMAGE_OPERATORS, wrapper)


def sweep_sites(change: Callable[[Any], Any]) -> Patch:
    return lambda: _operators(SWEEPS, lambda inner, source, sites, *rest: inner(source, change(sites), *rest))


def options(names: tuple[str, ...], **changes: Any) -> Patch:
    """Run the operators with other options."""

    def wrapper(inner: Any, *args: Any) -> Any:
        return inner(*args[:-1], args[-1]._replace(**changes))

    return lambda: _operators(names, wrapper)


def outcome(names: tuple[str, ...], change: Callable[..., Any]) -> Patch:
    """Change what the operators return: ``change(values, visible, *args)``."""
    return lambda: _operators(names, lambda inner, *args: change(*inner(*args), *args))


def both(*patches: Patch) -> Patch:
    @contextlib.contextmanager
    def combined() -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            for patch in patches:
                stack.enter_context(patch())
            yield

    return combined


def rows(matrix: Tensor, x: Any = None, y: Any = None, z: Any = None) -> Tensor:
    """M with its rows replaced by functions of (row 0, row 1, row 2)."""
    given = matrix.unbind(-2)
    made = [given[i] if make is None else make(*given) for i, make in enumerate((x, y, z))]
    return torch.stack(made, -2)
