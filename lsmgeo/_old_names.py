"""Names and places of the version before, which stay for this one with a `DeprecationWarning` that says the new one."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__all__ = ["moved_to", "old_names"]


def moved_to(place: str, old: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a module whose content is at ``place`` now."""

    def find(name: str) -> Any:
        module = import_module(place)
        if name == "__all__":
            return module.__all__
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of a name that has changed too
            value = None if name.startswith("__") else getattr(module, name, None)
        if value is None:
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        warnings.warn(f"{old} is now {place}", DeprecationWarning, stacklevel=2)
        return value

    return find


def old_names(module: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a module that has ``names`` (old to new) under other names now."""

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(f"{module}.{name} is now {module}.{names[name]}", DeprecationWarning, stacklevel=2)
        return getattr(import_module(module), names[name])

    return find
