"""Published training sets of rendered objects, converted to the shards that `render_set` writes."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch

from lsmgeo._checks import check_flag, check_whole
from lsmgeo.data.formats.format_lsm import read_lsm_object
from lsmgeo.data.formats.format_r2n2 import METADATA, read_r2n2
from lsmgeo.data.json_files import read_json
from lsmgeo.data.read_files import os_errors_as_data_errors
from lsmgeo.data.sample import Sample
from lsmgeo.data.shards.render_set import SetOptions, SetResult, write_set
from lsmgeo.data.shards.shape_sources import (
    FileSource,
    Recipe,
    RenderedShape,
    rendered_shape,
    sort_paths,
    split_by_name,
    walk,
)
from lsmgeo.data.shards.shard_metadata import MAX_SIDE, MAX_VOXELS
from lsmgeo.errors import DataError

__all__ = ["LsmTree", "ObjectTree", "R2n2Tree", "convert_set", "open_tree", "read_splits"]

VERSION = 1
IDENTIFIER = re.compile(r"[A-Za-z0-9_-]{1,128}")
PARTS = ("train", "val", "test")
# The largest depth of a shard's 16-bit images at the default step.
MAX_DEPTH = 65535 * 5e-5


def convert_set(
    source: str | Path,
    out: str | Path,
    *,
    voxels: Sequence[int] | None = None,
    depth: bool = True,
    splits: str | Path | None = None,
    shapes: int | None = None,
    per_shard: int = 50,
    jobs: int = -1,
    on_error: str = "skip",
    overwrite: bool = False,
    progress: bool = False,
) -> SetResult:
    """Convert a tree of the LSM release or of 3D-R2N2's renderings into shards, as `ShardSet` reads them.

    Parsers that a damaged file can crash run in isolated processes; an object with such a file is left out like any
    other that cannot be used. Complete shards are kept, so a stopped run continues where it was; see `render_set`.

    Convention:
        That of `read_lsm` and `read_r2n2`. The cube of the voxels becomes [-0.5, 0.5]^3, which it already is in the LSM
        release; for 3D-R2N2 the cameras are scaled with it.

    Args:
        source: the folder with ``renders`` and ``voxels`` of the LSM release; or one with folders
            ``MODEL/rendering`` at any depth, such as that of ShapeNetRendering and ShapeNetVox32.
        out: the folder for the shards.
        voxels: resolutions to keep; by default all: 32 and 64 of the LSM release, 32 of 3D-R2N2.
        depth: whether depth is kept, if the source has it (the LSM release does).
        splits: a ``splits.json`` with the split (train, val or test) of each object; other objects are left out. By
            default the split depends on the object's name, 0.7 / 0.1 / 0.2.
        shapes: convert only the first so many objects.
        per_shard: objects in a shard.
        jobs: worker processes; -1 for all cores, 1 for only this process.
        on_error: "skip" leaves out and reports objects that cannot be used, "raise" stops at the first.
        overwrite: replace shards made with other settings; without it they are an error.
        progress: show a progress bar.

    Returns:
        `SetResult`.

    Raises:
        OptionError: an option out of range, or joblib or SciPy is missing.
        DataError: the source or the splits cannot be read, no object can be used, the folder cannot be written, or it
            holds shards of another set.
    """
    who = "convert_set"
    check_flag(who, "depth", depth)
    tree = open_tree(source, splits)
    if shapes is not None:
        tree = tree.part(0, min(check_whole(who, "shapes", shapes, 1, 10**8), len(tree)))
    # Views and size are those of the files; the numbers here distinguish sets and count progress.
    is_lsm = isinstance(tree, LsmTree)
    views, size, all_voxels = (20, 224, (32, 64)) if is_lsm else (24, 137, (32,))
    kept = all_voxels if voxels is None else tuple(voxels)
    recipe = Recipe(views=views, size=size, voxels=kept, depth=depth and is_lsm)
    options = SetOptions(per_shard, jobs, on_error, overwrite, progress)
    return write_set(tree, out, recipe, options, who=who, where=source)


class Splits(NamedTuple):
    """The split of each object, by "SYNSET/MODEL", and the file that states it."""

    file: Path
    part_of: Mapping[str, str]


def read_splits(path: str | Path) -> Splits:
    """Read a ``splits.json``: ``{synset: {"name": ..., "train": [...], "val": [...], "test": [...]}}``.

    Raises:
        DataError: the file is missing, damaged or too large, has an invalid identifier, or puts an object into two
            splits.
    """
    path = Path(path)
    part_of: dict[str, str] = {}
    for synset, parts in read_json(path).items():
        if not IDENTIFIER.fullmatch(synset) or not isinstance(parts, dict) or not set(parts) <= {"name", *PARTS}:
            raise DataError(path, f"{synset[:80]!r} must be a synset with name, train, val and test")
        for part in PARTS:
            models = parts.get(part, [])
            if not isinstance(models, list):
                raise DataError(path, f"{synset}: {part} must be a list of models")
            for model in models:
                if not isinstance(model, str) or not IDENTIFIER.fullmatch(model):
                    raise DataError(path, f"{synset}: {part} holds {str(model)[:80]!r}, not an identifier of a model")
                if part_of.setdefault(f"{synset}/{model}", part) != part:
                    raise DataError(path, f"{synset}: {model} is in two parts")
    return Splits(path, part_of)


@dataclass(frozen=True)
class ObjectTree(FileSource):
    """Objects with their own views and voxels; their paths are those of their folders.

    Attributes:
        splits: the split of each object; None to choose it by the name.
    """

    splits: Splits | None = None

    def part(self, start: int, stop: int) -> Self:
        """Only these objects."""
        some = super().part(start, stop)
        if some.splits is None:
            return some
        known = some.splits.part_of
        part_of = {key: known[key] for path in some.paths if (key := _key(path)) in known}
        return replace(some, splits=some.splits._replace(part_of=part_of))

    def identity(self) -> Any:
        """SHA-256 of the files of all objects, and their splits."""
        parts = None if self.splits is None else sorted(self.splits.part_of.items())
        files = [[path, *(f"{name} {digest}".strip() for name, digest in self.digests(path))] for path in self.paths]
        return [VERSION, type(self).__name__, parts, files]

    def _render(self, index: int, recipe: Recipe) -> RenderedShape:
        key, folder = _key(self.paths[index - self.first]), Path(self.file(index))
        if self.splits is not None and key not in self.splits.part_of:
            raise DataError(folder, f"is in no part of {self.splits.file}")
        sample, grids = self._read(index, recipe)
        _check(sample, grids, folder)
        split = split_by_name(key) if self.splits is None else self.splits.part_of[key]
        return rendered_shape(sample._replace(name=key), grids, split)

    @abstractmethod
    def _read(self, index: int, recipe: Recipe) -> tuple[Sample, tuple[torch.Tensor, ...]]:
        """The views, and the occupancy of each resolution of the recipe."""


def _key(name: str) -> str:
    """SYNSET/MODEL of an object's path."""
    return "/".join(name.split("/")[-2:])


def _check(sample: Sample, grids: tuple[torch.Tensor, ...], folder: Path) -> None:
    """Refuse objects that a shard cannot hold."""
    if max(sample.images.shape[2:]) > MAX_SIDE or any(len(grid) > MAX_VOXELS for grid in grids):
        raise DataError(folder, f"has images beyond {MAX_SIDE} pixels or voxels beyond {MAX_VOXELS} a side")
    if sample.mask is None or not bool(sample.mask.any()):
        raise DataError(folder, "is visible in none of its views")
    if sample.depth is not None and float(sample.depth.max()) > MAX_DEPTH:
        raise DataError(folder, f"has depth beyond {MAX_DEPTH:.4g}, the largest depth of a shard")


class LsmTree(ObjectTree):
    """The LSM release: ``renders/SYNSET/MODEL`` and ``voxels`` beside ``renders``."""

    def _files(self, folder: Path) -> list[Path]:
        voxels = (self.root / "voxels").glob(f"modelVoxels*/{folder.parent.name}/{folder.name}.mat")
        renders = (file for file in folder.iterdir() if file.suffix in (".png", ".mat"))
        return sorted([*renders, *voxels])

    def _read(self, index: int, recipe: Recipe) -> tuple[Sample, tuple[torch.Tensor, ...]]:
        folder = Path(self.file(index))
        scene, grids = read_lsm_object(folder, recipe.voxels)
        if len(grids) != len(recipe.voxels):
            raise DataError(folder, f"lacks voxels: has {len(grids)} of the resolutions {recipe.voxels}")
        sample = (scene if recipe.depth else replace(scene, depths=None)).sample()
        if recipe.depth and sample.depth is None:
            raise DataError(folder, "lacks the depth of a view")
        return sample, grids


class R2n2Tree(ObjectTree):
    """3D-R2N2's renderings: folders with ``rendering/rendering_metadata.txt``, and their voxels."""

    def _files(self, folder: Path) -> list[Path]:
        apart = self.root / "ShapeNetVox32" / folder.parent.name / folder.name / "model.binvox"
        voxels = (file for file in (folder / "model.binvox", apart) if file.is_file())
        renders = (file for file in (folder / "rendering").iterdir() if file.suffix in (".png", ".txt"))
        return sorted([*renders, *voxels])

    def _read(self, index: int, recipe: Recipe) -> tuple[Sample, tuple[torch.Tensor, ...]]:
        folder = Path(self.file(index))
        scene = read_r2n2(folder)
        sides = () if scene.voxels is None else (len(scene.voxels.occupancy),)
        if scene.voxels is None or (recipe.voxels and sides != recipe.voxels):
            raise DataError(folder, f"must have voxels of the resolutions {recipe.voxels}; found {sides or 'none'}")
        sample = scene.sample()
        return sample, (scene.voxels.occupancy,) if recipe.voxels else ()


def open_tree(source: str | Path, splits: str | Path | None = None) -> ObjectTree:
    """Open a tree of the LSM release or of 3D-R2N2's renderings; its folders decide which.

    Raises:
        DataError: the folder cannot be read, has no object, or one with an invalid name; or the splits cannot be used.
    """
    root = Path(source)
    if not root.is_dir():
        raise DataError(root, "is not a folder of rendered objects")
    root = root.resolve()
    kind: type[ObjectTree] = LsmTree if (root / "renders").is_dir() else R2n2Tree
    folders = _lsm_folders(root) if kind is LsmTree else _r2n2_folders(root)
    found = sort_paths(root, folders, f"renders/SYNSET/MODEL or MODEL/rendering/{METADATA}")
    strange = next((name for name in found if not all(IDENTIFIER.fullmatch(part) for part in name.split("/"))), None)
    if strange is not None:
        raise DataError(root, f"holds an object with an invalid name: {strange[:80]!r}")
    name = root.name.lstrip(".") or "objects"
    return kind(root, found, name, splits=None if splits is None else read_splits(splits))


def _lsm_folders(root: Path) -> Iterator[Path]:
    with os_errors_as_data_errors(root, "read"):
        for synset in (root / "renders").iterdir():
            if synset.is_dir() and not synset.is_symlink():
                yield from (folder for folder in synset.iterdir() if folder.is_dir() and not folder.is_symlink())


def _r2n2_folders(root: Path) -> Iterator[Path]:
    for folder, names in walk(root):
        if folder.name == "rendering" and METADATA in names and folder.parent != root:
            yield folder.parent
