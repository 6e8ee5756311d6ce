"""Reconstruction by the visual hull: from silhouettes to a surface in the colours of the images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lsmgeo import functional
from lsmgeo._checks import check_choice, check_whole
from lsmgeo.cameras import CameraTensors, crop, project, resize
from lsmgeo.classical.gathering import fitted, resized
from lsmgeo.classical.silhouettes import signed_distance, silhouettes
from lsmgeo.classical.surface import drop_specks, extract_mesh
from lsmgeo.classical.tsdf import voxel_side
from lsmgeo.classical.visual_hull import RULES, default_grid, visual_hull
from lsmgeo.data.meshes import Mesh
from lsmgeo.errors import OptionError
from lsmgeo.reconstruct.scene_input import named_colour
from lsmgeo.reconstruct.write_results import Results, ViewResult, mesh_facts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lsmgeo.data import PosedImages
    from lsmgeo.grids import VoxelGrid

__all__ = ["colour_vertices", "hull_depth", "hull_results", "silhouette_iou"]

# Planes along a ray for every voxel that it crosses, and sites per slab.
PLANES_PER_VOXEL, SITES = 1.0, 1 << 24
# A vertex is visible up to so many voxels behind the depth of the hull.
BEHIND = 2.0
SPECK_FACES = 20


def hull_results(
    scene: PosedImages,
    view: int | None,
    title: str,
    *,
    rule: str,
    masks: str | None,
    background: str | None,
    resolution: int,
    size: int,
) -> Results:
    """Carve the visual hull of all silhouettes and colour its surface.

    Depth is where a ray first meets the hull, confidence is the silhouette.

    Raises:
        OptionError: there are no silhouettes, one is empty, or nothing projects into all of them.
        DataError: an image or a mask cannot be read.
    """
    who = "reconstruct"
    check_choice(who, "rule", rule, RULES)
    check_whole(who, "resolution", resolution, 8, 1024)
    check_whole(who, "size", size, 16)
    try:
        found = silhouettes(scene, folder=masks, background=named_colour(background))
    except OptionError as error:
        if "no alpha" not in str(error):
            raise
        raise OptionError(f"{error}: --masks FOLDER, or --background white, black or R,G,B") from None
    for number, mask in enumerate(found):
        if not bool(mask.any()):
            raise OptionError(f"{who}: the silhouette of view {number} ({scene.names[number]}) is empty")
    shape = fitted(scene.size(0), size)
    cameras = resize(scene.cameras, *shape)
    small_masks = torch.stack([resized(mask[None].float(), shape)[0] > 0.5 for mask in found])
    grid = default_grid(small_masks, cameras, resolution)
    border = small_masks.clone()
    border[:, 1:-1, 1:-1] = False
    # An object that is cut off by the border of an image continues beyond it.
    outside = "unknown" if bool(border.any()) else "empty"
    soft = torch.stack([signed_distance(mask) for mask in small_masks]) if rule == "all" else small_masks.float()
    level = {"all": 0.0, "mean": 0.75}[rule]
    hull = visual_hull(soft, cameras, grid, rule=rule, threshold=level, outside=outside)
    if not bool(hull.occupancy.any()):
        raise OptionError(f"{who}: no voxel is within the silhouettes; rule='mean' tolerates wrong ones")
    views, ious = [], []
    for number, mask in enumerate(tqdm(small_masks, desc="hull", unit="view", disable=None)):
        camera, image = cameras.at(number), resized(scene.load(number), shape)
        depth = hull_depth(hull.occupancy, grid, camera)
        ious.append(silhouette_iou(depth, mask))
        numbers = (("IoU of silhouette and hull", f"{ious[-1]:.3f}"),)
        views.append(ViewResult(number, image, camera, depth, mask.float(), "silhouette", numbers))
    mesh = drop_specks(extract_mesh(hull.support, grid, level=level), SPECK_FACES)
    mesh = colour_vertices(mesh, views, BEHIND * voxel_side(grid))
    z, y, x = hull.occupancy.shape
    volume = 100 * float(hull.occupancy.float().mean())
    facts = (
        ("scene", f"{len(scene)} images, {scene.source}"),
        ("hull", f"of {len(ious)} silhouettes, {x} x {y} x {z} voxels (x, y, z), {volume:.1f} % inside"),
        ("silhouettes", f"IoU with those of the hull {np.mean(ious):.3f} on average, {min(ious):.3f} at least"),
        *mesh_facts(mesh),
    )
    notes: tuple[str, ...] = ()
    worst = int(np.argmin(ious))
    if ious[worst] < 0.8:
        notes = (
            f"The silhouette of {scene.names[worst]} and the hull have an IoU of only {ious[worst]:.2f}. Background in "
            "the silhouette does no harm; where a part of the object is missing from the hull, another silhouette or a "
            "camera is wrong, which --rule mean tolerates.",
        )
    views.sort(key=lambda one: view is not None and one.view != view)
    return Results(title, facts, notes, tuple(views), mesh=mesh)


def silhouette_iou(depth: Tensor, mask: Tensor) -> float:
    """Intersection over union of the pixels with depth (h, w) and a silhouette."""
    return float(((depth > 0) & mask).sum()) / max(1, int(((depth > 0) | mask).sum()))


def hull_depth(occupancy: Tensor, grid: VoxelGrid, camera: CameraTensors) -> Tensor:
    """Camera z where the rays of a camera first meet occupied voxels, to about a voxel.

    The occupancy is (D, H, W) bool; the result (h, w) float32, of the size of the camera, 0 where a ray meets none.
    """
    height, width = int(torch.as_tensor(camera.height)), int(torch.as_tensor(camera.width))
    depth = torch.zeros(height, width)
    index = occupancy.nonzero()
    if not len(index):
        return depth
    # The corners of the box of occupied voxels bound their depths and pixels.
    ends = torch.stack([index.amin(0).flip(0) - 0.5, index.amax(0).flip(0) + 0.5]).double()
    T = grid.world_from_lattice.double()
    corners = torch.cartesian_prod(*ends.unbind(1)) @ T[:3, :3].T + T[:3, 3]
    pixels, z = (part[0, 0].numpy() for part in project(camera.at(None), corners[None])[:2])
    # By the shortest side, so that no flat voxel is skipped.
    step = float(T[:3, :3].norm(dim=0).min()) / PLANES_PER_VOXEL
    nearest, farthest = float(z.min()), float(z.max())
    start = max(nearest, step) + step / 2
    top, left, bottom, right = 0, 0, height, width
    if nearest > step:
        (x0, y0), (x1, y1) = (end.astype(int).tolist() for end in (np.floor(pixels.min(0)), np.ceil(pixels.max(0))))
        top, left, bottom, right = max(0, y0), max(0, x0), min(height, y1 + 1), min(width, x1 + 1)
    if top >= bottom or left >= right or farthest <= start:
        return depth
    window = crop(camera.at(None), top, left, bottom - top, right - left)
    size = bottom - top, right - left
    seen = depth[top:bottom, left:right]
    volume = occupancy[None, None].float()
    planes = torch.arange(start, farthest, step, dtype=torch.float64)
    for slab in planes.split(max(1, SITES // (size[0] * size[1]))):
        maps, _ = functional.plane_sweep_project(volume, window, grid, slab, size, mode="nearest")
        hit = maps[0, 0] > 0.5
        first = slab.float()[hit.to(torch.uint8).argmax(0)]
        seen.copy_(torch.where((seen == 0) & hit.any(0), first, seen))
    return depth


def colour_vertices(mesh: Mesh, views: Sequence[ViewResult], behind: float) -> Mesh:
    """A mesh whose vertices have the mean of their colours in the images in which they are visible.

    The weight of a view is the fourth power of the cosine between its ray and the normal of the surface.
    A vertex is visible up to a distance ``behind`` the depth of the view, in world units.
    """
    import trimesh

    if not len(mesh.vertices):
        return mesh
    normals = torch.tensor(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals).float()
    points = torch.from_numpy(mesh.vertices).float()[None]
    total, weight = torch.zeros(3, len(mesh.vertices)), torch.zeros(len(mesh.vertices))
    for view in views:
        cameras = view.camera.at(None)
        # With "zeros" the outer half pixel would fade to black.
        colours, _ = functional.unproject_points(view.image[None, None], cameras, points, padding_mode="border")
        depth, visible = functional.unproject_points(
            view.depth[None, None, None], cameras, points, mode="nearest", augment=("depth", "direction")
        )
        known, z, *ray = depth[0, 0]
        cosine = -(torch.stack(ray, -1) * normals).sum(-1)
        seen = visible[0, 0] & (known > 0) & (z < known + behind)
        # Never 0, so that surfaces that are seen only at a grazing angle have a colour.
        each = torch.where(seen, cosine.clamp_min(0.03) ** 4, 0.0)
        total += each * colours[0, 0]
        weight += each
    mean = torch.where(weight > 0, total / weight.clamp_min(1e-12), 0.7)
    rounded = (mean.T * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    return Mesh(mesh.vertices, mesh.faces, colours=rounded)
