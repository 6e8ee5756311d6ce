"""Results of a reconstruction and their files: depth maps, images, points, a mesh, cameras, and a page."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.classical.surface import write_mesh
from lsmgeo.data.atomic_files import write_atomic
from lsmgeo.data.formats.format_cameras_json import NAME, camera_entry, encode_cameras
from lsmgeo.data.formats.scene_writers import write_point_cloud
from lsmgeo.data.images import encode_png
from lsmgeo.data.read_files import os_errors_as_data_errors
from lsmgeo.drawing import as_pixels
from lsmgeo.reconstruct import result_figures
from lsmgeo.reconstruct.page import make_page

if TYPE_CHECKING:
    from collections.abc import Sequence
    from os import PathLike

    import torch

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.data import PosedImages
    from lsmgeo.data.meshes import Mesh

__all__ = ["Results", "ViewResult", "file_names", "mesh_facts", "write_results"]

# The largest depth of a map, in steps of its 16-bit image.
STEPS = 65_000
LONGEST_NAME = 80


class ViewResult(NamedTuple):
    """The results for one view, all maps of one size (h, w)."""

    view: int
    image: torch.Tensor  # (3, h, w)
    camera: CameraTensors  # of that size
    depth: torch.Tensor  # (h, w), 0 where it is unknown
    confidence: torch.Tensor  # (h, w) in [0, 1]
    confidence_name: str  # what it is: "confidence", "silhouette", ...
    numbers: tuple[tuple[str, str], ...]


class Results(NamedTuple):
    """The results for a scene."""

    title: str
    facts: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    views: tuple[ViewResult, ...] = ()
    points: np.ndarray = np.empty((0, 3), np.float32)  # (N, 3); none for a hull
    colours: np.ndarray = np.empty((0, 3), np.uint8)  # (N, 3)
    mesh: Mesh | None = None
    used: tuple[int, ...] = ()  # views that were matched, besides those above


def write_results(scene: PosedImages, results: Results, folder: str | PathLike[str]) -> dict[str, Path]:
    """Write results to a folder, where files of the same names are replaced; no file is left incomplete.

    ``report.html`` is a page with everything, ``summary.png`` an image of it; ``model.glb`` and ``model.ply`` are the
    mesh, ``points.ply`` the points. ``images``, ``depth`` and ``pictures`` hold a PNG per view, named after its image:
    the image at the size of its depth map, the depth as 16 bit, and the depth in colours. ``cameras.json`` has the
    camera and the step of depth of each (see `lsmgeo.data.read_cameras_json`): the folder is a scene again.

    All contents are computed before the first file is written.

    Returns:
        The path of each result.

    Raises:
        DataError: a file cannot be written.
    """
    folder = Path(folder)
    names = file_names([scene.names[one.view] for one in results.views])
    contents: dict[str, bytes] = {}
    entries = []
    for one, name in zip(results.views, names, strict=True):
        step = max(float(one.depth.max()), 1e-30) / STEPS
        steps = (one.depth.double() / step).round().numpy().astype(np.uint16)
        for kind, pixels in (
            ("images", as_pixels(one.image)),
            ("depth", steps),
            ("pictures", result_figures.coloured_depth(one.depth)),
        ):
            contents[f"{kind}/{name}.png"] = encode_png(pixels)
        named = {"file": f"images/{name}.png", "photograph": scene.names[one.view]}
        entries.append(named | camera_entry(one.camera) | {"depth": f"depth/{name}.png", "depth_step": step})
    mesh, points, colours = results.mesh, results.points, results.colours
    if not len(points) and mesh is not None and mesh.colours is not None:
        points, colours = mesh.vertices, mesh.colours
    summary = result_figures.summary(results.views[0], points, colours, results.title)
    page = make_page(results, scene.names, scene.cameras)
    written = {}
    # Files of an earlier run that this one does not replace do not belong to these results.
    has_mesh, has_points = mesh is not None and len(mesh.faces) > 0, len(results.points) > 0
    for name, exists in (("model.glb", has_mesh), ("model.ply", has_mesh), ("points.ply", has_points)):
        if not exists:
            with os_errors_as_data_errors(folder / name, "removed"):
                (folder / name).unlink(missing_ok=True)
    if mesh is not None and has_mesh:
        written["mesh"] = write_mesh(folder / "model.glb", mesh)
        write_mesh(folder / "model.ply", mesh)
    if has_points:
        written["points"] = write_point_cloud(folder / "points.ply", results.points, results.colours)
    written["page"] = write_atomic(folder / "report.html", page.encode())
    written["summary"] = write_atomic(folder / "summary.png", summary)
    for name, content in contents.items():
        write_atomic(folder / name, content)
    written["depth, 16 bit"] = folder / "depth"
    written["depth in colours"] = folder / "pictures"
    # Last, so that it never names a missing file.
    written["cameras"] = write_atomic(folder / NAME, encode_cameras(entries))
    return written


def mesh_facts(mesh: Mesh | None) -> list[tuple[str, str]]:
    """The size of a mesh as a fact; nothing for one without faces."""
    if mesh is None or not len(mesh.faces):
        return []
    return [("mesh", f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces")]


def file_names(names: Sequence[str]) -> list[str]:
    """Unique names of files, without extension, from names that may have folders and any characters.

    Example:
        >>> file_names(["left/a.png", "a.jpg", "A.png", "../a b:c.png", ""])
        ['left_a', 'a', 'A_2', 'a_b_c', 'view']
    """
    taken: set[str] = set()
    made = []
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        parts = [part for part in path.with_suffix("").parts if part != ".."] if name else []
        plain = re.sub(r"[^\w.-]+", "_", "_".join(parts)).strip("._-")[:LONGEST_NAME] or "view"
        unique, number = plain, 1
        # Some systems ignore case.
        while unique.lower() in taken:
            number += 1
            unique = f"{plain}_{number}"
        taken.add(unique.lower())
        made.append(unique)
    return made
