"""Shards: what is written is read, by us and by others; damage is noticed."""

import gc
import io
import json
import os
import pickle
import tarfile

import numpy as np
import pytest
import torch
import webdataset
from PIL import Image

from lsmgeo import scenes
from lsmgeo.data import ShardSet, encode_sample, hash_settings, verify_shard, write_shard
from lsmgeo.data.images import DEPTH, RGBA, decode_png, encode_png
from lsmgeo.data.shards import read_shards
from lsmgeo.errors import CameraError, DataError, DTypeError, OptionError, ShapeError
from tests.data.shapes import SETTINGS, STEP, assert_equal, make_shape, write_set

NAMES = ["set-000000.json", "set-000000.tar", "set-000001.json", "set-000001.tar"]
pytestmark = pytest.mark.timeout(120)


def test_what_is_written_is_read(tmp_path):
    shapes = write_set(tmp_path)
    shards = ShardSet(tmp_path)
    assert sorted(os.listdir(tmp_path)) == NAMES
    assert shards.names == [shape.name for shape in shapes]
    assert shards.categories == [shape.category for shape in shapes]
    assert shards.splits == [shape.split for shape in shapes]
    assert shards.view_counts.tolist() == [3] * 6
    for index in (5, 0, 3):
        assert_equal(shards.read(index, occupancy=8), shapes[index], range(3))
        assert_equal(shards.read(index, views=[2, 0], occupancy=16), shapes[index], (2, 0), side=16)
        bare = shards.read(index, views=np.array([1]), depth=False, occupancy=None, background=(0.25, 0, 1))
        assert bare.depth is None
        assert_equal(bare, shapes[index], (1,), background=(0.25, 0, 1), side=None)
        assert shards.metadata(index).seed == index
        assert shards.metadata(index).source == "test"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # theirs leaves files open
def test_others_read_it(tmp_path):
    shapes = write_set(tmp_path, shards=1)
    count = 0
    reader = webdataset.WebDataset(str(tmp_path / "set-000000.tar"), shardshuffle=False)
    for number, (found, shape) in enumerate(zip(reader, shapes, strict=True)):
        assert found["__key__"] == f"{number:08d}"
        metadata = json.loads(found["json"])
        assert (metadata["name"], metadata["category"], metadata["split"]) == shape[:3]
        assert (metadata["key"], metadata["seed"], metadata["source"]) == (f"{number:08d}", number, "test")
        assert (metadata["views"], metadata["size"], metadata["voxels"]) == (3, [12, 16], [8, 16])
        np.testing.assert_array_equal(metadata["cameras"]["intrinsics"], shape.K)
        np.testing.assert_array_equal(metadata["cameras"]["cam_from_world"], shape.E)
        for view in range(3):
            image = np.array(Image.open(io.BytesIO(found[f"{view:02d}.png"])))
            np.testing.assert_array_equal(image[..., :3], shape.pixels[view])
            np.testing.assert_array_equal(image[..., 3], 255 * shape.mask[view])
            depth = np.array(Image.open(io.BytesIO(found[f"{view:02d}.depth.png"])))
            np.testing.assert_array_equal(depth, shape.steps[view])
        for side, grid in shape.grids.items():
            packed = np.load(io.BytesIO(found[f"vox{side}.npy"]))
            np.testing.assert_array_equal(np.unpackbits(packed, axis=-1), grid)
        count += 1
    assert count == 3
    del reader, found
    gc.collect()


def test_headers_hold_only_names_and_sizes(tmp_path):
    write_set(tmp_path, shards=1)
    with tarfile.open(tmp_path / "set-000000.tar") as tar:
        for info in tar.getmembers():
            assert info.isreg()
            assert (info.mtime, info.uid, info.gid, info.uname, info.gname, info.mode) == (0, 0, 0, "", "", 0o644)
        first = tar.getnames()[:9]
    views = [f"{view:02d}{kind}.png" for view in range(3) for kind in ("", ".depth")]
    assert first == [f"00000000.{suffix}" for suffix in ("json", *views, "vox8.npy", "vox16.npy")]


def test_the_same_content_gives_the_same_bytes(tmp_path):
    write_set(tmp_path / "a")
    write_set(tmp_path / "b")
    for name in NAMES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_depth_is_off_by_half_a_step(tmp_path):
    shape = make_shape(0)
    rng = np.random.default_rng(5)
    depth = rng.uniform(1.0, 3.2, shape.mask.shape).astype(np.float32) * shape.mask
    depth[0, 0, 0] = 1e-9  # seen, however near
    sample = shape.sample()._replace(depth=torch.from_numpy(depth), mask=None)
    write_shard(tmp_path / "a.tar", [(0, encode_sample(sample, 0))], SETTINGS)
    read = ShardSet(tmp_path).read(0, occupancy=8)
    expected = np.where(depth == np.float32(1e-9), np.float32(STEP), depth)
    np.testing.assert_allclose(read.depth.numpy(), expected, rtol=0, atol=0.5 * STEP + 1e-6)
    np.testing.assert_array_equal(read.depth.numpy() > 0, depth > 0)
    np.testing.assert_array_equal(read.mask.numpy(), depth > 0)  # where there is depth, there is the object


def test_a_sample_of_only_images(tmp_path):
    sample = make_shape(0).sample()._replace(depth=None, mask=None, occupancy=None, mesh=None, category=None)
    members = encode_sample(sample, "00000007")
    assert list(members) == ["json", "00.png", "01.png", "02.png"]
    write_shard(tmp_path / "a.tar", [(7, members)], SETTINGS)
    shards = ShardSet(tmp_path)
    read = shards.read(0, depth=False, occupancy=None)
    assert read.mask.all()
    torch.testing.assert_close(read.images, sample.images, rtol=0, atol=0)
    assert (read.mesh, read.category, shards.splits) == (None, None, [None])
    with pytest.raises(DataError, match="has no depth; read it with depth=False"):
        shards.read(0, occupancy=None)
    with pytest.raises(DataError, match="no occupancy of int 32 voxels; it has none"):
        shards.read(0, depth=False)


SAMPLE = make_shape(0).sample()


@pytest.mark.parametrize(
    ("change", "options", "error", "match"),
    [
        ({"images": SAMPLE.images + 0.1}, {}, OptionError, r"images must be in \[0, 1\]"),
        ({"images": SAMPLE.images * torch.nan}, {}, OptionError, r"images must be in \[0, 1\]; got \[nan"),
        ({"depth": -SAMPLE.depth}, {}, OptionError, "depth must be in"),
        ({"depth": SAMPLE.depth * torch.nan}, {}, OptionError, "depth must be in"),
        ({"depth": SAMPLE.depth + 4}, {}, OptionError, "depth_step = 3.27675"),
        ({"depth": SAMPLE.depth * torch.inf}, {}, OptionError, "depth must be in"),
        ({}, {"depth_step": 0}, OptionError, "depth_step must be a positive"),
        ({}, {"depth_step": "x"}, OptionError, "depth_step must be a positive"),
        ({}, {"more_occupancy": [SAMPLE.occupancy]}, OptionError, "two occupancy grids of 8"),
        ({}, {"more_occupancy": [SAMPLE.occupancy[:4]]}, ShapeError, r"\(n, n, n\)"),
        ({}, {"more_occupancy": [torch.ones(4, 4, 4)]}, DTypeError, "bool tensors"),
        ({}, {"seed": -1}, OptionError, "seed must be"),
        ({}, {"split": ""}, OptionError, "split must be"),
        ({"name": "a\nb"}, {}, OptionError, "name must be 1 to 1024 printable"),
        ({"cameras": SAMPLE.cameras._replace(intrinsics=-SAMPLE.cameras.intrinsics)}, {}, CameraError, "last row"),
    ],
)
def test_what_is_not_encoded(change, options, error, match):
    assert "json" in encode_sample(SAMPLE, 3)
    with pytest.raises(error, match=match):
        encode_sample(SAMPLE._replace(**change), 3, **options)


@pytest.mark.parametrize("key", [-1, 10**8, "1", "0000000x", True, None, "0000000\u0661"])
def test_keys_are_eight_digits(key):
    with pytest.raises(OptionError, match="key must be"):
        encode_sample(SAMPLE, key)


def test_what_is_no_shard(tmp_path):
    members = encode_sample(SAMPLE, 0)
    path = tmp_path / "a.tar"
    for wrong, error, match in (
        ([], OptionError, "no shape to write"),
        ([(0, members), (0, members)], OptionError, "the key '00000000' comes twice"),
        ([(0, members), (1, encode_sample(SAMPLE, 1))], OptionError, f"the name {SAMPLE.name!r} comes twice"),
        ([(1, members)], OptionError, "belongs to key"),
        ([(0, {**members, "../x": b""})], OptionError, "must be those of encode_sample"),
        ([(0, dict(reversed(members.items())))], OptionError, "json first"),
        ([(0, {**members, "json": b"{"})], OptionError, "is not JSON"),
    ):
        with pytest.raises(error, match=match):
            write_shard(path, wrong, SETTINGS)
    for name in ("a.zip", ".a.tar"):
        with pytest.raises(DataError, match="must end in"):
            write_shard(tmp_path / name, [(0, members)], SETTINGS)
    for settings in ("", 3, "x" * 200):
        with pytest.raises(OptionError, match="settings_hash must be"):
            write_shard(path, [(0, members)], settings)
    with pytest.raises(OptionError, match="must be JSON values"):
        hash_settings({"views": torch.ones(1)})
    assert list(tmp_path.iterdir()) == []


def test_verifying(tmp_path):
    write_set(tmp_path, shards=1)
    path, sidecar = tmp_path / NAMES[1], tmp_path / NAMES[0]
    content, index = path.read_bytes(), sidecar.read_bytes()
    assert verify_shard(path, SETTINGS) is True
    assert verify_shard(path, hash_settings({"made": "otherwise"})) is False
    assert verify_shard(tmp_path / "other.tar", SETTINGS) is False
    rng = np.random.default_rng(0)
    for position in rng.integers(len(content), size=60):
        flipped = bytearray(content)
        flipped[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        assert verify_shard(path, SETTINGS) is False
    for length in (0, 1, 511, 512, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert verify_shard(path, SETTINGS) is False
        with pytest.raises(DataError, match=r"set-000000.json: belongs to"):
            ShardSet(tmp_path)
    path.write_bytes(content)
    damaged = [index[:length] for length in (0, 1, len(index) // 2, len(index) - 1)]
    for position in rng.integers(len(index), size=60):
        flipped = bytearray(index)
        flipped[position] ^= 1 << int(rng.integers(8))
        damaged.append(bytes(flipped))
    for wrong in damaged:
        sidecar.write_bytes(wrong)
        assert verify_shard(path, SETTINGS) is False
        with pytest.raises(DataError, match=r"set-000000.json: is (damaged|not the index)"):
            ShardSet(tmp_path)
    sidecar.write_bytes(index)
    assert verify_shard(path, SETTINGS) is True
    sidecar.unlink()
    assert verify_shard(path, SETTINGS) is False


def read_all(folder):
    shards = ShardSet(folder)
    return [shards.read(index, occupancy=16) for index in range(len(shards))]


@pytest.mark.parametrize("indexed", [True, False])
def test_damage_in_a_member_is_reported_or_does_not_matter(tmp_path, indexed):
    """Every flipped bit gives a DataError that names the tar, or (in padding and the like) what was written.

    Without a sidecar there are no check sums of occupancy and json: there the values may change, within their rules.
    """
    shapes = write_set(tmp_path, shards=1)
    path = tmp_path / NAMES[1]
    content = path.read_bytes()
    if not indexed:
        (tmp_path / NAMES[0]).unlink()
    rng = np.random.default_rng(1)
    told = failures = 0
    for position in rng.integers(len(content), size=150):
        flipped = bytearray(content)
        flipped[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            samples = read_all(tmp_path)
        except DataError as error:
            failures += 1
            told += str(path) in str(error)
            continue
        for sample, shape in zip(samples, shapes, strict=True):
            if indexed:
                assert_equal(sample, shape, range(3), side=16)
            else:
                assert sample.images.shape == (3, 3, 12, 16)
    assert told == failures
    assert told > (20 if indexed else 10)


def test_a_shard_without_a_sidecar_is_indexed_from_its_headers(tmp_path):
    shapes = write_set(tmp_path)
    (tmp_path / NAMES[0]).unlink()
    shards = ShardSet(tmp_path)
    assert shards.categories == [shape.category for shape in shapes]
    assert shards.splits == [shape.split for shape in shapes]
    for index, shape in enumerate(shapes):
        assert_equal(shards.read(index, occupancy=8), shape, range(3))
    assert sorted(os.listdir(tmp_path)) == NAMES[1:]


def test_a_shard_of_another_tar_program(tmp_path):
    """Other headers, other order, extended headers: what a tar program makes of the unpacked members."""
    shapes = write_set(tmp_path / "ours", shards=1)
    with tarfile.open(tmp_path / "ours" / NAMES[1]) as tar:
        members = [(info.name, tar.extractfile(info).read()) for info in tar.getmembers()]
    with tarfile.open(tmp_path / "b.tar", "w", format=tarfile.PAX_FORMAT) as tar:
        for name, content in sorted(members):
            info = tarfile.TarInfo(name)
            info.size, info.mtime, info.uname = len(content), 1234.5, "some one"
            tar.addfile(info, io.BytesIO(content))
    shards = ShardSet(tmp_path)
    for index, shape in enumerate(shapes):
        assert_equal(shards.read(index, occupancy=8), shape, range(3))


def test_only_what_is_asked_for_is_read(tmp_path):
    """All else of the shard is damaged."""
    shape = write_set(tmp_path, shards=1)[1]
    content = bytearray((tmp_path / NAMES[1]).read_bytes())
    with tarfile.open(tmp_path / NAMES[1]) as tar:
        for info in tar.getmembers():
            if not info.name.endswith(".json") and info.name != "00000001.02.png":
                content[info.offset_data : info.offset_data + info.size] = bytes(info.size)
    (tmp_path / NAMES[1]).write_bytes(content)
    assert_equal(ShardSet(tmp_path).read(1, views=[2], depth=False, occupancy=None), shape, (2,), side=None)


def test_sets_go_to_other_processes(tmp_path):
    shapes = write_set(tmp_path)
    shards = ShardSet(tmp_path)
    assert_equal(shards.read(4, occupancy=8), shapes[4], range(3))
    assert_equal(pickle.loads(pickle.dumps(shards)).read(4, occupancy=8), shapes[4], range(3))
    child = os.fork()
    if child == 0:
        status = 1
        try:
            assert_equal(shards.read(4, occupancy=8), shapes[4], range(3))
            assert_equal(shards.read(0, occupancy=8), shapes[0], range(3))
            status = 0
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0
    assert_equal(shards.read(5, occupancy=8), shapes[5], range(3))


def test_few_files_are_open_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(read_shards, "OPEN_FILES", 2)
    shapes = write_set(tmp_path, shards=5, each=1)
    shards = ShardSet(tmp_path)
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(2):
        for index, shape in enumerate(shapes):
            assert_equal(shards.read(index, occupancy=8), shape, range(3))
            assert len(os.listdir("/proc/self/fd")) <= before + 2


def test_a_shard_that_changes_is_noticed(tmp_path):
    write_set(tmp_path, shards=1)
    shards = ShardSet(tmp_path)
    with (tmp_path / NAMES[1]).open("ab") as stream:
        stream.write(b"\0")
    with pytest.raises(DataError, match="has changed since"):
        shards.read(0, occupancy=8)
    (tmp_path / NAMES[1]).unlink()
    with pytest.raises(DataError, match="cannot be read"):
        shards.read(0, occupancy=8)


@pytest.mark.parametrize(
    ("index", "options", "match"),
    [
        (6, {}, "index must be an integer from 0 to 5"),
        (-1, {}, "index must be"),
        ("a", {}, "index must be"),
        (0, {"views": []}, "views must be numbers from 0 to 2"),
        (0, {"views": [3]}, "views must be"),
        (0, {"views": [0.5]}, "views must be"),
        (0, {"views": 3}, "views must be"),
        (0, {"depth": 1}, "depth must be True or False"),
        (0, {"background": (0, 1)}, "background must be"),
        (0, {"background": (0, 1, 2)}, "background must be"),
        (0, {"background": 7}, "background must be"),
        (0, {"background": "random"}, "needs a generator"),
    ],
)
def test_what_is_not_read(tmp_path, index, options, match):
    write_set(tmp_path)
    with pytest.raises(OptionError, match=match):
        ShardSet(tmp_path).read(index, **{"occupancy": 8, **options})


def test_backgrounds_from_a_folder(tmp_path):
    shapes = write_set(tmp_path / "set", shards=1)
    folder = tmp_path / "folder"
    folder.mkdir()
    v, u = np.mgrid[:30, :50].astype(np.uint8)
    Image.fromarray(np.stack([4 * u, 4 * v, np.full_like(u, 9)], -1)).save(folder / "ramp.png")
    (folder / "notes.txt").write_text("no image")
    shards = ShardSet(tmp_path / "set")

    def read(seed):
        return shards.read(1, occupancy=8, background=folder, generator=np.random.default_rng(seed))

    sample = read(0)
    assert torch.equal(sample.images, read(0).images)
    assert not torch.equal(sample.images, read(1).images)
    images, mask = 255 * sample.images.numpy(), shapes[1].mask
    np.testing.assert_array_equal(images.transpose(0, 2, 3, 1)[mask].round(), shapes[1].pixels[mask])
    for image, inside in zip(images, mask, strict=True):
        # A cutting of the ramp, scaled: red grows to the right, green downwards, between 1 and 2 source pixels a pixel.
        np.testing.assert_allclose(image[2][~inside], 9, atol=0.01)
        for values, axis in ((image[0], 1), (image[1], 0)):
            steps = np.diff(values, axis=axis)[1:-1, 1:-1]
            outside = ~(inside[1:, :] | inside[:-1, :] if axis == 0 else inside[:, 1:] | inside[:, :-1])[1:-1, 1:-1]
            assert 3 <= steps[outside].mean() <= 11
    (folder / "ramp.png").write_bytes(b"GIF89a")
    with pytest.raises(DataError, match="not a readable PNG"):
        read(0)
    (folder / "ramp.png").unlink()
    with pytest.raises(DataError, match="holds no PNG or JPEG"):
        read(0)
    with pytest.raises(DataError, match="is not a folder of backgrounds"):
        shards.read(0, background="whlte", occupancy=8)


def test_drawn_backgrounds(tmp_path):
    """One for each view, drawn with the generator that was given."""
    shape = write_set(tmp_path, shards=1)[2]
    options = {"views": [1, 0], "occupancy": 8, "background": "random", "generator": np.random.default_rng(4)}
    sample = ShardSet(tmp_path).read(2, **options)
    generator = np.random.default_rng(4)
    behind = np.stack([scenes.background(generator, 12, 16).permute(1, 2, 0).numpy() for _ in range(2)])
    assert not np.array_equal(behind[0], behind[1])
    colours, mask = shape.pixels[[1, 0]] / np.float32(255), shape.mask[[1, 0]][..., None]
    np.testing.assert_array_equal(sample.images.permute(0, 2, 3, 1).numpy(), np.where(mask, colours, behind))


def test_names_are_unique_in_a_set(tmp_path):
    for shard in range(2):
        write_shard(tmp_path / f"{shard}.tar", [(shard, encode_sample(SAMPLE, shard))], SETTINGS)
    with pytest.raises(DataError, match=r"two shapes are named 'shape-0', in 0.tar and 1.tar"):
        ShardSet(tmp_path)
    (tmp_path / "1.tar").unlink()
    (tmp_path / "0.json").unlink()
    with tarfile.open(tmp_path / "0.tar", "a") as tar:
        content = encode_sample(SAMPLE, 1)["json"]
        info = tarfile.TarInfo("00000001.json")
        info.size = len(content)
        tar.addfile(info, io.BytesIO(content))
    with pytest.raises(DataError, match=r"two shapes are named 'shape-0', in 0.tar and 0.tar"):
        ShardSet(tmp_path)


@pytest.mark.parametrize("kind", [RGBA, DEPTH])
def test_images_of_other_writers(kind):
    shape = (37, 29, 4) if kind is RGBA else (37, 29)
    rng = np.random.default_rng(0)
    smooth = np.cumsum(rng.integers(0, 3, shape), axis=1) * (1 if kind is RGBA else 300)
    pixels = smooth.astype(kind.dtype)
    ours = encode_png(pixels)
    np.testing.assert_array_equal(np.array(Image.open(io.BytesIO(ours))), pixels)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    for content in (ours, stream.getvalue()):
        np.testing.assert_array_equal(decode_png(content, (37, 29), kind, "memory"), pixels)
    with pytest.raises(ValueError, match="pixels must be"):
        encode_png(pixels.astype(np.float32))
