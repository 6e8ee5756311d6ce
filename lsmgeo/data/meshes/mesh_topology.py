"""The topology of a mesh: coinciding vertices, edges, connected parts, and the normals at corners."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lsmgeo.errors import BackendError

__all__ = [
    "Edges",
    "Parts",
    "are_nondegenerate",
    "components",
    "corner_normals",
    "distinct_faces",
    "edges_of",
    "face_normals",
    "is_watertight",
    "merged_faces",
    "misoriented_faces",
    "parts_of",
]

# The largest fraction of inconsistent inner edges in an open part that counts as oriented.
MISORIENTED = 0.05


class Edges(NamedTuple):
    """The sides of all faces, sorted so that sides on one edge are adjacent.

    Attributes:
        face: (3F,) the face of each side.
        corner: (3F,) the corner of the face where the side begins, 0, 1 or 2.
        forward: (3F,) bool, whether the side runs from the lower to the higher vertex number.
        edge: (3F,) number of the edge, ascending.
    """

    face: np.ndarray
    corner: np.ndarray
    forward: np.ndarray
    edge: np.ndarray


class Parts(NamedTuple):
    """Faces connected through edges.

    Attributes:
        part: (F,) the part of each face.
        closed: (parts,) bool, every edge belongs to an even number of the part's faces.
        oriented: (parts,) bool, two faces at an edge run along it in opposite directions: all in a closed part, else
            nearly all.
        doubled: (parts,) bool, most faces have a copy on the same three vertices.
    """

    part: np.ndarray
    closed: np.ndarray
    oriented: np.ndarray
    doubled: np.ndarray


def merged_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces (F, 3) with exactly coinciding vertices merged, which files split at textures and hard edges."""
    order, new = _grouped(vertices)
    number = np.empty(len(vertices), np.int64)
    number[order] = np.cumsum(new) - 1
    return number[faces]


def are_nondegenerate(faces: np.ndarray) -> np.ndarray:
    """(F,) bool, whether the three vertices of each face differ."""
    return (faces != np.roll(faces, 1, axis=1)).all(1)


def distinct_faces(faces: np.ndarray) -> np.ndarray:
    """The faces without copies, (K,) ascending: the first on each three vertices."""
    order, new = _grouped(np.sort(faces, axis=1))
    return np.sort(order[new])


def _grouped(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A stable order in which equal rows are adjacent, and where in it a new row begins."""
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    new = np.ones(len(order), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(1)
    return order, new


def edges_of(faces: np.ndarray) -> Edges:
    """The edges of faces (F, 3)."""
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    order, new = _grouped(np.stack((np.minimum(start, end), np.maximum(start, end)), 1))
    return Edges(order // 3, order % 3, (start < end)[order], np.cumsum(new) - 1)


def is_watertight(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether every edge belongs to exactly two faces, coinciding vertices merged and faces without area left out."""
    merged = merged_faces(vertices, faces)
    merged = merged[are_nondegenerate(merged)]
    return len(merged) > 0 and bool((np.bincount(edges_of(merged).edge) == 2).all())


def components(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The connected component of each of ``count`` nodes, first[i] and second[i] linked; (count,) int64 from 0."""
    try:
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components
    except ImportError as error:
        raise BackendError("smooth normals and the parts of a mesh need SciPy; install lsmgeo[data]") from error
    links = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)


def parts_of(faces: np.ndarray) -> Parts:
    """Split faces that pass `are_nondegenerate`, by merged vertices, into parts connected through edges."""
    edges = edges_of(faces)
    same = np.flatnonzero(edges.edge[1:] == edges.edge[:-1])
    part = components(len(faces), edges.face[same], edges.face[same + 1])
    count = int(part.max()) + 1
    edge_part = np.empty(edges.edge[-1] + 1, np.int64)
    edge_part[edges.edge] = part[edges.face]

    def total(of_edge: np.ndarray) -> np.ndarray:
        return np.bincount(edge_part, weights=of_edge, minlength=count)

    valence = np.bincount(edges.edge)
    balance = np.bincount(edges.edge, weights=np.where(edges.forward, 1.0, -1.0))
    closed = total(valence % 2 != 0) == 0
    wrong = total((valence == 2) & (balance != 0))
    oriented = np.where(closed, total(balance != 0) == 0, wrong <= MISORIENTED * total(valence == 2))
    order, new = _grouped(np.sort(faces, axis=1))
    group = np.cumsum(new) - 1
    copies = np.empty(len(faces), np.int64)
    copies[order] = np.bincount(group)[group]
    doubled = 2 * np.bincount(part, weights=copies > 1, minlength=count) > np.bincount(part, minlength=count)
    return Parts(part, closed, oriented, doubled)


def misoriented_faces(faces: np.ndarray) -> np.ndarray:
    """The faces to reverse, (F,) bool, so that neighbours over edges of two faces agree, if possible.

    Every face has two states, unchanged and reversed, and each edge of two faces links the states that agree. Faces
    whose unchanged state is not linked to that of their group's first face are reversed; on a one-sided surface, none.
    """
    edges = edges_of(faces)
    first = np.flatnonzero((edges.edge[1:] == edges.edge[:-1]) & (np.bincount(edges.edge)[edges.edge[1:]] == 2))
    one, two = edges.face[first], edges.face[first + 1]
    across = np.where(edges.forward[first] == edges.forward[first + 1], 1, 0)
    count = len(faces)
    state = components(
        2 * count,
        np.concatenate((one, one + count)),
        np.concatenate((two + across * count, two + (1 - across) * count)),
    )
    group = components(count, one, two)
    leader = np.zeros(group.max() + 1, np.int64)
    leader[group[::-1]] = np.arange(count)[::-1]  # the last value written is the first face
    kept = state[:count] == state[leader[group]]
    return ~kept


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) unit normals; 0 for faces without area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)


def corner_normals(vertices: np.ndarray, faces: np.ndarray, crease: float) -> np.ndarray:
    """Unit normals at the corners of faces, smooth except at sharp edges.

    Around a vertex, faces connected by edges that bend by less than ``crease`` share the mean of their normals, each
    weighted by its angle at the vertex (Thuermer and Wuethrich, 1998).

    Args:
        vertices: (N, 3).
        faces: (F, 3).
        crease: degrees, 0 to 180.

    Returns:
        (F, 3, 3) float64: face, corner, x y z.
    """
    normals = face_normals(vertices, faces)
    edges = edges_of(merged_faces(vertices, faces))
    begin, end = 3 * edges.face + edges.corner, 3 * edges.face + (edges.corner + 1) % 3
    least = np.cos(np.radians(crease))
    links: list[tuple[np.ndarray, np.ndarray]] = []
    # An edge of a two-sided sheet has four faces; three steps link all pairs of them.
    for step in range(1, 4):
        first = np.flatnonzero(edges.edge[step:] == edges.edge[:-step])
        second = first + step
        bent = (normals[edges.face[first]] * normals[edges.face[second]]).sum(1) <= least
        first, second = first[~bent], second[~bent]
        alike = edges.forward[first] == edges.forward[second]
        links.append((begin[first], np.where(alike, begin[second], end[second])))
        links.append((end[first], np.where(alike, end[second], begin[second])))
    pairs = [np.concatenate(side) for side in zip(*links, strict=True)]
    group = components(faces.size, pairs[0], pairs[1])
    weighted = _corner_angles(vertices, faces)[..., None] * normals[:, None]  # (F, 3, 3)
    sums = np.stack([np.bincount(group, weights=weighted[..., axis].reshape(-1)) for axis in range(3)], 1)
    length = np.linalg.norm(sums, axis=1)
    smooth = sums[group].reshape(-1, 3, 3) / np.maximum(length, 1e-300)[group].reshape(-1, 3, 1)
    return np.where((length > 1e-12)[group].reshape(-1, 3, 1), smooth, normals[:, None])


def _corner_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) radians."""
    corners = vertices[faces]
    forth = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    return np.arctan2(np.linalg.norm(np.cross(forth, back), axis=2), (forth * back).sum(2))
