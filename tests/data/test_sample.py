"""Samples and batches: what is refused, what is filled, and the ways that a batch must survive."""

import pickle

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader

from lsmgeo import data
from lsmgeo.cameras import CameraTensors
from lsmgeo.data import Batch, Sample, check_sample, collate
from lsmgeo.errors import DataError, DeviceError, DTypeError, LsmGeoError, OptionError, ShapeError
from tests.data.shapes import make_shape
from tests.data.writers import make_scene, write_colmap, write_middlebury

SAMPLES = [make_shape(number, views=views).sample() for number, views in enumerate((2, 1, 4))]


def test_a_ragged_batch():
    batch = collate(SAMPLES)
    assert isinstance(batch, Batch)
    assert batch.images.shape == (3, 4, 3, 12, 16)
    assert batch.view_mask.tolist() == [[True, True, False, False], [True, False, False, False], [True] * 4]
    assert batch.name == ("shape-0", "shape-1", "shape-2")
    assert batch.category == ("chair", "table", "lamp")
    assert batch.mesh == tuple(f"meshes/shape-{number}.obj" for number in range(3))
    for b, sample in enumerate(SAMPLES):
        count = len(sample.images)
        for field in ("images", "depth", "mask"):
            rows = getattr(batch, field)[b].numpy()
            np.testing.assert_array_equal(rows[:count], getattr(sample, field).numpy())
            np.testing.assert_array_equal(rows[count:], np.zeros_like(rows[count:]))
        for ours, theirs in zip(batch.cameras, sample.cameras, strict=True):
            expected = np.concatenate([theirs.numpy()] + [theirs.numpy()[:1]] * (4 - count))
            np.testing.assert_array_equal(ours[b].numpy(), expected)
        np.testing.assert_array_equal(batch.occupancy[b].numpy(), sample.occupancy.numpy())


@pytest.mark.parametrize("field", ["depth", "mask", "occupancy"])
def test_a_field_is_there_in_all_samples_or_in_none(field):
    without = [sample._replace(**{field: None}) for sample in SAMPLES]
    batch = collate(without)
    assert getattr(batch, field) is None
    assert batch.images.shape == (3, 4, 3, 12, 16)
    for samples, given, missing in ((without[:1] + SAMPLES[1:], 1, 0), (SAMPLES[:2] + without[2:], 0, 2)):
        with pytest.raises(ShapeError, match=rf"{field} .*samples\[{given}\].* has it, samples\[{missing}\]"):
            collate(samples)


def test_names_may_be_missing():
    batch = collate([sample._replace(mesh=None, category=None) for sample in SAMPLES])
    assert batch.mesh == batch.category == (None, None, None)


def changed(sample, **fields):
    return sample._replace(**fields)


FIRST = SAMPLES[0]
CAMERAS = FIRST.cameras


@pytest.mark.parametrize(
    ("sample", "error", "match"),
    [
        (tuple(FIRST), DTypeError, "Sample"),
        (changed(FIRST, images=None), DTypeError, "images must be a tensor"),
        (changed(FIRST, images=FIRST.images.double()), DTypeError, "images must be of float32"),
        (changed(FIRST, images=FIRST.images[0]), ShapeError, "images must be"),
        (changed(FIRST, images=FIRST.images[:, :2]), ShapeError, "images must be"),
        (changed(FIRST, images=FIRST.images[:0]), ShapeError, "images must be"),
        (changed(FIRST, images=FIRST.images[:1]), ShapeError, r"leading shape \(V,\) = \(1,\); got \(2,\)"),
        (changed(FIRST, images=FIRST.images[..., :-1]), ShapeError, r"images are \(12, 15\).* for \(12, 16\)"),
        (changed(FIRST, cameras=None), DTypeError, "cameras must be"),
        (changed(FIRST, cameras=CAMERAS._replace(height=torch.tensor([12, 11]))), ShapeError, r"for \(11, 16\)"),
        (changed(FIRST, depth=FIRST.depth.double()), DTypeError, "depth must be of float32"),
        (changed(FIRST, depth=FIRST.depth[:, :-1]), ShapeError, r"depth must be \(V, H, W\) = \(2, 12, 16\)"),
        (changed(FIRST, mask=FIRST.depth), DTypeError, "mask must be a bool"),
        (changed(FIRST, mask=FIRST.mask[:1]), ShapeError, "mask must be"),
        (changed(FIRST, occupancy=FIRST.occupancy.float()), DTypeError, "occupancy must be a bool"),
        (changed(FIRST, occupancy=FIRST.occupancy[0]), ShapeError, "occupancy must be"),
        (changed(FIRST, depth=FIRST.depth.to("meta")), DeviceError, "one device"),
        (changed(FIRST, name=None), DTypeError, "name must be a string;"),
        (changed(FIRST, category=3), DTypeError, "category must be a string or None"),
    ],
)
def test_what_no_sample_is(sample, error, match):
    with pytest.raises(error, match=match):
        check_sample(sample)
    with pytest.raises(error, match=r"collate: samples\[1\].*" + match):
        collate([FIRST, sample])


def test_what_makes_no_batch():
    other = make_shape(1, height=13).sample()
    with pytest.raises(ShapeError, match=r"samples\[1\] has \(13, 16\), samples\[0\] \(12, 16\)"):
        collate([FIRST, other])
    with pytest.raises(ShapeError, match=r"\(D, H, W\) must be equal"):
        collate([FIRST, changed(SAMPLES[1], occupancy=torch.ones(9, 9, 9, dtype=torch.bool))])
    single = CameraTensors(CAMERAS[0].float(), CAMERAS[1].float(), *CAMERAS[2:])
    with pytest.raises(DTypeError, match=r"one dtype.*samples\[1\] has torch.float32"):
        collate([FIRST, changed(FIRST, cameras=single)])
    for nothing in ([], None, FIRST):
        with pytest.raises(LsmGeoError, match="at least one Sample"):
            collate(nothing)


def test_a_batch_is_a_pytree():
    batch = collate(SAMPLES)
    leaves, structure = pytree.tree_flatten(batch)
    assert sum(isinstance(leaf, torch.Tensor) for leaf in leaves) == 9
    again = pytree.tree_unflatten(leaves, structure)
    assert isinstance(again, Batch)
    assert isinstance(again.cameras, CameraTensors)
    halved = pytree.tree_map_only(torch.Tensor, lambda tensor: tensor[:1], batch)
    torch.testing.assert_close(halved.images, batch.images[:1], rtol=0, atol=0)
    assert halved.cameras.intrinsics.shape == (1, 4, 3, 3)
    assert halved.name == batch.name


@pytest.mark.parametrize("workers", [0, 2])
def test_a_batch_passes_a_loader(workers):
    loader = DataLoader(SAMPLES, batch_size=2, collate_fn=collate, num_workers=workers)
    batches = list(loader)
    for batch, samples in zip(batches, (SAMPLES[:2], SAMPLES[2:]), strict=True):
        assert isinstance(batch, Batch)
        assert isinstance(batch.cameras, CameraTensors)
        expected = collate(samples)
        for ours, theirs in zip(pytree.tree_leaves(batch), pytree.tree_leaves(expected), strict=True):
            if isinstance(theirs, torch.Tensor):
                torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
            else:
                assert ours == theirs


@pytest.mark.parametrize("form", ["middlebury", "colmap"])
def test_posed_images_become_a_sample(tmp_path, form):
    scene = make_scene(24, 32)
    folder = tmp_path / "temple"
    folder = write_middlebury(scene, folder) if form == "middlebury" else write_colmap(scene, folder, form="text")
    posed = data.open(folder)
    order = [posed.names.index(scene.names[view]) for view in (3, 0)]
    sample = posed.sample(order)
    check_sample(sample)
    assert sample.name == "temple"
    expected = scene.images[[3, 0]].transpose(0, 3, 1, 2) / np.float32(255)
    np.testing.assert_array_equal(sample.images.numpy(), expected)
    np.testing.assert_allclose(sample.cameras.intrinsics.numpy(), scene.K[[3, 0]], atol=1e-6)
    np.testing.assert_allclose(sample.cameras.cam_from_world[:, :3, :3].numpy(), scene.R[[3, 0]], atol=1e-6)
    assert len(posed.sample().images) == 5
    for views in ([], [5], [-1], [0.0], [True]):
        with pytest.raises(OptionError, match="views must be numbers from 0 to 4"):
            posed.sample(views)


def test_images_of_two_sizes_are_no_sample(tmp_path):
    folder = write_middlebury(make_scene(24, 32), tmp_path)
    Image.new("RGB", (30, 24)).save(folder / "v1.png")
    posed = data.open(folder)
    with pytest.raises(ShapeError, match=r"is 24 x 32 .*'v1.png' 24 x 30"):
        posed.sample()
    assert isinstance(posed.sample([1]), Sample)


def test_errors_pass_between_processes():
    error = pickle.loads(pickle.dumps(DataError("some/file", "too short")))
    assert (type(error), error.path, error.reason) == (DataError, "some/file", "too short")
    assert str(error) == "some/file: too short"


def test_the_first_views_of_a_batch():
    batch = collate(SAMPLES)
    some = batch.first_views(2)
    assert torch.equal(some.images, batch.images[:, :2])
    assert torch.equal(some.view_mask, batch.view_mask[:, :2])
    for found, expected in zip(some.cameras, batch.cameras, strict=True):
        assert torch.equal(found, expected[:, :2])
    assert torch.equal(some.occupancy, batch.occupancy)
    with pytest.raises(OptionError, match="views must be a whole number, at least 1; got int 0"):
        batch.first_views(0)
