"""Writes what later versions must still load: ``python -m tests.compatibility.write_files NEW_FOLDER``.

The files of a folder are never written again: a change of a format writes another folder, and both must load.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tarfile
from pathlib import Path

import numpy as np
import torch
import webdataset
from PIL import Image

from lsmgeo.cameras import CameraTensors, orbit
from lsmgeo.data import PosedImages, ShardSet, open_scene, write_cameras_json
from lsmgeo.models import create, load
from lsmgeo.models.weights import write_weights
from tests.data.shapes import write_set
from tests.training.runs import SIZES, configure, losses, run, write_shapes

MODELS = {
    "voxel-lsm": SIZES,
    "depth-lsm": {**SIZES, "planes": 4, "ray_channels": (4, 4)},
    "r2n2": {"channels": (4, 4, 8, 8), "features": 8, "hidden": 4, "decoder": (4, 4, 4)},
    "r2n2-pose": {"channels": (4, 4, 8, 8), "features": 8, "pose_features": 4, "hidden": 4, "decoder": (4, 4, 4)},
}


def write_all(folder: Path) -> None:
    """Write every kind of file, and ``holds.json``: what they held when they were written."""
    folder.mkdir(parents=True)
    with contextlib.chdir(folder):
        write_shapes(Path("shards"))
        write_set(Path("depth"), shards=1)
        write_plain(Path("depth/set-000000.tar"), Path("plain/set-000000.tar"))
        for name, settings in MODELS.items():
            torch.manual_seed(0)
            write_weights(f"{name}.safetensors", create(name, preset="tiny", **settings), half=name == "r2n2")
        run(configure(Path("shards"), keep=1, steps=4, checkpoint_every=4), Path("run"))
        write_scene(Path("scene"))
        Path("holds.json").write_text(json.dumps(what_they_hold(), indent=1) + "\n")


def write_plain(shard: Path, plain: Path) -> None:
    """The first two shapes of a shard as the webdataset library writes them, which knows nothing of our sidecars."""
    plain.parent.mkdir()
    with tarfile.open(shard) as tar, webdataset.TarWriter(str(plain)) as writer:
        for key in ("00000000", "00000001"):
            names = [name for name in tar.getnames() if name.startswith(key + ".")]
            members = {name.partition(".")[2]: tar.extractfile(name).read() for name in names}
            writer.write({"__key__": key, **members})


def write_scene(folder: Path) -> None:
    """Two photographs of different sizes, and their cameras with a skew."""
    cameras = orbit(torch.tensor([0.0, 100.0]), 20.0, 2.0, focal_length=9.5, height=6, width=8)
    intrinsics = cameras.intrinsics.double()
    intrinsics[:, 0, 1] = 0.25
    made = CameraTensors(intrinsics, cameras.cam_from_world.double(), torch.tensor([6, 5]), torch.tensor([8, 7]))
    folder.mkdir()
    for name, size in (("a.png", (6, 8)), ("b.png", (5, 7))):
        pixels = np.arange(size[0] * size[1] * 3, dtype=np.uint8).reshape(*size, 3)
        Image.fromarray(pixels).save(folder / name)
    paths = (folder / "a.png", folder / "b.png")
    write_cameras_json(PosedImages(("a", "b"), paths, made, None, "test"), folder / "cameras.json")


def what_they_hold() -> dict[str, object]:
    """Numbers from every file of the folder that is the current one."""
    scene = open_scene("scene")
    return {
        "models": {name: output_of(name) for name in MODELS},
        "losses": {str(step): loss for step, loss in losses(Path("run")).items()},
        "shards": shapes_of("shards"),
        "depth": shapes_of("depth"),
        "plain": shapes_of("plain"),
        "scene": {
            "intrinsics": scene.cameras.intrinsics.tolist(),
            "cam_from_world": scene.cameras.cam_from_world.tolist(),
            "means": [scene.load(view).mean().item() for view in range(2)],
        },
    }


def output_of(name: str) -> list[float]:
    """A few numbers of what a model makes of two views of a pattern, from its weights."""
    model = load(f"{name}.safetensors").eval()
    cameras = orbit(torch.tensor([10.0, 80.0]), 20.0, 2.0, focal_length=50.0, height=32, width=32)
    images = torch.linspace(0, 7, 2 * 3 * 32 * 32).sin().reshape(1, 2, 3, 32, 32) / 2 + 0.5
    with torch.no_grad():
        answer = model(images, cameras)
    return answer[0].flatten()[::97][:20].tolist()


def shapes_of(folder: str) -> list[dict[str, object]]:
    """Names and sums of a set's shapes."""
    shards = ShardSet(folder)
    found = []
    for index in range(len(shards)):
        sample = shards.read(index, depth=folder != "shards", occupancy=16)
        found.append({
            "name": sample.name, "category": sample.category, "split": shards.splits[index],
            "image": sample.images.double().sum().item(), "voxels": int(sample.occupancy.sum()),
            "depth": 0 if sample.depth is None else sample.depth.double().sum().item(),
            "cameras": sample.cameras.cam_from_world.double().sum().item(),
        })  # fmt: skip
    return found


if __name__ == "__main__":
    write_all(Path(sys.argv[1]))
