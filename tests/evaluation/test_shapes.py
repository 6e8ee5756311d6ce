"""What is evaluated on: the same shapes and views, however many are asked for and however they are stored."""

import numpy as np
import pytest
import torch

from lsmgeo.cameras import stack
from lsmgeo.data import Recipe, ShardSet, render_set
from lsmgeo.data.sample import first_views
from lsmgeo.data.shards.shape_transforms import resize_views
from lsmgeo.errors import DataError, OptionError
from lsmgeo.evaluation import open_shapes
from lsmgeo.evaluation.held_out_shapes import batches, noise_of
from lsmgeo.scenes import synthetic13

READ = {"resolution": 16, "depth": True, "background": "white"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("set")
    render_set("synthetic-13", made, Recipe(0, 20, 24, (16,)), shapes=4, jobs=1)
    return made


def test_shapes_rendered_as_needed_are_those_of_shards(folder):
    shards = open_shapes(folder, size=24)
    rendered = open_shapes(None, size=24, shapes=400)
    there = {rendered.read(index, 1, **READ).name: index for index in range(2)}
    name = shards.read(0, 1, **READ).name
    assert name in there
    one, other = shards.read(0, 3, **READ), rendered.read(there[name], 3, **READ)
    torch.testing.assert_close(one.images, other.images, atol=0.6 / 255, rtol=0)
    torch.testing.assert_close(one.cameras.cam_from_world, other.cameras.cam_from_world)
    torch.testing.assert_close(one.depth, other.depth, atol=1e-3, rtol=0)
    assert torch.equal(one.occupancy, other.occupancy)
    assert torch.equal(one.mask, other.mask)
    behind = {**READ, "background": "random"}
    one, other = shards.read(0, 3, **behind), rendered.read(there[name], 3, **behind)
    torch.testing.assert_close(one.images, other.images, atol=0.6 / 255, rtol=0)
    assert float((one.images - shards.read(0, 3, **READ).images)[:, :, 0, 0].abs().max()) > 0.05


def test_the_first_views_do_not_depend_on_their_number_and_follow_from_the_seed(folder):
    shapes = open_shapes(folder, size=24)
    few, more = shapes.read(0, 2, **READ), shapes.read(0, 5, **READ)
    assert torch.equal(few.images, more.images[:2])
    assert not torch.equal(few.images, open_shapes(folder, size=24, seed=1).read(0, 2, **READ).images)
    in_order = ShardSet(folder).read(ShardSet(folder).names.index(few.name), occupancy=None)
    assert not torch.equal(in_order.images[:5], more.images)


def test_only_test_shapes_are_taken_in_turn_of_the_categories():
    shapes = open_shapes(None, size=16, shapes=20)
    assert shapes.categories == [*synthetic13.CATEGORIES, *tuple(synthetic13.CATEGORIES)[:7]]
    assert {synthetic13.split(0, index) for index in shapes.source.numbers} == {"test"}
    assert open_shapes(None, size=16, shapes=30).source.numbers[:20] == shapes.source.numbers
    some = open_shapes(None, size=16, shapes=4, categories=("lamp", "car"))
    assert some.categories == ["car", "lamp", "car", "lamp"]


def test_shards_are_filtered_by_split_and_told_when_nothing_is_left(folder):
    shards = ShardSet(folder)
    for split in ("train", "test"):
        shapes = open_shapes(folder, size=24, split=split)
        assert sorted(shapes.indices) == [i for i, part in enumerate(shards.splits) if part == split]
    with pytest.raises(OptionError, match="is of the split 'test' and the categories"):
        open_shapes(folder, size=24, categories=("boat",))
    with pytest.raises(DataError):
        open_shapes(folder / "nowhere", size=24)
    with pytest.raises(OptionError, match="split must be one of 'train', 'val', 'test'; got str 'tset'"):
        open_shapes(None, size=24, split="tset")
    with pytest.raises(OptionError, match="shapes"):
        open_shapes(None, size=24, shapes=0)


def test_batches_hold_all_shapes_once(folder):
    shapes = open_shapes(folder, size=24, split="train")
    names = [name for batch in batches(shapes, 2, 2, resolution=None) for name in batch.name]
    assert sorted(names) == sorted(shapes.source.names[index] for index in shapes.indices)


def test_other_sizes_keep_the_camera_s_view(folder):
    sample = open_shapes(folder, size=24).read(0, 2, **READ)
    images, cameras = resize_views(sample.images[None], stack([sample.cameras]), 12)
    torch.testing.assert_close(images[0, :, :, 3, 4], sample.images[:, :, 6:8, 8:10].mean((-2, -1)))
    torch.testing.assert_close(cameras.intrinsics[0, :, 0, 0], sample.cameras.intrinsics[:, 0, 0] / 2)
    sized = open_shapes(folder, size=24).at(12).read(0, 2, **READ)
    torch.testing.assert_close(sized.images, images[0])
    assert sized.depth.shape == (2, 12, 12)
    assert tuple(first_views(cameras, 1).intrinsics.shape) == (1, 1, 3, 3)


def test_noise_belongs_to_a_shape():
    draws = [torch.rand(3, generator=noise_of(seed, name)) for seed, name in ((0, "a"), (0, "a"), (0, "b"), (1, "a"))]
    assert torch.equal(draws[0], draws[1])
    assert len({float(draw[0]) for draw in draws}) == 3
    assert np.isfinite(draws[0].numpy()).all()
