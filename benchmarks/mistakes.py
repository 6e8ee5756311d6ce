"""Common errors in cameras, planted in data; independent of the code that finds them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch

from lsmgeo import VoxelGrid
from lsmgeo.data import Calibration, PosedImages, Voxels

HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
SHIFT = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])

POSES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    # Camera-to-world used as world-to-camera.
    "poses inverted": np.linalg.inv,
    # Cameras that look along -z with y up, used as ones that look along z with y down.
    "OpenGL axes": lambda pose: HALF_TURN @ pose,
    # Cameras and world with y in the opposite direction: a left-handed system used as a right-handed one.
    "y flipped": lambda pose: MIRROR @ pose @ MIRROR,
}
INTRINSICS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    # Half-integer pixel centres used as integer ones.
    "half a pixel": lambda K: K + SHIFT,
    # K of images of half the size.
    "K of another resolution": lambda K: np.diag([0.5, 0.5, 1.0]) @ K,
}


def _another(count: int) -> np.ndarray:
    """A permutation without fixed points, for more than three."""
    rng = np.random.default_rng(0)
    order = np.arange(count)[::-1] if count < 4 else rng.permutation(count)
    while count >= 4 and (order == np.arange(count)).any():
        order = rng.permutation(count)
    return order


def plants(content: Any) -> dict[str, Callable[[], Any]]:
    """For each error that applies to the data, by name, a call that returns the data with it."""
    if isinstance(content, PosedImages):
        made: dict[str, Callable[[], Any]] = {}
        for name, change in (POSES | INTRINSICS).items():
            field = "cam_from_world" if name in POSES else "intrinsics"
            made[name] = lambda field=field, change=change: _with_cameras(content, field, change)
        return made | {"frames shuffled": lambda: _shuffled(content)}
    if isinstance(content, Voxels):
        side = content.grid.world_from_lattice[0, 0].item() * content.occupancy.shape[0]
        centred = VoxelGrid(content.occupancy.shape, -side / 2, side / 2)
        return {
            "voxels placed otherwise": lambda: content._replace(grid=centred),
            "axes of the voxels exchanged or flipped": lambda: content._replace(
                occupancy=content.occupancy.permute(2, 1, 0).contiguous()
            ),
        }
    if isinstance(content, Calibration):
        made = {name: lambda change=change: _with_views(content, change) for name, change in POSES.items()}
        made |= {name: lambda change=change: _with_lenses(content, change) for name, change in INTRINSICS.items()}
        return made | {"frames shuffled": lambda: _shuffled_pairs(content)}
    raise TypeError(f"no errors are defined for {type(content)}")


def _with_cameras(scene: PosedImages, field: str, change: Callable[[np.ndarray], np.ndarray]) -> PosedImages:
    matrices = getattr(scene.cameras, field).double().numpy()
    changed = torch.from_numpy(np.stack([change(matrix) for matrix in matrices]))
    return replace(scene, cameras=scene.cameras._replace(**{field: changed}))


def _shuffled(scene: PosedImages) -> PosedImages:
    """Images and their depth with the cameras of other images of the same size; other sizes would raise an error."""
    sizes = [scene.size(view) for view in range(len(scene))]
    alike = np.array([view for view, size in enumerate(sizes) if size == max(sizes, key=sizes.count)])
    order = np.arange(len(scene))
    order[alike] = alike[_another(len(alike))]
    names, paths = ([items[index] for index in order] for items in (scene.names, scene.paths))
    depths = None if scene.depths is None else tuple(scene.depths[index] for index in order)
    return replace(scene, names=tuple(names), paths=tuple(paths), depths=depths)


def _with_lenses(calibration: Calibration, change: Callable[[np.ndarray], np.ndarray]) -> Calibration:
    lenses = {name: replace(lens, intrinsics=change(lens.intrinsics)) for name, lens in calibration.lenses.items()}
    return replace(calibration, lenses=lenses)


def _with_views(calibration: Calibration, change: Callable[[np.ndarray], np.ndarray]) -> Calibration:
    lenses = {}
    for name, lens in calibration.lenses.items():
        rows = []
        for row in [] if lens.views is None else lens.views:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(row[:3])[0], row[3:]
            pose = change(pose)
            rows.append(np.concatenate([cv2.Rodrigues(pose[:3, :3])[0][:, 0], pose[:3, 3]]))
        lenses[name] = replace(lens, views=np.stack(rows)) if rows else lens
    return replace(calibration, lenses=lenses)


def _shuffled_pairs(calibration: Calibration) -> Calibration:
    """The second camera's images in another order."""
    first, second = calibration.images
    return replace(calibration, images=(first, tuple(second[index] for index in _another(len(second)))))
