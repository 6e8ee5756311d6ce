"""Data sets and orders: the same for any number of workers, resumable anywhere, honest about bad shapes."""

import json
import os
import tarfile

import numpy as np
import pytest
import torch
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader

from lsmgeo.data import EpochSampler, ShapeDataset, ShardSet, collate
from lsmgeo.errors import DataError, OptionError
from tests.data.shapes import assert_equal, write_set

SHAPES = 12
VIEWS = 5
# More workers than processors: loaders warn of it.
pytestmark = [pytest.mark.timeout(120), pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("set")
    write_set(folder, shards=3, each=4, views=VIEWS)
    return folder


def dataset_of(folder, **options):
    return ShapeDataset(ShardSet(folder), **{"occupancy": 8, "views": (1, 4), "seed": 3, **options})


def same(ours, theirs):
    for a, b in zip(pytree.tree_leaves(ours), pytree.tree_leaves(theirs), strict=True):
        if isinstance(b, torch.Tensor):
            torch.testing.assert_close(a, b, rtol=0, atol=0)
        else:
            assert a == b
    return True


def different(ours, theirs):
    return ours.shape != theirs.shape or not torch.equal(ours, theirs)


def views_of(sample, shape):
    """Which views of a shape a sample has, inferred from the cameras."""
    matches = (sample.cameras.intrinsics.numpy()[:, None] == shape.K.astype(np.float32)).all((-2, -1))
    assert (matches.sum(1) == 1).all()
    return matches.argmax(1).tolist()


def test_items_are_views_of_their_shape(tmp_path):
    shapes = write_set(tmp_path, shards=1, each=4, views=VIEWS)
    dataset = dataset_of(tmp_path)
    counts, orders = set(), set()
    for epoch in range(15):
        for index, shape in enumerate(shapes):
            sample = dataset[epoch, index]
            views = views_of(sample, shape)
            assert len(set(views)) == len(views)
            assert_equal(sample, shape, views)
            counts.add(len(views))
            orders.add(tuple(views))
    assert counts == {1, 2, 3, 4}
    assert len(orders) > 40  # of 205
    assert {len(dataset_of(tmp_path, views=2)[0, 1].images)} == {2}
    assert views_of(dataset_of(tmp_path, views=None)[7, 2], shapes[2]) == list(range(VIEWS))


def test_an_item_depends_on_seed_epoch_and_index(folder):
    dataset = dataset_of(folder, views=4)
    first = dataset[2, 5]
    dataset[1, 1], dataset[2, 6]  # what is read between does not matter
    same(dataset[2, 5], first)
    same(dataset_of(folder, views=4)[2, 5], first)
    for other in (dataset[3, 5], dataset_of(folder, views=4, seed=4)[2, 5]):
        assert other.name == first.name
        assert different(other.cameras.intrinsics, first.cameras.intrinsics)
    same(dataset[5], dataset[0, 5])
    assert len(dataset) == SHAPES
    with pytest.raises(IndexError):
        dataset[SHAPES]


@pytest.mark.parametrize("workers", [1, 4])
def test_workers_change_nothing(folder, workers):
    """Three epochs from persistent workers, which copied the data set before the first."""
    expected, came = [], []
    for batches, number in ((expected, 0), (came, workers)):
        sampler = EpochSampler(SHAPES, seed=7)
        dataset = dataset_of(folder, background=folder_of_images(folder))
        loader = DataLoader(
            dataset, 4, sampler=sampler, collate_fn=collate, num_workers=number, persistent_workers=number > 0
        )
        for epoch in range(3):
            sampler.set_epoch(epoch)
            batches += list(loader)
    assert len(expected) == 9
    assert all(same(ours, theirs) for ours, theirs in zip(came, expected, strict=True))
    assert different(expected[0].images, expected[3].images)


def folder_of_images(folder):
    from PIL import Image

    images = folder / "images"
    images.mkdir(exist_ok=True)
    noise = np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8)
    Image.fromarray(noise).save(images / "noise.png")
    return images


def test_orders_are_permutations():
    sampler = EpochSampler(100, seed=1)
    orders = []
    for epoch in range(3):
        sampler.set_epoch(epoch)
        pairs = list(sampler)
        assert {pair[0] for pair in pairs} == {epoch}
        orders.append([pair[1] for pair in pairs])
        assert sorted(orders[-1]) == list(range(100))
        assert sampler.order(epoch).tolist() == orders[-1]
    orders.append([index for _, index in EpochSampler(100, seed=2)])
    assert len(set(map(tuple, orders))) == 4
    # Fixed for good: a run that was saved must resume with later versions too.
    assert EpochSampler(8, seed=1).order(5).tolist() == [index for _, index in EpochSampler(8, seed=1, epoch=5)]
    drawn = np.random.Generator(np.random.PCG64(np.random.SeedSequence([1, 5]))).random(8)
    assert EpochSampler(8, seed=1).order(5).tolist() == sorted(range(8), key=lambda index: drawn[index])
    assert [index for _, index in EpochSampler(4, seed=0, epoch=9, shuffle=False)] == [0, 1, 2, 3]


@pytest.mark.parametrize("world_size", [1, 2, 3])
def test_resumed_at_any_position_the_order_is_the_same(world_size):
    length = 23
    for rank in range(world_size):
        whole = list(EpochSampler(length, seed=4, epoch=6, rank=rank, world_size=world_size))
        for done in range(len(whole) + 1):
            sampler = EpochSampler(length, seed=0, rank=rank, world_size=world_size)
            state = EpochSampler(length, seed=4, epoch=6, position=done * world_size).state_dict()
            assert state == {"epoch": 6, "position": done * world_size, "seed": 4}
            sampler.load_state_dict(json.loads(json.dumps(state)))
            assert list(sampler) == whole[done:]
            assert len(sampler) == len(whole) - done


def test_a_resumed_loader_gives_the_rest(folder):
    dataset = dataset_of(folder)

    def batches(position, workers):
        sampler = EpochSampler(SHAPES, seed=7, epoch=2, position=position)
        return list(DataLoader(dataset, 3, sampler=sampler, collate_fn=collate, num_workers=workers))

    whole = batches(0, 0)
    for done in range(5):
        rest = batches(3 * done, done % 2)
        assert all(same(ours, theirs) for ours, theirs in zip(rest, whole[done:], strict=True))


@pytest.mark.parametrize(("length", "world_size"), [(24, 4), (23, 4), (3, 5), (1, 1)])
def test_ranks_share_an_epoch(length, world_size):
    order = EpochSampler(length, seed=9).order(1).tolist()
    parts = [
        [index for _, index in EpochSampler(length, seed=9, epoch=1, rank=rank, world_size=world_size)]
        for rank in range(world_size)
    ]
    each = -(-length // world_size)
    assert {len(part) for part in parts} == {each}
    together = [part[turn] for turn in range(each) for part in parts]
    assert together[:length] == order
    assert together[length:] == (order * world_size)[: each * world_size - length]


def test_another_number_of_ranks_goes_on_where_the_others_stopped():
    whole = [index for _, index in EpochSampler(24, seed=2)]
    two = [[i for _, i in EpochSampler(24, seed=2, rank=rank, world_size=2)] for rank in range(2)]
    seen = two[0][:6] + two[1][:6]
    rest = [i for rank in range(3) for _, i in EpochSampler(24, seed=2, position=12, rank=rank, world_size=3)]
    assert sorted(seen + rest) == sorted(whole)


@pytest.mark.parametrize(
    "options",
    [{"seed": -1}, {"seed": 0.5}, {"seed": 0, "rank": 1}, {"seed": 0, "rank": -1}, {"seed": 0, "world_size": 0},
     {"seed": 0, "epoch": -1}, {"seed": 0, "position": -1}, {"seed": 0, "shuffle": 1}, {"seed": True},
     {"seed": 0, "length": 0}],
)  # fmt: skip
def test_what_is_no_order(options):
    with pytest.raises(OptionError, match="EpochSampler: "):
        EpochSampler(**{"length": 10, **options})


def test_shapes_are_chosen_by_category_and_split(folder):
    every = dataset_of(folder)
    assert every.names == [f"shape-{number}" for number in range(SHAPES)]
    chairs = dataset_of(folder, categories=["chair"])
    assert chairs.names == ["shape-0", "shape-3", "shape-6", "shape-9"]
    assert chairs[0, 1].name == "shape-3"
    assert dataset_of(folder, split="test").names == ["shape-3", "shape-7", "shape-11"]
    assert dataset_of(folder, split="test", categories={"chair", "lamp"}).names == ["shape-3", "shape-11"]
    with pytest.raises(OptionError, match=r"no shape is of \['sofa'\]; the shards have chair, lamp, table"):
        dataset_of(folder, categories=["chair", "sofa"])
    with pytest.raises(OptionError, match=r"no shape is of \['val'\]; the shards have test, train"):
        dataset_of(folder, split="val")
    with pytest.raises(OptionError, match="no shape is of"):
        dataset_of(folder, categories=[])


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"views": 0}, OptionError, "views"),
        ({"views": (3, 2)}, OptionError, "low <= high"),
        ({"views": (1, 2, 3)}, OptionError, "views must be a number"),
        ({"views": "4"}, OptionError, "views must be a number"),
        ({"views": VIEWS + 1}, DataError, r"set-000000.tar: shape-0 has 5 views; 6 are asked for"),
        ({"seed": -1}, OptionError, "ShapeDataset: seed must be a whole number, at least 0; got int -1"),
        ({"depth": None}, OptionError, "depth"),
        ({"background": "nowhere"}, DataError, "not a folder of backgrounds"),
        ({"on_error": "ignore"}, OptionError, "on_error must be one of 'raise', 'skip'"),
        *(
            ({"max_bad_fraction": value}, OptionError, r"max_bad_fraction must be a share in \[0, 1\]")
            for value in ("x", -1, -1e-9, 1.001, float("nan"))
        ),
    ],
)
def test_what_is_no_data_set(folder, options, error, match):
    with pytest.raises(error, match=match):
        dataset_of(folder, **options)


@pytest.fixture
def damaged(tmp_path):
    """A set of 12 shapes, shape 5 damaged in all its images."""
    write_set(tmp_path, shards=3, each=4, views=VIEWS)
    shards = ShardSet(tmp_path)
    path = shards.path(5)
    content = bytearray(path.read_bytes())
    assert shards.names[5] == "shape-5"
    with tarfile.open(path) as tar:
        for info in tar.getmembers():
            if info.name.startswith("00000005.") and info.name.endswith(".png"):
                content[info.offset_data + 40] ^= 8
    path.write_bytes(content)
    return tmp_path


def test_a_bad_shape_is_reported(damaged):
    dataset = dataset_of(damaged)
    with pytest.raises(DataError, match=r"set-000001.tar: 00000005\.0\d\.png is damaged") as caught:
        dataset[0, 5]
    assert caught.value.path == (damaged / "set-000001.tar").resolve()
    loader = DataLoader(dataset, 4, sampler=EpochSampler(SHAPES, seed=0), collate_fn=collate, num_workers=2)
    with pytest.raises(RuntimeError, match=r"set-000001.tar: 00000005\.0\d\.png is damaged"):
        list(loader)
    assert not (damaged / "bad_samples.jsonl").exists()


def test_another_shape_stands_in_for_a_bad_one(damaged):
    def batches(workers):
        dataset = dataset_of(damaged, on_error="skip", max_bad_fraction=0.1)
        loader = DataLoader(dataset, 4, sampler=EpochSampler(SHAPES, seed=0), collate_fn=collate, num_workers=workers)
        return list(loader)

    expected = batches(0)
    names = [name for batch in expected for name in batch.name]
    assert len(names) == SHAPES
    assert set(names) == {f"shape-{number}" for number in range(SHAPES)} - {"shape-5"}
    for workers in (1, 3):
        assert all(same(ours, theirs) for ours, theirs in zip(batches(workers), expected, strict=True))
    lines = [json.loads(line) for line in (damaged / "bad_samples.jsonl").read_text().splitlines()]
    assert len(lines) == 3  # once for each run
    for line in lines:
        assert (line["name"], line["index"], line["epoch"]) == ("shape-5", 5, 0)
        assert line["path"].endswith("set-000001.tar")
        assert "is damaged" in line["reason"]
    dataset = dataset_of(damaged, on_error="skip", max_bad_fraction=0.1)
    standing_in = {dataset[epoch, 5].name for epoch in range(20)}
    assert len(standing_in) > 4  # of 11
    assert "shape-5" not in standing_in


def test_too_many_bad_shapes_stop_the_run(damaged, tmp_path):
    report = tmp_path / "elsewhere.jsonl"
    dataset = dataset_of(damaged, on_error="skip", bad_samples=report)
    assert dataset[0, 4].name == "shape-4"
    with pytest.raises(DataError, match=r"1 of 12 shapes are bad, more than the 0.001 that max_bad_fraction allows"):
        dataset[0, 5]
    assert len(report.read_text().splitlines()) == 1
    assert not (damaged / "bad_samples.jsonl").exists()
    dataset = dataset_of(damaged, on_error="skip", max_bad_fraction=1, bad_samples=damaged / "no" / "folder")
    with pytest.raises(DataError, match="folder: cannot be written"):
        dataset[0, 5]


@pytest.mark.parametrize("workers", [0, 1])
def test_a_bad_background_is_no_bad_shape(damaged, workers):
    images = folder_of_images(damaged)
    dataset = dataset_of(damaged, on_error="skip", max_bad_fraction=1, background=images)
    (images / "noise.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    for index in (4, 5):  # a good shape, and one that another stands in for
        loader = DataLoader(dataset, sampler=[(0, index)], collate_fn=collate, num_workers=workers)
        with pytest.raises((DataError, RuntimeError), match=r"images/noise\.png: "):
            list(loader)
    report = damaged / "bad_samples.jsonl"
    assert {json.loads(line)["name"] for line in report.read_text().splitlines()} == {"shape-5"}
    with pytest.raises(DataError) as caught:
        dataset[0, 4]
    assert caught.value.path == (images / "noise.png").resolve()


@pytest.mark.parametrize("item", [(0, 1, 2), (), (1,), [0, 1, 2], "a", (0, "a"), (0.5, 1), None])
def test_what_is_no_item(folder, item):
    with pytest.raises(OptionError, match="ShapeDataset: "):
        dataset_of(folder)[item]


def test_a_set_of_bad_shapes_ends(damaged):
    dataset = dataset_of(damaged, on_error="skip", max_bad_fraction=1)
    for path in damaged.glob("*.tar"):
        size = path.stat().st_size
        os.truncate(path, 0)
        os.truncate(path, size)  # zeros
    with pytest.raises(DataError, match="found no shape in the place of shape-3 in 16 tries"):
        dataset[0, 3]
