"""What a training set is made from: synthetic shapes by number, or the meshes of a folder; both can be pickled."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from lsmgeo.data.sample import Sample
from lsmgeo.errors import DataError, OptionError

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

    def identity(self, start: int, stop: int) -> Any:
        """What shapes start to stop depend on besides the recipe, as JSON can hold it."""

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

    def identity(self, start: int, stop: int) -> Any:
        """The version of the generators."""
        return [self.name, VERSION, start, stop]

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

    def __len__(self) -> int:
        return len(self.files)

    def identity(self, start: int, stop: int) -> Any:
        """Paths and sizes of the files."""
        some = self.files[start:stop]
        return [VERSION, start, [[file, (self.root / file).stat().st_size] for file in some]]

    def render(self, index: int, recipe: Recipe) -> Rendered:
        """Views and voxels of one mesh.

        Raises:
            DataError: the file is no mesh that can be used.
        """
        from lsmgeo.data.mesh_rendering import render_mesh
        from lsmgeo.data.meshes import load_mesh, normalise
        from lsmgeo.data.voxelise import voxelise
        from lsmgeo.scenes import synthetic13

        file = self.files[index]
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
            name=file.rpartition(".")[0],
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
    if shapes is not None and shapes < 1:
        raise OptionError(f"shapes must be at least 1; got {shapes}")
    if str(source) == "synthetic-13":
        if shapes is None:
            raise OptionError("shapes must be given for synthetic-13, which has no end")
        return Synthetic13(shapes)
    root = Path(source)
    if not root.is_dir():
        raise DataError(root, "is no folder of meshes, and not 'synthetic-13'")
    try:
        root = root.resolve()
        # Links are not followed: they may lead outside, or in circles.
        found = []
        for folder, _, names in os.walk(root):
            below = Path(folder).relative_to(root)
            found += [(below / name).as_posix() for name in names if name.lower().endswith(MESH_SUFFIXES)]
        found = sorted(file for file in found if not (root / file).is_symlink())
    except OSError as error:
        raise DataError(root, f"cannot be read ({error})") from error
    if not found:
        raise DataError(root, f"holds no mesh ({', '.join(MESH_SUFFIXES)})")
    if len(found) > MAX_MESHES:
        raise DataError(root, f"holds {len(found)} meshes, the limit is {MAX_MESHES}")
    return MeshFolder(root, tuple(found[:shapes]), root.name)
