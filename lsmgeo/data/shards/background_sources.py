"""Backgrounds for the images of shards, which contain only the objects."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from lsmgeo._checks import check_number, describe
from lsmgeo.data.images import SUFFIXES, read_image
from lsmgeo.data.read_files import path_inside
from lsmgeo.errors import DataError, OptionError

__all__ = ["Background", "BackgroundError", "BackgroundSource", "make_background"]


class BackgroundError(DataError):
    """A background cannot be read; the shape itself is not at fault."""


BackgroundSource: TypeAlias = Callable[[np.random.Generator | None, int, int], np.ndarray]
"""Draws a background from a generator, height and width: (3, H, W) or (3, 1, 1) float32 in [0, 1]."""
Background: TypeAlias = str | os.PathLike[str] | Sequence[float] | BackgroundSource


def _plain(
    colour: tuple[float, float, float], generator: np.random.Generator | None, height: int, width: int
) -> np.ndarray:
    return np.array(colour, np.float32).reshape(3, 1, 1)


def _analytic(generator: np.random.Generator | None, height: int, width: int) -> np.ndarray:
    from lsmgeo import scenes

    if generator is None:
        raise OptionError("background: 'random' needs a generator")
    return np.asarray(scenes.background(generator, height, width), np.float32)


def _random_crop(
    folder: Path, names: tuple[str, ...], generator: np.random.Generator | None, height: int, width: int
) -> np.ndarray:
    """A crop of a random image, anywhere in it, half to all of the largest size that fits, resized to (H, W)."""
    from PIL import Image

    if generator is None:
        raise OptionError("background: a folder of images needs a generator")
    name = names[int(generator.random() * len(names))]
    pixels = read_image(path_inside(folder, name, folder))
    scale = min(pixels.shape[0] / height, pixels.shape[1] / width) * (0.5 + 0.5 * generator.random())
    tall, wide = (max(1, round(side * scale)) for side in (height, width))
    top = int(generator.random() * (pixels.shape[0] - tall + 1))
    left = int(generator.random() * (pixels.shape[1] - wide + 1))
    crop = Image.fromarray(pixels[top : top + tall, left : left + wide])
    resized = np.asarray(crop.resize((width, height), Image.Resampling.BILINEAR))
    return resized.transpose(2, 0, 1).astype(np.float32) / np.float32(255)


def make_background(background: Background) -> BackgroundSource:
    """Make the source of the backgrounds that an option names.

    Args:
        background: "white"; an RGB colour in [0, 1]; "random" for analytic ones (`lsmgeo.scenes.background`); a folder
            of PNG or JPEG images, for random crops of them; or the result of an earlier call.

    Raises:
        OptionError: any other value.
        DataError: the folder cannot be read or has no image.

    Example:
        >>> make_background("white")(None, 48, 64).ravel().tolist()
        [1.0, 1.0, 1.0]
    """
    if background == "white":
        return partial(_plain, (1.0, 1.0, 1.0))
    if background == "random":
        return _analytic
    if isinstance(background, (str, os.PathLike)):
        return _folder(Path(background))
    if callable(background):
        return background
    try:
        values = [check_number("background", "a colour", value, "three numbers in [0, 1]") for value in background]
    except TypeError:
        values = []
    if len(values) != 3 or not all(0 <= value <= 1 for value in values):
        raise OptionError(
            f"background must be 'white', 'random', three numbers in [0, 1] or a folder; got {describe(background)}"
        )
    return partial(_plain, (values[0], values[1], values[2]))


def _folder(folder: Path) -> BackgroundSource:
    try:
        names = tuple(sorted(entry.name for entry in os.scandir(folder) if entry.name.lower().endswith(SUFFIXES)))
    except (OSError, ValueError) as error:
        raise DataError(folder, f"is not a folder of backgrounds, 'white' or 'random' ({error})") from error
    if not names:
        raise DataError(folder, "holds no PNG or JPEG image")
    return partial(_random_crop, folder, names)
