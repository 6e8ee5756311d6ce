"""Silhouettes of the object in images: from alpha, from mask files, or by the colour of the background."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_choice, check_number, describe
from lsmgeo.data import PosedImages
from lsmgeo.data.images import read_cut_out
from lsmgeo.errors import DataError, OptionError, ShapeError

__all__ = ["mask_folder", "signed_distance", "silhouettes"]

# Folders of masks that are found beside the images, or beside their folder.
FOLDERS = ("masks", "mask", "silhouettes", "derived_silhouettes")
ENDINGS = (".png", ".jpg", ".jpeg")
COLOURS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
# Of the background: the largest difference of a channel; components below this fraction of the pixels are noise.
TOLERANCE, SPECK_FRACTION = 0.1, 5e-4


def silhouettes(
    scene: PosedImages,
    views: Sequence[int] | None = None,
    *,
    folder: str | os.PathLike[str] | None = None,
    background: str | Sequence[float] | None = None,
) -> list[Tensor]:
    """The pixels of posed images that show the object.

    The first of these that applies: the files of a ``folder``; the colour of the ``background``; the alpha of the
    images, if they are cut out; a folder named masks, mask, silhouettes or derived_silhouettes beside the images or
    beside their folder.

    A mask file has the name (the ending may differ, and ``name.png.png`` is accepted) and the size of its image; a
    pixel is on the object if it is brighter than half, and opaque. By colour, a pixel is on the object if a channel
    differs from the background by more than 0.1; then components and holes smaller than 0.05 % of the image are
    removed. Parts of the object in the colour of the background are lost.

    Args:
        scene: posed images.
        views: indices; all by default.
        folder: of mask files.
        background: "black", "white" or (r, g, b) in [0, 1].

    Returns:
        (H, W) bool for every view, undistorted as the images are.

    Raises:
        OptionError: no silhouettes and no background; a view that does not exist; both a folder and a background.
        DataError: a mask or an image is missing, damaged or not of the size of its camera.
    """
    who = "silhouettes"
    chosen = range(len(scene)) if views is None else views
    for view in chosen:
        if not 0 <= view < len(scene):
            raise OptionError(f"{who}: views must be numbers from 0 to {len(scene) - 1}; got {view}")
    if folder is not None and background is not None:
        raise OptionError(f"{who}: give a folder of masks or a background, not both")
    if background is not None:
        colour = _colour(who, background)
        return [_by_background(scene.load(view), colour) for view in chosen]
    if folder is None and scene.cut_out:
        masks = [scene.load_mask(view) for view in chosen]
        return [mask for mask in masks if mask is not None]
    found = mask_folder(scene) if folder is None else Path(folder)
    if found is None:
        raise OptionError(
            f"{who}: the images have no alpha, and there is no folder named {', '.join(FOLDERS)} beside them; "
            "name a folder of masks, or give the colour of the background"
        )
    return [_from_file(scene, view, found) for view in chosen]


def mask_folder(scene: PosedImages) -> Path | None:
    """The folder of masks beside the images of a scene, or beside their folder; None without."""
    beside = scene.paths[0].parent
    for place in (beside, beside.parent):
        for name in FOLDERS:
            folder = place / name
            if folder.is_dir() and all(_file_of(path, folder) is not None for path in scene.paths):
                return folder
    return None


def signed_distance(mask: Tensor) -> Tensor:
    """Distance of every pixel to the contour of a silhouette, in pixels, positive on the object.

    The interpolated distance is 0 halfway between the centres of a pixel on the object and a neighbour off it. From the
    support of a `lsmgeo.classical.visual_hull` of distances, with rule "all" and threshold 0,
    `lsmgeo.classical.extract_mesh` makes a smooth surface.

    Args:
        mask: (h, w) bool.

    Returns:
        (h, w) float32; if the mask is constant, plus or minus the diagonal of the image.

    Example:
        >>> import torch
        >>> from lsmgeo.classical import signed_distance
        >>> signed_distance(torch.tensor([[False, False, True, True, True, False]]))
        tensor([[-1.5000, -0.5000,  0.5000,  1.5000,  0.5000, -0.5000]])
    """
    who = "signed_distance"
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.dim() != 2:
        raise ShapeError(f"{who}: mask must be a bool tensor (h, w); got {describe(mask)}")
    import cv2

    on = mask.cpu().numpy()
    if on.all() or not on.any():
        far = float(np.hypot(*on.shape))
        return torch.full(on.shape, far if on.all() else -far)
    within, beyond = (
        cv2.distanceTransform(side.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for side in (on, ~on)
    )
    return torch.from_numpy(np.where(on, within - 0.5, 0.5 - beyond).astype(np.float32))


def _colour(who: str, background: str | Sequence[float]) -> tuple[float, float, float]:
    if isinstance(background, str):
        return COLOURS[check_choice(who, "background", background, tuple(COLOURS))]
    values = tuple(background) if isinstance(background, Sequence) else ()
    if len(values) != 3:
        raise OptionError(f"{who}: background must be 'black', 'white' or (r, g, b); got {describe(background)}")
    red, green, blue = (check_number(who, "background", value, "numbers in [0, 1]", 0, 1) for value in values)
    return red, green, blue


def _by_background(image: Tensor, colour: tuple[float, float, float]) -> Tensor:
    away = (image - image.new_tensor(colour)[:, None, None]).abs().amax(0)
    mask = (away > TOLERANCE).numpy()
    least = SPECK_FRACTION * mask.size
    mask = _without_specks(mask, least)
    return torch.from_numpy(~_without_specks(~mask, least))


def _without_specks(mask: np.ndarray, least: float) -> np.ndarray:
    import cv2

    _, label, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return np.asarray(large[label])


def _file_of(image: Path, folder: Path) -> Path | None:
    names = [image.stem + ending for ending in ENDINGS] + [image.name + ".png"]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _from_file(scene: PosedImages, view: int, folder: Path) -> Tensor:
    path = _file_of(scene.paths[view], folder)
    if path is None:
        raise DataError(folder, f"holds no mask of {scene.paths[view].name}")
    pixels = read_cut_out(path, scene.size(view))
    mask = ((pixels[..., :3].max(-1) >= 128) & (pixels[..., 3] >= 128)).astype(np.uint8)
    lens = None if scene.lenses is None else scene.lenses[view]
    if lens is not None:
        mask = lens.straighten(mask, nearest=True)
    return torch.from_numpy(mask > 0)
