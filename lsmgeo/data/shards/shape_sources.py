"""Sources of the shapes of a set: synthetic-13, or the files below a folder. All can be pickled."""

from __future__ import annotations

import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
from torch import Tensor

from lsmgeo import scenes
from lsmgeo._checks import check_whole
from lsmgeo.data.formats.synsets import synset_category
from lsmgeo.data.sample import Sample
from lsmgeo.data.shards.shape_sets import describe_shape, render_shapes
from lsmgeo.data.shards.shard_metadata import is_text
from lsmgeo.errors import DataError, LsmGeoError, OptionError
from lsmgeo.scenes import synthetic13

__all__ = [
    "FileSource",
    "MeshFolder",
    "Recipe",
    "RenderedShape",
    "Source",
    "Synthetic13",
    "open_source",
    "rendered_shape",
    "sort_paths",
    "split_by_name",
    "walk",
]

# Increased by a change of the generators or of the renderer that changes the shapes of a seed.
VERSION = 1
MESH_SUFFIXES = (".obj", ".ply", ".off", ".stl", ".glb", ".gltf")
MAX_PATHS = 1_000_000
# The last number of the seed of a mesh's lights.
LIGHTS = 2


class Recipe(NamedTuple):
    """The settings of the views and voxels of a set.

    Attributes:
        seed: of shapes, lights and views.
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


class RenderedShape(NamedTuple):
    """A shape as it is written into a shard."""

    sample: Sample  # with the first of the occupancy grids
    more_occupancy: tuple[Tensor, ...]
    split: str


@dataclass(frozen=True)
class Synthetic13:
    """The parametric shapes of `lsmgeo.scenes.synthetic13`; its methods are those of `FileSource`."""

    count: int
    name: str = "synthetic-13"

    def __len__(self) -> int:
        return self.count

    def part(self, start: int, stop: int) -> Self:
        """Itself, since a shape is made from its number."""
        return self

    def identity(self) -> Any:
        """The version of the generators."""
        return VERSION

    def file(self, index: int) -> str:
        """The shape's number."""
        return f"shape {index}"

    def render(self, index: int, recipe: Recipe) -> RenderedShape:
        """Views and voxels of one synthetic shape, exact."""
        spec = describe_shape(recipe.seed, index, recipe.views, recipe.size)
        sample = render_shapes([spec], depth=recipe.depth, shadows=recipe.shadows)[0]
        grids = [scenes.voxels([spec.shape.scene], resolution)[0] for resolution in recipe.voxels]
        return rendered_shape(sample, grids, synthetic13.split(recipe.seed, index))


def rendered_shape(sample: Sample, grids: Sequence[Tensor], split: str) -> RenderedShape:
    """A shape with its occupancy grids."""
    return RenderedShape(sample._replace(occupancy=grids[0] if grids else None), tuple(grids[1:]), split)


@dataclass(frozen=True)
class FileSource(ABC):
    """Shapes made from files below a folder, in the order of their paths.

    Attributes:
        root: the folder.
        paths: of the shapes, relative to the root, with forward slashes.
        name: of the shards.
        first: the number of the first shape.
    """

    root: Path
    paths: tuple[str, ...]
    name: str
    first: int = 0

    def __len__(self) -> int:
        return len(self.paths)

    def part(self, start: int, stop: int) -> Self:
        """Only these shapes, with their numbers, so that a task need not hold the paths of all."""
        return replace(self, paths=self.paths[start - self.first : stop - self.first], first=start)

    def file(self, index: int) -> str:
        """The shape's path."""
        return str(self.root / self.paths[index - self.first])

    def digests(self, path: str) -> list[tuple[str, str]]:
        """Name and SHA-256 of the files of a shape."""
        try:
            digests = []
            for file in self._files(self.root / path):
                with file.open("rb") as stream:
                    digests.append((file.name, hashlib.file_digest(stream, "sha256").hexdigest()))
            return digests
        except OSError as error:
            return [("", f"cannot be read ({error})")]

    def render(self, index: int, recipe: Recipe) -> RenderedShape:
        """Views and voxels of one shape; a DataError if its files cannot be used."""
        try:
            return self._render(index, recipe)
        except DataError:
            raise
        except LsmGeoError as error:  # found only in use: no extent, colours out of range
            raise DataError(self.file(index), str(error)) from error

    @abstractmethod
    def identity(self) -> Any:
        """All that the shapes depend on besides the recipe, as JSON values."""

    @abstractmethod
    def _files(self, path: Path) -> list[Path]:
        """The files of a shape, in order."""

    @abstractmethod
    def _render(self, index: int, recipe: Recipe) -> RenderedShape:
        """Views and voxels of one shape."""


class MeshFolder(FileSource):
    """The meshes below a folder, centred and scaled so that the diagonal of their bounding box is 1.

    The category is the first folder below the root, for a ShapeNet synset its name.
    """

    def identity(self) -> Any:
        """SHA-256 of the files and of the material files beside them, and the renderer's backend."""
        backend = "embree" if find_spec("embreex") else "numpy"  # the choice of render_mesh
        return [VERSION, backend, [[path, *(digest for _, digest in self.digests(path))] for path in self.paths]]

    def _files(self, path: Path) -> list[Path]:
        return [path, *(sorted(path.parent.glob("*.mtl")) if path.suffix.lower() == ".obj" else [])]

    def _render(self, index: int, recipe: Recipe) -> RenderedShape:
        from lsmgeo.data.meshes import load_mesh, normalise
        from lsmgeo.data.meshes.mesh_rendering import render_mesh
        from lsmgeo.data.meshes.voxelise import voxelise

        file = self.paths[index - self.first]
        mesh = normalise(load_mesh(self.root / file))
        cameras = synthetic13.views(recipe.seed, index, recipe.views, recipe.size)
        lights = synthetic13.random_lights(np.random.default_rng([recipe.seed, index, LIGHTS]))
        rendering = render_mesh(mesh, cameras, lights, shadows=recipe.shadows)
        if not rendering.mask.any():
            raise DataError(self.root / file, "is visible in none of its views")
        # Thin objects, such as lampshades and sails, contain hardly any voxel centres.
        grids = [voxelise(mesh, resolution, keep_thin=True) for resolution in recipe.voxels]
        depth = rendering.depth if recipe.depth else None
        sample = Sample(rendering.images, cameras, depth, rendering.mask, None, file, _category(file), file)
        return rendered_shape(sample, grids, split_by_name(file))


def _category(file: str) -> str | None:
    first, slash, _ = file.partition("/")
    return (synset_category(first) or first) if slash else None


Source: TypeAlias = Synthetic13 | FileSource


def split_by_name(name: str) -> str:
    """The split (train 0.7, val 0.1, test 0.2) of a shape, by a hash of its name.

    Example:
        >>> split_by_name("03001627/1a6f615e8b1b5ae4dbbc9440457e303e/models/model_normalized.obj")
        'train'
    """
    place = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) / 2**64
    return "train" if place < 0.7 else "val" if place < 0.8 else "test"


def open_source(source: str | Path, shapes: int | None = None) -> Source:
    """Open a source of shapes.

    Args:
        source: "synthetic-13", or a folder of meshes (a ShapeNetCore tree, or any other).
        shapes: the number of shapes, of a folder the largest number; all of a folder by default.

    Raises:
        OptionError: no number of shapes for synthetic-13, or fewer than one.
        DataError: the folder cannot be read or has no mesh.
    """
    if shapes is not None:
        shapes = check_whole("render_set", "shapes", shapes, 1, 10**8)
    if str(source) == "synthetic-13":
        if shapes is None:
            raise OptionError("render_set: shapes must be given for synthetic-13, which is endless; got None")
        return Synthetic13(shapes)
    root = Path(source)
    if not root.is_dir():
        raise DataError(root, "is neither a folder of meshes nor 'synthetic-13'")
    root = root.resolve()
    meshes = (folder / name for folder, names in walk(root) for name in names if name.lower().endswith(MESH_SUFFIXES))
    found = sort_paths(root, (file for file in meshes if not file.is_symlink()), f"mesh ({', '.join(MESH_SUFFIXES)})")
    strange = next((file for file in found if not is_text(file)), None)
    if strange is not None:
        raise DataError(root, f"holds a mesh whose name is too long or not printable: {strange[:80]!r}")
    return MeshFolder(root, found[:shapes], root.name.lstrip(".") or "meshes")


def walk(root: Path) -> Iterator[tuple[Path, list[str]]]:
    """The folders below a folder, not through links, and their files' names; a DataError if one cannot be read."""

    def refuse(error: OSError) -> None:
        raise DataError(error.filename or root, f"cannot be read ({error})") from error

    for folder, _, names in os.walk(root, onerror=refuse):
        yield Path(folder), names


def sort_paths(root: Path, paths: Iterable[Path], what: str) -> tuple[str, ...]:
    """Paths relative to a folder, with forward slashes, in order; a DataError if there are none or too many."""
    found = tuple(sorted(path.relative_to(root).as_posix() for path in paths))
    if not 1 <= len(found) <= MAX_PATHS:
        raise DataError(root, f"holds {len(found) or 'no'} {what}; 1 to {MAX_PATHS} are expected")
    return found
