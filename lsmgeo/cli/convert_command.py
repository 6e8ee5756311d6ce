"""`lsmgeo convert`: scenes for other programs, and released data sets as shards."""

from __future__ import annotations

from typing import Literal

from lsmgeo.cli.shard_output import count_jobs, print_shards, print_skipped

__all__ = ["convert"]


def convert(
    scene: str,
    to: Literal["colmap", "transforms", "cameras", "shards"] = "colmap",
    out: str = "lsmgeo-convert",
    splits: str | None = None,
    jobs: int = -1,
) -> None:
    """Write posed photographs in the form that another program reads, straightened where their lens bent them.

    Args:
        scene: posed photographs in any form that lsmgeo reads; for shards, a whole tree of the LSM release or of
            3D-R2N2's renderings.
        to: "colmap" is a COLMAP model as text, "transforms" a transforms.json of instant-ngp and nerfstudio, "cameras"
            a plain JSON of K and world-to-camera matrices; "shards" is a training set, as lsmgeo render makes it.
        out: folder to make for the photographs and their cameras; it must not exist or be empty. Run again, shards go
            on where they were.
        splits: for shards, a splits.json that says what is trained on; by default names decide.
        jobs: for shards, worker processes; -1 takes all cores.
    """
    from lsmgeo import data
    from lsmgeo.errors import OptionError

    if to == "shards":
        made = data.convert_set(scene, out, splits=splits, jobs=count_jobs(jobs), progress=True)
        print(f"objects:  {made.shapes}")
        print_shards(made.shards, made.kept, out)
        print_skipped(made.skipped, "objects")
        return
    if splits is not None or jobs != -1:
        raise OptionError(f"convert: splits and jobs are for shards; got to={to!r}")
    images = data.open(scene)
    write = {"colmap": data.write_colmap, "transforms": data.write_transforms, "cameras": data.write_cameras_json}[to]
    folder = write(images, out)
    left = [
        what
        for what, there in (
            ("points", images.points is not None and len(images.points.positions) > 0 and to != "colmap"),
            ("depth", images.depths is not None),
            ("voxels", images.voxels is not None),
        )
        if there
    ]
    bent = sum(lens is not None for lens in images.lenses or ())
    print(f"scene:       {len(images)} photographs, {images.source}")
    if bent:
        print(f"straight:    {bent} photographs had distortion and are written without, as PNG")
    if left:
        print(f"left out:    {', '.join(left)}: {to} is written without")
    print(f"written:     {to} in {folder.resolve()}")
