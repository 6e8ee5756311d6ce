"""What a run is fed with: the same samples however they are read (F11), and what is done to them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools

import numpy as np
import pytest
import torch

from lsmgeo import cameras as camera_tools
from lsmgeo import scenes
from lsmgeo.data import Recipe, Sample, ShardSet, render_set
from lsmgeo.data.shards.shape_transforms import resize_sample
from lsmgeo.errors import DataError, OptionError
from lsmgeo.scenes import synthetic13
from lsmgeo.training.batches import (
    Need,
    categories_of,
    endless_order,
    open_shapes,
    training_batches,
    validation_batches,
)
from lsmgeo.training.config import DataConfig

CPU = torch.device("cpu")
VOXELS, DEPTH = Need(32, 16, False), Need(32, None, True)
SYNTHETIC = DataConfig(source="synthetic-13", shapes=39, pool=4, views=(1, 3), pose_noise=5.0, background="random")


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shards")
    render_set("synthetic-13", folder, Recipe(0, 4, 32, (16,)), shapes=26, jobs=1)
    return folder


@pytest.fixture(scope="module")
def stored(shards):
    return DataConfig(source=str(shards), views=(1, 3), pose_noise=5.0, background="random")


def opened(config, need=VOXELS, *, is_training=True, seed=5, views=None):
    return open_shapes(config, need, seed=seed, device=CPU, is_training=is_training, views=views)


def batches(shapes, count=3, *, start=0, workers=0, batch=4, rank=0, processes=1):
    options = {"seed": 5, "start": start, "batch": batch, "workers": workers, "device": CPU}
    with contextlib.closing(training_batches(shapes, **options, rank=rank, processes=processes)) as items:
        return list(itertools.islice(items, count))


def assert_equal(found, expected):
    assert (found.name, found.category) == (expected.name, expected.category)
    leaves = [tree_leaves(batch) for batch in (found, expected)]
    for ours, theirs in zip(*leaves, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


def tree_leaves(batch):
    return [leaf for leaf in torch.utils._pytree.tree_leaves(batch) if isinstance(leaf, torch.Tensor)]


@pytest.mark.filterwarnings("ignore:This DataLoader will create 4 worker:UserWarning")
@pytest.mark.parametrize("workers", [1, 4])
def test_workers_change_nothing(stored, workers):
    expected = batches(opened(stored))
    for found, one in zip(batches(opened(stored), workers=workers), expected, strict=True):
        assert_equal(found, one)


def test_workers_render_the_same():
    for found, one in zip(batches(opened(SYNTHETIC), 2, workers=2), batches(opened(SYNTHETIC), 2), strict=True):
        assert_equal(found, one)


@pytest.mark.parametrize("workers", [0, 1])
def test_rendering_all_views_at_once_is_the_same(workers):
    """What a GPU does, on the CPU: scenes come from the workers, shapes have two or three lights, views are ragged."""
    one_by_one = opened(SYNTHETIC, Need(32, 16, True))
    render = functools.partial(one_by_one.collate, at_once=True)
    at_once = dataclasses.replace(one_by_one, collate=render, on_device=True)
    for found, expected in zip(batches(at_once, 2, workers=workers), batches(one_by_one, 2), strict=True):
        assert not expected.view_mask.all()
        assert_equal(found, expected)


@pytest.mark.parametrize("start", [0, 4, 20, 24])
def test_reading_goes_on_from_any_sample(stored, start):
    shapes = opened(stored)
    whole = [name for batch in batches(shapes, 12) for name in batch.name]
    assert [name for batch in batches(shapes, 3, start=start) for name in batch.name] == whole[start : start + 12]
    epoch = len(shapes)
    assert sorted(whole[:epoch]) == sorted(set(whole))  # every shape once an epoch
    assert whole[:epoch] != whole[epoch : 2 * epoch]


def test_processes_share_a_step(stored):
    shapes = opened(stored)
    together = [name for batch in batches(shapes, 2, batch=4) for name in batch.name]
    parts = [
        [name for batch in batches(shapes, 2, batch=2, rank=rank, processes=2) for name in batch.name]
        for rank in (0, 1)
    ]
    assert sorted(parts[0] + parts[1]) == sorted(together)
    assert sorted(parts[0][:2] + parts[1][:2]) == sorted(together[:4])  # also in every single step


def test_a_stream_never_ends_and_every_epoch_has_its_own_order():
    stream = endless_order(5, seed=1, start=3, batch=4)
    items = list(itertools.chain.from_iterable(itertools.islice(stream, 6)))
    assert [epoch for epoch, _ in items] == [0] * 2 + [1] * 5 + [2] * 5 + [3] * 5 + [4] * 5 + [5] * 2
    orders = [[index for epoch, index in items if epoch == number] for number in (1, 2, 3, 4)]
    assert all(sorted(order) == list(range(5)) for order in orders)
    assert len({tuple(order) for order in orders}) > 1


def test_views_are_ragged_and_in_random_order(stored):
    counts, first = set(), set()
    for batch in batches(opened(stored), 6):
        counts |= set(batch.view_mask.sum(1).tolist())
        first |= {round(float(value), 3) for value in batch.cameras.cam_from_world[:, 0, 0, 0]}
    assert counts == {1, 2, 3}
    assert len(first) > 12  # not always the same view first


def test_pose_noise_turns_cameras_about_the_object(stored, shards):
    quiet = batches(opened(dataclasses.replace(stored, pose_noise=0.0)), 1)[0]
    noisy = batches(opened(stored), 1)[0]
    torch.testing.assert_close(noisy.images, quiet.images, rtol=0, atol=0)
    R, S = (batch.cameras.cam_from_world[..., :3, :3].double() for batch in (noisy, quiet))
    turned = (R.transpose(-1, -2) * S.transpose(-1, -2)).sum((-1, -2))
    angles = torch.rad2deg(torch.acos(((turned - 1) / 2).clamp(-1, 1)))[quiet.view_mask]
    assert 0.05 < float(angles.max()) < 5.001
    assert len(set(angles.tolist())) > 3
    centers = [batch.cameras.cam_from_world[..., :3, 3] for batch in (noisy, quiet)]
    torch.testing.assert_close(*centers, rtol=1e-5, atol=1e-5)  # the origin stays where it was
    held_back = opened(stored, is_training=False)
    plain = opened(dataclasses.replace(stored, pose_noise=0.0), is_training=False)
    both = [next(validation_batches(s, seed=0, count=2, batch=2, device=CPU)) for s in (held_back, plain)]
    assert_equal(*both)


def test_evaluation_sees_every_shape_once_whatever_the_processes(shards):
    config = DataConfig(source=str(shards), views=2)
    shapes = opened(config, is_training=False, views=3)
    expected = sorted(
        name for name, split in zip(ShardSet(shards).names, ShardSet(shards).splits, strict=True) if split == "val"
    )
    for processes in (1, 2, 3):
        names = []
        for rank in range(processes):
            for batch in validation_batches(
                shapes, seed=0, count=99, batch=2, device=CPU, rank=rank, processes=processes
            ):
                assert batch.view_mask.sum(1).tolist() == [3] * len(batch.name)
                names += batch.name
        assert sorted(names) == expected


def test_rendering_when_needed_is_what_rendering_before_gives(shards):
    """The same shape, cameras and views: colours differ by a rounding to bytes, depth and voxels do not."""
    config = DataConfig(source="synthetic-13", shapes=26, pool=4, views=4)
    need = Need(32, 16, True)
    batch = batches(opened(config, need), 1)[0]
    shards = ShardSet(shards)
    for index, name in enumerate(batch.name):
        stored = shards.read(shards.names.index(name), occupancy=16)
        order = [
            int((stored.cameras.cam_from_world - pose).abs().sum((1, 2)).argmin())
            for pose in batch.cameras.cam_from_world[index]
        ]
        assert sorted(order) == [0, 1, 2, 3]
        torch.testing.assert_close(batch.images[index], stored.images[order], rtol=0, atol=0.5001 / 255)
        assert torch.equal(batch.mask[index], stored.mask[order])
        torch.testing.assert_close(batch.depth[index], stored.depth[order], rtol=0, atol=1e-3)
        assert torch.equal(batch.occupancy[index], stored.occupancy)


def test_categories_of_a_split():
    assert categories_of("all") is None
    assert categories_of("first") == synthetic13.CLASS_SPLITS["first"]
    assert categories_of("chair") == ("chair",)
    config = DataConfig(source="synthetic-13", shapes=39, pool=4, views=1, categories="first")
    found = {name for batch in batches(opened(config), 6) for name in batch.category}
    assert found == set(synthetic13.CLASS_SPLITS["first"])


def test_a_limit_takes_the_first_shapes(shards):
    config = DataConfig(source=str(shards), views=1, limit=3)
    assert len({name for batch in batches(opened(config), 6) for name in batch.name}) == 3


@pytest.mark.parametrize("size", [16, 64])
def test_another_size_of_images_keeps_the_geometry(size):
    """A ball, rendered large, resized: it stays where the resized cameras see it."""
    ball = scenes.Scene([scenes.sphere((0.1, 0.05, 0), 0.4)])
    cameras = camera_tools.orbit(torch.tensor([30.0]), 10.0, 2.0, focal_length=60.0, height=32, width=32)
    lights = synthetic13.random_lights(np.random.default_rng(0))
    batched = type(cameras)(*(torch.as_tensor(value)[None] for value in cameras))
    picture = scenes.render([ball], batched, lights)
    sample = Sample(picture.images[0], cameras, picture.depth[0], picture.mask[0], None, None, None, "ball")
    found = resize_sample(sample, size)
    assert found.images.shape[2:] == found.depth.shape[1:] == found.mask.shape[1:] == (size, size)
    assert found.cameras.height.tolist() == found.cameras.width.tolist() == [size]
    batched = type(cameras)(*(torch.as_tensor(value)[None] for value in found.cameras))
    expected = scenes.render([ball], batched, lights)
    both = found.mask & expected.mask[0]
    centers = [mask.nonzero()[:, 1:].double().mean(0) for mask in (found.mask, expected.mask[0])]
    torch.testing.assert_close(*centers, rtol=0, atol=0.15)  # half a pixel would be a mistake
    assert int(both.sum()) > 0.9 * int(expected.mask.sum())
    assert float((found.depth - expected.depth[0])[both].abs().median()) < 0.01
    assert bool((found.depth > 0).eq(found.mask).all())


@pytest.mark.parametrize(
    ("changes", "need", "message"),
    [
        ({}, Need(32, 64, False), "no voxels at the model's resolution 64: {shards} has 16"),
        ({"categories": ("chairs",)}, VOXELS, "categories: no shape is of"),
        ({"split": "training"}, VOXELS, "split: no shape is of"),
        ({"source": "synthetic-13", "categories": "chairs", "views": 1}, VOXELS, "categories must be of airplane"),
        ({"source": "synthetic-13", "shapes": 1, "views": 1}, VOXELS, "of synthetic-13 is of split 'train'"),
        ({"views": 9}, VOXELS, "views; 9 are asked for"),
    ],
)
def test_what_a_set_lacks_is_reported_at_once(shards, changes, need, message):
    config = DataConfig(**{"source": str(shards), "views": 1, **changes})
    with pytest.raises((OptionError, DataError)) as caught:
        opened(config, need)
    assert message.format(shards=shards) in str(caught.value)


def test_shards_without_depth_are_reported(tmp_path):
    render_set("synthetic-13", tmp_path, Recipe(0, 1, 16, (16,), depth=False), shapes=13, jobs=1)
    with pytest.raises(OptionError, match="data: source has no depth, which the model needs"):
        opened(DataConfig(source=str(tmp_path), views=1), DEPTH)
