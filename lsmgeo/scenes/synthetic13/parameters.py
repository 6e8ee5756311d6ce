"""Random parameters of a shape: named numbers and choices, and a palette of materials."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lsmgeo.errors import OptionError
from lsmgeo.scenes.primitives import Material

__all__ = ["Palette", "Parameters", "random_palette"]


class Parameters:
    """Draws the parameters of a shape, and records each under its name.

    Attributes:
        choices: the discrete structure, by name.
        counts: the numbers of repeated parts, by name.
        numbers: the continuous parameters, by name.

    Example:
        >>> import numpy as np
        >>> from lsmgeo.scenes.synthetic13.parameters import Parameters
        >>> p = Parameters(np.random.default_rng(0))
        >>> height = p.uniform("height", 0.3, 0.5)
        >>> p.choice("legs", ("four", "sled")), p.count("slats", 3, 5)
        ('sled', 3)
        >>> p.numbers
        {'height': 0.427}
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self._generator = generator
        self.choices: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        self.numbers: dict[str, float] = {}

    def uniform(self, name: str, low: float, high: float) -> float:
        """A number between ``low`` and ``high``."""
        self._check_new(name)
        self.numbers[name] = float(self._generator.uniform(low, high))
        return self.numbers[name]

    def uniforms(self, names: Sequence[str], limits: Sequence[tuple[float, float]]) -> list[float]:
        """A number between the limits of each name, drawn in their order."""
        return [self.uniform(name, low, high) for name, (low, high) in zip(names, limits, strict=True)]

    def choice(self, name: str, options: tuple[str, ...]) -> str:
        """One of ``options``, with probability proportional to how often it is listed."""
        self._check_new(name)
        self.choices[name] = options[int(self._generator.integers(len(options)))]
        return self.choices[name]

    def count(self, name: str, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``, both included."""
        self._check_new(name)
        self.counts[name] = int(self._generator.integers(low, high + 1))
        return self.counts[name]

    def _check_new(self, name: str) -> None:
        # Two parameters with the same name would be recorded as one.
        if name in self.numbers or name in self.choices or name in self.counts:
            raise OptionError(f"Parameters: {name!r} has been drawn already")


class Palette(NamedTuple):
    """The materials of one shape by role; similar parts share one.

    Attributes:
        body: of the largest parts.
        trim: of parts that contrast with them.
        detail: of small parts.
        dark: of tyres, screens, window panes.
    """

    body: Material
    trim: Material
    detail: Material
    dark: Material


def random_palette(generator: np.random.Generator, textured: float = 0.12) -> Palette:
    """Four materials in two to four colours; all but the dark one are textured with probability ``textured``."""
    body, trim, detail = (_colour(generator) for _ in range(3))
    if generator.random() < 0.3:
        detail = trim
    if generator.random() < 0.15:
        trim = body
    shade = float(generator.uniform(0.06, 0.22))
    materials = [_material(generator, colour, textured) for colour in (body, trim, detail)]
    return Palette(materials[0], materials[1], materials[2], Material((shade, shade, 1.1 * shade)))


def _colour(generator: np.random.Generator) -> tuple[float, float, float]:
    """The colour of a paint, a wood or a grey; bright enough for visible shading."""
    kind, hue, first, second = generator.random(4)
    if kind < 0.5:
        red, green, blue = colorsys.hsv_to_rgb(hue, 0.35 + 0.55 * first, 0.6 + 0.4 * second)
    elif kind < 0.75:
        red, green, blue = colorsys.hsv_to_rgb(0.05 + 0.06 * hue, 0.35 + 0.35 * first, 0.5 + 0.4 * second)
    else:
        red, green, blue = colorsys.hsv_to_rgb(hue, 0.08 * first, 0.45 + 0.55 * second)
    return float(red), float(green), float(blue)


def _material(generator: np.random.Generator, colour: tuple[float, float, float], textured: float) -> Material:
    draw, which, pitch = generator.random(3)
    second = _colour(generator)
    seed = int(generator.integers(2**31))
    if draw >= textured:
        return Material(colour)
    texture = ("stripes", "checker", "waves")[int(3 * which)]
    return Material(colour, texture, second, float(6.0 + 14.0 * pitch), seed)
