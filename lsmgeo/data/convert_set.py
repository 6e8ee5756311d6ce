"""Training sets of objects that others have rendered: their trees become the shards that `render_set` writes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lsmgeo._checks import check_flag, check_whole
from lsmgeo.data.object_trees import LsmTree, open_tree
from lsmgeo.data.render_set import Made, make_set
from lsmgeo.data.sources import Recipe

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = ["convert_set"]


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
) -> Made:
    """Convert a tree of the LSM release or of 3D-R2N2's renderings into shards, once, as `ShardSet` reads them.

    Parsers that a file can crash run in processes of their own; an object with such a file is left out like any other
    that cannot be used. Shards that are there and whole are kept, so a run that was stopped goes on where it was; see
    `render_set`.

    Convention:
        As `read_lsm` and `read_r2n2` give them. The cube of the voxels becomes [-0.5, 0.5]^3, which it is already in
        the LSM release; for 3D-R2N2 cameras are scaled with it.

    Args:
        source: the folder with ``renders`` and ``voxels`` of the LSM release; or one with folders
            ``MODEL/rendering`` at any depth, such as that of ShapeNetRendering and ShapeNetVox32.
        out: the folder for the shards.
        voxels: resolutions to keep; by default all: 32 and 64 of the LSM release, 32 of 3D-R2N2.
        depth: whether depth is kept, where the source has it; the LSM release has.
        splits: a ``splits.json`` that puts every object into train, val or test; objects that it does not name are left
            out. By default names decide, 0.7 / 0.1 / 0.2.
        shapes: the first so many objects alone.
        per_shard: objects in a shard.
        jobs: worker processes; -1 takes all cores, 1 works in this process.
        on_error: "skip" leaves out objects that cannot be used and reports them, "raise" stops at the first.
        overwrite: make shards again that were made with other settings; without it they are an error.
        progress: show a bar.

    Returns:
        `Made`.

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
    # Views and size are those of the files; here they only tell sets apart and count progress.
    if isinstance(tree, LsmTree):
        recipe = Recipe(views=20, size=224, voxels=(32, 64), depth=depth)
    else:
        recipe = Recipe(views=24, size=137, voxels=(32,), depth=False)
    if voxels is not None:
        recipe = recipe._replace(voxels=tuple(voxels))
    return make_set(
        tree,
        out,
        recipe,
        per_shard=per_shard,
        jobs=jobs,
        on_error=on_error,
        overwrite=overwrite,
        progress=progress,
        who=who,
        where=source,
    )
