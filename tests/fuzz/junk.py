"""Values that somebody passes by mistake, each made from what would have been right."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor


def _filled(value: float) -> Callable[[Any], Any]:
    """The right tensor filled with a value (short of overflow); the value itself where a number is right."""

    def make(right: Any) -> Any:
        if not _is_float(right):
            return value
        largest = torch.finfo(right.dtype).max
        return torch.full_like(right, min(value, 0.9 * largest) if math.isfinite(value) else value)

    return make


def _is_float(value: Any) -> bool:
    return isinstance(value, Tensor) and value.is_floating_point()


def _tensor(right: Any) -> Tensor:
    return right if isinstance(right, Tensor) else torch.ones(2, 3)


def _one_bad(value: float) -> Callable[[Any], Any]:
    """The right tensor with its last element replaced."""

    def make(right: Any) -> Any:
        if not _is_float(right):
            return (value, 1, 1)
        bad = right.detach().clone()
        bad.reshape(-1)[-1:] = value
        return bad

    return make


# Never right, whatever the argument.
NEVER: dict[str, Callable[[Any], Any]] = {
    "object": lambda right: object(),
    "function": lambda right: len,
    "type": lambda right: int,
    "bytes": lambda right: b"\xff",
    "complex number": lambda right: 1j,
    "word": lambda right: "junk",
    "nested list": lambda right: [[1, [2]], []],
    "set": lambda right: {1.5},
    "dict": lambda right: {"junk": 1},
    "complex tensor": lambda right: torch.ones(_tensor(right).shape, dtype=torch.complex64),
    "sparse tensor": lambda right: torch.ones(_tensor(right).shape).to_sparse(),
}

# Wrong for most arguments and right for some.
SOMETIMES: dict[str, Callable[[Any], Any]] = {
    "None": lambda right: None,
    "tensor of rank 9": lambda right: torch.ones((1,) * 9),
    "empty string": lambda right: "",
    "empty list": lambda right: [],
    "list of numbers": lambda right: [1.0, 2.0],
    "strange sizes": lambda right: (0, -3),
    "huge sizes": lambda right: (2**31, 2**31),
    "True": lambda right: True,
    "zero": lambda right: 0,
    "minus one": lambda right: -1,
    "2^31": lambda right: 2**31,
    "10^30": lambda right: 10**30,
    "NaN": _filled(float("nan")),
    "infinity": _filled(float("inf")),
    "1e38": _filled(1e38),
    "-0.0": _filled(-0.0),
    "denormal": _filled(1e-42),
    "largest float": _filled(sys.float_info.max),
    "one NaN": _one_bad(float("nan")),
    "one infinity": _one_bad(float("-inf")),
    "negated": lambda right: -right if _is_float(right) else -1.5,
    "numpy array": lambda right: _tensor(right).detach().numpy() if _is_float(right) else np.ones(3),
    "numpy number": lambda right: np.float32("nan"),
    "scalar tensor": lambda right: torch.tensor(1.0),
    "NaN scalar tensor": lambda right: torch.tensor(float("nan")),
    "empty tensor": lambda right: torch.ones(0),
    "int8": lambda right: torch.ones(_tensor(right).shape, dtype=torch.int8),
    "bool": lambda right: torch.ones(_tensor(right).shape, dtype=torch.bool),
    "float16": lambda right: torch.ones(_tensor(right).shape, dtype=torch.float16),
    "other float": lambda right: _tensor(right).to(torch.float64),
    "meta tensor": lambda right: torch.ones(_tensor(right).shape, device="meta", dtype=_tensor(right).dtype),
    "one axis more": lambda right: _tensor(right)[None],
    "one axis less": lambda right: _tensor(right)[0] if _tensor(right).dim() else torch.ones(2),
    "transposed": lambda right: _tensor(right).transpose(-1, -2) if _tensor(right).dim() > 1 else torch.ones(3, 2),
    "first axis doubled": lambda right: torch.cat((_tensor(right), _tensor(right))) if _tensor(right).dim() else right,
    "first axis empty": lambda right: _tensor(right)[:0] if _tensor(right).dim() else torch.ones(0, 3),
    "last axis empty": lambda right: _tensor(right)[..., :0] if _tensor(right).dim() else torch.ones(3, 0),
    "huge expanded": lambda right: torch.ones(()).expand(2**33),
    "strided": lambda right: torch.ones(2**12)[:: 2**11].expand(*_tensor(right).shape[:-1], 2),
}

JUNK = NEVER | SOMETIMES


def mutations(right: Any, generator: np.random.Generator) -> Iterator[Any]:
    """Endless damaged forms of a right value: for tensors elements, axes, strides and dtypes, else other junk."""
    values = (float("nan"), float("inf"), -1.0, 0.0, 1e38, -1e38, 1e-42, 2.0**31, 0.5)
    dtypes = (torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int64, torch.uint8, torch.bool)
    names = sorted(JUNK)
    while True:
        kind = generator.integers(5)
        if not isinstance(right, Tensor) or kind == 0:
            yield JUNK[names[generator.integers(len(names))]](right)
            continue
        damaged = right.detach().clone()
        if kind == 1 and _is_float(damaged) and damaged.numel():
            for _ in range(generator.integers(1, 4)):
                damaged.reshape(-1)[generator.integers(damaged.numel())] = values[generator.integers(len(values))]
        elif kind == 2:
            sizes = [max(0, size + int(generator.integers(-1, 2))) for size in damaged.shape]
            damaged = torch.ones(sizes, dtype=damaged.dtype)
        elif kind == 3 and damaged.dim():
            axis = int(generator.integers(damaged.dim()))
            damaged = damaged.flip(axis) if generator.integers(2) else damaged.transpose(axis, -1)
        else:
            damaged = damaged.to(dtypes[generator.integers(len(dtypes))])
        yield damaged
