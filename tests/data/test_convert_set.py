"""Trees of rendered objects become shards: nothing is lost, bad objects are left out, and runs can be resumed."""

import hashlib
import json
import shutil

import joblib
import numpy as np
import pytest
import torch
from PIL import Image

from lsmgeo import cli, data
from lsmgeo.data.shards.convert_set import read_splits
from lsmgeo.data.shards.shape_sources import split_by_name
from lsmgeo.errors import DataError, OptionError
from tests.data.hostile import TRIALS, judged, mutated
from tests.data.release_writers import CENTRE, R2N2_SCALE, RADIUS, write_lsm, write_r2n2
from tests.fuzz.forked import outcomes

CHAIR, CAR = "03001627", "02958343"
OBJECTS = [(CAR, "m0"), (CHAIR, "m0"), (CHAIR, "m1"), (CHAIR, "u_2-x")]  # in the order of their paths
NAMES = [f"{synset}/{model}" for synset, model in OBJECTS]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("release") / "release"
    for synset, model in OBJECTS:
        write_lsm(root, views=2, synset=synset, model=model)
    return root


@pytest.fixture
def tree(written, tmp_path):
    """A copy to damage."""
    return shutil.copytree(written, tmp_path / "release")


def contents(folder):
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_the_lsm_release_becomes_shards(written, tmp_path):
    made = data.convert_set(written, tmp_path / "set", per_shard=3, jobs=1)
    assert (made.shapes, made.kept, made.skipped) == (4, 0, ())
    assert [path.name for path in made.shards] == ["release-000000.tar", "release-000001.tar"]
    shards = data.ShardSet(tmp_path / "set")
    assert shards.names == NAMES
    for index in (0, 3):
        synset, model = OBJECTS[index]
        folder = written / "renders" / synset / model
        for side in (32, 64):
            expected = data.read_lsm(folder, voxels=side).sample()
            sample = shards.read(index, occupancy=side)
            assert torch.equal(sample.occupancy, expected.occupancy)
        assert sample.category == ("car" if synset == CAR else "chair")
        assert torch.equal(sample.mask, expected.mask)
        # Behind the object a shard's colour is the reader's to choose.
        error = (sample.images - expected.images).abs() * expected.mask[:, None]
        assert float(error.max()) < 0.5 / 255 + 1e-6
        torch.testing.assert_close(sample.depth, expected.depth, rtol=0, atol=2.6e-5)
        torch.testing.assert_close(sample.cameras.intrinsics.double(), expected.cameras.intrinsics, rtol=0, atol=1e-5)
        torch.testing.assert_close(
            sample.cameras.cam_from_world.double(), expected.cameras.cam_from_world, rtol=0, atol=1e-6
        )
    dataset = data.ShapeDataset(shards, views=2, occupancy=32)
    assert len(dataset) == 4


def test_it_is_resumed_and_the_same_from_any_number_of_workers(written, tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    data.convert_set(written, one, per_shard=2, jobs=1)
    with joblib.parallel_config("multiprocessing"):
        data.convert_set(written, other, per_shard=2, jobs=2)
    assert contents(one) == contents(other)
    first, second = (one / f"release-00000{number}.tar" for number in range(2))
    first.write_bytes(b"damaged")
    (second.with_suffix(".json")).unlink()
    assert data.convert_set(written, one, per_shard=2, jobs=1).kept == 0
    assert contents(one) == contents(other)
    assert data.convert_set(written, one, per_shard=2, jobs=1).kept == 2
    with pytest.raises(DataError, match="other settings"):
        data.convert_set(written, one, per_shard=2, jobs=1, depth=False)
    data.convert_set(written, one, per_shard=2, jobs=1, depth=False, voxels=(64,), overwrite=True)
    sample = data.ShardSet(one).read(0, depth=False, occupancy=64)
    assert sample.occupancy.shape == (64, 64, 64)


def test_a_change_of_any_file_makes_its_shard_again(tree, tmp_path):
    data.convert_set(tree, tmp_path / "set", per_shard=2, jobs=1)
    image = tree / "renders" / CAR / "m0" / "render_1.png"
    Image.fromarray(np.asarray(Image.open(image)) // 2 * 2).save(image)
    assert data.convert_set(tree, tmp_path / "set", per_shard=2, jobs=1).kept == 1


def test_objects_that_cannot_be_used_are_left_out(tree, tmp_path):
    """The file of one kills its parser; the others are there."""
    bad = tree / "renders" / CHAIR / "m0" / "camera_1.mat"
    content = bytearray(bad.read_bytes())
    at = content.index(b"\x09\0\0\0\x48\0\0\0")
    content[at] = 200
    bad.write_bytes(bytes(content))
    deep = tree / "renders" / CHAIR / "m1" / "depth_0.png"
    Image.fromarray(np.full((56, 56), 60_000, np.uint16)).save(deep)
    made = data.convert_set(tree, tmp_path / "set", jobs=1)
    assert made.shapes == 2
    reasons = dict(made.skipped)
    assert "crashed its parser" in reasons[str(bad)]
    assert "depth beyond" in reasons[str(deep.parent)]
    assert data.ShardSet(tmp_path / "set").names == [NAMES[0], NAMES[3]]
    again = data.convert_set(tree, tmp_path / "set", jobs=1)
    assert again.kept == 1
    assert {path for path, _ in again.skipped} == {str(bad.parent), str(deep.parent)}


@pytest.mark.parametrize(
    ("lost", "match"),
    [
        ("voxels/modelVoxels64/02958343/m0.mat", "lacks voxels"),
        ("renders/02958343/m0/depth_1.png", "lacks the depth"),
        ("renders/02958343/m0/render_*.png", "must hold render_0.png"),
        ("renders/02958343/m0/camera_1.mat", "no such file"),
    ],
)
def test_what_an_object_must_have(tree, tmp_path, lost, match):
    for file in tree.glob(lost):
        file.unlink()
    made = data.convert_set(tree, tmp_path / "set", jobs=1)
    assert made.shapes == 3
    ((_, reason),) = made.skipped
    assert match in reason


def test_an_empty_tree_and_strange_names(tree, tmp_path):
    with pytest.raises(DataError, match="not a folder"):
        data.convert_set(tmp_path / "nowhere", tmp_path / "set", jobs=1)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="holds no renders"):
        data.convert_set(tmp_path / "empty", tmp_path / "set", jobs=1)
    with pytest.raises(OptionError, match="convert_set: jobs"):
        data.convert_set(tree, tmp_path / "set", jobs=0)
    with pytest.raises(OptionError, match="convert_set: shapes"):
        data.convert_set(tree, tmp_path / "set", jobs=1, shapes=0)
    assert data.convert_set(tree, tmp_path / "set", jobs=1, shapes=1).shapes == 1
    (tree / "renders" / CHAIR / "a b").mkdir()
    with pytest.raises(DataError, match="an object with an invalid name"):
        data.convert_set(tree, tmp_path / "other", jobs=1)
    shutil.rmtree(tree / "renders" / CHAIR)
    shutil.rmtree(tree / "voxels")
    with pytest.raises(DataError, match=r"no shape that can be used.*lacks voxels") as caught:
        data.convert_set(tree, tmp_path / "other", jobs=1)
    assert caught.value.path == tree


SPLITS = {CHAIR: {"name": "chair", "train": ["m0"], "val": ["m1"], "test": []}, CAR: {"test": ["m0", "other"]}}


def test_published_splits(written, tmp_path):
    file = tmp_path / "splits.json"
    file.write_text(json.dumps(SPLITS))
    made = data.convert_set(written, tmp_path / "set", splits=file, jobs=1)
    ((path, reason),) = made.skipped
    assert path.endswith("u_2-x")
    assert "is in no part" in reason
    for split, names in (("train", [NAMES[1]]), ("val", [NAMES[2]]), ("test", [NAMES[0]])):
        assert data.ShapeDataset(data.ShardSet(tmp_path / "set"), split=split, views=1).names == names
    data.convert_set(written, tmp_path / "named", jobs=1)
    shards = data.ShardSet(tmp_path / "named")
    for name in NAMES:
        assert name in data.ShapeDataset(shards, split=split_by_name(name), views=1).names


def test_the_command(written, tmp_path, capsys):
    file = tmp_path / "splits.json"
    file.write_text(json.dumps(SPLITS))
    out = tmp_path / "set"
    arguments = ["convert", str(written), "--to", "shards", "--out", str(out), "--splits", str(file), "--jobs", "1"]
    assert cli.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "objects:  3\n" in printed
    assert f"shards:   1 in {out.resolve()}" in printed
    assert "skipped:  1 objects that cannot be used" in printed
    assert "is in no part of" in printed
    file.write_text("{")
    assert cli.main(arguments) == 2
    assert f"lsmgeo: error: {file}: is not JSON" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "is not JSON"),
        ("[]", "JSON object"),
        ("[" * 100_000, "is not JSON"),
        ('{"a": 1}', "must be a synset"),
        ('{"../a": {}}', "must be a synset"),
        ('{"": {}}', "must be a synset"),
        ('{"a": {"other": []}}', "must be a synset"),
        ('{"a": {"train": "b"}}', "must be a list"),
        ('{"a": {"train": {"b": 1}}}', "must be a list"),
        ('{"a": {"train": ["../../etc"]}}', "not an identifier of a model"),
        ('{"a": {"train": ["b\\u0000"]}}', "not an identifier of a model"),
        ('{"a": {"train": [1]}}', "not an identifier of a model"),
        ('{"a": {"train": [NaN]}}', "is not JSON"),
        ('{"a": {"train": ["' + "b" * 129 + '"]}}', "not an identifier of a model"),
        ('{"a": {"train": ["b"], "test": ["b"]}}', "in two parts"),
        ('{"a": {}, "a": {}}', "twice"),
        (" " * (1 << 25), "larger than the limit"),
    ],
)
def test_splits_that_lie_are_refused(tmp_path, text, match):
    file = tmp_path / "splits.json"
    file.write_text(text)
    with pytest.raises(DataError, match=match) as caught:
        read_splits(file)
    assert caught.value.path == file


def test_damaged_splits_are_refused_or_read(tmp_path):
    original = json.dumps(SPLITS).encode()
    rng = np.random.default_rng(0)
    file = tmp_path / "splits.json"

    def judge(content):
        file.write_bytes(content)
        return judged(lambda: read_splits(file))

    results = outcomes([mutated(rng, original) for _ in range(TRIALS)], judge)
    assert set(results) == {"read", "refused"}, set(results)
    assert results.count("refused") > TRIALS // 2


@pytest.mark.parametrize("apart", [False, True])
def test_r2n2_becomes_shards_of_the_unit_cube(tmp_path, apart):
    home = write_r2n2(tmp_path / "tree", apart=apart)
    write_r2n2(tmp_path / "tree", apart=apart, model="other")
    made = data.convert_set(tmp_path / "tree", tmp_path / "set", jobs=1)
    assert (made.shapes, made.skipped) == (2, ())
    shards = data.ShardSet(tmp_path / "set")
    assert shards.names == [f"{CHAIR}/a1b2c3", f"{CHAIR}/other"]
    sample = shards.read(0, depth=False, occupancy=32)
    line = (torch.arange(32) + 0.5) / 32 - 0.5
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    centers = torch.stack([x, y, z], -1).double() * R2N2_SCALE
    inside = torch.linalg.norm(centers - torch.from_numpy(CENTRE), dim=-1) <= RADIUS
    assert torch.equal(sample.occupancy, inside)
    # The ball of the smaller world, seen by the cameras scaled with it, has the silhouettes of the files.
    v, u = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1).double()
    for view, mask in enumerate(sample.mask):
        K, E = sample.cameras.intrinsics[view].double(), sample.cameras.cam_from_world[view].double()
        rays = torch.nn.functional.normalize(pixels @ torch.linalg.inv(K).T @ E[:3, :3], dim=-1)
        offset = -E[:3, :3].T @ E[:3, 3] - torch.from_numpy(CENTRE) / R2N2_SCALE
        miss = (offset - (rays @ offset)[..., None] * rays).norm(dim=-1)
        assert int(((miss <= RADIUS / R2N2_SCALE) != mask).sum()) <= 1  # cameras of a shard are single precision
    assert sample.category == "chair"
    with pytest.raises(DataError, match=r"must have voxels of the resolutions \(64,\); found \(32,\)"):
        data.convert_set(tmp_path / "tree", tmp_path / "fine", jobs=1, voxels=(64,), on_error="raise")
    (home / "rendering" / "03.png").unlink()
    made = data.convert_set(tmp_path / "tree", tmp_path / "set", jobs=1)
    assert made.shapes == 1
    assert made.skipped[0][0].endswith("03.png")
