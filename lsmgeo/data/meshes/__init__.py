"""Triangle meshes, read, checked and normalised."""

from lsmgeo.data.meshes.load_mesh import load_mesh
from lsmgeo.data.meshes.mesh import DEFAULT_COLOUR, Mesh, check_mesh, from_trimesh, normalise

__all__ = ["DEFAULT_COLOUR", "Mesh", "check_mesh", "from_trimesh", "load_mesh", "normalise"]
