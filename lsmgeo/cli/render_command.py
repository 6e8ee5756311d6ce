"""`lsmgeo render`: a training set from shapes."""

from __future__ import annotations

import re
from contextlib import ExitStack
from typing import Literal

from lsmgeo.cli.shard_output import count_jobs, print_shards, print_skipped

__all__ = ["render"]

CLUSTER_SECONDS = 20


def render(
    source: str = "synthetic-13",
    shapes: int | None = None,
    views: int = 20,
    out: str = "lsmgeo-set",
    size: int = 224,
    voxels: str = "32,64",
    depth: bool = True,
    shadows: bool = False,
    seed: int = 0,
    per_shard: int = 50,
    jobs: int = -1,
    cluster: str | None = None,
    on_error: Literal["skip", "raise"] = "skip",
    overwrite: bool = False,
) -> None:
    """Make a training set: views, depth and voxels of many shapes, in tar shards; run again, it is continued.

    Args:
        source: "synthetic-13", or a folder of meshes such as a ShapeNetCore tree.
        shapes: number of shapes; by default all meshes of the folder.
        views: images of each shape.
        out: folder for the shards; created if it does not exist.
        size: height and width of the images in pixels.
        voxels: resolutions of the occupancy grids, such as 32 or 32,64.
        depth: whether to write depth.
        shadows: whether shapes cast shadows on themselves.
        seed: seed of shapes, lights and views.
        per_shard: shapes in a shard.
        jobs: worker processes; -1 uses all cores.
        cluster: address of a Dask scheduler with workers that have access to the same folders; by default only this
            machine is used.
        on_error: what to do with a mesh that cannot be used.
        overwrite: whether to replace shards that were made with other settings.
    """
    import time

    from lsmgeo.data import Recipe, render_set
    from lsmgeo.errors import OptionError

    if not re.fullmatch(r"[0-9]+(,[0-9]+)*", voxels):
        raise OptionError(f"render: voxels must be whole numbers separated by commas, such as 32,64; got {voxels!r}")
    sides = tuple(int(side[:6]) for side in voxels.split(","))
    start = time.perf_counter()
    with ExitStack() as stack:
        if cluster is not None:
            _join(cluster, stack)
        made = render_set(
            source,
            out,
            Recipe(seed, views, size, sides, depth, shadows),
            shapes=shapes,
            per_shard=per_shard,
            jobs=count_jobs(jobs) if cluster is None else jobs,
            on_error=on_error,
            overwrite=overwrite,
            progress=True,
        )
    seconds = time.perf_counter() - start
    print(f"shapes:   {made.shapes}, {views} views each at {size} x {size}")
    print_shards(made.shards, made.kept, out)
    if made.kept < len(made.shards):
        fresh = "" if made.kept else f", {made.shapes * views / seconds:.0f} views a second"
        print(f"time:     {seconds:.1f} s{fresh}")
    print_skipped(made.skipped, "meshes")


def _join(address: str, stack: ExitStack) -> None:
    """Run joblib on a Dask cluster."""
    from lsmgeo.errors import OptionError

    try:
        import joblib
        from distributed import Client
    except ImportError as error:
        raise OptionError("render: cluster needs joblib and distributed; install them first") from error
    try:
        stack.enter_context(Client(address, timeout=CLUSTER_SECONDS))
    except (OSError, ValueError) as error:
        raise OptionError(f"render: no Dask scheduler answers at cluster {address!r} ({error})") from error
    stack.enter_context(joblib.parallel_config("dask"))
