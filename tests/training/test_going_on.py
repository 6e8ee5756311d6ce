"""What a resumed run knows of itself: its best, its beginning, the shapes it skipped."""

import json
import math
import shutil

import pytest
import torch

from lsmgeo.data import ShardSet
from lsmgeo.data.shards.shape_transforms import resize_sample, resize_views
from lsmgeo.errors import OptionError
from lsmgeo.models import create, write_weights
from lsmgeo.training import train
from lsmgeo.training.checkpoints import load_latest
from lsmgeo.training.validation import Evaluation
from tests.training.runs import SIZES, changed, configure, run


def test_a_run_that_ends_by_the_clock_keeps_its_last_measure(shards, tmp_path):
    ended = run(configure(shards, steps=None, minutes=0.03, checkpoint_every=1), tmp_path)
    checkpoint = load_latest(tmp_path)
    assert ended.ended == "minutes"
    assert ended.best == ended.step > 0
    assert (checkpoint.step, checkpoint.best) == (ended.step, ended.step)
    assert checkpoint.part("place")["evaluated"] == ended.step


def test_another_evaluation_forgets_the_best_of_the_one_before(shards, tmp_path):
    run(configure(shards, steps=2, evaluate_every=2), tmp_path)
    place = load_latest(tmp_path).part("place")
    assert place["best"] == 2
    ended = run(configure(shards, steps=3, evaluate_every=100, evaluate_shapes=1), tmp_path)
    # Were the first still held, it could only be beaten, and what beats it was measured on half of the shapes.
    assert ended.best == 3


@pytest.mark.parametrize(("value", "before", "better"), [(0.5, None, True), (0.5, math.nan, True), (0.5, 0.6, False)])
def test_anything_is_better_than_no_measure(value, before, better):
    found = Evaluation("iou", {1: value}, {}, 0.1, ())
    assert found.is_better_than(before) is better


def test_a_run_goes_on_without_the_weights_it_began_with(shards, tmp_path):
    model = create("voxel-lsm", preset="tiny", **SIZES)
    write_weights(tmp_path / "begin.safetensors", model)
    config = changed(configure(shards, steps=1), "model", weights=str(tmp_path / "begin.safetensors"))
    run(config, tmp_path / "run")
    (tmp_path / "begin.safetensors").unlink()
    assert run(changed(config, "run", steps=2), tmp_path / "run").step == 2


def test_a_skipped_shape_is_reported_in_the_run(shards, tmp_path):
    copy = shutil.copytree(shards, tmp_path / "shards")
    shard = next(copy.glob("*.tar"))
    first = next(index for index, part in enumerate(ShardSet(copy).splits) if part == "train")
    content = bytearray(shard.read_bytes())
    begin = content.index(b"\x89PNG")
    content[begin : begin + 200] = bytes(200)
    shard.write_bytes(content)
    config = changed(configure(copy, steps=3), "data", on_error="skip", max_bad_fraction=0.5)
    train(config, tmp_path / "run", quiet=True)
    lines = [json.loads(line) for line in (tmp_path / "run" / "bad_samples.jsonl").read_text().splitlines()]
    assert [line["name"] for line in lines] == [f"chair-{first}"]
    assert not (copy / "bad_samples.jsonl").exists()


def test_one_view_is_not_drawn_for_shapes_that_have_differently_many(shards):
    with pytest.raises(OptionError, match=r"loss_views must be 'every' or 'last' .* data.views = \(1, 2\)"):
        configure(shards, loss_views="random")


def test_images_grow_in_evaluation_as_in_training(shards):
    sample = ShardSet(shards).read(0, depth=False, occupancy=None)
    images, _ = resize_views(sample.images[None], type(sample.cameras)(*(item[None] for item in sample.cameras)), 48)
    torch.testing.assert_close(images[0], resize_sample(sample, 48).images, rtol=0, atol=0)
    # Interpolated, not repeated: every second pixel of a row of a repeated image equals its neighbour.
    assert not torch.equal(images[0, ..., 0], images[0, ..., 1])
