"""Visual hulls of a real temple and of synthetic shapes: ``python -m benchmarks.classical --only hull``.

The temple's hull is carved in a box told from its silhouettes alone. To compare, its occupancy is projected back into
every photograph by our own plane sweep (the nearest voxel at depths a voxel apart, the largest along each ray) and laid
over the silhouette that was given.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.classical_rows import Row
from lsmgeo import VoxelGrid, functional, scenes
from lsmgeo.cameras import CameraTensors, select, stack
from lsmgeo.classical import hull_box, silhouettes, visual_hull
from lsmgeo.classical.tsdf import voxel_side
from lsmgeo.data import PosedImages, open_scene
from lsmgeo.metrics import VoxelIoU
from lsmgeo.scenes import synthetic13

__all__ = ["rows"]

RESOLUTION = 192
# As the publisher states it, metres.
PUBLISHED = np.array([(-0.073568, 0.021728, -0.012445), (0.028855, 0.181892, 0.062736)])
LEAST_IOU, FARTHEST = 0.88, 0.020
# Sites that are projected back at once.
SITES = 1 << 24
# Mean IoU of the thirteen categories with 1 to 4 views; Kar, Haene and Malik 2017, table 1.
PAPER = (18.0, 36.9, 47.0, 52.4)
SHAPES_OF_A_CATEGORY, SIZE = 10, 224


def project_back(occupancy: Tensor, grid: VoxelGrid, camera: CameraTensors, size: tuple[int, int]) -> Tensor:
    """The silhouette of voxels, (h, w) bool."""
    T = grid.world_from_lattice
    counts = torch.tensor(grid.shape, dtype=torch.float64).flip(0)
    corners = torch.cartesian_prod(*(torch.tensor([-0.5, float(count) - 0.5], dtype=torch.float64) for count in counts))
    E = camera.cam_from_world.double()
    depth = (corners @ T[:3, :3].T + T[:3, 3]) @ E[2, :3] + E[2, 3]
    near, far, step = float(depth.min()), float(depth.max()), voxel_side(grid)
    planes = torch.arange(near, far + step, step)
    drawn = torch.zeros(size, dtype=torch.bool)
    for some in planes.split(max(1, SITES // (size[0] * size[1]))):
        maps, _ = functional.plane_sweep_project(
            occupancy[None, None].float(), stack([camera]), grid, some, size, mode="nearest"
        )
        drawn |= (maps[0, 0] > 0.5).any(0)
    return drawn


def overlap(first: Tensor, second: Tensor) -> float:
    return float((first & second).sum()) / max(1, int((first | second).sum()))


def bounds(occupancy: Tensor, grid: VoxelGrid) -> np.ndarray:
    """(2, 3): the box around occupied voxels, of a grid along the axes."""
    index = occupancy.nonzero().flip(1).double()
    T = grid.world_from_lattice
    ends = torch.stack((index.amin(0) - 0.5, index.amax(0) + 0.5))
    return np.asarray(ends @ T[:3, :3].T + T[:3, 3])


def temple(scene: PosedImages) -> list[Row]:
    masks = silhouettes(scene)
    given = torch.stack(masks)
    grid = VoxelGrid(RESOLUTION, *hull_box(masks, scene.cameras))
    found = []
    for rule, name in (("all", "strict intersection"), ("mean", "mean above 0.75")):
        hull = visual_hull(given, scene.cameras, grid, rule=rule)
        drawn = [
            project_back(hull.occupancy, grid, select(scene.cameras, 0, view), scene.size(view))
            for view in range(len(scene))
        ]
        scores = [overlap(one, mask) for one, mask in zip(drawn, masks, strict=True)]
        away = 1000 * (bounds(hull.occupancy, grid) - PUBLISHED)
        far = float(np.abs(away).max())
        strict = rule == "all"
        section = f"Visual hull, temple, {RESOLUTION}^3"
        found += [
            Row(
                section,
                f"{name}: IoU of its silhouettes with those given, mean of {len(scene)} views",
                f"{np.mean(scores):.4f} (least {min(scores):.4f})",
                f">= {LEAST_IOU}" if strict else "",
                bool(np.mean(scores) >= LEAST_IOU) if strict else None,
            ),
            Row(
                section,
                f"{name}: its box from the published one, six faces",
                f"most {far:.1f} mm (lower {', '.join(f'{item:+.1f}' for item in away[0])}; "
                f"upper {', '.join(f'{item:+.1f}' for item in away[1])})",
                f"<= {1000 * FARTHEST:.0f} mm" if strict else "",
                far <= 1000 * FARTHEST if strict else None,
            ),
        ]
    return found


def synthetic() -> list[Row]:
    """With 1 to 4 views of the paper's cameras, 32^3 over the cube, by both rules."""
    grid = VoxelGrid(32)
    dark = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(3))
    rules = {"mean above 0.75": "mean", "strict intersection": "all"}
    scores = {(name, views): VoxelIoU() for name in rules for views in range(1, 5)}
    for index in range(13 * SHAPES_OF_A_CATEGORY):
        shape = synthetic13.shape(0, index)
        cameras = stack([synthetic13.views(0, index, 4, SIZE)])
        masks = scenes.render([shape.scene], cameras, dark).mask[0]
        true = scenes.voxels([shape.scene], grid)
        for (name, views), score in scores.items():
            some = stack([select(select(cameras, 0, 0), 0, view) for view in range(views)])
            hull = visual_hull(masks[:views], some, grid, rule=rules[name])
            score.update(hull.occupancy[None].float(), true, [shape.category])
    section = f"Visual hull, synthetic-13, {SHAPES_OF_A_CATEGORY} shapes a category, 32^3"
    found = []
    for name in rules:
        values = [100 * float(scores[name, views].compute().mean) for views in range(1, 5)]
        gains, published = np.diff(values), np.diff(PAPER)
        rises = bool((gains > 0).all() and (np.diff(gains) < 0).all())
        paper = ", ".join(f"{value:.1f}" for value in PAPER)
        is_paper = name.startswith("mean")
        found.append(
            Row(
                section,
                f"{name}: mean IoU of the categories with 1, 2, 3, 4 views (the paper, on ShapeNet: {paper})",
                f"{', '.join(f'{value:.1f}' for value in values)}; gains {', '.join(f'{g:.1f}' for g in gains)} "
                f"(paper {', '.join(f'{g:.1f}' for g in published)})",
                "rises, ever less" if is_paper else "",
                rises if is_paper else None,
            )
        )
    return found


def rows(root: Path | None = None) -> list[Row]:
    """The lines of the table; the temple only where the folder of sets is given."""
    real = temple(open_scene(root / "middlebury_temple")) if root is not None else []
    return [*real, *synthetic()]
