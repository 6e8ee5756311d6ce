"""The input of all methods: a scene without unreadable images, the view to start from, the colour of the background."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from lsmgeo import data
from lsmgeo.data import PosedImages
from lsmgeo.errors import DataError, OptionError

__all__ = ["first_few", "named_colour", "open_scene"]

MOST_NAMED = 5


def open_scene(
    path: str | Path, view: int | str | None, out: str | Path
) -> tuple[PosedImages, int | None, tuple[str, ...]]:
    """Open a scene and find one of its views.

    Args:
        path: posed images in any form that `lsmgeo.data.open` reads.
        view: number or name of an image; None for none.
        out: the folder of the results, which must not contain the images.

    Returns:
        The scene without the images that cannot be read, the index of the view in it, and a note on the others.

    Raises:
        OptionError: there is no such view, it cannot be read, or ``out`` contains an image.
        DataError: the scene, or all of its images, cannot be read.
    """
    scene = data.open(path)
    name = scene.names[view] if isinstance(view, int) and 0 <= view < len(scene) else view
    if name is not None and name not in scene.names:
        expected = "" if isinstance(view, int) else " or be the name of an image"
        raise OptionError(f"view must lie in 0..{len(scene) - 1}{expected}; got {view!r}")
    if any(image.resolve().is_relative_to(Path(out).resolve()) for image in scene.paths):
        raise OptionError(f"out must not contain the images, which could be overwritten; got {os.fspath(out)!r}")
    scene, notes = _readable(scene)
    if name is not None and name not in scene.names:
        raise OptionError(f"view must be an image that can be read: {notes[0]}")
    return scene, None if name is None else scene.names.index(str(name)), notes


def named_colour(background: str | None) -> str | tuple[float, ...] | None:
    """A colour as `lsmgeo.classical.silhouettes` takes it, of a name or of three numbers separated by commas."""
    if background is None or "," not in background:
        return background
    try:
        return tuple(float(part) for part in background.split(","))
    except ValueError:
        raise OptionError(
            f"background must be black, white or three numbers such as 0.1,0.8,0.2; got {background!r}"
        ) from None


def _readable(scene: PosedImages) -> tuple[PosedImages, tuple[str, ...]]:
    """A scene without the images that cannot be read, and a note on those."""
    kept: list[int] = []
    reasons: list[str] = []
    for view in range(len(scene)):
        try:
            scene.load(view)
        except DataError as error:
            if len(scene) == len(reasons) + 1:
                raise
            reasons.append(str(error))
        else:
            kept.append(view)
    if not reasons:
        return scene, ()
    points = scene.points
    if points is not None:
        points = points._replace(observations=tuple(points.observations[view] for view in kept))
    fewer = replace(
        scene,
        names=tuple(scene.names[view] for view in kept),
        paths=tuple(scene.paths[view] for view in kept),
        cameras=scene.cameras.at(kept),
        points=points,
        lenses=None if scene.lenses is None else tuple(scene.lenses[view] for view in kept),
        depths=None if scene.depths is None else tuple(scene.depths[view] for view in kept),
    )
    return fewer, (f"Left out, unreadable: {first_few(reasons)}",)


def first_few(reasons: list[str]) -> str:
    """The first of the reasons, and the number of the others."""
    more = f"; and {len(reasons) - MOST_NAMED} more" if len(reasons) > MOST_NAMED else ""
    return "; ".join(reasons[:MOST_NAMED]) + more
