"""`lsmgeo convert`: scenes in the formats of other programs, and released data sets as shards."""

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
    """Write posed images in the format of another program, without lens distortion; or a data set as shards.

    Args:
        scene: posed images in any supported format; for shards, a tree of the LSM release or of the renderings of
            3D-R2N2.
        to: "colmap" is a COLMAP model as text, "transforms" a transforms.json of instant-ngp and nerfstudio, "cameras"
            a plain JSON of K and world-to-camera matrices; "shards" is a training set, as from lsmgeo render.
        out: folder for the images and their cameras; it must be new or empty. Run again, shards are continued.
        splits: for shards, a splits.json with the splits; by default they follow from the names.
        jobs: for shards, worker processes; -1 uses all cores.
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
    has = {
        "points": images.points is not None and len(images.points.positions) > 0 and to != "colmap",
        "depth": images.depths is not None,
        "voxels": images.voxels is not None,
    }
    left_out = [what for what, exists in has.items() if exists]
    distorted = sum(lens is not None for lens in images.lenses or ())
    print(f"scene:       {len(images)} images, {images.source}")
    if distorted:
        print(f"undistorted: {distorted} images had lens distortion and are written without it, as PNG")
    if left_out:
        print(f"left out:    {', '.join(left_out)}, which {to} is written without")
    print(f"written:     {to} in {folder.resolve()}")
