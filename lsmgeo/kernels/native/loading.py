"""The C++ library: its arguments, how it is loaded, and memory for its outputs."""

from __future__ import annotations

import ctypes
import os
import sysconfig
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from lsmgeo._torch_compat import as_constant

HUGE = 4 << 20  # bytes from which an output is allocated in huge pages

_INTEGER, _NUMBER, _ADDRESS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class Call(ctypes.Structure):
    """`Call` of native/call.h, field by field."""

    _fields_ = (
        *((name, _INTEGER) for name in ("kind", "threads", "scenes", "views", "channels")),
        ("size", 3 * _INTEGER),
        ("sites", 3 * _INTEGER),
        *((name, _INTEGER) for name in ("nearest", "border", "projective", "depth", "direction", "extra")),
        ("statistics", _INTEGER),
        ("statistic", 3 * _INTEGER),
        ("near", _NUMBER),
        ("source", _ADDRESS),
        ("source_type", _INTEGER),
        ("source_stride", 5 * _INTEGER),
        ("original", _ADDRESS),
        ("original_stride", 6 * _INTEGER),
        ("ready", _ADDRESS),
        *((name, _ADDRESS) for name in ("matrix", "direction_matrix", "x", "y", "z")),
        ("z_stride", 3 * _INTEGER),
        ("depths", _ADDRESS),
        ("depths_type", _INTEGER),
        ("depths_stride", 5 * _INTEGER),
        ("reference", _ADDRESS),
        ("reference_stride", 6 * _INTEGER),
        ("groups", _INTEGER),
        ("share", _NUMBER),
        *((name, _ADDRESS) for name in ("view_mask", "pixels", "front", "extras")),
        ("values", _ADDRESS),
        ("values_type", _INTEGER),
        ("values_stride", 6 * _INTEGER),
        ("visible", _ADDRESS),
        ("gradient", _ADDRESS),
        ("gradient_type", _INTEGER),
        ("gradient_stride", 6 * _INTEGER),
        ("chunks", _INTEGER),
        ("accumulate", _INTEGER),
        ("whole_scenes", _INTEGER),
        ("source_gradient", _ADDRESS),
        ("source_gradient_type", _INTEGER),
        ("source_gradient_stride", 5 * _INTEGER),
        *((name, _ADDRESS) for name in ("matrix_gradient", "direction_gradient", "z_gradient")),
        ("depths_gradient", _ADDRESS),
        ("depths_gradient_stride", 3 * _INTEGER),
        ("reference_gradient", _ADDRESS),
        ("reference_gradient_stride", 5 * _INTEGER),
        *((name, _ADDRESS) for name in ("pixels_gradient", "extras_gradient")),
    )


@cache
def _library() -> ctypes.CDLL | str:
    """The library, or why it is missing."""
    if os.environ.get("LSMGEO_NATIVE") == "0":
        return "turned off by LSMGEO_NATIVE=0"
    folder = Path(__file__).parent
    names = (f"_native{suffix}" for suffix in (".abi3.so", sysconfig.get_config_var("EXT_SUFFIX"), ".so", ".pyd"))
    path = next((folder / name for name in names if (folder / name).is_file()), None)
    if path is None:
        return "not built; install from source with a C++ compiler to have it"
    return load(path)


def load(path: Path) -> ctypes.CDLL | str:
    """The library in a file, ready for calls, or why it cannot be used."""
    try:
        library = ctypes.CDLL(str(path))
        library.lsmgeo_size_of_call.restype = ctypes.c_int64
    except (OSError, AttributeError) as error:
        return f"{path.name} does not load: {error}"
    if library.lsmgeo_size_of_call() != ctypes.sizeof(Call):
        return f"{path.name} was built from other sources; install again"
    library.lsmgeo_instruction_set.restype = ctypes.c_char_p
    library.lsmgeo_use_huge_pages.argtypes = (ctypes.c_void_p, ctypes.c_int64)
    library.lsmgeo_use_openmp.argtypes = (ctypes.c_void_p,)
    try:
        parallel = ctypes.CDLL(None).GOMP_parallel  # of the OpenMP runtime that PyTorch has loaded
        library.lsmgeo_use_openmp(ctypes.cast(parallel, ctypes.c_void_p))
    except (AttributeError, OSError, TypeError):
        pass  # the library starts threads of its own
    return library


@as_constant
def missing() -> str | None:
    """Why there is no library, or None."""
    library = _library()
    return library if isinstance(library, str) else None


def instruction_set(name: str | None = None) -> str:
    """The instruction set in use: "avx512", "avx2" or "baseline"; sets another by its name, if the machine has it."""
    library = _library()
    if isinstance(library, str):
        raise RuntimeError(library)
    found = library.lsmgeo_instruction_set(None if name is None else name.encode())
    if found is None:
        raise ValueError(f"this machine does not have the instruction set {name!r}")
    return found.decode()


def empty(shape: Sequence[int], dtype: torch.dtype, order: Sequence[int] | None = None) -> Tensor:
    """Memory for an output of this shape; `order` names its axes from the slowest to the fastest.

    Large outputs are put in huge pages: touching fresh pages of 4 KiB costs as much as the kernels do.
    """
    order = tuple(range(len(shape))) if order is None else order
    tensor = torch.empty([shape[axis] for axis in order], dtype=dtype, device="cpu")
    if tensor.nbytes >= HUGE and not isinstance(library := _library(), str):
        library.lsmgeo_use_huge_pages(tensor.data_ptr(), tensor.nbytes)
    return tensor.permute([order.index(axis) for axis in range(len(shape))])


def run(call: Call, backward: bool) -> None:
    """Run a call; the tensors that it names must be alive."""
    library = _library()
    assert not isinstance(library, str), library
    failed = (library.lsmgeo_backward if backward else library.lsmgeo_forward)(ctypes.byref(call))
    if failed:
        raise MemoryError("lsmgeo: no memory for the workspace of a kernel")
