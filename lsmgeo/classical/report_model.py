"""A model, and the cameras that saw it, to be turned in a browser: one HTML document that loads nothing.

The drawing is three.js's, which trimesh carries in a page of its own; here the model is placed before it, and a few
controls are added.
"""

from __future__ import annotations

import json
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.data.meshes import Mesh

if TYPE_CHECKING:
    from trimesh.path import Path3D

    from lsmgeo.cameras import CameraTensors

__all__ = ["Model", "make_viewer"]

MOST_FACES, MOST_POINTS = 250_000, 200_000
# Of the model, whose middle is the origin and whose radius is 1: how long a frustum may be, and of the way to its
# nearest neighbour.
LONGEST_FRUSTUM, FRUSTUM_OF_GAP = 0.35, 0.6
USED, UNUSED, REFERENCE = (31, 119, 180), (170, 170, 170), (214, 39, 40)
PLAIN = (176, 180, 188)
EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [5, 6], [6, 7]])


class Model(NamedTuple):
    """What is to be turned.

    Convention:
        World-to-camera, OpenCV axes, integer pixel centres.
    """

    cameras: CameraTensors  # leading shape (V,)
    used: tuple[int, ...]  # cameras to be drawn in colour; the first looks at the start
    surface: Mesh | None
    points: np.ndarray  # (N, 3)
    colours: np.ndarray  # (N, 3) uint8


def make_viewer(model: Model) -> str:
    """An HTML document that shows the model as its first camera sees it, and lets it be turned.

    Convention:
        In the document the first camera's y points up, the middle of the model is the origin, and nine tenths of it
        lie within a radius of 1.

    Args:
        model: with a surface, or points, or both. Larger ones than a browser likes are thinned: surfaces to 250,000
            faces, points to 200,000.
    """
    import trimesh
    from trimesh.viewer.notebook import scene_to_html

    K, E = (np.asarray(part.double().numpy()) for part in model.cameras[:2])
    sizes = np.stack([np.broadcast_to(np.asarray(size), len(K)) for size in model.cameras[2:]], -1)
    seen = model.points if model.surface is None or not len(model.surface.vertices) else model.surface.vertices
    low, high = np.percentile(seen, (3, 97), axis=0)
    middle = (low + high) / 2
    radius = float(np.quantile(np.linalg.norm(seen - middle, axis=1), 0.97)) or 1.0
    # OpenGL's axes, which three.js has: y up, looking along -z.
    turn = np.diag([1.0, -1.0, -1.0]) @ E[model.used[0], :3, :3]

    def placed(points: np.ndarray) -> np.ndarray:
        return (points - middle) @ turn.T / radius

    centers = placed(-np.einsum("vji,vj->vi", E[:, :3, :3], E[:, :3, 3]))
    scene = trimesh.Scene()
    if model.surface is not None and len(model.surface.faces):
        surface = _thinned(model.surface)
        colours = np.broadcast_to(PLAIN, surface.vertices.shape) if surface.colours is None else surface.colours
        mesh = trimesh.Trimesh(placed(surface.vertices), surface.faces, process=False, vertex_colors=_opaque(colours))
        scene.add_geometry(mesh, node_name="mesh", geom_name="mesh")
    if len(model.points):
        chosen = np.random.default_rng(0).permutation(len(model.points))[:MOST_POINTS]
        cloud = trimesh.PointCloud(placed(model.points[chosen]), colors=_opaque(model.colours[chosen]))
        scene.add_geometry(cloud, node_name="points", geom_name="points")
    scene.add_geometry(_frusta(model, K, E, sizes, centers, turn), node_name="cameras", geom_name="cameras")
    # The script places the camera; without one trimesh would look for a place itself.
    scene.set_camera(angles=(0, 0, 0), distance=3, center=(0, 0, 0))
    stands = []
    for view in range(len(K)):
        axes = E[view, :3, :3] @ turn.T  # rows: right, down, forward
        halves = 0.5 * sizes[view] / (K[view, 1, 1], K[view, 0, 0])  # tangents of half the field, up and aside
        stands.append(np.concatenate([centers[view], axes[2], -axes[1], halves]).round(6).tolist())
    settings = {
        "first": model.used[0],
        "stands": stands,
        "shaded": model.surface is not None and model.surface.colours is None,
    }
    script = files("lsmgeo.classical").joinpath("report_model.js").read_text("utf-8")
    style = files("lsmgeo.classical").joinpath("report_model.css").read_text("utf-8")
    added = f"<style>{style}</style><script>const settings = {json.dumps(settings)};\n{script}</script></body>"
    before, _, after = scene_to_html(scene).rpartition("</body>")
    return before + added + after


def _opaque(colours: np.ndarray) -> np.ndarray:
    return np.concatenate([colours, np.full((len(colours), 1), 255)], 1).astype(np.uint8)


def _frusta(
    model: Model, K: np.ndarray, E: np.ndarray, sizes: np.ndarray, centers: np.ndarray, turn: np.ndarray
) -> Path3D:
    """Pyramids as lines, with a roof over the upper side of the picture."""
    from trimesh.path import Path3D
    from trimesh.path.entities import Line

    length = LONGEST_FRUSTUM
    if len(centers) > 1:
        from scipy.spatial import cKDTree

        # Cameras that turned in their place have no gap.
        gaps = cKDTree(np.unique(centers.round(6), axis=0)).query(centers, k=2)[0].max(1)
        length = float(np.clip(FRUSTUM_OF_GAP * np.median(gaps), 0.1, LONGEST_FRUSTUM))
    lines, colours = [], []
    # The first is drawn last: it is seen where another stands in its place.
    for view in sorted(range(len(centers)), key=lambda view: view == model.used[0]):
        (height, width), center = sizes[view], centers[view]
        left, right, top, bottom = -0.5, width - 0.5, -0.5, height - 0.5
        roof = top - 0.25 * height
        corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
        corners += [(0.7 * left + 0.3 * right, top), ((left + right) / 2, roof), (0.3 * left + 0.7 * right, top)]
        rays = np.array([(x, y, 1) for x, y in corners]) @ np.linalg.inv(K[view]).T
        rays /= max(1.0, float(np.abs(rays[:4, :2]).max()))
        nodes = np.concatenate([center[None], center + length * rays @ E[view, :3, :3] @ turn.T])
        lines.append(nodes[EDGES])
        colour = REFERENCE if view == model.used[0] else USED if view in model.used else UNUSED
        colours.append(np.tile((*colour, 255), (len(EDGES), 1)))
    entities = [Line([2 * index, 2 * index + 1]) for index in range(len(lines) * len(EDGES))]
    return Path3D(entities, np.concatenate(lines).reshape(-1, 3), process=False, colors=np.concatenate(colours))


def _thinned(surface: Mesh) -> Mesh:
    """Vertices in the same cell of a lattice become one, the coarser the lattice the fewer faces are left."""
    cells = 512.0
    thin = surface
    low, side = surface.vertices.min(0), float(np.ptp(surface.vertices, axis=0).max())
    while len(thin.faces) > MOST_FACES:
        cells *= 0.85
        keys = np.floor((surface.vertices - low) * (cells / side)).astype(np.int64)
        cell, inverse = np.unique(keys @ [1, 1 << 20, 1 << 40], return_inverse=True)
        count = np.bincount(inverse, minlength=len(cell))[:, None]

        def mean(values: np.ndarray, inverse: np.ndarray = inverse, count: np.ndarray = count) -> np.ndarray:
            sums = [np.bincount(inverse, column, len(count)) for column in values.T]
            return np.stack(sums, -1) / count

        faces = inverse[surface.faces]
        apart = (faces != np.roll(faces, 1, 1)).all(1)
        colours = None if surface.colours is None else mean(surface.colours).round().astype(np.uint8)
        thin = Mesh(mean(surface.vertices), faces[apart], colours=colours)
    return thin
