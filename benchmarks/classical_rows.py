"""One line of the table of the classical machine: what was measured, and the figure it was to reach."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["Row"]


class Row(NamedTuple):
    """A figure of the table.

    Attributes:
        section: what the figure is of: a set, or a part of the machine.
        what: the figure, with its statistic and what it is taken over.
        measured: with its unit.
        goal: what it was to reach; empty where it is printed beside the others.
        reached: whether it does; None where there is no goal.
    """

    section: str
    what: str
    measured: str
    goal: str
    reached: bool | None
