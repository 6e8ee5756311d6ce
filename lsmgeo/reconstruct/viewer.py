"""The interactive model and its cameras as a self-contained HTML document.

three.js draws, from the page that comes with trimesh; this file adds the poses and a few controls.
"""

from __future__ import annotations

import json
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np

from lsmgeo.cameras import centers
from lsmgeo.data.meshes import Mesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trimesh.path import Path3D

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.reconstruct.write_results import Results

__all__ = ["make_viewer"]

MOST_FACES, MOST_POINTS = 250_000, 200_000
# The largest length of a frustum, where the radius of the model is 1, and its length as a fraction of the distance to
# the nearest camera.
LONGEST_FRUSTUM, FRUSTUM_OF_GAP = 0.35, 0.6
USED, UNUSED, REFERENCE = (31, 119, 180), (170, 170, 170), (214, 39, 40)
PLAIN = (176, 180, 188)
EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [5, 6], [6, 7]])


def make_viewer(results: Results, cameras: CameraTensors) -> str:
    """An HTML document with an interactive model, at first from the camera of the first view.

    Convention:
        In the document the y axis of the first camera points up, the centre of the model is the origin, and about 97 %
        of it are within a radius of 1.

    Args:
        results: with a surface, or points, or both. Surfaces are reduced to 250,000 faces, points to 200,000.
        cameras: leading shape (V,), drawn in colour if their images were used.
    """
    import trimesh
    from trimesh.viewer.notebook import scene_to_html

    K, E = (np.asarray(part.double().numpy()) for part in cameras[:2])
    sizes = np.stack([np.broadcast_to(np.asarray(size), len(K)) for size in cameras[2:]], -1)
    used = [*(one.view for one in results.views), *results.used]
    surface, points = results.mesh, results.points
    seen = points if surface is None or not len(surface.vertices) else surface.vertices
    low, high = np.percentile(seen, (3, 97), axis=0)
    middle = (low + high) / 2
    radius = float(np.quantile(np.linalg.norm(seen - middle, axis=1), 0.97)) or 1.0
    # The axes of OpenGL and three.js: y up, looking along -z.
    rotation = np.diag([1.0, -1.0, -1.0]) @ E[used[0], :3, :3]

    def placed(points: np.ndarray) -> np.ndarray:
        return (points - middle) @ rotation.T / radius

    origins = placed(centers(cameras).double().numpy())
    scene = trimesh.Scene()
    if surface is not None and len(surface.faces):
        thin = _thinned(surface)
        colours = np.broadcast_to(PLAIN, thin.vertices.shape) if thin.colours is None else thin.colours
        mesh = trimesh.Trimesh(placed(thin.vertices), thin.faces, process=False, vertex_colors=_opaque(colours))
        scene.add_geometry(mesh, node_name="mesh", geom_name="mesh")
    if len(points):
        chosen = np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]
        cloud = trimesh.PointCloud(placed(points[chosen]), colors=_opaque(results.colours[chosen]))
        scene.add_geometry(cloud, node_name="points", geom_name="points")
    scene.add_geometry(_frusta(used, K, E, sizes, origins, rotation), node_name="cameras", geom_name="cameras")
    # The script places the camera; without one trimesh would choose a pose.
    scene.set_camera(angles=(0, 0, 0), distance=3, center=(0, 0, 0))
    poses = []
    for view in range(len(K)):
        axes = E[view, :3, :3] @ rotation.T  # rows: right, down, forward
        halves = 0.5 * sizes[view] / (K[view, 1, 1], K[view, 0, 0])  # tangents of half the fields of view
        poses.append(np.concatenate([origins[view], axes[2], -axes[1], halves]).round(6).tolist())
    settings = {"first": used[0], "poses": poses, "shaded": surface is not None and surface.colours is None}
    script = files("lsmgeo.reconstruct").joinpath("viewer.js").read_text("utf-8")
    style = files("lsmgeo.reconstruct").joinpath("viewer.css").read_text("utf-8")
    added = f"<style>{style}</style><script>const settings = {json.dumps(settings)};\n{script}</script></body>"
    before, _, after = scene_to_html(scene).rpartition("</body>")
    return before + added + after


def _opaque(colours: np.ndarray) -> np.ndarray:
    return np.concatenate([colours, np.full((len(colours), 1), 255)], 1).astype(np.uint8)


def _frusta(
    used: Sequence[int], K: np.ndarray, E: np.ndarray, sizes: np.ndarray, origins: np.ndarray, rotation: np.ndarray
) -> Path3D:
    """Pyramids as lines, with a triangle above the top of the image."""
    from trimesh.path import Path3D
    from trimesh.path.entities import Line

    length = LONGEST_FRUSTUM
    if len(origins) > 1:
        from scipy.spatial import cKDTree

        # Cameras at one position have no gap.
        gaps = cKDTree(np.unique(origins.round(6), axis=0)).query(origins, k=2)[0].max(1)
        length = float(np.clip(FRUSTUM_OF_GAP * np.median(gaps), 0.1, LONGEST_FRUSTUM))
    lines, colours = [], []
    # The first is drawn last: it is visible even if another is at the same position.
    for view in sorted(range(len(origins)), key=lambda view: view == used[0]):
        (height, width), origin = sizes[view], origins[view]
        left, right, top, bottom = -0.5, width - 0.5, -0.5, height - 0.5
        roof = top - 0.25 * height
        corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
        corners += [(0.7 * left + 0.3 * right, top), ((left + right) / 2, roof), (0.3 * left + 0.7 * right, top)]
        rays = np.array([(x, y, 1) for x, y in corners]) @ np.linalg.inv(K[view]).T
        rays /= max(1.0, float(np.abs(rays[:4, :2]).max()))
        nodes = np.concatenate([origin[None], origin + length * rays @ E[view, :3, :3] @ rotation.T])
        lines.append(nodes[EDGES])
        colour = REFERENCE if view == used[0] else USED if view in used else UNUSED
        colours.append(np.tile((*colour, 255), (len(EDGES), 1)))
    entities = [Line([2 * index, 2 * index + 1]) for index in range(len(lines) * len(EDGES))]
    return Path3D(entities, np.concatenate(lines).reshape(-1, 3), process=False, colors=np.concatenate(colours))


def _thinned(surface: Mesh) -> Mesh:
    """A mesh in which the vertices of a cell of a lattice are one; the lattice is as coarse as needed."""
    cells = 512.0
    thin = surface
    low, side = surface.vertices.min(0), float(np.ptp(surface.vertices, axis=0).max())
    while len(thin.faces) > MOST_FACES:
        cells *= 0.85
        keys = np.floor((surface.vertices - low) * (cells / side)).astype(np.int64)
        inverse = np.unique(keys @ [1, 1 << 20, 1 << 40], return_inverse=True)[1]
        faces = inverse[surface.faces]
        apart = (faces != np.roll(faces, 1, 1)).all(1)
        values = np.column_stack([surface.vertices, *([] if surface.colours is None else [surface.colours])])
        means = np.stack([np.bincount(inverse, column) for column in values.T], -1) / np.bincount(inverse)[:, None]
        colours = None if surface.colours is None else means[:, 3:].round().astype(np.uint8)
        thin = Mesh(means[:, :3], faces[apart], colours=colours)
    return thin
