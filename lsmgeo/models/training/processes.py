"""What the processes of one run must agree on; with a single process every answer is its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from torch import distributed

from lsmgeo.errors import TrainingError

__all__ = ["any_true", "check_agreement", "gather"]

Value = TypeVar("Value")


def any_true(flag: bool) -> bool:
    """Whether the flag is true in any process. All processes must call this together.

    Args:
        flag: this process's.
    """
    return any(gather(flag))


def gather(value: Value) -> list[Value]:
    """The values of all processes in the order of their ranks. All processes must call this together.

    Args:
        value: this process's: numbers, strings, tensors and containers of them.
    """
    if not (distributed.is_available() and distributed.is_initialized()):
        return [value]
    values: list[Value | None] = [None] * distributed.get_world_size()
    distributed.all_gather_object(values, value)
    return values  # type: ignore[return-value]


def check_agreement(things: Mapping[str, object]) -> None:
    """Refuse to train where processes start from different things.

    Args:
        things: what must be the same everywhere, by name: the configuration, checksums of parameters and of data.

    Raises:
        TrainingError: a thing differs; the message names it and the first process that differs.
    """
    for rank, others in enumerate(gather(dict(things))):
        for name, own in things.items():
            if own != (other := others[name]):
                raise TrainingError(f"processes do not agree: {name} is {own!r} here and {other!r} in process {rank}")
