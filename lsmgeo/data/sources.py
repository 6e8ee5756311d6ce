"""What a training set is made from: synthetic shapes by number, or the meshes of a folder; both can be pickled."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_whole
from lsmgeo.data.metadata import is_text
from lsmgeo.data.sample import Sample
from lsmgeo.errors import DataError, LsmGeoError, OptionError

__all__ = ["MeshFolder", "Recipe", "Rendered", "Source", "Synthetic13", "open_source"]

# Raised when a change of the generators or of the renderer changes what a seed gives.
VERSION = 1
MESH_SUFFIXES = (".obj", ".ply", ".off", ".stl", ".glb", ".gltf")
MAX_MESHES = 1_000_000
# The last number of the seed that a mesh's lights are drawn from.
LIGHTS = 2


class Recipe(NamedTuple):
    """How shapes are turned into views and voxels.

    Attributes:
        seed: decides shapes, lights and views.
        views: number of views of a shape.
        size: height and width of the images in pixels.
        voxels: resolutions of the occupancy grids.
        depth: whether depth is kept.
        shadows: whether shapes cast shadows on themselves.
    """

    seed: int = 0
    views: int = 20
    size: int = 224
    voxels: tuple[int, ...] = (32, 64)
    depth: bool = True
    shadows: bool = False


class Rendered(NamedTuple):
    """A shape as it goes into a shard."""

    sample: Sample  # with the first of the occupancy grids
    more_occupancy: tuple[Tensor, ...]
    split: str


class Source(Protocol):
    """Shapes by number."""

    @property
    def name(self) -> str:
        """What its shards are called."""

    def __len__(self) -> int: ...

    def part(self, start: int, stop: int) -> Source:
        """The same source with nothing but shapes start to stop, which keep their numbers: what one task needs."""

    def identity(self) -> Any:
        """What its shapes depend on besides the recipe, as JSON can hold it."""

    def file(self, index: int) -> str:
        """What a shape is made from, in a message."""

    def render(self, index: int, recipe: Recipe) -> Rendered:
        """One shape.

        Raises:
            DataError: its file cannot be used.
        """


@dataclass(frozen=True)
class Synthetic13:
    """The parametric shapes of `lsmgeo.scenes.synthetic13`."""

    count: int
    name: str = "synthetic-13"

    def __len__(self) -> int:
        return self.count

    def part(self, start: int, stop: int) -> Synthetic13:
        """Itself: a shape is made from its number."""
        return self

    def identity(self) -> Any:
        """The version of the generators."""
        return VERSION

    def file(self, index: int) -> str:
        """Its number."""
        return f"shape {index}"

    def render(self, index: int, recipe: Recipe) -> Rendered:
        """Views and voxels of one synthetic shape, exact."""
        from lsmgeo import scenes
        from lsmgeo.scenes import synthetic13

        shape = synthetic13.shape(recipe.seed, index)
        scene = shape.scene
        cameras = synthetic13.views(recipe.seed, index, recipe.views, recipe.size)
        batch = type(cameras)(*(torch.as_tensor(value)[None] for value in cameras))
        picture = scenes.render([scene], batch, shape.lights, shadows=recipe.shadows)
        grids = [scenes.voxels([scene], resolution)[0] for resolution in recipe.voxels]
        sample = Sample(
            images=picture.images[0],
            cameras=cameras,
            depth=picture.depth[0] if recipe.depth else None,
            mask=picture.mask[0],
            occupancy=grids[0] if grids else None,
            mesh=None,
            category=shape.category,
            name=shape.name,
        )
        return Rendered(sample, tuple(grids[1:]), synthetic13.split(recipe.seed, index))


@dataclass(frozen=True)
class MeshFolder:
    """The meshes below a folder, in the order of their paths.

    The first folder below the root names the category; a ShapeNet synset is spelt out. Meshes are centred, and scaled
    so that the diagonal of the box around them is 1.
    """

    root: Path
    files: tuple[str, ...]  # relative to the root, with forward slashes
    name: str
    first: int = 0  # the number of the first file

    def __len__(self) -> int:
        return len(self.files)

    def part(self, start: int, stop: int) -> MeshFolder:
        """The files of these shapes alone: a task need not carry the paths of a whole tree."""
        return replace(self, files=self.files[start - self.first : stop - self.first], first=start)

    def identity(self) -> Any:
        """SHA-256 of the files and of the material files beside them, and what casts the rays."""
        caster = "embree" if find_spec("embreex") else "numpy"  # what render_mesh takes
        return [VERSION, caster, [[file, *self._digests(file)] for file in self.files]]

    def _digests(self, file: str) -> list[str]:
        path = self.root / file
        try:
            beside = sorted(path.parent.glob("*.mtl")) if path.suffix.lower() == ".obj" else []
            digests = []
            for one in (path, *beside):
                with one.open("rb") as stream:
                    digests.append(hashlib.file_digest(stream, "sha256").hexdigest())
            return digests
        except OSError as error:
            return [f"cannot be read ({error})"]

    def file(self, index: int) -> str:
        """Its path."""
        return str(self.root / self.files[index - self.first])

    def render(self, index: int, recipe: Recipe) -> Rendered:
        """Views and voxels of one mesh.

        Raises:
            DataError: the file is no mesh that can be used.
        """
        try:
            return self._render(self.files[index - self.first], index, recipe)
        except DataError:
            raise
        except LsmGeoError as error:  # what only shows when the mesh is used: no extent, colours out of range
            raise DataError(self.file(index), str(error)) from error

    def _render(self, file: str, index: int, recipe: Recipe) -> Rendered:
        from lsmgeo.data.mesh_rendering import render_mesh
        from lsmgeo.data.meshes import load_mesh, normalise
        from lsmgeo.data.voxelise import voxelise
        from lsmgeo.scenes import synthetic13

        mesh = normalise(load_mesh(self.root / file))
        cameras = synthetic13.views(recipe.seed, index, recipe.views, recipe.size)
        lights = synthetic13.random_lights(np.random.default_rng([recipe.seed, index, LIGHTS]))
        picture = render_mesh(mesh, cameras, lights, shadows=recipe.shadows)
        if not picture.mask.any():
            raise DataError(self.root / file, "is seen in none of the views")
        # A lampshade or a sail has hardly a voxel whose centre it holds.
        grids = [voxelise(mesh, resolution, keep_thin=True) for resolution in recipe.voxels]
        sample = Sample(
            images=picture.images,
            cameras=cameras,
            depth=picture.depth if recipe.depth else None,
            mask=picture.mask,
            occupancy=grids[0] if grids else None,
            mesh=file,
            category=_category(file),
            name=file,
        )
        return Rendered(sample, tuple(grids[1:]), split_by_name(file))


def _category(file: str) -> str | None:
    from lsmgeo.scenes.synthetic13 import CATEGORIES

    first, slash, _ = file.partition("/")
    spelt = {synset: name for name, synset in CATEGORIES.items()}
    return spelt.get(first, first) if slash else None


def split_by_name(name: str) -> str:
    """The part of a set that a name belongs to, 0.7 / 0.1 / 0.2 in expectation, whatever else the set holds.

    Example:
        >>> split_by_name("03001627/1a6f615e8b1b5ae4dbbc9440457e303e/models/model_normalized.obj")
        'train'
    """
    place = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) / 2**64
    return "train" if place < 0.7 else "val" if place < 0.8 else "test"


def open_source(source: str | Path, shapes: int | None = None) -> Source:
    """Open what shapes are made from.

    Args:
        source: "synthetic-13", or a folder of meshes (a ShapeNetCore tree, or any other).
        shapes: number of shapes; of a folder at most so many, all by default.

    Raises:
        OptionError: no number of shapes for synthetic-13, or fewer than one.
        DataError: the folder cannot be read or holds no mesh.
    """
    if shapes is not None:
        shapes = check_whole("render_set", "shapes", shapes, 1, 10**8)
    if str(source) == "synthetic-13":
        if shapes is None:
            raise OptionError("render_set: shapes must be given for synthetic-13, which has no end; got None")
        return Synthetic13(shapes)
    root = Path(source)
    if not root.is_dir():
        raise DataError(root, "is no folder of meshes, and not 'synthetic-13'")

    def refuse(error: OSError) -> None:
        raise DataError(error.filename or root, f"cannot be read ({error})") from error

    found = []
    root = root.resolve()
    for folder, _, names in os.walk(root, onerror=refuse):  # links to folders are not followed
        below = Path(folder).relative_to(root)
        found += [(below / name).as_posix() for name in names if name.lower().endswith(MESH_SUFFIXES)]
    found = sorted(file for file in found if not (root / file).is_symlink())
    if not found:
        raise DataError(root, f"holds no mesh ({', '.join(MESH_SUFFIXES)})")
    if len(found) > MAX_MESHES:
        raise DataError(root, f"holds {len(found)} meshes, the limit is {MAX_MESHES}")
    strange = next((file for file in found if not is_text(file)), None)
    if strange is not None:
        raise DataError(root, f"holds a mesh whose name is too long or not printable: {strange[:80]!r}")
    return MeshFolder(root, tuple(found[:shapes]), root.name.lstrip(".") or "meshes")
