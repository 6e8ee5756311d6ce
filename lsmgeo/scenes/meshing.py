"""Analytic scenes as watertight triangle meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lsmgeo._checks import is_whole
from lsmgeo.errors import OptionError
from lsmgeo.scenes.primitives import Kind, Solid
from lsmgeo.scenes.tables import Scene, check_scenes

if TYPE_CHECKING:
    import trimesh

__all__ = ["to_mesh"]


def to_mesh(scene: Scene, *, segments: int = 64) -> trimesh.Trimesh:
    """The union of a scene's solids as one closed mesh, each face in the plain colour of its solid.

    Round primitives become polyhedra with vertices on the true surface, so the mesh lies inside the scene, except at
    subtracted primitives; the volume error falls with the square of ``segments``. Textures are ignored.

    Args:
        scene: a scene without half-spaces among its solids; as cuts they are allowed.
        segments: vertices of a full circle, a multiple of 4 and at least 8, so that round solids reach their bounds.

    Returns:
        A watertight mesh with outward faces, in the scene's frame; a face's colour is 8-bit RGBA.

    Raises:
        OptionError: not a `Scene`, a solid that is a half-space, or an invalid number of segments.

    Example:
        >>> from lsmgeo.scenes import Scene, box, half_space
        >>> from lsmgeo.scenes.meshing import to_mesh
        >>> wedge = box((0, 0, 0), (1, 1, 1)).minus(half_space((0, 0, 0), (1, 1, 0)))
        >>> mesh = to_mesh(Scene([wedge]))
        >>> mesh.is_watertight, float(mesh.volume)
        (True, 0.500)
    """
    import manifold3d
    import trimesh

    (scene,) = check_scenes("to_mesh", [scene])
    if not is_whole(segments) or segments < 8 or segments % 4:
        raise OptionError(f"to_mesh: segments must be a multiple of 4, at least 8; got {segments!r}")
    if any(solid.kind is Kind.HALF_SPACE for solid in scene.solids):
        raise OptionError("to_mesh: a half-space has no closed surface; expected solids of finite size")

    parts, colours = [], {}
    for solid in scene.solids:
        part = _manifold(solid, segments, solid)
        for cut in solid.cuts:
            part = part - _manifold(cut, segments, solid)
        # One identity for all faces of a solid, including those of its cuts, to recognise them in the union.
        part = part.as_original()
        parts.append(part)
        colours[part.original_id()] = solid.material.colour
    union = manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add)
    mesh = union.to_mesh64()
    faces = np.asarray(mesh.tri_verts, dtype=np.int64)
    shown = np.empty((len(faces), 4), dtype=np.uint8)
    ends = np.asarray(mesh.run_index) // 3
    for first, last, original in zip(ends[:-1], ends[1:], mesh.run_original_id, strict=True):
        shown[first:last] = np.rint([255 * value for value in (*colours[original], 1.0)])
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], faces, face_colors=shown, process=False)


def _manifold(solid: Solid, segments: int, part: Solid) -> Any:
    """One primitive without cuts; a half-space as a box that covers its side of ``part``."""
    from manifold3d import Manifold

    if solid.kind is Kind.HALF_SPACE:
        solid = _large_box(solid, part)
    if solid.kind is Kind.BOX:
        shape = Manifold.cube([2.0, 2.0, 2.0], True)
    elif solid.kind is Kind.SPHERE:
        shape = Manifold.sphere(1.0, segments)
    else:
        # The library's cylinders are along z; ours along y, with the full radius at y = -1.
        taper = solid.taper if solid.kind is Kind.CONE else 1.0
        shape = Manifold.cylinder(2.0, 1.0, taper, segments, True)
        shape = shape.transform(np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0]]))
    return shape.transform(solid.world_from_local)


def _large_box(half_space: Solid, part: Solid) -> Solid:
    """The box below a half-space's face that contains all of ``part`` on that side."""
    low, high = part.bounds()
    linear, point = half_space.world_from_local[:, :3], half_space.world_from_local[:, 3]
    local = np.linalg.solve(linear, ((low + high) / 2 - point)[:, None])[:, 0]
    # The largest distance of any point of the part from its centre, in local units along each axis.
    reach = np.abs(np.linalg.inv(linear)) @ (high - low) / 2
    sides, depth = 1.5 * reach, max(1.5 * reach[1] - local[1], reach[1])
    center = np.array([local[0], -depth / 2, local[2]])
    matrix = np.c_[linear * np.array([sides[0], depth / 2, sides[2]]), linear @ center + point]
    return Solid(Kind.BOX, matrix)
