"""What a reconstruction leaves behind: depth maps, pictures, points, a mesh, cameras, and a page."""

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

__all__ = ["Looked", "Results", "file_names", "write_results"]

# The farthest depth of a map takes that many steps of its 16-bit picture.
STEPS = 65_000
LONGEST_NAME = 80


class Looked(NamedTuple):
    """One view of what was reconstructed, all maps of one size (h, w)."""

    view: int
    image: torch.Tensor  # (3, h, w)
    camera: CameraTensors  # of that size
    depth: torch.Tensor  # (h, w), 0 where none is known
    certain: torch.Tensor  # (h, w) in [0, 1]
    meaning: str  # of what is certain: "confidence", "silhouette"
    numbers: tuple[tuple[str, str], ...]


class Results(NamedTuple):
    """What is written, beside the scene that it is of."""

    title: str
    facts: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    views: tuple[Looked, ...] = ()
    points: np.ndarray = np.empty((0, 3), np.float32)  # (N, 3); none of a hull, whose mesh says all
    colours: np.ndarray = np.empty((0, 3), np.uint8)  # (N, 3)
    mesh: Mesh | None = None
    used: tuple[int, ...] = ()  # photographs that helped, beside those of the views


def write_results(scene: PosedImages, results: Results, folder: str | PathLike[str]) -> dict[str, Path]:
    """Write results to a folder, where files of the same names are replaced; every file is there whole or not at all.

    ``report.html`` is a page with everything, ``summary.png`` one picture of it; ``model.glb`` and ``model.ply`` are
    the mesh, ``points.ply`` the points. ``images``, ``depth`` and ``pictures`` hold a PNG a view, named after its
    photograph: the photograph at the size of its depth map, the depth as 16 bit, and in colours. ``cameras.json``
    states the camera and the step of depth of each (see `lsmgeo.data.read_cameras_json`): the folder is a scene again.

    Everything is made before the first file is written.

    Returns:
        For each thing where it is.

    Raises:
        DataError: something cannot be written.
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
    # What an earlier run left, and this one does not write again, is not of these results.
    has_mesh, has_points = mesh is not None and len(mesh.faces) > 0, len(results.points) > 0
    for name, is_there in (("model.glb", has_mesh), ("model.ply", has_mesh), ("points.ply", has_points)):
        if not is_there:
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
    # Last, so that it never names what is not there.
    written["cameras"] = write_atomic(folder / NAME, encode_cameras(entries))
    return written


def file_names(names: Sequence[str]) -> list[str]:
    """Names for files, without an ending, told from names that may hold folders and any characters; none is twice.

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
        # Some systems do not tell capitals from small letters.
        while unique.lower() in taken:
            number += 1
            unique = f"{plain}_{number}"
        taken.add(unique.lower())
        made.append(unique)
    return made
